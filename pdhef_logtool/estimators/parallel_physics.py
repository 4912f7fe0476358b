"""The pure physics filter that runs beside the network and gives it its features (METHOD §5)."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from pdhef_logtool.estimators.base import without_impossible
from pdhef_logtool.estimators.physics import U_FRICTION, U_STEER, FilterCarry, PhysicsUkf, PosteriorSteps
from pdhef_logtool.nominal_model import measured_lateral_acceleration, model_parameters
from pdhef_logtool.residual_model.features import make_features
from pdhef_logtool.signals import FloatArray, Signals
from pdhef_logtool.vehicle import VehicleParameters


@njit(cache=True)
def _predicted_ay(x, inputs, p, out):  # type: ignore[no-untyped-def]
    for k in range(x.shape[0]):
        out[k] = math.nan
        if math.isfinite(x[k, 0]):
            out[k] = measured_lateral_acceleration(
                x[k, 0], x[k, 1], x[k, 2], inputs[k, U_STEER], inputs[k, U_FRICTION], p
            )


def parallel_filter(vehicle: VehicleParameters, *, use_speed: bool = True) -> PhysicsUkf:
    """Return the filter whose steps the features are made of: ``phy-ukf`` as it is frozen."""
    return PhysicsUkf(vehicle, use_speed=use_speed, name="parallel")


def run_features(
    physics: PhysicsUkf, signals: Signals, carry: FilterCarry | None
) -> tuple[FloatArray, PosteriorSteps, FilterCarry]:
    """Run the parallel filter over a window.

    Returns
    -------
    features : [K, 8], NaN where the filter has no state. steps, carry : of the filter.
    """
    steps, after = physics.filter_steps(signals, carry)
    usable = without_impossible(signals)
    predicted = np.empty(len(signals))
    _predicted_ay(steps.x, steps.inputs, model_parameters(physics.vehicle), predicted)
    features = make_features(
        steps.inputs[:, U_STEER], usable.ay_m_s2, usable.yaw_rate_rad_s, steps.x, steps.prior, predicted
    )
    features[~steps.valid] = np.nan
    return features, steps, after
