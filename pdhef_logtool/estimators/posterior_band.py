"""95 % confidence intervals from the uncertainty of a car's parameters, by their posterior or prior.

    s² = (k_o s_own)² + Σ_i (v_y,i − v_y)² / v_x² + w²

v_y,i is the lateral velocity of the physics filter on the vehicle one 1-sigma away in direction i of the posterior, or
of the prior if no drive has validated the vehicle file, without the states that compensate model errors. w is the
disagreement of accelerometer and gyro with the estimate's changes, ``kinematic`` of
:mod:`~pdhef_logtool.estimators.error_features`; it indicates driving unlike the identification's. Both are available
online, so that the confidence interval is causal. s_own has a reduced weight, because the noise of an identified car
includes the model error of a_y.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.adaptive_physics import CURES
from pdhef_logtool.estimators.calibrated_band import lateral_velocities, widened
from pdhef_logtool.estimators.calibration.joint import prior_variations
from pdhef_logtool.estimators.error_features import TERMS, error_terms
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf, of_car
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack

#: k_o above, tuned on 8 simulated cars, each identified on one drive and evaluated on drives of other manoeuvres. The
#: other two terms have the weight 1.
OWN_SHARE = 0.5
_KINEMATIC = TERMS.index("kinematic")


@dataclass(slots=True)
class PosteriorBand:
    """The confidence interval of one car over one drive.

    ``filters`` : the physics filter on the car, then on its variations. All tracks share their runs.
    ``vehicle_file`` : the vehicle that the signals were read with.
    """

    filters: tuple[VehicleUkf, ...]
    vehicle_file: VehicleParameters
    _signals: Signals | None = None
    _vy: list[FloatArray] = field(default_factory=list)

    def widen(self, track: StateTrack, signals: Signals) -> StateTrack:
        """Return a track [N] with the 1-sigmas of this module's equation."""
        if signals is not self._signals:
            self._signals, self._vy = signals, lateral_velocities(self.filters, signals, self.vehicle_file)
        vehicle = self.filters[0].vehicle
        terms = error_terms(track, signals, vehicle.roll_gradient_rad_per_m_s2)
        seen = terms[:, _KINEMATIC] * np.abs(track.vx_m_s)
        return widened(track, self._vy, seen, vehicle.low_speed_blend_m_s, own_share=OWN_SHARE)


def posterior_band(car: Car, *, use_speed: bool = True) -> PosteriorBand | None:
    """Return the intervals of estimators on the vehicle file; None if identification stored no posterior."""
    varied = prior_variations(car.physics_vehicle) if car.fitted_physics is None else car.varied_physics
    if not varied:
        return None
    physics, none = of_car(car, use_speed=use_speed), dict.fromkeys(CURES, False)

    def on(vehicle: VehicleParameters) -> VehicleUkf:
        bare = vehicle.model_copy(update={"physics": vehicle.physics.model_copy(update=none)})
        return replace(physics, vehicle=bare)

    return PosteriorBand(tuple(on(v) for v in (physics.vehicle, *varied)), car.vehicle)
