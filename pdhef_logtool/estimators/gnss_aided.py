"""``physics`` and ``pd-hef`` with GNSS velocity, as late as it arrives (docs/method.md#gnss).

The :mod:`~.kinematic_filter` runs forward at 20 Hz. The v_y of the wrapped filter is one of its measurements, with an
uncertainty that increases with a_y and beyond the linear range of the tyres; GNSS velocity is another. A single antenna
provides a course but no heading: the heading is a state, which the filter's v_y determines in normal driving. States
and inputs of the last second are kept; a late sample corrects the state of its time, from which the filter is run
again.

The wrapped filter is better than a course in most driving. Therefore

- the noise of a receiver is enlarged by its innovations (normalized innovation squared, over seconds), so that a
  receiver with jumps, a wrong accuracy, a lag or exchanged axes has little influence, and
- its change c of v_y, of variance P, counts with the weight max(0, 1 − (3 σ / c)²), σ² = P: the estimate is unchanged
  unless GNSS contradicts it by more than three standard deviations (non-negative garrote, Breiman 1995).
"""

import math
from copy import deepcopy
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators import kinematic_filter as f
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.base import notes_of
from pdhef_logtool.estimators.prediction import sideslip_std
from pdhef_logtool.estimators.reference.gnss import LEAST_COURSE_SPEED_M_S
from pdhef_logtool.estimators.reference.inputs import RATE_HZ, ROLL_PER_AY_RAD_S2_M, SLOW_S
from pdhef_logtool.estimators.vehicle_ukf import LIMIT_TIME_S, LINEAR_SHARE
from pdhef_logtool.records.signals import LEAST_DIVISOR, S_PER_NS, BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import RESTART_GAP_S, Extrapolation, StepColumns
from pdhef_logtool.records.tracks import StateTrack, scaled_covariance

#: Columns of a queued row after those of the kinematic filter: v_y of the wrapped filter, time of the row, arrival of
#: its GNSS velocity, and whether that was used.
FILTER_VY, TIME, ARRIVAL, USED = range(f.INPUTS, f.INPUTS + 4)
#: Rows in the queue: 1.2 s. A sample that arrives later is not used.
QUEUE = 24
#: Uncertainty of the filter's v_y over v_x in degrees: constant, per m/s², per rad/s of roll rate, and per square of
#: the share of the grip beyond the linear range. Chosen on simulated drives.
FILTER_DEG = (0.3, 0.15, 5.0, 30.0)
#: 1-sigma of v_x and its share of the one of v_y, for sliding wheels; minimum of a GNSS velocity, its increase with a_y
#: (lag), and with roll rate (height of the antenna).
SPEED_STD_M_S, SPEED_SHARE, GNSS_STD_M_S, LAG_S, HEIGHT_STD_M = 0.1, 0.3, 0.1, 0.02, 0.5
#: White noise of v_x and of a_y, m/s²/√Hz, of the gyro, rad/s/√Hz, and random walk of its bias, rad/s/√s.
NOISE, RATE_WALK = (1.0, 0.05, 0.001), 1e-5
#: Time constants of the innovation statistic of a receiver that gets worse or better, s, for samples at 10 Hz; its
#: limit for one sample; its value at which the heading is reinitialized.
WORSE_S, BETTER_S, SAMPLE_S, LARGEST_NIS, LOST_NIS = 1.0, 10.0, 0.1, 100.0, 60.0
#: Standard deviations of a change of v_y below which it has no weight; 1-sigma of the errors of a receiver that samples
#: do not average out, m/s; share of v_x above which a change is a divergence.
GARROTE, PERSISTENT_M_S, LARGEST_SHARE = 3.0, 0.07, 0.5
#: Time constant of the low pass of the roll rate, s; height of the antenna over the roll axis, m; 1-sigma of a first
#: heading, rad; slightly less than the time between rows, s.
ROLL_S, ANTENNA_HEIGHT_M, HEADING_STD_RAD, KNOT_S = 0.1, 1.2, 0.1, 1.0 / RATE_HZ - 1e-4
#: 1-sigmas of the first state; other entries are exactly 0. Antenna x: unknown and known.
START_STD = {
    f.VX: 0.3, f.VY: 0.1, f.AX_BIAS: f.BIAS_M_S2,
    f.AY_BIAS: f.BIAS_M_S2, f.LAW_ERROR: 1.0, f.YAW_RATE_BIAS: 0.003,
    f.YAW_RATE_GAIN: 0.003, f.ROLL_GAIN: 0.02, f.IMU_X: 1.0, f.HEADING: HEADING_STD_RAD,
    f.EAST_ERROR: f.RECEIVER_M_S,
    f.NORTH_ERROR: f.RECEIVER_M_S, f.ANTENNA_X: 0.5, f.ANTENNA_Y: 0.3,
    f.GNSS_DELAY: 0.05, f.ANTENNA_HEIGHT: 0.5,
}  # fmt: skip
KNOWN_ANTENNA_STD_M = 0.1
#: Memory besides the queue: time; time since the last estimate and since the last row; integrals of a_y and yaw rate
#: since that row, and their last values; share of the grip; innovation statistic; heading change since the last course,
#: that course, and the agreement of both; number of rows; whether the heading is initialized.
PROGRESS = np.dtype([(name, np.float64) for name in (
    "clock", "pause", "elapsed", "ay_sum", "rate_sum", "ay", "rate", "grip", "nis",
    "heading", "course", "agreement",
)] + [(name, np.int64) for name in ("rows", "has_heading")])  # fmt: skip


