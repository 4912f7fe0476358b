"""``physics`` and ``pd-hef`` with GNSS velocity, including its delay (docs/method.md#gnss).

A single antenna provides a course but no heading. Hypotheses differ in the uncertainty of the filter's v_y (unchanged,
good in the linear range of the tyres, poor) and in the position of the accelerometer. For each one a Kalman filter
estimates [v_y, heading, bias of a_y, bias of the gyro, error of the filter's v_y, antenna x, delay of the receiver,
accelerometer x] from

    v̇_y = a_y − b − x ṙ − (r − b_r) v_x,   ψ̇ = r − b_r,   v_y,filter = v_y − S v_x d,

with d of unit variance and S the uncertainty of the hypothesis, and from the velocity of the antenna across the
heading; for a late sample, the motion that the sensors measured since then is subtracted from the present velocity. The
hypotheses are weighted by the likelihood of the GNSS samples, with a forgetting time of seconds, as in
:mod:`~.adaptive_physics`: unless GNSS contradicts the filter, its estimate is unchanged. Samples between a jump against
the sensors and a jump back are ignored.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.base import notes_of, predict_track
from pdhef_logtool.estimators.intervals import scaled_covariance
from pdhef_logtool.estimators.kinematic_filter import BIAS_M_S2, BIAS_S, LAW_S, LAW_WHITE, TILT_SHARE, correct
from pdhef_logtool.estimators.reference.gnss import JUMP_M_S, LEAST_COURSE_SPEED_M_S
from pdhef_logtool.estimators.reference.inputs import GNSS_LAG_S
from pdhef_logtool.estimators.vehicle_ukf import LIMIT_TIME_S, LINEAR_SHARE, VehicleUkf, sideslip_std
from pdhef_logtool.records.signals import FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import RESTART_GAP_S, ExtendedSteps, Extrapolation, last_stamp_ns, step_durations_s
from pdhef_logtool.records.tracks import StateTrack

#: Entries of the state of a hypothesis.
VY, HEADING, AY_BIAS, RATE_BIAS, LAW_ERROR, ANTENNA_X, DELAY, IMU_X, STATES = range(9)
#: Uncertainty of the filter's v_y over v_x in degrees: constant, per m/s², per m/s³, per square of the share of the
#: grip beyond the linear range; the logarithm of the prior weight; and 1-sigma of the accelerometer's position in m.
#: Tuned on simulated drives. A free position in every hypothesis would absorb tyre model errors.
HYPOTHESES = ((0.01, 0.0, 0.0, 0.0, 0.0, 0.0), (0.06, 0.02, 0.02, 30.0, -5.5, 0.0), (0.06, 0.02, 0.02, 30.0, -6.5, 1.0),
              (1.0, 0.3, 0.1, 30.0, -9.0, 0.3), (10.0, 0.3, 0.1, 30.0, -13.0, 0.3))  # fmt: skip
#: Minimum 1-sigma of a GNSS velocity, m/s; gate in 1-sigmas.
GNSS_STD_M_S, GATE_SIGMA = 0.1, 4.0
#: Forgetting time constant of the likelihood, s; time of contradicting samples after which the heading is
#: reinitialized, s.
FORGET_S, LOST_S = 5.0, 20.0
#: Height of an antenna over the roll axis and its 1-sigma, m; 1-sigma of antenna x, unknown and known, m.
ANTENNA_HEIGHT_M, HEIGHT_STD_M, ANTENNA_STD_M, KNOWN_ANTENNA_STD_M = 1.2, 0.5, 0.5, 0.1
#: Initial 1-sigmas: heading, rad; gyro, rad/s; delay, s.
HEADING_STD, RATE_STD, DELAY_STD_S = 0.1, 0.002, 0.03
#: White noise of accelerometer, m/s²/√Hz, and gyro, rad/s/√Hz; random walk of the gyro's bias, rad/s/√s; time interval
#: of the white part of the filter's error, s, and its floor, m/s.
AY_NOISE, RATE_NOISE, RATE_WALK, KNOT_S, FLOOR_M_S = 0.05, 0.001, 1e-5, 0.05, 0.005
#: Low-pass time constants for the magnitude and the derivative of a_y, s; capacity of the queue of late GNSS samples.
SIZE_S, SLOPE_S, QUEUE = 0.05, 0.1, 64
_LAW = np.array(HYPOTHESES) * np.array([math.pi / 180.0] * 4 + [1.0, 1.0])

# Entries of the state shared by all hypotheses, and columns of a queued sample.
_CLOCK, _RATE, _AY, _VX, _TURNED, _MOVED, _SIZE, _SLOPE = range(8)
_GRIP, _RUNS, _LEFT, _LAST, _JUMP, _SINCE, _AGREES, _FIRST, _END = range(8, 17)
_EAST, _NORTH, _AT, _ARRIVAL, _TURNED_THEN, _MOVED_THEN, _RATE_THEN, _AY_THEN, _ROLL_THEN, _STD = range(10)


class Aiding(NamedTuple):
    """Memory between windows: states [H, 8] and covariances, facts of each, shared state, queued samples.

    ``facts`` [H, 3]: evidence, whether the heading is initialized, and start of the rejection of samples (−1: none).
    """

    x: FloatArray
    P: FloatArray
    facts: FloatArray
    shared: FloatArray
    waiting: FloatArray


@njit(cache=True)
def _start(memory, antenna, imu_x_m, vy, vx):  # type: ignore[no-untyped-def]
    x, P, facts, shared, _ = memory
    x[:], P[:], facts[:], shared[:] = 0.0, 0.0, 0.0, 0.0
    x[:, VY], x[:, ANTENNA_X], x[:, IMU_X], facts[:, 2] = vy, antenna[0], imu_x_m, -1.0
    for i in range(x.shape[0]):
        P[i, VY, VY] = 0.01 + (_LAW[i, 0] * vx) ** 2
        P[i, AY_BIAS, AY_BIAS], P[i, RATE_BIAS, RATE_BIAS] = BIAS_M_S2**2, RATE_STD**2
        P[i, LAW_ERROR, LAW_ERROR] = 1.0
        P[i, ANTENNA_X, ANTENNA_X], P[i, DELAY, DELAY] = antenna[1] ** 2, DELAY_STD_S**2
        P[i, IMU_X, IMU_X] = _LAW[i, 5] ** 2


@njit(cache=True)
def _advance(x, P, dt, vx, ay_slope, kinematic):  # type: ignore[no-untyped-def]
    """Advance one hypothesis by a step; ``kinematic`` has the integrals of the sensors.

    These are the changes of v_y at the sensors for constant heading, of the heading, and of the yaw rate.
    """
    kept, law_kept = math.exp(-dt / BIAS_S), math.exp(-dt / LAW_S)
    x[VY] += kinematic[0] - dt * (x[AY_BIAS] - x[RATE_BIAS] * vx) - kinematic[2] * x[IMU_X]
    x[HEADING] += kinematic[1] - dt * x[RATE_BIAS]
    x[AY_BIAS] *= kept
    x[LAW_ERROR] *= law_kept
    for j in range(STATES):  # F P, then (F P) Fᵀ
        P[VY, j] += dt * (vx * P[RATE_BIAS, j] - P[AY_BIAS, j]) - kinematic[2] * P[IMU_X, j]
        P[HEADING, j] -= dt * P[RATE_BIAS, j]
        P[AY_BIAS, j] *= kept
        P[LAW_ERROR, j] *= law_kept
    for i in range(STATES):
        P[i, VY] += dt * (vx * P[i, RATE_BIAS] - P[i, AY_BIAS]) - kinematic[2] * P[i, IMU_X]
        P[i, HEADING] -= dt * P[i, RATE_BIAS]
        P[i, AY_BIAS] *= kept
        P[i, LAW_ERROR] *= law_kept
    gyro = RATE_NOISE**2 * dt
    P[VY, VY] += AY_NOISE**2 * dt + gyro * vx * vx
    P[VY, HEADING] -= gyro * vx
    P[HEADING, VY] -= gyro * vx
    P[HEADING, HEADING] += gyro
    P[AY_BIAS, AY_BIAS] += BIAS_M_S2**2 * (1.0 - kept * kept) + (TILT_SHARE * ay_slope * dt) ** 2
    P[RATE_BIAS, RATE_BIAS] += RATE_WALK**2 * dt
    P[LAW_ERROR, LAW_ERROR] += 1.0 - law_kept * law_kept


@njit(cache=True)
def _residual(x, P, facts, sample, shared, h):  # type: ignore[no-untyped-def]
    """Return the residual of a GNSS velocity across the heading, its own and its total variance; Jacobian in h."""
    age = shared[_CLOCK] - sample[_AT]
    turned = shared[_TURNED] - sample[_TURNED_THEN] - age * x[RATE_BIAS]
    moved = shared[_MOVED] - sample[_MOVED_THEN] - age * (x[AY_BIAS] - x[RATE_BIAS] * shared[_VX])
    rate = sample[_RATE_THEN] - x[RATE_BIAS]
    sped = shared[_RATE] - sample[_RATE_THEN]
    left = (
        x[VY]
        - moved
        + x[IMU_X] * sped
        + x[ANTENNA_X] * rate
        - x[DELAY] * sample[_AY_THEN]
        - ANTENNA_HEIGHT_M * sample[_ROLL_THEN]
    )
    if facts[1] == 0.0:
        x[HEADING] = math.atan2(sample[_NORTH], sample[_EAST]) - math.atan2(left, shared[_VX]) + turned
        P[HEADING, :], P[:, HEADING] = 0.0, 0.0
        P[HEADING, HEADING], facts[1] = HEADING_STD**2, 1.0
    c, s = math.cos(x[HEADING] - turned), math.sin(x[HEADING] - turned)
    h[:] = 0.0
    h[VY], h[HEADING] = 1.0, c * sample[_EAST] + s * sample[_NORTH]
    h[ANTENNA_X], h[DELAY], h[IMU_X] = rate, -sample[_AY_THEN], sped
    white = sample[_STD] ** 2 + (BIAS_M_S2 * age) ** 2
    variance = white
    for i in range(STATES):
        for j in range(STATES):
            variance += h[i] * P[i, j] * h[j]
    return c * sample[_NORTH] - s * sample[_EAST] - left, white, variance


@njit(cache=True)
def _use(x, P, facts, sample, shared, h, doubt):  # type: ignore[no-untyped-def]
    """Update one hypothesis with a GNSS velocity; return the remaining residual. ``doubt``: cost of a misfit."""
    error, white, variance = _residual(x, P, facts, sample, shared, h)
    square = error * error / variance
    facts[0] -= 0.5 * (min(square, GATE_SIGMA**2) + math.log(variance))
    if square <= GATE_SIGMA**2:
        facts[2] = -1.0
        correct(x, P, h, error, white)
        return error * white / variance
    facts[0] -= doubt
    facts[2] = shared[_CLOCK] if facts[2] < 0.0 else facts[2]
    if shared[_CLOCK] - facts[2] > LOST_S:
        facts[1], facts[2] = 0.0, -1.0
    return error


@njit(cache=True)
def _has_jumped(error, sample, shared, facts):  # type: ignore[no-untyped-def]
    """Return whether GNSS is between a jump against the sensors and a jump back (multipath), at most ``LOST_S``."""
    change = error - shared[_LEFT]
    limit = JUMP_M_S + 0.02 * abs(sample[_AY_THEN]) + 0.5 * (sample[_AT] - shared[_LAST]) + abs(sample[_ROLL_THEN])
    limit += 0.3 * abs(sample[_RATE_THEN])  # an error of v_x becomes one of v_y
    shared[_LAST] = sample[_AT]
    if shared[_JUMP] == 0.0 and abs(change) > limit:
        shared[_JUMP], shared[_SINCE] = change, shared[_CLOCK]
    elif abs(change + shared[_JUMP]) < 0.5 * abs(shared[_JUMP]):
        shared[_JUMP] = 0.0
    elif shared[_JUMP] != 0.0 and shared[_CLOCK] - shared[_SINCE] > LOST_S:
        shared[_JUMP], shared[_LEFT] = 0.0, 0.0
        facts[:, 1] = 0.0
        return True
    shared[_LEFT] = error
    return shared[_JUMP] != 0.0


@njit(cache=True)
def _queue(columns, k, p_roll, shared, waiting):  # type: ignore[no-untyped-def]
    """Queue the GNSS velocity of step k until its arrival; a full queue drops the oldest sample."""
    east, north, std, late = columns[7:]
    row, last = waiting[int(shared[_END]) % QUEUE], waiting[int(shared[_END] - 1.0) % QUEUE]
    if shared[_END] > 0.0:  # a course that turns against the gyro indicates exchanged or mirrored axes
        turn = last[_EAST] * north[k] - last[_NORTH] * east[k]
        shared[_AGREES] += turn / (math.hypot(east[k], north[k]) ** 2) * (shared[_TURNED] - last[_TURNED_THEN])
    row[_EAST], row[_NORTH], row[_AT], row[_ARRIVAL] = east[k], north[k], shared[_CLOCK], shared[_CLOCK] + late[k]
    row[_TURNED_THEN], row[_MOVED_THEN], row[_ROLL_THEN] = shared[_TURNED], shared[_MOVED], p_roll
    row[_RATE_THEN], row[_AY_THEN] = shared[_RATE], shared[_AY]
    stated = max(std[k], GNSS_STD_M_S) if std[k] == std[k] else GNSS_STD_M_S
    row[_STD] = math.sqrt(stated**2 + (GNSS_LAG_S * shared[_AY]) ** 2 + (HEIGHT_STD_M * p_roll) ** 2)
    shared[_END] += 1.0
    shared[_FIRST] = max(shared[_FIRST], shared[_END] - QUEUE)


@njit(cache=True)
def _share(columns, k, dt, roll_gradient, grip_m_s2, shared):  # type: ignore[no-untyped-def]
    """Advance the shared state to step k; return the integrals of the sensors, and the slope of a_y."""
    ay, rate, vx = columns[2:5]
    new_rate = rate[k] if math.isfinite(rate[k]) else shared[_RATE]
    new_ay = ay[k] / (1.0 + GRAVITY_M_S2 * roll_gradient) if math.isfinite(ay[k]) else shared[_AY]
    if dt == 0.0:
        shared[_RATE], shared[_AY], shared[_SIZE], shared[_SLOPE], shared[_VX] = new_rate, new_ay, new_ay, new_ay, vx[k]
    r = 0.5 * (shared[_RATE] + new_rate)
    turned = dt * r
    moved = dt * (0.5 * (shared[_AY] + new_ay) - r * 0.5 * (shared[_VX] + vx[k]))
    sped = new_rate - shared[_RATE]
    before = shared[_SLOPE]
    shared[_SIZE] += (new_ay - shared[_SIZE]) * (1.0 - math.exp(-dt / SIZE_S))
    shared[_SLOPE] += (new_ay - shared[_SLOPE]) * (1.0 - math.exp(-dt / SLOPE_S))
    shared[_GRIP] = max(abs(shared[_SIZE]) / grip_m_s2, shared[_GRIP] * math.exp(-dt / LIMIT_TIME_S))
    shared[_CLOCK] += dt
    shared[_TURNED] += turned
    shared[_MOVED] += moved
    shared[_RATE], shared[_AY], shared[_VX] = new_rate, new_ay, vx[k]
    return (moved, turned, sped), (shared[_SLOPE] - before) / dt if dt > 0.0 else 0.0


@njit(cache=True)
def _mixture(x, P, facts, agrees, vy, out, k):  # type: ignore[no-untyped-def]
    """Write the correction of v_y at step k by the hypotheses, the weight of the filter, and their variance."""
    total, mean, variance, most = 0.0, 0.0, 0.0, np.max(facts[:, 0] + _LAW[:, 4])
    for i in range(x.shape[0]):
        has_heading = i == 0 or (agrees and facts[i, 1] > 0.0)  # GNSS is not informative without a heading
        weight = math.exp(facts[i, 0] + _LAW[i, 4] - most) if has_heading else 0.0
        total += weight
        if i > 0:
            mean += weight * (x[i, VY] - vy)
            variance += weight * (P[i, VY, VY] + (x[i, VY] - vy) ** 2)
        else:
            out[k, 1] = weight
    mean /= total
    out[k, 0], out[k, 1], out[k, 2] = mean, out[k, 1] / total, max(0.0, variance / total - mean * mean)


@njit(cache=True)
def _aid(columns, body, antenna, memory, out):  # type: ignore[no-untyped-def]
    """Process one window; ``memory`` is updated in place. ``out`` [K, 3] as in :func:`_mixture`."""
    dts, ready, _, _, vx, vy, usable, east, north, _, _ = columns
    x, P, facts, shared, waiting = memory
    h = np.empty(STATES)
    for k in range(dts.shape[0]):
        out[k, 0], out[k, 1], out[k, 2] = 0.0, 1.0, 0.0
        if not usable[k]:
            shared[_RUNS] = 0.0
            continue
        dt = dts[k]
        if shared[_RUNS] == 0.0 or not dt <= RESTART_GAP_S:
            _start(memory, antenna, body[1], vy[k], vx[k])
            dt = 0.0
        shared[_RUNS] = 1.0
        kinematic, ay_slope = _share(columns, k, dt, body[0], body[2], shared)
        beyond = max(0.0, shared[_GRIP] - LINEAR_SHARE) ** 2
        for i in range(x.shape[0]):
            if dt == 0.0:
                continue
            facts[i, 0] *= math.exp(-dt / FORGET_S)
            _advance(x[i], P[i], dt, vx[k], ay_slope, kinematic)
            law = _LAW[i, 0] + _LAW[i, 1] * abs(shared[_SIZE]) + _LAW[i, 2] * abs(ay_slope) + _LAW[i, 3] * beyond
            error_m_s = law * max(vx[k], 1.0)
            h[:] = 0.0
            h[VY], h[LAW_ERROR] = 1.0, -error_m_s
            white = (LAW_WHITE * error_m_s) ** 2 * KNOT_S / dt + FLOOR_M_S**2
            correct(x[i], P[i], h, vy[k] - x[i, VY] + error_m_s * x[i, LAW_ERROR], white)
        if math.hypot(east[k], north[k]) >= LEAST_COURSE_SPEED_M_S:
            _queue(columns, k, body[0] * ay_slope, shared, waiting)
        while shared[_FIRST] < shared[_END]:
            sample = waiting[int(shared[_FIRST]) % QUEUE]
            if sample[_ARRIVAL] > shared[_CLOCK] + ready[k]:
                break
            shared[_FIRST] += 1.0
            error, _, _ = _residual(x[-1], P[-1], facts[-1], sample, shared, h)
            if not _has_jumped(error, sample, shared, facts):
                for i in range(x.shape[0]):
                    shared[_LEFT] = _use(x[i], P[i], facts[i], sample, shared, h, min(i, 1))
        _mixture(x, P, facts, shared[_AGREES] > 0.0, vy[k], out, k)


@dataclass(frozen=True, slots=True, eq=False)
class AidedSteps(ExtendedSteps):
    """Steps of the filter, and for each step the correction of v_y, the filter's weight and more variance, [K, 3]."""

    aid: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class AidedState:
    """State of the filter and of the GNSS correction, and the last stamp, between windows."""

    filter: Any
    aiding: Aiding
    last_stamp_ns: int | None


