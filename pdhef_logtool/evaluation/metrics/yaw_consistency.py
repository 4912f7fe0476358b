"""``yaw_consistency``: yaw rate of the car's tyres at the estimated v_y and the measured steering, against the gyro."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from pdhef_logtool.car.nominal_model import lateral_acceleration_and_yaw_acceleration, model_parameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.evaluation.metrics.metric import Columns, EvaluatedDrive, described, rms
from pdhef_logtool.evaluation.metrics.sensors import MAX_STEP_S, carried_speed

#: Longest step of its integration: the yaw motion of any car has time constants above 20 ms at 3 m/s and more.
_STEP_S = 0.004


def _columns(drive: EvaluatedDrive) -> Iterator[Columns]:
    """Yield the modelled minus the measured yaw rate; NaN across gaps, at low speed, and without steering."""
    if drive.calibrated is None:
        return
    signals, vehicle, delay_s = drive.calibrated
    t, rate = signals.stamps_ns, signals.yaw_rate_rad_s
    steer = np.interp(t - round(delay_s * 1e9), t, signals.steer_rad)
    friction = np.where(np.isfinite(signals.friction), signals.friction, vehicle.assumed_friction)
    dt = np.diff(t, prepend=t[:1]) * 1e-9
    dt[dt > MAX_STEP_S] = np.nan
    speed, model = carried_speed(signals), model_parameters(vehicle)
    for track in drive.tracks.values():
        vy, modelled = np.where(track.valid, track.vy_m_s, np.nan), np.full(len(t), np.nan)
        inputs = dt, speed, vy, steer, friction, rate
        _yaw_rates(inputs, model, max(vehicle.relaxation_length_m, 0.01), modelled)
        yield Columns(track.name, "yaw_rate_rad_s", {"yaw_consistency": modelled - rate})


@njit(cache=True)
def _yaw_rates(inputs, p, relaxation_m, out):  # type: ignore[no-untyped-def]
    """Write the yaw rate [N] that the tyres cause at a given v_y, where all inputs are finite.

    ``inputs`` [N] each: step before the sample, v_x, v_y, steering, friction and measured yaw rate, from which the
    model starts. The yaw acceleration follows the static one of the model ``p`` with the tyres' relaxation length.
    """
    dt, vx, vy, steer, friction, measured = inputs
    r, r_dot = math.nan, 0.0
    for k in range(dt.shape[0]):
        v, mu = vx[k], friction[k]
        whole = v > p.blend_high_m_s and math.isfinite(vy[k] + steer[k]) and dt[k] >= 0.0
        if not whole or not math.isfinite(r):
            r, r_dot = measured[k] if whole else math.nan, 0.0
            continue
        n = max(1, math.ceil(dt[k] / _STEP_S))
        kept = math.exp(-dt[k] / n * v / relaxation_m)
        for _ in range(n):
            _, static = lateral_acceleration_and_yaw_acceleration(v, vy[k], r, steer[k], mu, p)
            r_dot = static + (r_dot - static) * kept
            r += dt[k] / n * r_dot
        out[k] = r


METRICS = described(_columns, yaw_consistency=rms)
