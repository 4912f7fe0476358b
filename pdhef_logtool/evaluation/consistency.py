"""What can be said without truth: innovations, disagreement between estimators, and sensors against one another.

========================  ============  ================================================================================
metric                    estimator     definition
========================  ============  ================================================================================
``nis``, ``nis_dof``,     each          see :mod:`pdhef_logtool.evaluation.metrics`
``diverged``
``nis_autocorrelation``   each          autocorrelation of NIS / dof from one stamp to the next, signal ``state``; 0 for
                                        white innovations, beyond ± 2/√n they are not white
``disagreement_rms``      ``a~b``       rms of the difference of two estimates' sideslip, both above the low-speed blend
``d2``                    each          signal ``vy_m_s``: rms of the change of the estimated v_y over 2 s minus the
                                        integral of a_y − v_x r, above the low-speed blend; a_y without bias, roll gain,
                                        lever arm and bank as the log has them (:class:`LogSensors`); large with a
                                        wrong model; ``kinematic`` integrates the same: its d2 says nothing
``residual_rms``,         ``sensors``   signal ``ay_m_s2``: a_y − v_x r, smoothed to 1 Hz, above the low-speed blend. It
``residual_bias``                       holds v̇_y (zero mean), roll and bank (g sin φ), sensor bias and speed error.
                                        signal ``vx_m_s``: change of speed over a second minus the integral of a_x. It
                                        holds grade and pitch (g sin θ), a_x bias, wheel slip and v_y r
========================  ============  ================================================================================
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from pdhef_logtool.drive.interpolation import Bracket
from pdhef_logtool.evaluation.blocks import (
    SegmentMasks,
    SegmentSums,
    blocks_with_halo,
    median_step_ns,
    packed,
    row_blocks,
)
from pdhef_logtool.evaluation.metrics import MetricRow, state_rows
from pdhef_logtool.evaluation.segments import reach_rows, smooth
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack

SENSORS = "sensors"
SMOOTHING_HZ = 1.0
SPEED_SPAN_S = 1.0
D2_SPAN_S = 2.0
#: Speed is carried over missing stamps for this long; a_x is integrated over no longer step.
MAX_STEP_S = 0.2


@dataclass(frozen=True, slots=True)
class LogSensors:
    """What a log's own sensors were found to have, against the vehicle that its signals were read with.

    Attributes
    ----------
    ay_bias_m_s2, yaw_rate_bias_rad_s : what they read too much. ay_gain : of body roll. lever_m : of a_y ahead of the
        centre of gravity. superelevation : share of v_x r that the road's bank carries.
    """

    ay_bias_m_s2: float = 0.0
    yaw_rate_bias_rad_s: float = 0.0
    ay_gain: float = 1.0
    lever_m: float = 0.0
    superelevation: float = 0.0


def innovation_rows(track: StateTrack, masks: Mapping[str, BoolArray], *, log: str) -> list[MetricRow]:
    """Return ``nis``, ``nis_dof``, ``diverged`` and ``nis_autocorrelation`` of one estimator.

    :func:`pdhef_logtool.evaluation.metrics.score_track` gives the first three itself: with truth, use only
    :func:`whiteness_rows`.
    """
    return state_rows(track, masks, log=log) + whiteness_rows(track, masks, log=log)


def whiteness_rows(track: StateTrack, masks: Mapping[str, BoolArray], *, log: str) -> list[MetricRow]:
    """Return ``nis_autocorrelation`` of one estimator, a row a segment with at least ten pairs of stamps."""
    masks = packed(masks, len(track))
    first = SegmentSums()
    for inside, before, after in _pairs(track, masks):
        first.add(inside, before, after)
    means = {segment: sums / n for segment, (n, sums) in first.totals().items() if n >= 10}
    second = SegmentSums()
    for inside, before, after in _pairs(track, masks):
        for segment, mean in means.items():
            use = inside[segment] & np.isfinite(before)
            x, y = before[use] - mean[0], after[use] - mean[1]
            second.add_to(segment, x**2, y**2, x * y)
    rows = []
    for segment, (n, (of_before, of_after, of_both)) in second.totals().items():
        power = float(np.sqrt(of_before * of_after))
        value = float(of_both) / power if power > 0 else float("nan")
        rows.append(MetricRow(log, track.name, "state", segment, "nis_autocorrelation", value, "1", n))
    return rows


def _pairs(track: StateTrack, masks: SegmentMasks) -> Iterator[tuple[dict[str, BoolArray], FloatArray, FloatArray]]:
    """Yield, by block, NIS / dof [M] of stamps and of those that follow, NaN where one lacks it, and their masks."""
    for a, b in row_blocks(len(track)):
        start = max(a - 1, 0)
        part = track.rows(start, b)
        nis, dof = part.nis, part.nis_dof
        known = np.isfinite(nis) & (dof > 0)
        ratio = np.where(known, nis / np.where(known, dof, 1.0), np.nan)
        both = known[1:] & known[:-1]
        inside = {segment: mask[1:] & mask[:-1] for segment, mask in masks.rows(start, b).items()}
        yield inside, np.where(both, ratio[:-1], np.nan), np.where(both, ratio[1:], np.nan)


def disagreement_rows(
    tracks: Sequence[StateTrack], masks: Mapping[str, BoolArray], *, log: str, low_speed_m_s: float
) -> list[MetricRow]:
    """Return the rms difference of sideslip of every pair of estimates [N] at the same stamps, by segment."""
    rows = []
    for pair in combinations(tracks, 2):
        masks = packed(masks, len(pair[0]))
        sums = SegmentSums()
        for start, end in row_blocks(len(pair[0])):
            a, b = (t.rows(start, end) for t in pair)
            moving = a.valid & b.valid & (a.vx_m_s > low_speed_m_s) & (b.vx_m_s > low_speed_m_s)
            difference = np.where(moving, wrap_angle(a.sideslip_rad - b.sideslip_rad), np.nan)
            sums.add(masks.rows(start, end), difference, difference**2)
        name = "~".join(t.name for t in pair)
        for segment, (n, (_, squares)) in sums.totals().items():
            rms = float(np.sqrt(squares / n))
            rows.append(MetricRow(log, name, "sideslip_rad", segment, "disagreement_rms", rms, "rad", n))
    return rows


def d2_rows(
    tracks: Sequence[StateTrack],
    signals: Signals,
    masks: Mapping[str, BoolArray],
    *,
    log: str,
    low_speed_m_s: float,
    sensors: LogSensors,
) -> list[MetricRow]:
    """Return ``d2`` of estimators at the same stamps as the signals [N], a row a segment; none where v_y is not."""
    masks = packed(masks, len(signals))
    found = [SegmentSums() for _ in tracks]
    for first, a, b, end in blocks_with_halo(signals, D2_SPAN_S + MAX_STEP_S, 1):
        core, inside = slice(a - first, b - first), dict(masks.rows(a, b))
        driven = _Driven(signals.rows(first, end), low_speed_m_s, sensors)
        for track, sums in zip(tracks, found, strict=True):
            residual = driven.residual(track.rows(first, end))[core]
            sums.add(inside, residual, residual**2)
    return [
        MetricRow(log, track.name, "vy_m_s", segment, "d2", float(np.sqrt(squares / n)), "m/s", n)
        for track, sums in zip(tracks, found, strict=True)
        for segment, (n, (_, squares)) in sums.totals().items()
    ]


def driving_products(
    track: StateTrack, signals: Signals, *, low_speed_m_s: float, sensors: LogSensors
) -> tuple[FloatArray, float]:
    """Return what :func:`driven_d2` needs of a window, to be added up: integrals over time [4, 4], and how long, s.

    They are of the products of the changes over 2 s of v_y, v_x r and a_y, and of the residual that d2 squares.
    """
    driven = _Driven(signals, low_speed_m_s, sensors)
    vy = driven.carried_vy(track)
    rows = np.stack([*map(driven.change, (vy, driven.turn, signals.ay_m_s2)), driven.residual(track)])
    step_s = np.minimum(np.diff(signals.stamps_ns, prepend=signals.stamps_ns[:1]) * 1e-9, MAX_STEP_S)
    known = np.isfinite(rows).all(axis=0)
    rows, step_s = rows[:, known], step_s[known]
    return np.stack([(rows * row * step_s).sum(axis=1) for row in rows]), float(step_s.sum())


def driven_d2(products: FloatArray, seconds: float) -> float:
    """Return that part of d2 in m/s which goes with v_y, v_x r and a_y: what the model is wrong by as the car turns.

    The rest is the road's: a bank moves a_y and says nothing of the estimate. What the rest would
    explain by chance, with 2 s as one sample, is believed the less. NaN for less than five of them.
    """
    if seconds < 5.0 * D2_SPAN_S:
        return float("nan")
    of_residual = products[:-1, -1]
    fit = float(of_residual @ np.linalg.pinv(products[:-1, :-1], hermitian=True) @ of_residual)
    explained = min(max(fit, 0.0), float(products[-1, -1]))
    chance = len(of_residual) * D2_SPAN_S / seconds * (float(products[-1, -1]) - explained)
    believed = explained**2 / (explained + chance) if explained > 0.0 else 0.0
    return float(np.sqrt(believed / seconds))


class _Driven:
    """What d2 needs of the signals [N] of a part of a drive, whichever estimate is held against them.

    Attributes
    ----------
    turn : v_x r as far as no bank carries it, [N] in m/s².
    """

    def __init__(self, signals: Signals, low_speed_m_s: float, sensors: LogSensors) -> None:
        t = signals.stamps_ns
        speed = _carried_speed(signals)
        rate = signals.yaw_rate_rad_s - sensors.yaw_rate_bias_rad_s
        self.turn = (1.0 - sensors.superelevation) * speed * rate
        rising = (signals.ay_m_s2 - sensors.ay_bias_m_s2) / sensors.ay_gain - self.turn
        self._fast = speed > low_speed_m_s
        self._of_lever = sensors.lever_m / sensors.ay_gain * rate
        gained, breaks, steps = np.zeros(len(t)), np.zeros(len(t)), np.diff(t) * 1e-9
        broken = ~np.isfinite(rising[1:] + rising[:-1]) | (steps > MAX_STEP_S)
        gained[1:] = np.cumsum(np.where(broken, 0.0, 0.5 * (rising[1:] + rising[:-1]) * steps))
        breaks[1:] = np.cumsum(broken)
        earlier = np.searchsorted(t, t - round(D2_SPAN_S * 1e9), side="right") - 1
        self._before = i = np.maximum(earlier, 0)
        self._whole = (earlier >= 0) & (breaks[i] == breaks) & (t - t[i] <= round((D2_SPAN_S + MAX_STEP_S) * 1e9))
        self._gained = gained - gained[i]

    def carried_vy(self, track: StateTrack) -> FloatArray:
        """Return v_y [N] of an estimate with the lever's share of ∫ a_y; NaN where it does not count."""
        return np.where(track.valid & self._fast, track.vy_m_s, np.nan) + self._of_lever

    def change(self, values: FloatArray) -> FloatArray:
        """Return by how much values [N] changed in 2 s, [N]; NaN where that cannot be told."""
        return np.where(self._whole, values - values[self._before], np.nan)

    def residual(self, track: StateTrack) -> FloatArray:
        """Return v_y(t) − v_y(t − 2 s) − ∫ (a_y − v_x r) dt, [N]; NaN where it cannot be told."""
        return self.change(self.carried_vy(track)) - self._gained


