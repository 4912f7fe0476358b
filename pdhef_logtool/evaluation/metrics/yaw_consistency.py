"""``yaw_consistency``: yaw rate of the car's tyres at the estimated v_y and the measured steering, against the gyro."""

import math
from collections.abc import Iterable, Iterator

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals, Columns, EvaluatedDrive, described, rms
from pdhef_logtool.evaluation.metrics.sensors import MAX_STEP_S, carried_speed
from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, FloatArray

#: Longest step of its integration: the yaw motion of any car has time constants above 20 ms at 3 m/s and more.
_STEP_S = 0.004


def _columns(drive: EvaluatedDrive) -> Iterator[Columns]:
    """Yield the modelled minus the measured yaw rate; NaN across gaps, at low speed, and without steering."""
    if drive.calibrated is None:
        return
    tracks = drive.tracks.values()
    errors = yaw_rate_errors(drive.calibrated, (np.where(t.valid, t.vy_m_s, np.nan) for t in tracks))
    for track, error in zip(tracks, errors, strict=True):
        yield Columns(track.name, "yaw_rate_rad_s", {"yaw_consistency": error})


def yaw_rate_errors(calibrated: CalibratedSignals, vys: Iterable[FloatArray]) -> Iterator[FloatArray]:
    """Yield the modelled minus the measured yaw rate [N], rad/s, for each v_y [N], m/s; NaN without one."""
    signals, vehicle, delay_s = calibrated
    t, rate = signals.stamps_ns, signals.yaw_rate_rad_s
    steer = np.interp(t - round(delay_s * NS_PER_S), t, signals.steer_rad)
    friction = np.where(np.isfinite(signals.friction), signals.friction, vehicle.assumed_friction)
    dt = np.diff(t, prepend=t[:1]) * S_PER_NS
    dt[dt > MAX_STEP_S] = np.nan
    speed, axles = carried_speed(signals), _axles(vehicle)
    # 1/m²: the inverse square of the radius of gyration.
    constants = vehicle.mass_kg / vehicle.yaw_inertia_kg_m2, vehicle.low_speed_blend_m_s
    for vy in vys:
        modelled = np.full(len(t), np.nan)
        inputs = dt, speed, vy, steer, friction, rate
        _yaw_rates(inputs, axles, *constants, max(vehicle.relaxation_length_m, 0.01), modelled)
        yield modelled - rate


def _axles(vehicle: VehicleParameters) -> FloatArray:
    """Return for front and rear [2, 6]: distance ahead of the CG, and B, C, D / m, E of Eq 2 at friction 1.

    The last column is 1 where the stiffness does not depend on friction.
    """
    front, rear = (vehicle.cg_to_front_axle_m, vehicle.tyres.front), (-vehicle.cg_to_rear_axle_m, vehicle.tyres.rear)
    axles = np.array([
        (arm_m, *vehicle.magic_formula(is_front, 1.0), tyre.keeps_stiffness)
        for is_front, (arm_m, tyre) in ((True, front), (False, rear))
    ])  # fmt: skip
    axles[:, 3] /= vehicle.mass_kg
    return axles


@njit(cache=True)
def _yaw_rates(inputs, axles, per_gyration, least_speed_m_s, relaxation_m, out):  # type: ignore[no-untyped-def]
    """Write the yaw rate [N] that the tyres cause at a given v_y, where all inputs are finite.

    ``inputs`` [N] each: step before the sample, v_x, v_y, steering, friction and measured yaw rate, from which the
    model starts. The yaw moment follows the static moment of the tyres with their relaxation length.
    """
    dt, vx, vy, steer, friction, measured = inputs
    r, r_dot = math.nan, 0.0
    for k in range(dt.shape[0]):
        v, mu = vx[k], friction[k]
        whole = v > least_speed_m_s and math.isfinite(vy[k] + steer[k]) and dt[k] >= 0.0
        if not whole or not math.isfinite(r):
            r, r_dot = measured[k] if whole else math.nan, 0.0
            continue
        n = max(1, math.ceil(dt[k] / _STEP_S))
        kept = math.exp(-dt[k] / n * v / relaxation_m)
        for _ in range(n):
            moment = 0.0
            for i in range(2):
                arm, b, c, peak, e, keeps = axles[i]
                turned = steer[k] if i == 0 else 0.0
                x = b * (turned - math.atan2(vy[k] + arm * r, v))
                x = x / mu if keeps else x
                force = mu * peak * math.sin(c * math.atan(x - e * (x - math.atan(x))))
                moment += arm * math.cos(turned) * force
            r_dot = per_gyration * moment + (r_dot - per_gyration * moment) * kept
            r += dt[k] / n * r_dot
        out[k] = r


METRICS = described(_columns, yaw_consistency=rms)
