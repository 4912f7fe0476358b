"""What can be said without truth: innovations, disagreement between estimators, and sensors against one another.

========================  ============  ================================================================================
metric                    estimator     definition
========================  ============  ================================================================================
``nis``, ``nis_dof``,     each          see :mod:`pdhef_logtool.evaluation.metrics`
``diverged``
``nis_autocorrelation``   each          autocorrelation of NIS / dof from one stamp to the next, signal ``state``; 0 for
                                        white innovations, beyond ± 2/√n they are not white
``disagreement_rms``      ``a~b``       rms of the difference of two estimates' sideslip, both above the low-speed blend
``residual_rms``,         ``sensors``   signal ``ay_m_s2``: a_y − v_x r, smoothed to 1 Hz, above the low-speed blend. It
``residual_bias``                       holds v̇_y (zero mean), roll and bank (g sin φ), sensor bias and speed error.
                                        signal ``vx_m_s``: change of speed over a second minus the integral of a_x. It
                                        holds grade and pitch (g sin θ), a_x bias, wheel slip and v_y r
========================  ============  ================================================================================
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np

from pdhef_logtool.drive.interpolation import Bracket
from pdhef_logtool.evaluation.metrics import MetricRow, known_by_segment, state_rows
from pdhef_logtool.evaluation.segments import smooth
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack

SENSORS = "sensors"
SMOOTHING_HZ = 1.0
SPEED_SPAN_S = 1.0
#: Speed is carried over missing stamps for this long; a_x is integrated over no longer step.
MAX_STEP_S = 0.2


def innovation_rows(track: StateTrack, masks: Mapping[str, BoolArray], *, log: str) -> list[MetricRow]:
    """Return ``nis``, ``nis_dof``, ``diverged`` and ``nis_autocorrelation`` of one estimator.

    :func:`pdhef_logtool.evaluation.metrics.score_track` gives the first three itself: with truth, use only
    :func:`whiteness_rows`.
    """
    return state_rows(track, masks, log=log) + whiteness_rows(track, masks, log=log)


def whiteness_rows(track: StateTrack, masks: Mapping[str, BoolArray], *, log: str) -> list[MetricRow]:
    """Return ``nis_autocorrelation`` of one estimator, a row a segment with at least ten pairs of stamps."""
    known = np.isfinite(track.nis) & (track.nis_dof > 0)
    ratio = np.where(known, track.nis / np.where(known, track.nis_dof, 1.0), np.nan)
    rows = []
    for segment, mask in masks.items():
        use = known & mask
        pairs = use[1:] & use[:-1]
        n = int(np.count_nonzero(pairs))
        if n < 10:
            continue
        before, after = ratio[:-1][pairs], ratio[1:][pairs]
        before, after = before - before.mean(), after - after.mean()
        power = float(np.sqrt((before**2).sum() * (after**2).sum()))
        value = float((before * after).sum()) / power if power > 0 else float("nan")
        rows.append(MetricRow(log, track.name, "state", segment, "nis_autocorrelation", value, "1", n))
    return rows


def disagreement_rows(
    tracks: Sequence[StateTrack], masks: Mapping[str, BoolArray], *, log: str, low_speed_m_s: float
) -> list[MetricRow]:
    """Return the rms difference of sideslip of every pair of estimates [N] at the same stamps, by segment."""
    rows = []
    for a, b in combinations(tracks, 2):
        moving = a.valid & b.valid & (a.vx_m_s > low_speed_m_s) & (b.vx_m_s > low_speed_m_s)
        difference = wrap_angle(a.sideslip_rad - b.sideslip_rad)
        for segment, inside in known_by_segment(np.where(moving, difference, np.nan), masks):
            rms, n, pair = float(np.sqrt(np.mean(inside**2))), int(inside.size), f"{a.name}~{b.name}"
            rows.append(MetricRow(log, pair, "sideslip_rad", segment, "disagreement_rms", rms, "rad", n))
    return rows


def sensor_rows(signals: Signals, masks: Mapping[str, BoolArray], *, log: str, low_speed_m_s: float) -> list[MetricRow]:
    """Return the residuals of the sensors against one another; no rows where a sensor is missing."""
    speed = _carried_speed(signals)
    lateral = signals.ay_m_s2 - speed * signals.yaw_rate_rad_s
    lateral = smooth(signals.stamps_ns, np.where(speed > low_speed_m_s, lateral, np.nan), SMOOTHING_HZ)
    rows = []
    for signal, residual, unit in (
        ("ay_m_s2", lateral, "m/s^2"),
        ("vx_m_s", _speed_change_residual(signals), "m/s"),
    ):
        for segment, inside in known_by_segment(residual, masks):
            n, rms, bias = int(inside.size), float(np.sqrt(np.mean(inside**2))), float(np.mean(inside))
            rows.append(MetricRow(log, SENSORS, signal, segment, "residual_rms", rms, unit, n))
            rows.append(MetricRow(log, SENSORS, signal, segment, "residual_bias", bias, unit, n))
    return rows


def _carried_speed(signals: Signals) -> FloatArray:
    """Return the speed [N] between its measurements, linear, not across gaps."""
    known = np.isfinite(signals.speed_m_s)
    bracket = Bracket(signals.stamps_ns[known], signals.stamps_ns, round(MAX_STEP_S * 1e9))
    return bracket.linear(signals.speed_m_s[known])


def _speed_change_residual(signals: Signals) -> FloatArray:
    """Return v(t) − v(t − 1 s) − ∫ a_x dt at stamps with a speed measurement, [N]; NaN elsewhere."""
    t = signals.stamps_ns
    residual = np.full(len(signals), np.nan)
    at = np.flatnonzero(np.isfinite(signals.speed_m_s))
    if at.size < 2:
        return residual
    step_s = np.diff(t) * 1e-9
    broken = ~np.isfinite(signals.ax_m_s2[1:] + signals.ax_m_s2[:-1]) | (step_s > MAX_STEP_S)
    mean_ax = np.where(broken, 0.0, 0.5 * (signals.ax_m_s2[1:] + signals.ax_m_s2[:-1]))
    gained = np.concatenate([[0.0], np.cumsum(mean_ax * step_s)])
    breaks = np.concatenate([[0], np.cumsum(broken)])
    earlier = np.searchsorted(t[at], t[at] - round(SPEED_SPAN_S * 1e9), side="right") - 1
    whole = earlier >= 0
    i, j = at[np.maximum(earlier, 0)], at
    whole &= (breaks[i] == breaks[j]) & (t[j] - t[i] <= round((SPEED_SPAN_S + MAX_STEP_S) * 1e9))
    i, j = i[whole], j[whole]
    residual[j] = signals.speed_m_s[j] - signals.speed_m_s[i] - (gained[j] - gained[i])
    return residual
