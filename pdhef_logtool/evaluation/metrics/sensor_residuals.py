"""``residual_rms``, ``residual_bias``: the sensors against one another, estimator ``sensors``."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pdhef_logtool.drive.interpolation import Bracket
from pdhef_logtool.evaluation.blocks import SegmentSums, blocks_with_halo, median_step_ns, packed
from pdhef_logtool.evaluation.metrics.metric import EvaluatedDrive, Metric, MetricRow, OfDrive
from pdhef_logtool.evaluation.smoothing import reach_rows, smooth
from pdhef_logtool.evaluation.units import SIGNALS
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals

SENSORS = "sensors"
SMOOTHING_HZ = 1.0
SPEED_SPAN_S = 1.0
#: Speed is carried over missing stamps for this long; a_x is integrated over no longer step.
MAX_STEP_S = 0.2


def _rows(drive: EvaluatedDrive) -> list[MetricRow]:
    return sensor_rows(drive.signals, drive.masks, log=drive.log, low_speed_m_s=drive.low_speed_m_s)


def sensor_rows(signals: Signals, masks: Mapping[str, BoolArray], *, log: str, low_speed_m_s: float) -> list[MetricRow]:
    """Return the residuals of the sensors against one another; no rows where a sensor is missing."""
    masks = packed(masks, len(signals))
    step_ns = median_step_ns(signals)
    of_lateral, of_speed = SegmentSums(), SegmentSums()
    for first, a, b, end in blocks_with_halo(signals, SPEED_SPAN_S + MAX_STEP_S, reach_rows(step_ns, SMOOTHING_HZ)):
        part, core = signals.rows(first, end), slice(a - first, b - first)
        speed = carried_speed(part)
        lateral = np.where(speed > low_speed_m_s, part.ay_m_s2 - speed * part.yaw_rate_rad_s, np.nan)
        lateral = smooth(part.stamps_ns, lateral, SMOOTHING_HZ, step_ns)
        for sums, residual in ((of_lateral, lateral[core]), (of_speed, _speed_change_residual(part)[core])):
            sums.add(masks.rows(a, b), residual, residual**2)
    rows = []
    for signal, sums in (("ay_m_s2", of_lateral), ("vx_m_s", of_speed)):
        unit = SIGNALS[signal]
        for segment, (n, (total, squares)) in sums.totals().items():
            rms, bias = float(np.sqrt(squares / n)), float(total) / n
            rows.append(MetricRow(log, SENSORS, signal, segment, "residual_rms", rms, unit, n))
            rows.append(MetricRow(log, SENSORS, signal, segment, "residual_bias", bias, unit, n))
    return rows


def carried_speed(signals: Signals) -> FloatArray:
    """Return the speed [N] between its measurements, linear, not across gaps."""
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


METRICS = (
    Metric(
        "residual_rms",
        "RMS",
        "signal `ay_m_s2`: RMS of a_y − v_x r, smoothed to 1 Hz, above the low-speed blend; contains v̇_y (zero mean), "
        "roll and bank (g sin φ), sensor bias and speed error. Signal `vx_m_s`: RMS of the change of speed over a "
        "second minus the integral of a_x; contains grade and pitch (g sin θ), a_x bias, wheel slip and v_y r. "
        "Estimator `sensors`",
        OfDrive(_rows),
        best="lower",
    ),
    Metric("residual_bias", "bias", "mean of the residuals of `residual_rms`", OfDrive(_rows), best=0.0),
)