class Aiding(NamedTuple):
    """Memory between windows: queue of states [Q, n], covariances and input rows, and a record of ``PROGRESS`` [1]."""

    x: FloatArray
    P: FloatArray
    rows: FloatArray
    progress: NDArray[np.void]


@njit(cache=True)
def filtered_velocity(point, row, h):  # type: ignore[no-untyped-def]
    """Measure the wrapped filter's v_y; its error has a correlated and a white part."""
    h[:] = 0.0
    error_m_s = row[f.LAW_STD] * max(row[f.SPEED], 1.0)
    h[f.VY], h[f.LAW_ERROR] = 1.0, -error_m_s
    return row[FILTER_VY] - point[f.VY] + error_m_s * point[f.LAW_ERROR], (f.LAW_WHITE * error_m_s) ** 2 + 0.005**2


@njit(cache=True)
def _advance(memory, number, h):  # type: ignore[no-untyped-def]
    """Predict the state of row ``number`` from the previous one, and measure the wrapped filter's velocity."""
    i, last = number % QUEUE, (number - 1) % QUEUE
    x, P, row, before = memory.x[i], memory.P[i], memory.rows[i], memory.rows[last]
    step_s = row[TIME] - before[TIME]
    x[:], P[:, :], _ = f.predict(memory.x[last], memory.P[last], memory.x[last], step_s, row, before, NOISE)
    P[f.YAW_RATE_BIAS, f.YAW_RATE_BIAS] += RATE_WALK**2 * step_s
    point = x.copy()
    f.use(x, P, point, h, f.speed(point, row, h), False)
    f.use(x, P, point, h, filtered_velocity(point, row, h), False)


@njit(cache=True)
def _use_gnss(x, P, row, h):  # type: ignore[no-untyped-def]
    point = x.copy()
    for east in (True, False):
        f.use(x, P, point, h, f.gnss_velocity(point, row, east, h), True)