def sensor_rows(signals: Signals, masks: Mapping[str, BoolArray], *, log: str, low_speed_m_s: float) -> list[MetricRow]:
    """Return the residuals of the sensors against one another; no rows where a sensor is missing."""
    masks = packed(masks, len(signals))
    step_ns = median_step_ns(signals)
    of_lateral, of_speed = SegmentSums(), SegmentSums()
    for first, a, b, end in blocks_with_halo(signals, SPEED_SPAN_S + MAX_STEP_S, reach_rows(step_ns, SMOOTHING_HZ)):
        part, core = signals.rows(first, end), slice(a - first, b - first)
        speed = _carried_speed(part)
        lateral = np.where(speed > low_speed_m_s, part.ay_m_s2 - speed * part.yaw_rate_rad_s, np.nan)
        lateral = smooth(part.stamps_ns, lateral, SMOOTHING_HZ, step_ns)
        for sums, residual in ((of_lateral, lateral[core]), (of_speed, _speed_change_residual(part)[core])):
            sums.add(masks.rows(a, b), residual, residual**2)
    rows = []
    for signal, sums, unit in (("ay_m_s2", of_lateral, "m/s^2"), ("vx_m_s", of_speed, "m/s")):
        for segment, (n, (total, squares)) in sums.totals().items():
            rms, bias = float(np.sqrt(squares / n)), float(total) / n
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
