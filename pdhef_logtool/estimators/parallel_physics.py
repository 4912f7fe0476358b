"""The pure physics filter that runs in parallel to the network and provides its features (docs/method.md#network).

The bundle of a network names the filter that it was trained with: ``physics``, or ``phy-ukf`` for the paper's network
and the baselines, which are frozen.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.estimators import vehicle_ukf as ukf
from pdhef_logtool.estimators.vehicle_model import AX_BIAS, FRONT, REAR, VX
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.residual_model.bundle import PHYSICS_MODEL
from pdhef_logtool.residual_model.features import make_features

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car

#: Number of features from the states of ``physics`` beyond the motion.
_BODY = 4


def filter_of(car: Car, model: str, *, use_speed: bool = True) -> ukf.VehicleUkf:
    """Return the parallel filter for networks of a model, one of :data:`~.bundle.MODELS`."""
    return (
        ukf.of_car(car, use_speed=use_speed)
        if model == PHYSICS_MODEL
        else ukf.nominal_filter(car.vehicle, use_speed=use_speed)
    )


def run_features(
    physics: ukf.VehicleUkf,
    signals: Signals,
    state: ukf.FilterState | None,
    *,
    seen: Signals | None = None,
    extra_r: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray, ukf.PosteriorSteps, ukf.FilterState]:
    """Run the parallel filter over a window; the network sees measurements less the biases that the filter estimates.

    Parameters
    ----------
    seen : measurements for the network; by default the measurements in ``signals``.
    extra_r : [K, 2], as for :meth:`~.vehicle_ukf.VehicleUkf.run`.

    Returns
    -------
    features : [K, 15], NaN without steering, without a state of the filter, or if the filter moves backwards against
        the speed sensor.
    dt_s : [K], duration before each step, NaN where the filter starts.
    steps, state : of the filter.
    """
    steps, after = physics.run(signals, state, extra_r=extra_r)
    seen = signals if seen is None else seen
    layout, body = physics.layout, np.zeros((len(signals), _BODY))
    if layout.roll >= 0:
        body[:, :2] = steps.x[:, layout.roll : layout.roll + 2]
    if layout.forces >= 0:
        body[:, 2:] = steps.x[:, [FRONT, REAR]]
    usable, bias = without_impossible(seen), np.zeros((len(signals), 4))
    if layout.sensor_bias >= 0:
        bias = steps.x[:, [layout.steer_bias, layout.sensor_bias, layout.sensor_bias + 1, AX_BIAS]]
    of_steer, of_ay, of_rate, of_ax = bias.T
    features = make_features(
        steps.inputs[:, ukf.U_STEER] - of_steer, usable.ay_m_s2 - of_ay, usable.yaw_rate_rad_s - of_rate,
        steps.x, steps.prior, physics.expected_ay(steps.x, steps.inputs) - of_ay,
        steps.inputs[:, ukf.U_FRICTION], usable.ax_m_s2 - of_ax, body,
    )  # fmt: skip
    steers = steps.inputs[:, ukf.U_STEER_KNOWN] > 0.0
    features[~(steps.valid & steers & ukf.rolls_forward(steps.x[:, VX], steps.inputs[:, ukf.U_SPEED]))] = np.nan
    dt_s = signals.steps_s
    dt_s[~np.isfinite(steps.prior[:, VX])] = np.nan
    return features, dt_s, steps, after