@njit(cache=True)
def _receive(x, P, row, now, h):  # type: ignore[no-untyped-def]
    """Judge a sample that has just arrived: update the innovation statistic and enlarge its noise accordingly."""
    row[USED] = 1.0
    if now.has_heading == 0:
        left = x[f.VY] + x[f.ANTENNA_X] * row[f.YAW_RATE]
        course = math.atan2(row[f.GNSS_NORTH], row[f.GNSS_EAST]) - row[f.GNSS_OFFSET] * row[f.YAW_RATE]
        x[f.HEADING] = course - math.atan2(left, x[f.VX])
        P[f.HEADING, :], P[:, f.HEADING] = 0.0, 0.0
        P[f.HEADING, f.HEADING], now.has_heading = HEADING_STD_RAD**2, 1
    else:
        nis = 0.0
        for east in (True, False):
            residual, variance = f.gnss_velocity(x, row, east, h)
            for i in range(h.shape[0]):
                for j in range(h.shape[0]):
                    variance += h[i] * P[i, j] * h[j]
            nis += 0.5 * residual * residual / variance
        time_s = WORSE_S if nis > now.nis else BETTER_S
        now.nis += (min(nis, LARGEST_NIS) - now.nis) * (1.0 - math.exp(-SAMPLE_S / time_s))
        if now.nis > LOST_NIS:
            now.has_heading, now.nis = 0, 1.0
    row[f.GNSS_STD] *= math.sqrt(max(1.0, now.nis))


@njit(cache=True)
def _take_arrivals(memory, now, until, h):  # type: ignore[no-untyped-def]
    """Use the samples that arrived ``until`` a time, each at its own row, and run the filter again from the first."""
    first = -1
    for number in range(max(0, now.rows - QUEUE), now.rows):
        i = number % QUEUE
        row = memory.rows[i]
        arrived = row[ARRIVAL] <= until
        if first < 0 and (not arrived or row[USED] > 0.0):
            continue
        if first >= 0:
            _advance(memory, number, h)
        else:
            first = number
        if arrived:
            if row[USED] == 0.0:
                _receive(memory.x[i], memory.P[i], row, now, h)
            _use_gnss(memory.x[i], memory.P[i], row, h)


@njit(cache=True)
def _start(memory, now, start, start_variance, vx, vy):  # type: ignore[no-untyped-def]
    """Restart the queue with a first state; the innovation statistic of the receiver is kept."""
    now.rows, now.has_heading, now.grip, now.elapsed, now.ay_sum, now.rate_sum = 1, 0, 0.0, 0.0, 0.0, 0.0
    now.nis = max(now.nis, 1.0)
    memory.rows[:, :], memory.rows[:, ARRIVAL] = 0.0, np.inf
    memory.x[0], memory.P[0] = start, np.diag(start_variance)
    memory.x[0, f.VX], memory.x[0, f.VY] = vx, vy
    row = memory.rows[0]
    row[f.SPEED], row[FILTER_VY], row[TIME] = vx, vy, now.clock
    row[f.AY] = row[f.MEAN_AY] = row[f.SLOW_AY] = now.ay
    row[f.YAW_RATE] = row[f.MEAN_YAW_RATE] = now.rate


