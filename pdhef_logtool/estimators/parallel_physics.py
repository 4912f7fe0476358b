"""The pure physics filter that runs in parallel to the network and provides its features (docs/method.md#network).

The bundle of a network names the filter that it was trained with: ``physics``, or ``phy-ukf`` for the paper's network
and the baselines, which are frozen.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.car.nominal_model import measured_lateral_acceleration, model_parameters
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.filter_base import (
    U_FRICTION,
    U_SPEED,
    U_STEER,
    U_STEER_KNOWN,
    VX,
    FilterState,
    PosteriorSteps,
    rolls_forward,
)
from pdhef_logtool.estimators.phy_ukf import PhysicsUkf
from pdhef_logtool.estimators.physics_filter import PhysicsFilter, of_car
from pdhef_logtool.estimators.physics_model import FRONT, REAR, sensed_ay
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.residual_model.bundle import PHYSICS_MODEL
from pdhef_logtool.residual_model.features import make_features

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car

#: Number of features from the states of ``physics`` beyond the motion.
_BODY = 4


@njit(cache=True)
def _nominal_ay(x, inputs, p, out):  # type: ignore[no-untyped-def]
    for k in range(x.shape[0]):
        out[k] = math.nan
        if math.isfinite(x[k, 0]):
            out[k] = measured_lateral_acceleration(
                x[k, 0], x[k, 1], x[k, 2], inputs[k, U_STEER], inputs[k, U_FRICTION], p
            )


@njit(cache=True)
def _physics_ay(x, inputs, layout, p, f, out):  # type: ignore[no-untyped-def]
    row = np.empty(x.shape[1])
    for k in range(x.shape[0]):
        out[k] = math.nan
        if math.isfinite(x[k, 0]):
            out[k] = sensed_ay(x[k], inputs[k, U_STEER], layout, p, f, row)


def parallel_filter(vehicle: VehicleParameters, *, use_speed: bool = True, slip_gate: bool = True) -> PhysicsUkf:
    """Return the filter for the features of the paper's network and of the baselines, the frozen ``phy-ukf``."""
    return PhysicsUkf(vehicle, use_speed=use_speed, slip_gate=slip_gate, name="parallel")


def filter_of(car: Car, model: str, *, use_speed: bool = True) -> PhysicsUkf | PhysicsFilter:
    """Return the parallel filter for networks of a model, one of :data:`~.bundle.MODELS`."""
    return (
        of_car(car, use_speed=use_speed)
        if model == PHYSICS_MODEL
        else parallel_filter(car.vehicle, use_speed=use_speed)
    )


def run_features(
    physics: PhysicsUkf | PhysicsFilter,
    signals: Signals,
    state: FilterState | None,
    *,
    seen: Signals | None = None,
    extra_r: FloatArray | None = None,
) -> tuple[FloatArray, PosteriorSteps, FilterState]:
    """Run the parallel filter over a window.

    Parameters
    ----------
    seen : measurements for the network; by default the measurements in ``signals``.
    extra_r : [K, 2], as for :meth:`~.phy_ukf.PhysicsUkf.run`.

    Returns
    -------
    features : [K, 15], NaN without steering, without a state of the filter, or if the filter moves backwards against
        the speed sensor.
    steps, state : of the filter.
    """
    steps, after = physics.run(signals, state, extra_r=extra_r)
    seen = signals if seen is None else seen
    friction, predicted = steps.inputs[:, U_FRICTION], np.empty(len(signals))
    body = np.zeros((len(signals), _BODY))
    if isinstance(physics, PhysicsFilter):
        layout, p, f = physics.parameters
        _physics_ay(steps.x, steps.inputs, layout, p, f, predicted)
        if layout.roll >= 0:
            body[:, :2] = steps.x[:, layout.roll : layout.roll + 2]
        body[:, 2:] = steps.x[:, [FRONT, REAR]]
    else:
        _nominal_ay(steps.x, steps.inputs, model_parameters(physics.vehicle), predicted)
    usable = without_impossible(seen)
    features = make_features(
        steps.inputs[:, U_STEER], usable.ay_m_s2, usable.yaw_rate_rad_s, steps.x, steps.prior, predicted,
        friction, usable.ax_m_s2, body,
    )  # fmt: skip
    steers = steps.inputs[:, U_STEER_KNOWN] > 0.0
    features[~(steps.valid & steers & rolls_forward(steps.x[:, VX], steps.inputs[:, U_SPEED]))] = np.nan
    return features, steps, after
