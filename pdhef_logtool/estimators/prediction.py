"""The time update of the vehicle filter, and its tracks: steps predicted to the scored stamps with inputs held."""

import numpy as np

from pdhef_logtool.compiled.cache import inner_kernel, kernel
from pdhef_logtool.estimators import unscented
from pdhef_logtool.estimators.filter_steps import U_AX, U_AX_KNOWN, U_FRICTION, U_SPEED, U_STEER, PosteriorSteps
from pdhef_logtool.estimators.vehicle_model import MOTION, VX, VY, HeldInputs, Model, move, planar_ay, process_noise
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.records.steps import Extrapolation
from pdhef_logtool.records.tracks import StateTrack, make_track

#: If the speed sensor last read more than this, the car does not roll backwards: a v_x below zero is divergence.
FORWARD_M_S = 0.5


# positional: to hand structures of arrays on at every step would cost as much as the step.
@inner_kernel
def predict(x, P, root, over, rate, dt, early, q, layout, places, p, f, points, away, count):  # type: ignore[no-untyped-def]
    """Move state and covariance of its first ``count`` entries by ``dt`` s with the residual ``rate`` of v̇_y and ṙ.

    The share ``early`` of the residual's increment comes before the model's step (Strang splitting: half of it), the
    rest behind it. Leaves the ``root`` of the former covariance, and the deviations of the moved points in ``away``.
    """
    m = layout.changing
    unscented.cholesky(P, root)
    columns = unscented.draw(x, root, places, m, points)
    move(points, columns, over, rate, dt, early, layout, p, f)
    unscented.moments(points, places, m, q, x, P, away, count)


@kernel
def _predict_outputs(due, held, q_std, early, model, scratch, out):  # type: ignore[no-untyped-def]
    """Predict the steps ``due`` with their inputs held; rows without a step (−1) are unchanged."""
    step, horizon_s = due
    held_x, held_P, inputs, residual_rate, noise = held
    out_x, out_P, out_ay = out
    layout, places, p, f = model
    x, P, root, q, points, away = scratch
    n = held_x.shape[1]
    for row in range(step.shape[0]):
        k, dt = step[row], horizon_s[row]
        if k < 0 or not unscented.is_finite(held_x[k], held_P[k]):
            continue
        over = HeldInputs(inputs[k, U_STEER], inputs[k, U_AX], inputs[k, U_AX_KNOWN] > 0.0, inputs[k, U_FRICTION])
        rate = (residual_rate[k, 0], residual_rate[k, 1])
        for a in range(n):
            x[a] = held_x[k, a]
            for b in range(n):
                P[a, b] = held_P[k, a, b]
        if dt > 0.0:
            process_noise(q_std, over.ax_known, noise[k] * dt, layout, q)
            predict(x, P, root, over, rate, dt, early, q, layout, places, p, f, points, away, MOTION)
        unscented.keep_state(x, out_x, row)
        for a in range(MOTION):
            for b in range(MOTION):
                out_P[row, a, b] = P[a, b]
        out_ay[row] = planar_ay(x, over.steer, over.friction, rate[0], layout, p)


def predicted_track(
    name: str,
    steps: PosteriorSteps,
    ahead: Extrapolation,
    stamps_ns: IntArray,
    q_std: FloatArray,
    model: Model,
    *,
    rate: FloatArray,
    noise: FloatArray,
    early: float = 0.5,
) -> StateTrack:
    """Return the track of steps [K], predicted to the scored stamps [M] with their inputs held.

    ``rate`` [K, 2] is the residual, ``noise`` [K] a factor on the time over which process noise adds up.
    """
    step, count, n = ahead.step, len(stamps_ns), model.layout.size
    x, covariance, ay = np.full((count, n), np.nan), np.full((count, MOTION, MOTION), np.nan), np.full(count, np.nan)
    due = (np.where(ahead.usable, step, -1), ahead.horizon_s)
    held = (steps.x, steps.P, steps.inputs, rate, noise)
    scratch = (np.zeros(n), unscented.padded(n, n), unscented.padded(n, n), np.zeros(n), *unscented.block(n))
    _predict_outputs(due, held, q_std, early, model, scratch, (x, covariance, ay))
    usable = ahead.usable & np.isfinite(x[:, VX]) & rolls_forward(x[:, VX], steps.inputs[step, U_SPEED])
    vx, vy, yaw_rate = x[:, :MOTION].T.copy()
    return make_track(
        name,
        stamps_ns,
        vx_m_s=vx,
        vy_m_s=vy,
        yaw_rate_rad_s=yaw_rate,
        ay_m_s2=ay,
        covariance=covariance,
        sideslip_std_rad=sideslip_std(vx, vy, covariance),
        r_scale=np.ones(count),
        nis=np.where(usable, steps.nis[step], np.nan),
        nis_dof=np.where(usable, steps.nis_dof[step], 0.0),
        friction=np.where(usable, steps.inputs[step, U_FRICTION], np.nan),
        valid=usable,
        diverged=usable & steps.diverged[step],
        **{column: np.where(usable, x[:, i], np.nan) for column, i in model.layout.named.items()},
    )


def rolls_forward(vx_m_s: FloatArray, last_speed_m_s: FloatArray) -> BoolArray:
    """Return where v_x [N] does not contradict the last speed sample: the sideslip would be at 180 degrees there."""
    return np.asarray(~((vx_m_s < 0.0) & (last_speed_m_s > FORWARD_M_S)), dtype=np.bool_)


def sideslip_std(vx_m_s: FloatArray, vy_m_s: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the 1-sigma of β = atan2(v_y, v_x) in rad, [N], to first order from the covariance [N, ≥2, ≥2]."""
    v2 = np.maximum(vx_m_s**2 + vy_m_s**2, 1e-6)
    gx, gy = -vy_m_s / v2, vx_m_s / v2
    variance = gx**2 * covariance[:, VX, VX] + gy**2 * covariance[:, VY, VY] + 2.0 * gx * gy * covariance[:, VX, VY]
    return np.sqrt(np.maximum(variance, 0.0))
