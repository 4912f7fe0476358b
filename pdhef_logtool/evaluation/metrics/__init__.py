"""Metrics: formulas over columns of a drive. Files, terminal, pages, plans and documentation use these entries.

To add a metric, write a file that exports ``METRICS`` (:class:`~.metric.Metric`; the words of our own are in
``metrics.toml``) and add its name to ``MODULES`` of :mod:`~.metric`. Example, ``interval_width.py``::

    from pdhef_logtool.evaluation.metrics.errors import errors_of_drive
    from pdhef_logtool.evaluation.metrics.metric import Metric
    from pdhef_logtool.evaluation.track_errors import NORMAL_95

    METRICS = (
        Metric(
            "interval_width",
            "interval width",
            "mean width of the 95 % confidence interval",
            columns=errors_of_drive,
            formula=lambda std: 2.0 * NORMAL_95 * float(std.mean()),
            over=("std",),
            best="lower",
            of_truth=True,
            terminal=("sideslip_rad",),
        ),
    )
"""

from pdhef_logtool.evaluation.metrics.metric import (
    EvaluatedDrive as EvaluatedDrive,
    MetricRow as MetricRow,
    evaluate_drive as evaluate_drive,
)
