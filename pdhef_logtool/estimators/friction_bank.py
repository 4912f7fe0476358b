"""Online road friction from a bank of filters with different frictions (docs/method.md#friction).

Every filter j of the bank has the state [v_y, r] at its friction μ_j; speed and held inputs come from a common
``phy-ukf``. It is an extended Kalman filter on the nominal model, with a_y corrected for body roll and R at model-error
level: below about 40 % of the grip, model errors have more effect than friction and must not change the weights.

The weights follow w_j ∝ (w_j^f · prior_j^(1−f)) · L_j^η with f = exp(−Δt/τ): past evidence is forgotten with the time
constant τ, and without new evidence the weights return to the prior of a dry road. L_j is the likelihood of the
innovations of a_y and yaw rate under a Student distribution, which limits the effect of single samples. Its normalising
factor is omitted: R is much larger than the noise, and a smaller predicted covariance is no evidence for a filter (with
the factor, a straight road would appear slippery). The power η < 1 accounts for correlated model errors of neighbouring
samples.

If no drive has validated the tyres of the vehicle file, eight more filters assume friction 1 and softer or stiffer
tyres at either axle. Then only saturation, which they cannot explain, indicates a slippery road.

The estimate is the weighted mean, with a lower bound from the largest lateral acceleration so far; this bound is
dropped once the weights indicate saturation. The estimate at step k uses only samples before step k, so that a filter
that uses it does not process its measurements twice.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from pdhef_logtool.car.nominal_model import (
    ModelParameters,
    measured_lateral_acceleration,
    model_parameters,
    state_derivative,
    substeps,
)
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.vehicle_model import VX
from pdhef_logtool.estimators.vehicle_ukf import U_STEER, nominal_filter
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.steps import step_durations_s

#: Required aligned signals.
NEEDS = frozenset({"steer_rad", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s"})
#: Frictions of the bank, and their prior probabilities on an unknown road: mean 0.86, 1-sigma 0.23.
GRID = (0.12, 0.2, 0.3, 0.4, 0.5, 0.62, 0.75, 0.88, 1.0, 1.12)
PRIOR = (0.015, 0.02, 0.025, 0.025, 0.03, 0.055, 0.14, 0.27, 0.27, 0.15)
USUAL_FRICTION = sum(mu * weight for mu, weight in zip(GRID, PRIOR, strict=True))
#: Factors on the stiffness of the front and rear axle of an unvalidated file: prior 1-sigma steps.
STIFFNESS = tuple(pair for pair in product((0.625, 1.0, 1.6), repeat=2) if pair != (1.0, 1.0))
#: Process 1-sigma per √s of v_y (m/s) and r (rad/s); measurement 1-sigma of a_y (m/s²) and r (rad/s), at model-error
#: level; all tuned for the sideslip error on simulated drives that are not used in any table.
Q_VY, Q_YAW_RATE = 0.3, 0.1
R_AY, R_YAW_RATE = 1.5, 0.006
#: Degrees of freedom of the Student distribution, the power η, and the forgetting time τ.
STUDENT_DOF, LIKELIHOOD_POWER, FORGETTING_S = 4.0, 0.3, 2.0
INITIAL_VY_STD, INITIAL_YAW_RATE_STD = 0.5, 0.1
#: Below this multiple of the low-speed blend, and after a longer step, the bank pauses and forgets.
LEAST_SPEED_BLENDS = 1.67
LONGEST_STEP_S = 0.1
#: Limit of |v_y| / v_x, as filters with too low friction drift off.
MAX_VY_SHARE = 0.7
#: The lower bound is this share of the friction required by the smoothed a_y.
BOUND_SHARE, BOUND_SMOOTHING_S = 0.9, 0.1
#: Friction is observable if the 1-sigma of the weights is below this; for the prior it is 0.23.
OBSERVABLE_STD = 0.12

# Scalars carried between steps: whether the states are initialized, smoothed a_y, the largest relevant a_y, and
# steering and speed of the previous step.
_STARTED, _AY, _REACHED, _STEER, _SPEED = range(5)
_MEMORY = 5
_NOT_MEASURED = 1e12  # variance of a channel without a sample
_STEP_VY, _STEP_YAW_RATE = 0.02, 0.002  # for difference quotients


@dataclass(frozen=True, slots=True, eq=False)
class FrictionEstimate:
    """Friction at each stamp, [N] each: estimate, 1-sigma of the weights, and whether it is observable."""

    friction: FloatArray
    std: FloatArray
    observable: BoolArray


@njit(cache=True)
def _advance(v, vy, r, steer, friction, dt, n, p):  # type: ignore[no-untyped-def]
    """Advance [v_y, r] at constant speed by ``dt`` s in ``n`` Heun steps."""
    h = dt / n
    for _ in range(n):
        _, a1, b1 = state_derivative(v, vy, r, steer, 0.0, friction, p)
        _, a2, b2 = state_derivative(v, vy + h * a1, r + h * b1, steer, 0.0, friction, p)
        vy += 0.5 * h * (a1 + a2)
        r += 0.5 * h * (b1 + b2)
    return vy, r


@njit(cache=True)
def _step(x, P, over, now, friction, dt, p):  # type: ignore[no-untyped-def]
    """Advance one filter by a step, x [2] and P [3] (vv, vr, rr) in place; return its log-likelihood, not normalised.

    ``over`` has speed and steering over the step, ``now`` the same at its end, a_y and yaw rate, which may be NaN.
    """
    v, steer = over
    v_now, steer_now, ay, yaw_rate = now
    limit = MAX_VY_SHARE * v
    vy, r = min(limit, max(-limit, x[0])), x[1]
    n = substeps(v, dt, friction, p)
    vy_next, r_next = _advance(v, vy, r, steer, friction, dt, n, p)
    vy_v, r_v = _advance(v, vy + _STEP_VY, r, steer, friction, dt, n, p)
    vy_r, r_r = _advance(v, vy, r + _STEP_YAW_RATE, steer, friction, dt, n, p)
    f00, f10 = (vy_v - vy_next) / _STEP_VY, (r_v - r_next) / _STEP_VY
    f01, f11 = (vy_r - vy_next) / _STEP_YAW_RATE, (r_r - r_next) / _STEP_YAW_RATE
    t00, t01 = f00 * P[0] + f01 * P[1], f00 * P[1] + f01 * P[2]
    t10, t11 = f10 * P[0] + f11 * P[1], f10 * P[1] + f11 * P[2]
    p0 = t00 * f00 + t01 * f01 + Q_VY * Q_VY * dt
    p1 = t00 * f10 + t01 * f11
    p2 = t10 * f10 + t11 * f11 + Q_YAW_RATE * Q_YAW_RATE * dt
    vy, r = vy_next, r_next

    z = measured_lateral_acceleration(v_now, vy, r, steer_now, friction, p)
    h0 = (measured_lateral_acceleration(v_now, vy + _STEP_VY, r, steer_now, friction, p) - z) / _STEP_VY
    h1 = (measured_lateral_acceleration(v_now, vy, r + _STEP_YAW_RATE, steer_now, friction, p) - z) / _STEP_YAW_RATE
    has_ay, has_rate = math.isfinite(ay), math.isfinite(yaw_rate)
    nu_a = ay - z if has_ay else 0.0
    nu_r = yaw_rate - r if has_rate else 0.0
    dof = (1.0 if has_ay else 0.0) + (1.0 if has_rate else 0.0)
    if dof == 0.0:
        x[0], x[1], P[0], P[1], P[2] = vy, r, p0, p1, p2
        return 0.0
    var_a = R_AY * R_AY if has_ay else _NOT_MEASURED
    var_r = R_YAW_RATE * R_YAW_RATE if has_rate else _NOT_MEASURED
    c0, c1 = p0 * h0 + p1 * h1, p1 * h0 + p2 * h1  # P Hᵀ of a_y; for r it is (p1, p2)
    s00, s01, s11 = h0 * c0 + h1 * c1 + var_a, c1, p2 + var_r
    det = s00 * s11 - s01 * s01
    square = (s11 * nu_a * nu_a - 2.0 * s01 * nu_a * nu_r + s00 * nu_r * nu_r) / det
    log_likelihood = -0.5 * (STUDENT_DOF + dof) * math.log(1.0 + square / STUDENT_DOF)

    # An outlier of the Student distribution is equivalent to a sample with a larger R.
    inflation = (STUDENT_DOF + square) / (STUDENT_DOF + dof)
    if inflation > 1.0:
        s00 += (inflation - 1.0) * var_a
        s11 += (inflation - 1.0) * var_r
        det = s00 * s11 - s01 * s01
    k00, k01 = (c0 * s11 - p1 * s01) / det, (p1 * s00 - c0 * s01) / det
    k10, k11 = (c1 * s11 - p2 * s01) / det, (p2 * s00 - c1 * s01) / det
    x[0] = vy + k00 * nu_a + k01 * nu_r
    x[1] = r + k10 * nu_a + k11 * nu_r
    P[0] = p0 - (k00 * c0 + k01 * p1)
    P[1] = p1 - (k00 * c1 + k01 * p2)
    P[2] = p2 - (k10 * c1 + k11 * p2)
    return log_likelihood


@njit(cache=True)
def _weigh(weights, prior, log_likelihood, keep):  # type: ignore[no-untyped-def]
    """Move the weights [M] by a share 1 - ``keep`` towards the prior [M], add the log-likelihoods [M]; in place."""
    total = 0.0
    best = log_likelihood.max()
    for j in range(weights.shape[0]):
        weights[j] = weights[j] ** keep * prior[j] ** (1.0 - keep) * math.exp(log_likelihood[j] - best)
        total += weights[j]
    for j in range(weights.shape[0]):
        weights[j] = max(weights[j] / total, 1e-12)


@njit(cache=True)
def _bank(drive, filters, ay_per_friction, bank, out_mu, out_std):  # type: ignore[no-untyped-def]
    """Run the bank over one window; weights [M], x [M, 2], P [M, 3] and memory of ``bank`` are updated in place.

    ``filters`` : friction, its 1-sigma if the filter is right, prior weight [M] and M model parameters.
    """
    dt, vx, steer, usable, ay, yaw_rate = drive
    grid, spread, prior, models = filters
    weights, x, P, memory = bank
    count = grid.shape[0]
    likelihood = np.zeros(count)
    for k in range(dt.shape[0]):
        mean = 0.0
        square = 0.0
        for j in range(count):
            mean += weights[j] * grid[j]
            square += weights[j] * (grid[j] * grid[j] + spread[j] * spread[j])
        out_std[k] = math.sqrt(max(0.0, square - mean * mean))
        out_mu[k] = max(mean, BOUND_SHARE * memory[_REACHED] / ay_per_friction)
        forgotten = math.exp(-max(0.0, dt[k]) / FORGETTING_S)
        if not dt[k] <= LONGEST_STEP_S:
            memory[_STARTED] = 0.0
            memory[_AY] = 0.0
        elif math.isfinite(ay[k]):
            memory[_AY] += (1.0 - math.exp(-dt[k] / BOUND_SMOOTHING_S)) * (ay[k] - memory[_AY])
        kept = forgotten if mean < USUAL_FRICTION - OBSERVABLE_STD else 1.0
        memory[_REACHED] = max(kept * memory[_REACHED], abs(memory[_AY]))
        if not usable[k]:
            memory[_STARTED] = 0.0
        elif memory[_STARTED] == 0.0:
            rate = yaw_rate[k] if math.isfinite(yaw_rate[k]) else 0.0
            for j in range(count):
                x[j, 0], x[j, 1] = models[j].rear_m * rate, rate  # the rear axle rolls without slip
                P[j, 0], P[j, 1], P[j, 2] = INITIAL_VY_STD**2, 0.0, INITIAL_YAW_RATE_STD**2
            memory[_STARTED] = 1.0
        else:
            over = (0.5 * (memory[_SPEED] + vx[k]), 0.5 * (memory[_STEER] + steer[k]))
            now = (vx[k], steer[k], ay[k], yaw_rate[k])
            for j in range(count):
                likelihood[j] = LIKELIHOOD_POWER * _step(x[j], P[j], over, now, grid[j], dt[k], models[j])
        if dt[k] > 0.0:  # not at the very first stamp
            _weigh(weights, prior, likelihood, forgotten)
        likelihood[:] = 0.0
        memory[_STEER] = steer[k]
        memory[_SPEED] = vx[k]


@dataclass(frozen=True, slots=True)
class FrictionBank:
    """The bank of this file.

    Parameters
    ----------
    vehicle : parameters; the bank ignores its friction.
    use_speed : False is the paper's ``esp`` suite: the speed sensor only initializes the filter for the speed.
    validated : whether a drive has validated the tyres of the vehicle.
    """

    vehicle: VehicleParameters
    use_speed: bool = True
    validated: bool = True

    @property
    def _filters(self) -> tuple[FloatArray, FloatArray, FloatArray, tuple[ModelParameters, ...]]:
        """Return friction, its 1-sigma, prior weight [M] and model of each filter."""
        models = (model_parameters(self.vehicle, roll_correction=True),) * len(GRID)
        grid, prior, exact = np.array(GRID), np.array(PRIOR), np.zeros(len(GRID))
        if self.validated:
            return grid, exact, prior, models
        others = (self.vehicle.with_stiffness(*pair) for pair in STIFFNESS)
        models += tuple(model_parameters(vehicle, roll_correction=True) for vehicle in others)
        more = np.ones(len(STIFFNESS))
        unknown = math.sqrt(prior @ (grid - USUAL_FRICTION) ** 2)
        prior = np.append(prior, more / len(more)) / 2.0  # half of the weight for the tyres of the file
        return np.append(grid, more), np.append(exact, unknown * more), prior, models

    @property
    def ay_per_friction(self) -> float:
        """Largest accelerometer reading on a level road at friction 1, m/s²."""
        front, rear = (self.vehicle.magic_formula(f, 1.0)[2] for f in (True, False))
        roll_gain = max(0.0, GRAVITY_M_S2 * self.vehicle.roll_gradient_rad_per_m_s2)
        return (1.0 + roll_gain) * (front + rear) / self.vehicle.mass_kg

    def run(self, signals: Signals) -> FrictionEstimate:
        """Estimate the friction over a drive; ``signals.friction`` is ignored."""
        signals = without_impossible(signals)
        vehicle = self.vehicle.model_copy(update={"friction": USUAL_FRICTION})
        unknown = replace(signals, friction=np.full(len(signals), np.nan))
        speed_filter = nominal_filter(vehicle, use_speed=self.use_speed)
        steps, _ = speed_filter.run(unknown, None)
        filters = grid, _, prior, models = self._filters
        bank = (prior.copy(), np.zeros((len(grid), 2)), np.zeros((len(grid), 3)), np.zeros(_MEMORY))
        dt = step_durations_s(signals.stamps_ns, None)
        vx = np.where(steps.valid, steps.x[:, VX], np.nan)
        usable = np.asarray(vx > LEAST_SPEED_BLENDS * models[0].blend_high_m_s)
        friction, std = np.empty(len(signals)), np.empty(len(signals))
        drive = (
            dt, vx, steps.inputs[:, U_STEER].copy(), usable, signals.ay_m_s2, signals.yaw_rate_rad_s,
        )  # fmt: skip
        _bank(drive, filters, self.ay_per_friction, bank, friction, std)
        return FrictionEstimate(friction, std, std < OBSERVABLE_STD)
