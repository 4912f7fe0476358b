"""``d2``, lateral kinematic consistency: change of the estimated v_y over 2 s minus the integral of a_y − v_x r."""

from collections.abc import Iterator

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals, Columns, EvaluatedDrive, described, rms
from pdhef_logtool.evaluation.metrics.sensors import MAX_STEP_S, carried_speed
from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, FloatArray
from pdhef_logtool.records.tracks import StateTrack

SPAN_S = 2.0


def _columns(drive: EvaluatedDrive) -> Iterator[Columns]:
    if drive.calibrated is not None:
        driven = _Driven(drive.calibrated, drive.low_speed_m_s)
        for track in drive.tracks.values():
            yield Columns(track.name, "vy_m_s", {"d2": driven.residual(track)})


def driven_consistency(track: StateTrack, signals: CalibratedSignals, low_speed_m_s: float) -> float:
    """Return the part of the residual in m/s that correlates with v_y, v_x r and a_y: the error of the model in turns.

    The remaining part comes from the road: a bank changes a_y and is not an error of the estimate. The share that the
    remaining part explains by chance, with 2 s as one sample, is subtracted. NaN below five samples.
    """
    driven = _Driven(signals, low_speed_m_s)
    vy, residual = driven.carried_vy(track), driven.residual(track)
    rows = np.stack([*map(driven.change, (vy, driven.turn, signals.signals.ay_m_s2)), residual])
    stamps_ns = signals.signals.stamps_ns
    step_s = np.minimum(np.diff(stamps_ns, prepend=stamps_ns[:1]) * S_PER_NS, MAX_STEP_S)
    step_s = np.where(np.isfinite(rows).all(axis=0), step_s, 0.0)
    if (seconds := float(step_s.sum())) < 5.0 * SPAN_S:
        return float("nan")
    rows = np.where(step_s > 0.0, rows, 0.0)
    products = (rows * step_s) @ rows.T
    of_residual = products[:-1, -1]
    fit = float(of_residual @ np.linalg.pinv(products[:-1, :-1], hermitian=True) @ of_residual)
    explained = min(max(fit, 0.0), float(products[-1, -1]))
    chance = len(of_residual) * SPAN_S / seconds * (float(products[-1, -1]) - explained)
    significant = explained**2 / (explained + chance) if explained > 0.0 else 0.0
    return float(np.sqrt(significant / seconds))


class _Driven:
    """Terms of the residual that depend on the signals [N] of a part of a drive, not on the estimate.

    Attributes
    ----------
    turn : v_x r, [N] in m/s².
    """

    def __init__(self, calibrated: CalibratedSignals, low_speed_m_s: float) -> None:
        signals, vehicle, _ = calibrated
        t, speed, rate = signals.stamps_ns, carried_speed(signals), signals.yaw_rate_rad_s
        ay_gain = 1.0 + GRAVITY_M_S2 * vehicle.roll_gradient_rad_per_m_s2
        self.turn = speed * rate
        rising = signals.ay_m_s2 / ay_gain - self.turn
        self._fast = speed > low_speed_m_s
        self._of_lever = vehicle.imu_position_m[0] / ay_gain * rate
        gained, breaks, steps = np.zeros(len(t)), np.zeros(len(t)), np.diff(t) * S_PER_NS
        broken = ~np.isfinite(rising[1:] + rising[:-1]) | (steps > MAX_STEP_S)
        gained[1:] = np.cumsum(np.where(broken, 0.0, 0.5 * (rising[1:] + rising[:-1]) * steps))
        breaks[1:] = np.cumsum(broken)
        earlier = np.searchsorted(t, t - round(SPAN_S * NS_PER_S), side="right") - 1
        self._before = i = np.maximum(earlier, 0)
        self._whole = (earlier >= 0) & (breaks[i] == breaks) & (t - t[i] <= round((SPAN_S + MAX_STEP_S) * NS_PER_S))
        self._gained = gained - gained[i]

    def carried_vy(self, track: StateTrack) -> FloatArray:
        """Return v_y [N] of an estimate plus the lever-arm term of ∫ a_y; NaN at stamps that are not scored."""
        return np.where(track.valid & self._fast, track.vy_m_s, np.nan) + self._of_lever

    def change(self, values: FloatArray) -> FloatArray:
        """Return the change of values [N] over 2 s, [N]; NaN across gaps."""
        return np.where(self._whole, values - values[self._before], np.nan)

    def residual(self, track: StateTrack) -> FloatArray:
        """Return v_y(t) − v_y(t − 2 s) − ∫ (a_y − v_x r) dt, [N]; NaN across gaps."""
        return self.change(self.carried_vy(track)) - self._gained


METRICS = described(_columns, d2=rms)