@njit(cache=True)
def _add_row(memory, now, vx, vy, grip_m_s2):  # type: ignore[no-untyped-def]
    """Add a row with the inputs since the last one."""
    before, row, step_s = memory.rows[(now.rows - 1) % QUEUE], memory.rows[now.rows % QUEUE], now.elapsed
    row[:], row[ARRIVAL], row[TIME] = 0.0, np.inf, now.clock
    row[f.MEAN_AY] = row[f.AY] = now.ay_sum / step_s
    row[f.MEAN_YAW_RATE] = now.rate_sum / step_s
    row[f.YAW_RATE] = 0.5 * (now.rate + row[f.MEAN_YAW_RATE])
    row[f.YAW_ACCELERATION] = row[f.MEAN_YAW_ACCELERATION] = (row[f.MEAN_YAW_RATE] - before[f.MEAN_YAW_RATE]) / step_s
    row[f.AY_RATE] = (row[f.MEAN_AY] - before[f.MEAN_AY]) / step_s
    row[f.SLOW_AY] = before[f.SLOW_AY] + (row[f.AY] - before[f.SLOW_AY]) * (1.0 - math.exp(-step_s / SLOW_S))
    roll_rate = ROLL_PER_AY_RAD_S2_M * row[f.AY_RATE]
    row[f.ROLL_RATE] = before[f.ROLL_RATE] + (roll_rate - before[f.ROLL_RATE]) * (1.0 - math.exp(-step_s / ROLL_S))
    row[f.SPEED], row[FILTER_VY] = vx, vy
    row[f.MEAN_AX] = row[f.AX] = (vx - before[f.SPEED]) / step_s - vy * now.rate
    now.grip = max(abs(row[f.AY]) / grip_m_s2, now.grip * math.exp(-step_s / LIMIT_TIME_S))
    beyond = max(0.0, now.grip - LINEAR_SHARE) ** 2
    constant, per_ay, per_roll_rate, per_beyond = FILTER_DEG
    error_deg = constant + per_ay * abs(row[f.AY]) + per_roll_rate * abs(row[f.ROLL_RATE]) + per_beyond * beyond
    row[f.LAW_STD] = math.radians(error_deg)
    row[f.SPEED_STD] = SPEED_STD_M_S + SPEED_SHARE * row[f.LAW_STD] * abs(vx)
    now.rows, now.elapsed, now.ay_sum, now.rate_sum = now.rows + 1, 0.0, 0.0, 0.0


@njit(cache=True)
def _aid(columns, grip_m_s2, start, start_variance, memory, out):  # type: ignore[no-untyped-def]
    """Process one window; ``memory`` is updated in place.

    ``out`` [K, 3]: correction of v_y, weight of the filter, and variance of v_y in addition to the weighted filter's.
    """
    dts, ready, ay, rate, vx, vy, usable, east, north, std, late = columns
    now, h = memory.progress[0], np.empty(f.WITH_GNSS)
    for k in range(dts.shape[0]):
        out[k, 0], out[k, 1], out[k, 2] = 0.0, 1.0, 0.0
        now.pause += dts[k]
        if not usable[k]:
            continue
        dt, now.pause = now.pause, 0.0
        now.ay = ay[k] if math.isfinite(ay[k]) else now.ay
        now.rate = rate[k] if math.isfinite(rate[k]) else now.rate
        if now.rows == 0 or not dt <= RESTART_GAP_S:
            _start(memory, now, start, start_variance, vx[k], vy[k])
            continue
        now.clock += dt
        now.elapsed += dt
        now.ay_sum += dt * now.ay
        now.rate_sum += dt * now.rate
        now.heading += dt * now.rate
        if now.elapsed > KNOT_S:
            _add_row(memory, now, vx[k], vy[k], grip_m_s2)
            _advance(memory, now.rows - 1, h)
        newest = (now.rows - 1) % QUEUE
        row = memory.rows[newest]
        if math.hypot(east[k], north[k]) >= LEAST_COURSE_SPEED_M_S and row[ARRIVAL] == np.inf:
            row[f.GNSS_EAST], row[f.GNSS_NORTH], row[f.GNSS_OFFSET] = east[k], north[k], now.clock - row[TIME]
            course, now.course = now.course, math.atan2(north[k], east[k])
            now.agreement += math.sin(now.course - course) * now.heading
            now.heading = 0.0
            stated = max(std[k], GNSS_STD_M_S) if math.isfinite(std[k]) else GNSS_STD_M_S
            row[f.GNSS_STD] = math.sqrt(stated**2 + (LAG_S * now.ay) ** 2 + (HEIGHT_STD_M * row[f.ROLL_RATE]) ** 2)
            row[ARRIVAL], row[USED] = now.clock + late[k], 0.0
        _take_arrivals(memory, now, now.clock + ready[k], h)
        change = memory.x[newest, f.VY] - row[FILTER_VY]
        variance = memory.P[newest, f.VY, f.VY] + PERSISTENT_M_S**2
        usable_heading = now.has_heading > 0 and now.agreement > 0.0 and abs(change) < LARGEST_SHARE * vx[k]
        weight = 1.0 - GARROTE**2 * variance / max(change * change, LEAST_DIVISOR)
        if usable_heading and weight > 0.0:
            out[k, 0], out[k, 1] = weight * change, 1.0 - weight
            out[k, 2] = weight * (variance + (1.0 - weight) * change * change)


