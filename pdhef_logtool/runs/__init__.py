"""Logs through estimators to outputs: one drive (:mod:`~.run_drive`) and a fleet (:mod:`~.fleet`).

It prepares, estimates, scores, selects, judges and reports a drive with the functions of the packages below, with no
algorithm except the selection. It must not import :mod:`~pdhef_logtool.cli`.
"""
