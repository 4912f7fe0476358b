"""``yaw_consistency``: yaw rate of the car's tyres at the estimated v_y and the measured steering, against the gyro."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals, Columns, EvaluatedDrive, described, rms
from pdhef_logtool.evaluation.metrics.sensors import MAX_STEP_S, carried_speed
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.tracks import StateTrack

#: Longest step of its integration: the yaw motion of any car has time constants above 20 ms at 3 m/s and more.
_STEP_S = 0.004


def _columns(drive: EvaluatedDrive) -> Iterator[Columns]:
    if drive.calibrated is not None:
        yaw = YawModel(drive.calibrated)
        for track in drive.tracks.values():
            yield Columns(track.name, "yaw_rate_rad_s", {"yaw_consistency": yaw.residual(track)})


class YawModel:
    """The inputs of the yaw model that do not depend on the estimate, for signals [N]."""

    def __init__(self, calibrated: CalibratedSignals) -> None:
        signals, vehicle, delay_s = calibrated
        t = signals.stamps_ns
        steer = np.interp(t - round(delay_s * 1e9), t, signals.steer_rad)
        friction = np.where(np.isfinite(signals.friction), signals.friction, vehicle.assumed_friction)
        dt = np.diff(t, prepend=t[:1]) * 1e-9
        dt[dt > MAX_STEP_S] = np.nan
        self._tyres, self._measured = _tyres_of(vehicle), signals.yaw_rate_rad_s
        self._inputs = dt, carried_speed(signals), steer, friction, signals.yaw_rate_rad_s

    def residual(self, track: StateTrack) -> FloatArray:
        """Return the modelled minus the measured yaw rate [N]; NaN across gaps, at low speed, and without steering."""
        modelled = np.full(len(track), np.nan)
        dt, vx, steer, friction, measured = self._inputs
        vy = np.where(track.valid, track.vy_m_s, np.nan)
        _yaw_rates((dt, vx, vy, steer, friction, measured), self._tyres, modelled)
        return modelled - self._measured


class _Tyres(NamedTuple):
    """Axle distances and radius of gyration over them, low-speed limit, relaxation, and the axles' formulas (Eq 2).

    B, C and D / m in m/s² of a formula are for friction 1; ``keeps`` : the stiffness does not depend on friction.
    """

    front_m: float
    rear_m: float
    per_gyration: float  # m / I_z, 1/m²
    least_speed_m_s: float
    relaxation_m: float
    formulas: tuple[tuple[float, float, float, float], tuple[float, float, float, float]]
    keeps: tuple[bool, bool]


def _tyres_of(vehicle: VehicleParameters) -> _Tyres:
    (bf, cf, df, ef), (br, cr, dr, er) = vehicle.magic_formula(True, 1.0), vehicle.magic_formula(False, 1.0)
    mass = vehicle.mass_kg
    return _Tyres(
        vehicle.cg_to_front_axle_m,
        vehicle.cg_to_rear_axle_m,
        mass / vehicle.yaw_inertia_kg_m2,
        vehicle.low_speed_blend_m_s,
        max(vehicle.relaxation_length_m, 0.01),
        ((bf, cf, df / mass, ef), (br, cr, dr / mass, er)),
        (vehicle.tyres.front.keeps_stiffness, vehicle.tyres.rear.keeps_stiffness),
    )


@njit(cache=True)
def _force(slip, formula, keeps, friction):  # type: ignore[no-untyped-def]
    b, c, peak, e = formula
    x = b * slip / friction if keeps else b * slip
    return friction * peak * math.sin(c * math.atan(x - e * (x - math.atan(x))))


@njit(cache=True)
def _yaw_rates(inputs, tyres, out):  # type: ignore[no-untyped-def]
    """Write the yaw rate [N] that the tyres cause at a given v_y, where all inputs are finite.

    ``inputs`` [N] each: step before the sample, v_x, v_y, steering, friction and measured yaw rate, from which the
    model starts. The yaw moment follows the static moment of the tyres with their relaxation length.
    """
    dt, vx, vy, steer, friction, measured = inputs
    r, r_dot = math.nan, 0.0
    for k in range(dt.shape[0]):
        v, mu = vx[k], friction[k]
        whole = v > tyres.least_speed_m_s and math.isfinite(vy[k] + steer[k]) and dt[k] >= 0.0
        if not whole or not math.isfinite(r):
            r, r_dot = measured[k] if whole else math.nan, 0.0
            continue
        n = max(1, math.ceil(dt[k] / _STEP_S))
        kept = math.exp(-dt[k] / n * v / tyres.relaxation_m)
        for _ in range(n):
            front = steer[k] - math.atan2(vy[k] + tyres.front_m * r, v)
            rear = -math.atan2(vy[k] - tyres.rear_m * r, v)
            moment = tyres.front_m * math.cos(steer[k]) * _force(front, tyres.formulas[0], tyres.keeps[0], mu)
            moment -= tyres.rear_m * _force(rear, tyres.formulas[1], tyres.keeps[1], mu)
            r_dot = tyres.per_gyration * moment + (r_dot - tyres.per_gyration * moment) * kept
            r += dt[k] / n * r_dot
        out[k] = r


METRICS = described(_columns, yaw_consistency=rms)
