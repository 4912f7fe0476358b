"""The pure physics filter that runs in parallel to the network and provides its features (docs/method.md#network).

The bundle of a network names the filter that it was trained with: ``physics``, or ``phy-ukf`` for the paper's network
and the baselines, which are frozen.
"""

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.estimators import vehicle_ukf as ukf
from pdhef_logtool.estimators.filter_steps import U_FRICTION, U_SPEED, U_STEER, U_STEER_KNOWN, PosteriorSteps
from pdhef_logtool.estimators.prediction import rolls_forward
from pdhef_logtool.estimators.vehicle_model import AX_BIAS, FRONT, REAR, VX, VY, YAW_RATE
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.residual_model.bundle import PHYSICS_MODEL
from pdhef_logtool.residual_model.features import FEATURES


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
) -> tuple[FloatArray, FloatArray, PosteriorSteps, ukf.FilterState]:
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
    features = make_features(physics, steps, signals if seen is None else seen)
    steers = steps.inputs[:, U_STEER_KNOWN] > 0.0
    features[~(steps.valid & steers & rolls_forward(steps.x[:, VX], steps.inputs[:, U_SPEED]))] = np.nan
    dt_s = signals.steps_s
    dt_s[~np.isfinite(steps.prior[:, VX])] = np.nan
    return features, dt_s, steps, after


def make_features(physics: ukf.VehicleUkf, steps: PosteriorSteps, seen: Signals) -> FloatArray:
    """Return the features [K, 15] of steps, finite where the filter's state is finite.

    The measurements ``seen`` count less the biases that the filter estimates; a missing one is replaced by the
    filter's prediction.
    """
    layout, x, seen = physics.layout, steps.x, without_impossible(seen)
    prior, nothing = np.where(np.isfinite(steps.prior), steps.prior, x), np.zeros(len(x))
    of_steer, of_ay, of_rate, of_ax = np.zeros((4, len(x)))
    if (bias := layout.sensor_bias) >= 0:
        of_steer, of_ay, of_rate, of_ax = x[:, [layout.steer_bias, bias, bias + 1, AX_BIAS]].T
    roll, roll_rate = x[:, layout.roll : layout.roll + 2].T if layout.roll >= 0 else (nothing, nothing)
    front, rear = x[:, [FRONT, REAR]].T if layout.forces >= 0 else (nothing, nothing)
    ay, rate, ax = seen.ay_m_s2 - of_ay, seen.yaw_rate_rad_s - of_rate, seen.ax_m_s2 - of_ax
    ay = np.where(np.isfinite(ay), ay, physics.expected_ay(x, steps.inputs) - of_ay)
    rate, friction = np.where(np.isfinite(rate), rate, prior[:, YAW_RATE]), steps.inputs[:, U_FRICTION]
    after, before = (np.arctan2(state[:, VY], np.maximum(state[:, VX], 0.1)) for state in (x, prior))
    columns = {
        "vx_m_s": x[:, VX],
        "ay_m_s2": ay,
        "steer_rad": steps.inputs[:, U_STEER] - of_steer,
        "yaw_rate_rad_s": rate,
        "delta_yaw_rate_rad_s": rate - prior[:, YAW_RATE],
        "delta_sideslip_rad": after - before,
        "physics_vy_m_s": x[:, VY],
        "physics_yaw_rate_rad_s": x[:, YAW_RATE],
        "friction": friction,
        "ax_m_s2": np.where(np.isfinite(ax), ax, 0.0),
        "utilisation": np.abs(ay) / (friction * GRAVITY_M_S2),
        "roll_rad": roll,
        "roll_rate_rad_s": roll_rate,
        "front_force_per_mass": front,
        "rear_force_per_mass": rear,
    }
    return np.stack([columns[name] for name in FEATURES], axis=1)
