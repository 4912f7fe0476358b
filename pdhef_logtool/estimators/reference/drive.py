"""The sideslip reference of one drive: its inputs at knots, priors, refusal, and the track between the knots."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.estimators.reference import smoother as s
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals

ComplexArray: TypeAlias = NDArray[np.complex128]

#: Knots per second.
RATE_HZ = 20.0
#: Lateral acceleration up to which the rear axle's slip is proportional to its force, at friction 0.85.
LINEAR_AY_M_S2, LINEAR_FRICTION = 3.5, 0.85
#: 1-sigma of the axle law in degrees: constant, per m/s², per m/s³, per (m/s²)² beyond the linear range.
LAW_DEG = (0.15, 0.06, 0.04, 1.5)
#: Wheelbase of the priors of lengths; those of smaller cars are proportional to theirs.
WHEELBASE_M = 2.7
#: An interval without a sample this long has no IMU.
LONGEST_IMU_GAP_S = 0.25
#: White noise of accelerometers, m/s²/√Hz, and of the gyro, rad/s/√Hz, at least.
LEAST_NOISE_M_S2, LEAST_NOISE_RAD_S = 0.02, 0.0007
#: Speed of standstill.
STANDSTILL_M_S = 0.1
#: A car that stands turns, accelerates (with bank and grade) and moves over ground by less.
STILL_RAD_S, STILL_M_S2, STILL_GNSS_M_S = 0.03, 2.0, 1.0
#: 1-sigma of GNSS velocity without a stated accuracy, its growth with acceleration (receivers filter), and with roll
#: rate, whose antenna moves on an arm of this uncertainty.
GNSS_STD_M_S, GNSS_LAG_S, ROLL_ARM_M = 0.05, 0.01, 0.3
#: Roll per lateral acceleration and pitch per longitudinal one of a usual car.
ROLL_PER_AY_RAD_S2_M, PITCH_PER_AX_RAD_S2_M = 0.0075, 0.004
#: Correlation of roll and pitch rate with those of a usual car that decides their signs.
LEAST_SIGN_CORRELATION = 0.3
#: 1-sigma of the distance of the rear axle, and of the gain of the gyro.
REAR_AXLE_STD_M, YAW_RATE_GAIN_STD = 0.1, 0.003
#: 1-sigma of the gains of accelerometers whose tilt is known; of the IMU's mounting; of the first position.
TILT_GAIN_STD, IMU_YAW_STD_RAD, FIRST_POSITION_M = 0.02, 0.015, 10.0
#: 1-sigma of the lateral position of an antenna, and its factor in a speed over ground: the error lasts.
ANTENNA_Y_STD_M, LENGTH_FACTOR = 0.5, 4.0
#: White and correlated 1-sigma of a position: with carrier phase, and of a single receiver.
RTK_M, SINGLE_M, RTK_ACCURACY_M = (0.01, 0.01), (0.3, 2.0), 0.1
EARTH_RADIUS_M = 6_378_137.0
#: Half of the time over which accelerations are averaged that gains multiply, s.
SLOW_S = 0.25
#: Speed from which on a course is known.
LEAST_COURSE_SPEED_M_S = 3.0
#: Time over which GNSS and IMU change, and the change below which they may differ.
CHANGE_S, LEAST_CHANGE_M_S = 0.5, 0.5
#: Uncertainty of the axle law up to which a course is that of the car, but for some degrees.
COURSE_LAW_RAD = math.radians(1.5)
#: A jump of GNSS velocity against the IMU within one interval, m/s, that is rejected if one back follows in this time.
JUMP_M_S, JUMP_BACK_S = 0.3, 60.0
#: Delays of GNSS that are tried, and the share of the cost of none that proves one; time of an unknown heading.
DELAYS_S = tuple(round(0.02 * i, 2) for i in range(-5, 31))
CLEAR_COST, HEADING_WINDOW_S = 0.7, 20.0
#: Smaller delays are left to the smoother. Half of the time over which a course is averaged.
SMALL_DELAY_S, COURSE_S = 0.06, 10.0
#: Wheel speed that GNSS contradicts by more is that of a wheel that locks, spins or is dragged across.
WHEEL_ERROR_M_S = 2.0
MAX_ITERATIONS, TOLERANCE_M_S, UNSETTLED_M_S = 8, 2e-3, 0.05
#: A parameter further than this from its prior mean, in 1-sigmas of the prior, refuses the drive. Lengths and the gain
#: of the gyro have narrow priors (bank in bends has the same effect) and limits of 0.45 m, 0.3 m and 3 %.
FAR_STD = 3.0
FAR_STD_OF = {s.REAR_AXLE: 9.0, s.IMU_X: 6.0, s.YAW_RATE_GAIN: 10.0}
#: The reference is valid where its 1-sigma of sideslip is smaller.
LARGEST_STD_RAD = math.radians(0.5)


@dataclass(frozen=True, slots=True)
class ReferencePrior:
    """What is known of the car and its sensors before the drive; all but the axle is of the sensors.

    ``rear_m``, ``wheelbase_m``: geometry. ``friction``: of the road, for the end of the linear range. ``imu_x_m``,
    ``ay_gain``, ``ay_bias_m_s2``, ``yaw_rate_bias_rad_s``: errors of the sensors as the log was read, with 1-sigmas of
    the first two. ``antenna_m``: position x, y of the antenna from the CG, NaN if unknown.
    """

    rear_m: float
    wheelbase_m: float
    friction: float = LINEAR_FRICTION
    imu_x_m: float = 0.0
    imu_x_std_m: float = 0.1
    ay_gain: float = 1.05
    ay_gain_std: float = 0.04
    ay_bias_m_s2: float = 0.0
    yaw_rate_bias_rad_s: float = 0.0
    antenna_m: tuple[float, float] = (math.nan, math.nan)


@dataclass(frozen=True, slots=True)
class ReferenceParameter:
    """A parameter that the smoother estimated of the drive, with its prior and the error that refuses."""

    name: str
    unit: str
    value: float
    std: float
    prior: float
    prior_std: float
    limit: float


@dataclass(frozen=True, slots=True, eq=False)
class SideslipReference:
    """The reference of a drive at its knots [K].

    ``vx_m_s``, ``vy_m_s`` at the CG and their kinematic derivatives; ``covariance`` [K, 3] of them (xx, xy, yy);
    ``law_share``, ``gnss_share`` of the information on v_y, the rest is that of kinematics; ``valid``: where it may be
    used; ``refused``: why it is not used at all, empty if it is.
    """

    stamps_ns: IntArray
    vx_m_s: FloatArray
    vy_m_s: FloatArray
    yaw_rate_rad_s: FloatArray
    vx_rate_m_s2: FloatArray
    vy_rate_m_s2: FloatArray
    covariance: FloatArray
    law_share: FloatArray
    gnss_share: FloatArray
    valid: BoolArray
    parameters: tuple[ReferenceParameter, ...]
    with_gnss: bool
    refused: str = ""

    def between(self, start_ns: int | None, end_ns: int | None) -> SideslipReference:
        """Return the knots in [start_ns, end_ns], from the first or to the last where that is None."""
        first = 0 if start_ns is None else int(np.searchsorted(self.stamps_ns, start_ns))
        last = len(self.stamps_ns) if end_ns is None else int(np.searchsorted(self.stamps_ns, end_ns, side="right"))
        columns: dict[str, Any] = {
            f.name: values[first:last] for f in fields(self) if isinstance(values := getattr(self, f.name), np.ndarray)
        }
        return replace(self, **columns)


_PARAMETERS = (
    (s.COMPLIANCE, "rear axle compliance", "rad s^2/m"),
    (s.YAW_COMPLIANCE, "rear slip per yaw acceleration", "s^2"),
    (s.RATE_COMPLIANCE, "lag of the rear axle", "s^2"),
    (s.LAW_ANGLE, "rear axle angle", "rad"),
    (s.REAR_AXLE, "rear axle distance error", "m"),
    (s.ROLL_GAIN, "roll gain of a_y", "1"),
    (s.AX_GAIN, "pitch gain of a_x", "1"),
    (s.IMU_YAW, "IMU yaw", "rad"),
    (s.SPEED_SCALE, "speed scale error", "1"),
    (s.IMU_X, "accelerometer x", "m"),
    (s.IMU_Y, "accelerometer y", "m"),
    (s.YAW_RATE_BIAS, "yaw rate bias", "rad/s"),
    (s.YAW_RATE_GAIN, "yaw rate gain error", "1"),
    (s.ANTENNA_X, "antenna x", "m"),
    (s.ANTENNA_Y, "antenna y", "m"),
    (s.GNSS_DELAY, "GNSS delay", "s"),
    (s.ANTENNA_HEIGHT, "antenna height over the roll axis", "m"),
)


def _priors(prior: ReferencePrior, n: int, *, tilts: bool) -> tuple[FloatArray, FloatArray]:
    """Return mean and 1-sigma of the first state, [n] each; v_x, v_y and heading are set by :func:`refer`.

    ``tilts``: roll and pitch rate give the tilt of the accelerometers, so that a_y and a_x have no gain.
    """
    small = min(1.0, prior.wheelbase_m / WHEELBASE_M)
    mean, std = np.zeros(s.WITH_POSITION), np.zeros(s.WITH_POSITION)
    x, y = prior.antenna_m
    has_antenna = math.isfinite(x)
    for entry, value, sigma in (
        (s.VX, 0.0, 1.0),
        (s.VY, 0.0, 1.0),
        (s.AX_BIAS, 0.0, s.BIAS_M_S2),
        (s.AY_BIAS, 0.0, s.BIAS_M_S2),
        (s.LAW_ERROR, 0.0, 1.0),
        (s.COMPLIANCE, 0.006, 0.004),
        (s.YAW_COMPLIANCE, 0.003, 0.004),
        (s.RATE_COMPLIANCE, 0.006 * small, 0.006 * small),
        (s.LAW_ANGLE, 0.0, math.radians(0.2)),
        (s.REAR_AXLE, 0.0, REAR_AXLE_STD_M * small),
        (s.ROLL_GAIN, 0.0 if tilts else prior.ay_gain - 1.0, TILT_GAIN_STD if tilts else prior.ay_gain_std),
        (s.AX_GAIN, 0.0 if tilts else 0.02, TILT_GAIN_STD if tilts else 0.02),
        (s.IMU_YAW, 0.0, IMU_YAW_STD_RAD),
        (s.IMU_Y, 0.0, 0.2 * small),
        (s.ROLL_RATE_BIAS, 0.0, 0.01),
        (s.PITCH_RATE_BIAS, 0.0, 0.01),
        (s.SPEED_SCALE, 0.0, 0.02),
        (s.IMU_X, prior.imu_x_m, prior.imu_x_std_m),
        (s.YAW_RATE_BIAS, prior.yaw_rate_bias_rad_s, 0.005),
        (s.YAW_RATE_GAIN, 0.0, YAW_RATE_GAIN_STD),
        (s.HEADING, 0.0, 0.3),
        (s.EAST_ERROR, 0.0, s.RECEIVER_M_S),
        (s.NORTH_ERROR, 0.0, s.RECEIVER_M_S),
        (s.ANTENNA_X, x if has_antenna else 0.0, (0.1 if has_antenna else 0.7) * small),
        (s.ANTENNA_Y, y if has_antenna else 0.0, (0.1 if has_antenna else ANTENNA_Y_STD_M) * small),
        (s.GNSS_DELAY, 0.0, 0.06),
        (s.ANTENNA_HEIGHT, 1.2 * small, 0.6 * small),
        (s.EAST, 0.0, FIRST_POSITION_M),
        (s.NORTH, 0.0, FIRST_POSITION_M),
    ):
        mean[entry], std[entry] = value, sigma
    return mean[:n], std[:n]


def refer(signals: Signals, prior: ReferencePrior, *, use_gnss: bool = True) -> SideslipReference:
    """Estimate v_x and v_y of a whole drive with all of its samples, later ones too; without tyre data.

    ``signals`` [N] need a_y and yaw rate, and speed or GNSS velocity.
    """
    stamps_ns, rows = knots(signals, prior)
    rows[:, s.GNSS_OFFSET] -= scanned_delay(rows)
    with_gnss = use_gnss and gnss_follows_imu(rows)
    noise = sensor_noise(signals, rows)
    alone = best = _smooth(rows, prior, noise, s.WITHOUT_GNSS)
    if with_gnss:
        rows = without_jumps(rows)
        aided = with_gnss_speed(rows)
        has_position = np.isfinite(rows[:, s.POSITION_EAST]).any()
        guess = first_guess(rows, alone.states)
        best = _smooth(aided, prior, noise, s.WITH_POSITION if has_position else s.WITH_GNSS, guess)
    gnss_share = np.clip(1.0 - best.covariance[:, 2] / np.maximum(alone.covariance[:, 2], 1e-12), 0.0, 1.0)
    vx, vy = best.states[:, s.VX], best.states[:, s.VY]
    law_m_s = np.where(rows[:, s.LAW_STD] > 0.0, rows[:, s.LAW_STD] * np.hypot(vx, vy), np.inf)
    law = np.clip(alone.covariance[:, 2] / np.maximum((1.0 + s.LAW_WHITE**2) * law_m_s**2, 1e-12), 0.0, 1.0)
    rate, ax, ay = corrected_inputs(best.states, rows)
    parameters = _parameters(best, prior, tilts=bool(rows[0, s.TILT]))
    refused = _refusal(best, parameters)
    valid = (rows[:, s.GAP] == 0.0) & (sideslip_std(vx, vy, best.covariance) < LARGEST_STD_RAD)
    return SideslipReference(
        stamps_ns, vx, vy, rate, ax + vy * rate, ay - vx * rate, best.covariance, law * (1.0 - gnss_share), gnss_share,
        valid & (not refused), parameters, with_gnss, refused,
    )  # fmt: skip


def with_gnss_speed(rows: FloatArray) -> FloatArray:
    """Return the inputs with the speed left out where it is that of GNSS, or less certain where GNSS differs.

    Wheels that lock, spin or roll across the direction of travel show another speed than GNSS.
    """
    aided = rows.copy()
    aided[aided[:, s.LENGTH] > 0.0, s.SPEED] = np.nan
    sampled = np.flatnonzero(np.isfinite(rows[:, s.GNSS_EAST]))
    over_ground = np.hypot(rows[sampled, s.GNSS_EAST], rows[sampled, s.GNSS_NORTH])
    k = np.arange(len(rows))
    difference = np.abs(rows[:, s.SPEED]) - np.interp(k, sampled, over_ground)
    apart = np.max(np.abs([np.interp(k + i, k, difference) for i in (-2, 0, 2)]), axis=0)
    after = np.minimum(np.searchsorted(sampled, k), sampled.size - 1)
    near = np.minimum(np.abs(sampled[after] - k), np.abs(sampled[np.maximum(after - 1, 0)] - k)) < RATE_HZ
    aided[near & (apart > WHEEL_ERROR_M_S), s.SPEED] = np.nan
    aided[:, s.SPEED_STD] = np.where(near, np.hypot(rows[:, s.SPEED_STD], apart), rows[:, s.SPEED_STD])
    return aided


def corrected_inputs(states: FloatArray, rows: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return yaw rate and accelerations of the CG at the knots [K], without the estimated errors of the sensors."""
    rate = rows[:, s.YAW_RATE] * (1.0 - states[:, s.YAW_RATE_GAIN]) - states[:, s.YAW_RATE_BIAS]
    x, y, yaw, turning = states[:, s.IMU_X], states[:, s.IMU_Y], states[:, s.IMU_YAW], rows[:, s.YAW_ACCELERATION]
    slow_ax, slow_ay = rows[:, s.SLOW_AX], rows[:, s.SLOW_AY]
    ax = rows[:, s.AX] - states[:, s.AX_GAIN] * slow_ax - yaw * slow_ay - states[:, s.AX_BIAS]
    ay = rows[:, s.AY] - states[:, s.ROLL_GAIN] * slow_ay + yaw * slow_ax - states[:, s.AY_BIAS]
    return rate, ax + x * rate**2 + y * turning, ay - x * turning + y * rate**2