@dataclass(frozen=True, slots=True)
class GnssAided:
    """The estimator of this file; GNSS velocity corrects ``estimator``."""

    algorithm = "gnss-aided"
    version = 1
    options = ("estimator",)

    estimator: AdaptivePhysics
    causal: bool = True

    @property
    def name(self) -> str:
        """Name of the filter."""
        return self.estimator.name

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the report."""
        return (*notes_of(self.estimator), "GNSS velocity corrects v_y")

    @property
    def calibrated_as(self) -> AdaptivePhysics:
        """Estimator that provides the intervals if this one has no calibrated intervals."""
        return self.estimator

    @property
    def _physics(self) -> VehicleUkf:
        return self.estimator.physics

    def run(self, signals: Signals, state: AidedState | None) -> tuple[AidedSteps, AidedState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        before_ns = None if state is None else state.last_stamp_ns
        steps, after = self.estimator.run(signals, None if state is None else state.filter)
        stamps_ns, count, h = signals.stamps_ns, len(signals), len(HYPOTHESES)
        everywhere = np.ones(count, dtype=np.bool_)
        at_steps = Extrapolation(np.arange(count), everywhere, np.zeros(count), np.asarray(steps.valid))
        track = predict_track(self.estimator, steps, at_steps, stamps_ns)
        columns = (
            step_durations_s(stamps_ns, before_ns), (signals.ready_ns - stamps_ns) * 1e-9, signals.ay_m_s2,
            signals.yaw_rate_rad_s, track.vx_m_s, track.vy_m_s, track.valid & np.isfinite(track.vy_m_s),
            *signals.gnss_velocity_m_s.T, signals.gnss_velocity_std_m_s, np.nan_to_num(signals.gnss_late_s),
        )  # fmt: skip
        shapes = ((h, STATES), (h, STATES, STATES), (h, 3), (_END + 1,), (QUEUE, _STD + 1))
        aiding = Aiding(*(np.zeros(s) for s in shapes) if state is None else (a.copy() for a in state.aiding))
        out = np.empty((count, 3))
        vehicle = self._physics.vehicle
        antenna = vehicle.gnss_antenna_position_m
        body = (vehicle.roll_gradient_rad_per_m_s2, vehicle.imu_position_m[0], GRAVITY_M_S2 * vehicle.assumed_friction)
        prior = (0.0, ANTENNA_STD_M) if antenna is None else (antenna[0], KNOWN_ANTENNA_STD_M)
        _aid(columns, body, prior, aiding, out)
        return AidedSteps(steps, out), AidedState(after, aiding, last_stamp_ns(stamps_ns, before_ns))

    def predict(self, steps: AidedSteps, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Extrapolate the filter's steps and add the GNSS correction (see :class:`~.base.ModelPredictor`)."""
        track = self.estimator.predict(steps.steps, ahead, stamps_ns)
        change, weight, variance = steps.aid[ahead.step].T
        change = np.where(track.valid, change, 0.0)
        vy, covariance = track.vy_m_s + change, track.covariance
        of_vy = np.sqrt(weight + variance / np.maximum(covariance[:, 1, 1], 1e-12))
        covariance = scaled_covariance(covariance, of_vy)
        return replace(
            track,
            vy_m_s=vy,
            sideslip_rad=np.arctan2(vy, track.vx_m_s),
            covariance=covariance,
            sideslip_std_rad=sideslip_std(track.vx_m_s, vy, covariance),
        )
