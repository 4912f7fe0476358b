"""Metrics, segments, manoeuvres, and statistics of drives with and without ground truth.

All are functions of state tracks and signals as arrays; :mod:`~.statistics` decides comparisons and requirements. It
must not import an estimator or the nominal model, so that a score does not depend on how an estimate was made.
"""
