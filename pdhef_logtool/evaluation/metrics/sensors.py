"""Duration and distance of each segment of a drive (estimator ``sensors``), and the mark ``not_independent``."""

from collections.abc import Iterator

import numpy as np

from pdhef_logtool.evaluation.metrics.metric import Columns, EvaluatedDrive, described, mean
from pdhef_logtool.evaluation.segments import driven_speed
from pdhef_logtool.evaluation.smoothing import median_step_ns
from pdhef_logtool.evaluation.track_errors import scorable
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.records.interpolation import Bracket
from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, FloatArray, Signals

SENSORS = "sensors"
#: Mark of signals with an estimator input as their ground truth.
NOT_INDEPENDENT = "not_independent"
#: Longest gap over which speed is interpolated.
MAX_STEP_S = 0.2


def carried_speed(signals: Signals) -> FloatArray:
    """Return the speed [N], interpolated linearly between its measurements except across gaps."""
    finite = np.isfinite(signals.speed_m_s)
    bracket = Bracket(signals.stamps_ns[finite], signals.stamps_ns, round(MAX_STEP_S * NS_PER_S))
    return bracket.linear(signals.speed_m_s[finite])


def _exposure(drive: EvaluatedDrive) -> Iterator[Columns]:
    if (signals := drive.signals) is None:
        return
    speed = np.nan_to_num(driven_speed(signals, drive.truth))
    step_s = np.full(len(signals), median_step_ns(signals.stamps_ns) * S_PER_NS)
    yield Columns(SENSORS, "state", {"step_s": step_s, "way_m": np.abs(speed) * step_s})


def _marks(drive: EvaluatedDrive) -> Iterator[Columns]:
    if drive.truth is None:
        return
    for signal in sorted({*SCORED_SIGNALS} & {*drive.dependent}):
        has_truth = scorable(drive.truth, signal, drive.low_speed_m_s)
        for name in drive.tracks:
            yield Columns(name, signal, {NOT_INDEPENDENT: np.where(has_truth, 1.0, np.nan)})


METRICS = (
    *described(
        _exposure,
        exposure_s=(lambda step_s: len(step_s) * float(step_s[0]), "step_s"),
        exposure_m=(lambda way_m: float(np.sum(way_m)), "way_m"),
    ),
    *described(_marks, not_independent=mean),
)
