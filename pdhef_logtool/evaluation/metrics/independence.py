"""``not_independent``: mark of signals with an estimator input as their ground truth."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pdhef_logtool.evaluation.metrics.metric import Columns, EvaluatedDrive, described, mean
from pdhef_logtool.evaluation.track_errors import scorable
from pdhef_logtool.evaluation.units import SCORED_SIGNALS

NOT_INDEPENDENT = "not_independent"


def _marks(drive: EvaluatedDrive) -> Iterator[Columns]:
    if drive.truth is None:
        return
    for signal in sorted({*SCORED_SIGNALS} & {*drive.dependent}):
        has_truth = scorable(drive.truth, signal, drive.low_speed_m_s)
        for name in drive.tracks:
            yield Columns(name, signal, {NOT_INDEPENDENT: np.where(has_truth, 1.0, np.nan)})


METRICS = described(_marks, not_independent=mean)
