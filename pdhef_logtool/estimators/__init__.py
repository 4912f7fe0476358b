"""Estimators: from aligned signals to state tracks, in pieces with carried state.

:mod:`~.table` lists them, :mod:`~.latency_compensation` runs them, :mod:`~.causality_check` rejects one that uses later
samples. Their inputs contain no ground truth, and this package must not import anything that reads it.
"""
