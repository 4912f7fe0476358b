"""Metrics: each is registered by one file, from which files, terminal, pages, plans and documentation derive it.

A new metric is a file that exports ``METRICS`` (:class:`~.metric.Metric`) and its name in ``MODULES`` of
:mod:`~.registry`. ``interval_width.py`` would be::

    from pdhef_logtool.evaluation.metrics.metric import Metric, SignalBlock, mean_by_segment
    from pdhef_logtool.evaluation.track_errors import NORMAL_95


    def _width(block: SignalBlock):
        return None if block.std is None else 2.0 * NORMAL_95 * block.std


    METRICS = (
        Metric(
            "interval_width",
            "interval width",
            "mean width of the 95 % confidence interval",
            mean_by_segment("interval_width", _width),
            best="lower",
            terminal=("sideslip_rad",),
        ),
    )
"""

from pdhef_logtool.evaluation.metrics.metric import ALL, MetricRow
from pdhef_logtool.evaluation.metrics.scoring import Scorer, score_track
from pdhef_logtool.evaluation.track_errors import NORMAL_95, signal_error
from pdhef_logtool.evaluation.units import SCORED_SIGNALS

__all__ = ["ALL", "NORMAL_95", "SCORED_SIGNALS", "MetricRow", "Scorer", "score_track", "signal_error"]
