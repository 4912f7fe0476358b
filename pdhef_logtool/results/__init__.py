"""Outputs of a drive and finished runs: tables, tracks and reports, written, read back, compared and searched.

Each sink is a function of the whole drive; finished runs are read by :mod:`~.opened_run`, which verifies their
checksums. It must not import an estimator or the nominal model.
"""