@dataclass(frozen=True, slots=True, eq=False)
class AidedSteps(StepColumns):
    """Steps of the filter, and for each step the correction of v_y, the filter's weight and more variance, [K, 3]."""

    steps: Any
    valid: BoolArray
    aid: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class AidedState:
    """State of the filter and of the GNSS correction between windows."""

    filter: Any
    aiding: Aiding


@dataclass(frozen=True, slots=True)
class GnssAided:
    """The estimator of this file; GNSS velocity corrects ``estimator``."""

    algorithm = "gnss-aided"
    version = 2
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

    def run(self, signals: Signals, state: AidedState | None) -> tuple[AidedSteps, AidedState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        steps, after = self.estimator.run(signals, None if state is None else state.filter)
        stamps_ns, count, n = signals.stamps_ns, len(signals), f.WITH_GNSS
        track = self.estimator.predict(steps, Extrapolation.none(steps.valid), stamps_ns)
        vehicle = self.estimator.physics.vehicle
        ay_m_s2 = signals.ay_m_s2 / (1.0 + GRAVITY_M_S2 * vehicle.roll_gradient_rad_per_m_s2)
        columns = (
            np.nan_to_num(signals.steps_s), (signals.ready_ns - stamps_ns) * S_PER_NS, ay_m_s2,
            signals.yaw_rate_rad_s, track.vx_m_s, track.vy_m_s, track.valid & np.isfinite(track.vy_m_s),
            *signals.gnss_velocity_m_s.T, signals.gnss_velocity_std_m_s, np.nan_to_num(signals.gnss_late_s),
        )  # fmt: skip
        if state is None:
            progress = np.zeros(1, PROGRESS)
            aiding = Aiding(np.zeros((QUEUE, n)), np.zeros((QUEUE, n, n)), np.zeros((QUEUE, USED + 1)), progress)
        else:
            aiding = deepcopy(state.aiding)
        start, start_std = np.zeros(n), np.zeros(n)
        start_std[list(START_STD)] = list(START_STD.values())
        start[[f.IMU_X, f.ANTENNA_HEIGHT]] = vehicle.imu_position_m[0], ANTENNA_HEIGHT_M
        if (antenna := vehicle.gnss_antenna_position_m) is not None:
            start[f.ANTENNA_X], start_std[f.ANTENNA_X] = antenna[0], KNOWN_ANTENNA_STD_M
        out = np.empty((count, 3))
        _aid(columns, GRAVITY_M_S2 * vehicle.assumed_friction, start, start_std**2, aiding, out)
        return AidedSteps(steps, steps.valid, out), AidedState(after, aiding)

    def predict(self, steps: AidedSteps, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Extrapolate the filter's steps and add the GNSS correction (see :class:`~.base.ModelPredictor`)."""
        track = self.estimator.predict(steps.steps, ahead, stamps_ns)
        change, weight, variance = steps.aid[ahead.step].T
        change = np.where(track.valid, change, 0.0)
        vy, covariance = track.vy_m_s + change, track.covariance
        of_vy = np.sqrt(weight + variance / np.maximum(covariance[:, 1, 1], LEAST_DIVISOR))
        covariance = scaled_covariance(covariance, of_vy)
        return replace(
            track,
            vy_m_s=vy,
            sideslip_rad=np.arctan2(vy, track.vx_m_s),
            covariance=covariance,
            sideslip_std_rad=sideslip_std(track.vx_m_s, vy, covariance),
        )