def sideslip_std(vx: FloatArray, vy: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return the 1-sigma of sideslip [K] for a covariance [K, 3] of v_x, v_y (xx, xy, yy)."""
    variance = vy**2 * covariance[:, 0] - 2.0 * vx * vy * covariance[:, 1] + vx**2 * covariance[:, 2]
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)) / np.maximum(vx**2 + vy**2, 1e-6))


@dataclass(frozen=True, slots=True, eq=False)
class _Smoothed:
    states: FloatArray
    covariance: FloatArray
    last_variance: FloatArray
    moved_m_s: float


def _smooth(
    rows: FloatArray, prior: ReferencePrior, noise: FloatArray, n: int, velocity: FloatArray | None = None
) -> _Smoothed:
    """Smooth with n states, of which ``velocity`` [K, 3] are v_x, v_y and heading to begin with, if given."""
    mean, std = _priors(prior, n, tilts=bool(rows[0, s.TILT]))
    speed = rows[:, s.SPEED]
    first = np.flatnonzero(np.isfinite(speed))
    mean[s.VX] = speed[first[0]] if first.size else 0.0
    mean[s.VY] = prior.rear_m * rows[0, s.YAW_RATE]
    if n >= s.WITH_GNSS:
        mean[s.HEADING], std[s.HEADING] = (0.0, math.pi) if velocity is None else (velocity[0, 2], 0.3)
    if n == s.WITH_POSITION:
        k = int(np.flatnonzero(np.isfinite(rows[:, s.POSITION_EAST]))[0])
        std[s.EAST_OFFSET] = std[s.NORTH_OFFSET] = rows[k, s.POSITION_OFFSET_STD]
        std[s.EAST] = std[s.NORTH] = FIRST_POSITION_M + 60.0 * k / RATE_HZ
    guess = np.empty((0, n))
    if velocity is not None:
        guess = np.tile(mean, (len(rows), 1))
        guess[:, [s.VX, s.VY, s.HEADING]] = velocity
    states, covariance, last, moved, _ = s.smooth(
        1.0 / RATE_HZ, rows, prior.rear_m, mean, std**2, noise, guess, MAX_ITERATIONS, TOLERANCE_M_S
    )
    return _Smoothed(states, covariance, last, moved)


def first_guess(rows: FloatArray, alone: FloatArray) -> FloatArray:
    """Return v_x, v_y and heading [K, 3] by GNSS, gyro and course; where there is no GNSS, those without it.

    The heading is that of the gyro and turned to the course where the car rolls without much slip. ``alone`` [K, n]:
    states without GNSS.
    """
    k = np.arange(len(rows))
    gyro = np.cumsum(rows[:, s.MEAN_YAW_RATE] - alone[:, s.YAW_RATE_BIAS]) / RATE_HZ
    sampled = np.flatnonzero(np.isfinite(rows[:, s.GNSS_EAST]))
    velocity = rows[sampled, s.GNSS_EAST] + 1j * rows[sampled, s.GNSS_NORTH]
    rolls = sampled[rolls_freely(rows)[sampled]]
    rolls = rolls if rolls.size else sampled
    course = np.angle(np.interp(rolls, sampled, velocity)) - gyro[rolls]
    around = np.cumsum(np.concatenate([[0.0], np.exp(1j * course)]))
    n = max(1, round(COURSE_S * RATE_HZ / max(1.0, float(np.median(np.diff(rolls))) if rolls.size > 1 else 1.0)))
    i = np.arange(rolls.size)
    offset = np.unwrap(np.angle(around[np.minimum(i + n, rolls.size)] - around[np.maximum(i - n, 0)]))
    heading = gyro + np.interp(k, rolls, offset)
    body = np.interp(k, sampled, velocity) * np.exp(-1j * heading)
    after = np.minimum(np.searchsorted(sampled, k), sampled.size - 1)
    near = np.minimum(np.abs(sampled[after] - k), np.abs(sampled[np.maximum(after - 1, 0)] - k)) <= RATE_HZ
    vx, vy = np.where(near, body.real, alone[:, s.VX]), np.where(near, body.imag, alone[:, s.VY])
    return np.stack([vx, vy, heading], axis=1)


def rolls_freely(rows: FloatArray) -> BoolArray:
    """Return where the car moves forward with little slip [K], so that its course is its heading but for some degrees.

    Wheel speed, where there is one, agrees with GNSS: it is not sideways.
    """
    over_ground = np.hypot(rows[:, s.GNSS_EAST], rows[:, s.GNSS_NORTH])
    rolls = (over_ground > LEAST_COURSE_SPEED_M_S) & (rows[:, s.LAW_STD] > 0.0) & (rows[:, s.LAW_STD] < COURSE_LAW_RAD)
    return rolls & ~(np.abs(rows[:, s.SPEED] - over_ground) > WHEEL_ERROR_M_S)


def _parameters(smoothed: _Smoothed, prior: ReferencePrior, *, tilts: bool) -> tuple[ReferenceParameter, ...]:
    n = smoothed.states.shape[1]
    mean, std = _priors(prior, n, tilts=tilts)
    value, sigma = smoothed.states[-1], np.sqrt(np.maximum(smoothed.last_variance, 0.0))
    return tuple(
        ReferenceParameter(
            name,
            unit,
            float(value[i]),
            float(sigma[i]),
            float(mean[i]),
            float(std[i]),
            float(FAR_STD_OF.get(i, FAR_STD) * std[i]),
        )
        for i, name, unit in _PARAMETERS
        if i < n
    )


def _refusal(smoothed: _Smoothed, parameters: tuple[ReferenceParameter, ...]) -> str:
    if not np.isfinite(smoothed.states).all() or smoothed.moved_m_s > UNSETTLED_M_S:
        return f"the smoother has not settled (v_y still moves by {smoothed.moved_m_s:.2g} m/s)"
    far = [p for p in parameters if abs(p.value - p.prior) > p.limit]
    if far:
        p = far[0]
        return f"{p.name} {p.value:.3g} {p.unit} is implausible (expected {p.prior:.3g} ± {p.limit:.2g})"
    return ""


def sensor_noise(signals: Signals, rows: FloatArray) -> FloatArray:
    """Return the white noise of a_x, a_y in m/s²/√Hz, at least 0.02, and of the gyro in rad/s/√Hz, at least 0.0007.

    The larger of the samples' and that of the means between knots: vibration of the body is not white.
    """
    columns = (
        (signals.ax_m_s2, s.MEAN_AX, LEAST_NOISE_M_S2),
        (signals.ay_m_s2, s.MEAN_AY, LEAST_NOISE_M_S2),
        (signals.yaw_rate_rad_s, s.MEAN_YAW_RATE, LEAST_NOISE_RAD_S),
    )
    stamps_ns = np.rint(np.arange(len(rows)) * (1e9 / RATE_HZ)).astype(np.int64)
    return np.array(
        [
            max(white_noise(signals.stamps_ns, values, least), white_noise(stamps_ns, rows[:, mean], least))
            for values, mean, least in columns
        ]
    )


def white_noise(stamps_ns: IntArray, values: FloatArray, least: float) -> float:
    """Return the white noise of a sensor [N] per √Hz from its third differences.

    Samples that repeat the one before are left out: sensors may repeat values.
    """
    good = np.isfinite(values)
    values, stamps = values[good], stamps_ns[good]
    changed = np.flatnonzero(np.diff(values, prepend=math.inf) != 0.0)
    values, stamps = values[changed], stamps[changed]
    if len(values) < 8:
        return least
    third = np.abs(np.diff(values, 3))
    sample_std = 1.4826 * float(np.median(third)) / math.sqrt(20.0)
    return max(least, sample_std * math.sqrt(float(np.median(np.diff(stamps))) * 1e-9))


def knots(signals: Signals, prior: ReferencePrior) -> tuple[IntArray, FloatArray]:
    """Return the stamps of the knots [K] and the smoother's inputs [K, INPUTS] there."""
    t = (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9
    h = 1.0 / RATE_HZ
    knot_s = np.arange(0.0, t[-1] + 0.5 * h, h)
    rows = np.full((len(knot_s), s.INPUTS), np.nan)
    gap = np.zeros(len(knot_s), dtype=np.bool_)
    for values, mean, value, derivative, averaged in (
        (signals.ax_m_s2, s.MEAN_AX, s.AX, None, s.SLOW_AX),
        (signals.ay_m_s2 - prior.ay_bias_m_s2, s.MEAN_AY, s.AY, s.AY_RATE, s.SLOW_AY),
        (signals.yaw_rate_rad_s, s.MEAN_YAW_RATE, s.YAW_RATE, s.YAW_ACCELERATION, None),
    ):
        if mean == s.MEAN_AX and np.isfinite(values).sum() < 2:
            values = _from_speed(t, signals.speed_m_s)
        integral, missing = _integral(t, values)
        gap |= missing(knot_s) & (mean != s.MEAN_AX)
        rows[:, mean] = (integral(knot_s) - integral(knot_s - h)) / h
        rows[:, value] = (integral(knot_s + 0.5 * h) - integral(knot_s - 0.5 * h)) / h
        if derivative is not None:
            rows[:, derivative] = (integral(knot_s + h) - 2.0 * integral(knot_s) + integral(knot_s - h)) / h**2
        if averaged is not None:
            rows[:, averaged] = (integral(knot_s + SLOW_S) - integral(knot_s - h - SLOW_S)) / (h + 2.0 * SLOW_S)
    rows[:, s.MEAN_YAW_ACCELERATION] = np.diff(rows[:, s.YAW_RATE], prepend=rows[0, s.YAW_RATE]) / h
    rows[:, s.GAP] = gap
    rows[:, s.SPEED] = _speed(t, signals.speed_m_s, knot_s)
    rows[:, s.SPEED_STD] = 0.15 + 0.01 * np.abs(np.nan_to_num(rows[:, s.SPEED])) + 0.05 * np.abs(rows[:, s.AX])
    rows[:, s.LENGTH] = is_length(signals)
    rows[:, s.UNSIGNED] = not (signals.speed_m_s < -STANDSTILL_M_S).any()
    if rows[0, s.LENGTH]:  # of the antenna
        rows[:, s.SPEED_STD] = np.hypot(rows[:, s.SPEED_STD], LENGTH_FACTOR * ANTENNA_Y_STD_M * rows[:, s.YAW_RATE])
    rows[:, s.LAW_STD] = np.where(gap, 0.0, law_std(rows, prior.friction))
    _add_tilt(rows, signals, t, knot_s)
    _add_gnss(rows, signals, knot_s)
    rows[:, s.STANDSTILL] = standstill(rows)
    return signals.stamps_ns[0] + np.rint(knot_s * 1e9).astype(np.int64), rows


def law_std(rows: FloatArray, friction: float) -> FloatArray:
    """Return the 1-sigma of the axle law [K] in rad."""
    linear = LINEAR_AY_M_S2 * min(1.0, friction / LINEAR_FRICTION)
    ay, ay_rate = np.abs(rows[:, s.AY]), np.abs(rows[:, s.AY_RATE])
    beyond = np.maximum(ay - linear, 0.0) ** 2
    return np.radians(LAW_DEG[0] + LAW_DEG[1] * ay + LAW_DEG[2] * ay_rate + LAW_DEG[3] * beyond)


def standstill(rows: FloatArray) -> BoolArray:
    """Return where the car stands [K]: no speed, as of a wheel that locks, and nothing that moves."""
    still = rows[:, s.SPEED] < STANDSTILL_M_S
    still &= np.abs(rows[:, s.YAW_RATE]) < STILL_RAD_S
    still &= np.hypot(rows[:, s.SLOW_AX], rows[:, s.SLOW_AY]) < STILL_M_S2
    return still & ~(np.hypot(rows[:, s.GNSS_EAST], rows[:, s.GNSS_NORTH]) > STILL_GNSS_M_S)


def is_length(signals: Signals) -> bool:
    """Return whether the speed is the length of GNSS velocity, and no measurement of its own."""
    length = np.hypot(*signals.gnss_velocity_m_s.T)
    both = np.isfinite(length) & np.isfinite(signals.speed_m_s)
    return bool(both.any()) and bool(np.abs(length - signals.speed_m_s)[both].max() < 1e-6)


def _add_tilt(rows: FloatArray, signals: Signals, t: FloatArray, knot_s: FloatArray) -> None:
    """Put roll and pitch rate into the rows with the signs that a body has which leans out of a turn and dives."""
    h = 1.0 / RATE_HZ
    rows[:, [s.TILT, s.MEAN_ROLL_RATE, s.MEAN_PITCH_RATE]] = 0.0
    rows[:, s.ROLL_RATE] = ROLL_PER_AY_RAD_S2_M * rows[:, s.AY_RATE]
    if not all(np.isfinite(v).sum() > 0.9 * len(t) for v in (signals.roll_rate_rad_s, signals.pitch_rate_rad_s)):
        return
    means = []
    for values in (signals.roll_rate_rad_s, signals.pitch_rate_rad_s):
        integral, _ = _integral(t, values)
        means.append((integral(knot_s) - integral(knot_s - h)) / h)
        at_knots = (integral(knot_s + 0.5 * h) - integral(knot_s - 0.5 * h)) / h
        means.append(at_knots)
    roll, roll_at, pitch, pitch_at = means
    turned = rows[:, s.YAW_RATE] * rows[:, s.SLOW_AY]  # a body that rolls in a turn has a pitch rate
    dives = ROLL_PER_AY_RAD_S2_M * turned - PITCH_PER_AX_RAD_S2_M * np.gradient(rows[:, s.SLOW_AX], h)
    signs = [correlation(roll_at, rows[:, s.AY_RATE]), correlation(slow(pitch_at), slow(dives))]
    if max(np.abs(signs)) < LEAST_SIGN_CORRELATION:
        return
    roll_sign, pitch_sign = (-1.0 if c < -LEAST_SIGN_CORRELATION else 1.0 for c in signs)
    rows[:, s.TILT], rows[:, s.ROLL_RATE] = 1.0, roll_sign * roll_at
    rows[:, s.MEAN_ROLL_RATE], rows[:, s.MEAN_PITCH_RATE] = roll_sign * roll, pitch_sign * pitch


def slow(values: FloatArray) -> FloatArray:
    """Return the moving mean [K] over twice ``SLOW_S``."""
    n = round(SLOW_S * RATE_HZ)
    return np.convolve(np.pad(values, n, mode="edge"), np.full(2 * n + 1, 1.0 / (2 * n + 1)), "valid")


def correlation(rate: FloatArray, change: FloatArray) -> float:
    """Return the correlation of an angular rate [K] with what an acceleration changes by [K], 0 where one is constant."""
    return 0.0 if rate.std() == 0.0 or change.std() == 0.0 else float(np.corrcoef(rate, change)[0, 1])


def _integral(t: FloatArray, values: FloatArray):  # type: ignore[no-untyped-def]
    """Return the integral of a column over time as a function, and where an interval of it has no sample."""
    good = np.isfinite(values)
    if good.sum() < 2:
        return (lambda knot_s: np.zeros_like(knot_s)), (lambda knot_s: np.ones(len(knot_s), dtype=np.bool_))
    times, y = t[good], values[good]
    total = np.concatenate([[0.0], np.cumsum(0.5 * (y[1:] + y[:-1]) * np.diff(times))])

    def integral(knot_s: FloatArray) -> FloatArray:
        inside = np.clip(knot_s, times[0], times[-1])
        i = np.clip(np.searchsorted(times, inside, side="right") - 1, 0, len(times) - 2)
        dt = inside - times[i]
        slope = (y[i + 1] - y[i]) / (times[i + 1] - times[i])
        held = np.where(knot_s < times[0], y[0], y[-1]) * (knot_s - inside)
        return np.asarray(total[i] + dt * (y[i] + 0.5 * slope * dt) + held)

    def missing(knot_s: FloatArray) -> BoolArray:
        i = np.clip(np.searchsorted(times, knot_s), 1, len(times) - 1)
        long = times[i] - times[i - 1] > LONGEST_IMU_GAP_S
        outside = (knot_s < times[0] - LONGEST_IMU_GAP_S) | (knot_s > times[-1] + LONGEST_IMU_GAP_S)
        return np.asarray(long | outside)

    return integral, missing


def _from_speed(t: FloatArray, speed: FloatArray) -> FloatArray:
    """Return a longitudinal acceleration [N] from the speed where the log has no sensor of it."""
    good = np.isfinite(speed)
    if good.sum() < 3:
        return np.zeros(len(t))
    smooth = np.convolve(np.pad(np.interp(t, t[good], speed[good]), 2, mode="edge"), np.full(5, 0.2), "valid")
    return np.asarray(np.gradient(smooth, t))


def _speed(t: FloatArray, speed: FloatArray, knot_s: FloatArray) -> FloatArray:
    """Return the speed at the knots [K], NaN further than a knot from a sample."""
    good = np.isfinite(speed)
    if not good.any():
        return np.full(len(knot_s), np.nan)
    times = t[good]
    i = (
        np.clip(np.searchsorted(times, knot_s), 1, max(len(times) - 1, 1))
        if len(times) > 1
        else np.zeros(len(knot_s), int)
    )
    near = np.minimum(
        np.abs(times[np.minimum(i, len(times) - 1)] - knot_s), np.abs(times[np.maximum(i - 1, 0)] - knot_s)
    )
    return np.where(near < 1.2 / RATE_HZ, np.interp(knot_s, times, speed[good]), np.nan)


def _add_gnss(rows: FloatArray, signals: Signals, knot_s: FloatArray) -> None:
    """Put each new GNSS velocity at its nearest knot with its offset in time; the last one of several."""
    velocity = signals.gnss_velocity_m_s
    good = np.flatnonzero(np.isfinite(velocity).all(axis=1))
    if not good.size:
        return
    new = np.ones(len(good), dtype=np.bool_)
    new[1:] = (velocity[good[1:]] != velocity[good[:-1]]).any(axis=1)
    good = good[new]
    t = (signals.stamps_ns[good] - signals.stamps_ns[0]) * 1e-9
    k = np.minimum(np.rint(t * RATE_HZ).astype(np.int64), len(knot_s) - 1)
    rows[k, s.GNSS_EAST], rows[k, s.GNSS_NORTH] = velocity[good].T
    rows[k, s.GNSS_OFFSET] = t - knot_s[k]
    acceleration = np.hypot(rows[k, s.AX], rows[k, s.AY])
    stated = np.nan_to_num(signals.gnss_velocity_std_m_s[good])
    white = np.hypot(np.maximum(stated, GNSS_STD_M_S), GNSS_LAG_S * acceleration)
    rows[k, s.GNSS_STD] = np.hypot(white, ROLL_ARM_M * rows[k, s.ROLL_RATE])
    _add_position(rows, signals, knot_s)


def _add_position(rows: FloatArray, signals: Signals, knot_s: FloatArray) -> None:
    """Put positions, in m from the first, at their nearest knots; they share the delay of the velocity."""
    good = np.flatnonzero(np.isfinite(signals.gnss_position_deg).all(axis=1))
    if not good.size:
        return
    latitude, longitude = np.radians(signals.gnss_position_deg[good]).T
    t = (signals.stamps_ns[good] - signals.stamps_ns[0]) * 1e-9
    k = np.minimum(np.rint(t * RATE_HZ).astype(np.int64), len(knot_s) - 1)
    north, east = latitude - latitude[0], np.cos(latitude[0]) * (longitude - longitude[0])
    used = np.isfinite(rows[k, s.GNSS_EAST])
    stated = np.nan_to_num(signals.gnss_position_std_m[good], nan=SINGLE_M[1])
    for column, values in (
        (s.POSITION_EAST, EARTH_RADIUS_M * east),
        (s.POSITION_NORTH, EARTH_RADIUS_M * north),
        (s.POSITION_STD, np.where(stated < RTK_ACCURACY_M, np.maximum(stated, RTK_M[0]), SINGLE_M[0])),
    ):
        rows[k[used], column] = values[used]
    typical = float(np.median(stated))
    rows[:, s.POSITION_OFFSET_STD] = max(typical, RTK_M[1]) if typical < RTK_ACCURACY_M else max(typical, SINGLE_M[1])


def gnss_follows_imu(rows: FloatArray) -> bool:
    """Return whether GNSS velocity changes as the IMU has it; not if its axes are swapped or those of the body.

    Where the car hardly accelerates there is no contradiction.
    """
    sampled = np.flatnonzero(np.isfinite(rows[:, s.GNSS_EAST]))
    sampled = sampled[np.diff(sampled // round(CHANGE_S * RATE_HZ), prepend=-1) > 0]
    if sampled.size < 3:
        return False
    by_gnss, by_imu = increments(rows, sampled, 0.0)
    changes = np.abs(by_imu) >= min(np.median(np.abs(by_imu)), LEAST_CHANGE_M_S)
    typical = max(float(np.median(np.abs(by_imu[changes]))), LEAST_CHANGE_M_S)
    return float(np.median(np.abs(by_gnss - by_imu)[changes])) < 0.5 * typical


def increments(rows: FloatArray, sampled: IntArray, delay_s: float) -> tuple[ComplexArray, ComplexArray]:
    """Return the changes of velocity between GNSS samples [M − 1], east + i north: of GNSS, and of the IMU.

    ``sampled`` [M]: knots with a sample, of a velocity ``delay_s`` old. The IMU's are turned by the angle, slowly
    varying, that fits best: its heading is unknown.
    """
    heading = np.cumsum(rows[:, s.MEAN_YAW_RATE]) / RATE_HZ
    turned = np.exp(1j * (heading - 0.5 * rows[:, s.MEAN_YAW_RATE] / RATE_HZ))
    velocity = np.cumsum((rows[:, s.MEAN_AX] + 1j * rows[:, s.MEAN_AY]) * turned) / RATE_HZ
    at = sampled + (rows[sampled, s.GNSS_OFFSET] - delay_s) * RATE_HZ
    by_imu = np.diff(np.interp(at, np.arange(len(rows)), velocity))
    by_gnss = np.diff(rows[sampled, s.GNSS_EAST] + 1j * rows[sampled, s.GNSS_NORTH])
    n = round(HEADING_WINDOW_S * RATE_HZ / max(1.0, float(np.median(np.diff(sampled)))))
    largest = 2.0 * np.median(np.abs(by_gnss)) + 0.1
    products = by_gnss * np.conj(by_imu) * np.minimum(1.0, largest / np.maximum(np.abs(by_gnss), 1e-9)) ** 2
    sums = np.cumsum(np.concatenate([[0.0], products]))
    k = np.arange(len(products))
    around = sums[np.minimum(k + n, len(products))] - sums[np.maximum(k - n, 0)]
    return by_gnss, by_imu * np.exp(1j * np.angle(around))


def scanned_delay(rows: FloatArray) -> float:
    """Return how late GNSS velocity is in s: changes of the IMU's velocity that old fit its changes best."""
    sampled = np.flatnonzero(np.isfinite(rows[:, s.GNSS_EAST]))
    if sampled.size < 8:
        return 0.0
    costs = []
    for delay_s in DELAYS_S:
        by_gnss, by_imu = increments(rows, sampled, delay_s)
        costs.append(float(np.minimum(np.abs(by_gnss - by_imu) ** 2, JUMP_M_S**2).sum()))
    zero = costs[DELAYS_S.index(0.0)]
    best = int(np.argmin(costs))
    return DELAYS_S[best] if costs[best] < CLEAR_COST * zero and abs(DELAYS_S[best]) > SMALL_DELAY_S else 0.0


def without_jumps(rows: FloatArray) -> FloatArray:
    """Return the inputs without GNSS velocities between a jump against the IMU and one back (multipath)."""
    sampled = np.flatnonzero(np.isfinite(rows[:, s.GNSS_EAST]))
    if sampled.size < 3:
        return rows
    by_gnss, by_imu = increments(rows, sampled, 0.0)
    jump = by_gnss - by_imu
    limit = JUMP_M_S + 0.02 * np.hypot(rows[sampled[1:], s.AX], rows[sampled[1:], s.AY])
    limit += 0.5 * np.diff(sampled) / RATE_HZ
    limit += np.abs(np.diff(rows[sampled, s.YAW_RATE])) + np.abs(np.diff(rows[sampled, s.ROLL_RATE]))
    candidates = np.flatnonzero(np.abs(jump) > limit)
    rejected = np.zeros(sampled.size, dtype=np.bool_)
    for i, first in enumerate(candidates):
        if rejected[first + 1]:
            continue
        back = [c for c in candidates[i + 1 :] if (sampled[c] - sampled[first]) <= JUMP_BACK_S * RATE_HZ]
        pair = next((c for c in back if abs(jump[c] + jump[first]) < 0.5 * abs(jump[first])), None)
        if pair is not None:
            rejected[first + 1 : pair + 1] = True
    cleaned = rows.copy()
    cleaned[sampled[rejected], s.GNSS_EAST] = np.nan
    return cleaned
