"""95 % confidence intervals of estimators on the vehicle calibrated by their log (docs/method.md#intervals).

The variance of sideslip has three sources: the estimator's own, the uncertainty of the parameters, and contradictions
between the sensors:

    s² = χ² (s_own² + s_car²) + (Σ_i (v_y,i − v_y)² + (0.7 lateral kinematic consistency)² + (s_l r)²) / v_x²,

where v_y,i is the lateral velocity of the physics filter on the vehicle one posterior 1-sigma away in direction i. Of
the lateral kinematic consistency of the whole log, only the part that correlates with the driving is used. s_car is the
model error of a single track, which is nearly constant within a drive and differs between drives and cars. χ ≥ 1 is the
RMS error of the fit over the assumed one (Birge 1932). s_l is the uncertainty of the distance from the rear axle to the
centre of gravity if no file contains it: the lateral velocity is determined at the rear axle. The variance of v_y is
the same sum as a velocity. The estimates are unchanged.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.car.car import WithoutTruth
from pdhef_logtool.car.vehicle import VehicleParameters, corrected_anew
from pdhef_logtool.estimators.intervals import MAX_SIDESLIP_STD_RAD, scaled_covariance
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack

if TYPE_CHECKING:
    from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf

#: Factor of lateral kinematic consistency, and s_car above; from seven simulated cars and real drives of four cars.
D2_SHARE, CAR_STD_RAD = 0.7, math.radians(0.15)


@dataclass(slots=True)
class CalibratedBand:
    """The interval above over one drive; its signals were read with the vehicle file. All tracks share its runs."""

    calibration: WithoutTruth
    vehicle_file: VehicleParameters
    _signals: Signals | None = None
    _vy: list[FloatArray] = field(default_factory=list)

    @property
    def note(self) -> str:
        """Components of the intervals; calibrated intervals of another car are not used."""
        parts = ["own", *(["parameters"] if self.calibration.varied else [])]
        parts += ["d2"] if math.isfinite(self.calibration.driven_d2_m_s) else []
        return f"intervals: {', '.join(parts[:-1])} and {parts[-1]}" if len(parts) > 1 else "intervals not calibrated"

    def widen(self, track: StateTrack, signals: Signals) -> StateTrack:
        """Return a track [N] with wider 1-sigmas of sideslip and v_y."""
        if not len(signals):
            return track
        if signals is not self._signals:
            self._signals, self._vy = signals, self._compared(signals)
        calibration = self.calibration
        d2, scale = calibration.driven_d2_m_s, calibration.error_scale
        contradicted = np.hypot(scale * CAR_STD_RAD * track.vx_m_s, D2_SHARE * d2 if math.isfinite(d2) else 0.0)
        contradicted = np.hypot(contradicted, calibration.cg_std_m * track.yaw_rate_rad_s)
        return widened(track, self._vy, contradicted, calibration.vehicle.low_speed_blend_m_s, own_share=scale)

    def _compared(self, signals: Signals) -> list[FloatArray]:
        """Return v_y of the physics filter on the calibrated vehicle and its variations; empty without variations."""
        from pdhef_logtool.estimators.vehicle_ukf import physics_filter

        calibration = self.calibration
        vehicles = (calibration.vehicle, *calibration.varied) if calibration.varied else ()
        filters = [physics_filter(vehicle, calibration.noise) for vehicle in vehicles]
        return lateral_velocities(filters, calibration.without_estimated_friction(signals), self.vehicle_file)


def lateral_velocities(
    filters: Sequence[VehicleUkf], signals: Signals, read_with: VehicleParameters
) -> list[FloatArray]:
    """Return v_y [N] of filters, each on signals as its vehicle corrects them; they were read with another one."""
    return [run_estimator(f, corrected_anew(signals, read_with, f.vehicle)).vy_m_s for f in filters]


def widened(
    track: StateTrack, compared: Sequence[FloatArray], seen_m_s: FloatArray, slow_m_s: float, *, own_share: float
) -> StateTrack:
    """Return a track [N] with wider 1-sigmas of sideslip and v_y; NaN stays NaN.

    Parameters
    ----------
    compared : v_y of the physics filter [N], first on the vehicle, then on those away from it.
    seen_m_s : contradiction between the sensors, as a velocity [N].
    slow_m_s : lower limit of the speed in the conversion of velocities to angles.
    own_share : factor on the track's own 1-sigma.
    """
    added = np.where(np.isfinite(seen_m_s), seen_m_s, 0.0)
    for vy in compared[1:]:
        away = vy - compared[0]
        added = np.hypot(added, np.where(np.isfinite(away), away, 0.0))
    speed = np.abs(track.vx_m_s)
    added = np.minimum(added / np.maximum(speed, slow_m_s), MAX_SIDESLIP_STD_RAD)
    std = np.minimum(np.hypot(own_share * track.sideslip_std_rad, added), MAX_SIDESLIP_STD_RAD)
    covariance = track.covariance
    if covariance.shape[0]:
        variance = covariance[:, 1, 1]
        rest = np.full(len(track), 1.0 - own_share**2)
        more = np.divide((added * speed) ** 2, variance, out=rest, where=variance > 0.0)
        covariance = scaled_covariance(covariance, np.sqrt(own_share**2 + more))
    return replace(track, sideslip_std_rad=std, covariance=covariance)
