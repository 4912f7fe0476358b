"""``not_independent``: the mark of signals whose ground truth is one of the estimators' inputs."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace

from pdhef_logtool.evaluation.metrics.metric import ALL, Metric, MetricRow

NOT_INDEPENDENT = "not_independent"


def marked(rows: Sequence[MetricRow], dependent: Collection[str]) -> list[MetricRow]:
    """Return the rows of one estimator with those of dependent signals marked, and a row for each such signal."""
    signals = sorted({r.signal for r in rows} & {*dependent})
    rows_out = [replace(r, independent=False) if r.signal in signals else r for r in rows]
    for signal in signals:
        of_signal = [r for r in rows if r.signal == signal]
        n = max(r.n for r in of_signal)
        rows_out.append(
            MetricRow(of_signal[0].log, of_signal[0].estimator, signal, ALL, NOT_INDEPENDENT, 1.0, "1", n, False)
        )
    return rows_out


METRICS = (
    Metric(
        NOT_INDEPENDENT,
        "not independent",
        "1 where the ground truth of this signal is one of the estimators' inputs: keep it out of rankings",
        None,
        unit="1",
    ),
)
