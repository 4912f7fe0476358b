"""Consistency of the sensors, and duration and distance of each segment of a drive, estimator ``sensors``."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from pdhef_logtool.drive.interpolation import Bracket
from pdhef_logtool.evaluation.metrics.metric import Columns, EvaluatedDrive, Metric, mean, rms
from pdhef_logtool.evaluation.segments import known_of, speed_and_ay
from pdhef_logtool.evaluation.smoothing import median_step_ns, smooth
from pdhef_logtool.records.signals import FloatArray, Signals

SENSORS = "sensors"
SMOOTHING_HZ = 1.0
SPEED_SPAN_S = 1.0
#: Longest gap over which speed is interpolated, and longest step over which a_x is integrated.
MAX_STEP_S = 0.2


def _residuals(drive: EvaluatedDrive) -> Iterator[Columns]:
    if (signals := drive.signals) is None:
        return
    speed = carried_speed(signals)
    lateral = np.where(speed > drive.low_speed_m_s, signals.ay_m_s2 - speed * signals.yaw_rate_rad_s, np.nan)
    smoothed = smooth(signals.stamps_ns, lateral, SMOOTHING_HZ, median_step_ns(signals.stamps_ns))
    yield Columns(SENSORS, "ay_m_s2", {"residual": smoothed})
    yield Columns(SENSORS, "vx_m_s", {"residual": _speed_change_residual(signals)})


def carried_speed(signals: Signals) -> FloatArray:
    """Return the speed [N], interpolated linearly between its measurements except across gaps."""
    finite = np.isfinite(signals.speed_m_s)
    bracket = Bracket(signals.stamps_ns[finite], signals.stamps_ns, round(MAX_STEP_S * 1e9))
    return bracket.linear(signals.speed_m_s[finite])


def _speed_change_residual(signals: Signals) -> FloatArray:
    """Return v(t) − v(t − 1 s) − ∫ a_x dt at stamps with a speed measurement, [N]; NaN elsewhere."""
    t = signals.stamps_ns
    residual = np.full(len(signals), np.nan)
    measured = np.flatnonzero(np.isfinite(signals.speed_m_s))
    if measured.size < 2:
        return residual
    step_s = np.diff(t) * 1e-9
    broken = ~np.isfinite(signals.ax_m_s2[1:] + signals.ax_m_s2[:-1]) | (step_s > MAX_STEP_S)
    mean_ax = np.where(broken, 0.0, 0.5 * (signals.ax_m_s2[1:] + signals.ax_m_s2[:-1]))
    gained = np.concatenate([[0.0], np.cumsum(mean_ax * step_s)])
    breaks = np.concatenate([[0], np.cumsum(broken)])
    earlier = np.searchsorted(t[measured], t[measured] - round(SPEED_SPAN_S * 1e9), side="right") - 1
    whole = earlier >= 0
    i, j = measured[np.maximum(earlier, 0)], measured
    whole &= (breaks[i] == breaks[j]) & (t[j] - t[i] <= round((SPEED_SPAN_S + MAX_STEP_S) * 1e9))
    i, j = i[whole], j[whole]
    residual[j] = signals.speed_m_s[j] - signals.speed_m_s[i] - (gained[j] - gained[i])
    return residual


def _exposure(drive: EvaluatedDrive) -> Iterator[Columns]:
    if (signals := drive.signals) is None:
        return
    speed = np.nan_to_num(speed_and_ay(signals, drive.truth, known_of(drive.truth))[0])
    step_s = np.full(len(signals), median_step_ns(signals.stamps_ns) * 1e-9)
    yield Columns(SENSORS, "state", {"step_s": step_s, "way_m": np.abs(speed) * step_s})


_RESIDUAL = partial(Metric, columns=_residuals, over=("residual",))
_WORDS = "of the drive in a segment; n = its stamps. Estimator `sensors`"
METRICS = (
    _RESIDUAL(
        "residual_rms",
        "RMS",
        "signal `ay_m_s2`: RMS of a_y − v_x r, smoothed to 1 Hz, above the low-speed blend; contains v̇_y (zero mean), "
        "roll and bank (g sin φ), sensor bias and speed error. Signal `vx_m_s`: RMS of the change of speed over a "
        "second minus the integral of a_x; contains grade and pitch (g sin θ), a_x bias, wheel slip and v_y r. "
        "Estimator `sensors`",
        formula=rms,
        best="lower",
    ),
    _RESIDUAL("residual_bias", "bias", "mean of the residuals of `residual_rms`", formula=mean, best=0.0),
    Metric(
        "exposure_s",
        "time",
        f"time {_WORDS}",
        columns=_exposure,
        formula=lambda step_s: len(step_s) * float(step_s[0]),
        over=("step_s",),
        unit="s",
    ),
    Metric(
        "exposure_m",
        "way",
        f"distance {_WORDS}",
        columns=_exposure,
        formula=lambda way_m: float(np.sum(way_m)),
        over=("way_m",),
        unit="m",
    ),
)
