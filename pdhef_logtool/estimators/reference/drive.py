"""The sideslip reference of one drive: its inputs at knots, priors, refusal, and the track between the knots."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from pdhef_logtool.estimators.reference import smoother as s
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals

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
#: Speed of standstill.
STANDSTILL_M_S = 0.1
#: 1-sigma of GNSS velocity without a stated accuracy, its growth with acceleration (receivers filter), and with roll
#: rate, whose antenna moves on an arm of this uncertainty.
GNSS_STD_M_S, GNSS_LAG_S, ROLL_ARM_M = 0.05, 0.01, 0.3
#: Roll per lateral acceleration of a usual car, where no roll rate is measured.
ROLL_PER_AY_RAD_S2_M = 0.0075
#: Correlation of roll rate with the change of a_y, and range of its gain, that prove its sign.
LEAST_ROLL_CORRELATION, ROLL_GAINS_RAD_S2_M = 0.3, (0.0005, 0.03)
#: 1-sigma of the gains of accelerometers whose tilt is known; of the IMU's mounting; of the first position.
TILT_GAIN_STD, IMU_YAW_STD_RAD, FIRST_POSITION_M = 0.02, 0.015, 10.0
#: White and correlated 1-sigma of a position: with carrier phase, and of a single receiver.
RTK_M, SINGLE_M, RTK_ACCURACY_M = (0.01, 0.01), (0.3, 2.0), 0.1
EARTH_RADIUS_M = 6_378_137.0
#: Half of the time over which accelerations are averaged that gains multiply, s.
SLOW_S = 0.1
#: Speed from which on a course is known; the time over which it turns, and the turn below which it may differ.
LEAST_COURSE_SPEED_M_S, TURN_S, LEAST_TURN_RAD = 3.0, 2.0, 0.2
#: Uncertainty of the axle law up to which a course is that of the car, but for some degrees.
COURSE_LAW_RAD = math.radians(1.5)
#: A jump of GNSS velocity against the IMU within one interval, m/s, that is rejected if one back follows in this time.
JUMP_M_S, JUMP_BACK_S = 0.3, 60.0
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
        (s.REAR_AXLE, 0.0, 0.05 * small),
        (s.ROLL_GAIN, 0.0 if tilts else prior.ay_gain - 1.0, TILT_GAIN_STD if tilts else prior.ay_gain_std),
        (s.AX_GAIN, 0.0 if tilts else 0.02, TILT_GAIN_STD if tilts else 0.02),
        (s.IMU_YAW, 0.0, IMU_YAW_STD_RAD),
        (s.IMU_Y, 0.0, 0.2 * small),
        (s.SPEED_SCALE, 0.0, 0.02),
        (s.IMU_X, prior.imu_x_m, prior.imu_x_std_m),
        (s.YAW_RATE_BIAS, prior.yaw_rate_bias_rad_s, 0.005),
        (s.YAW_RATE_GAIN, 0.0, 0.003),
        (s.HEADING, 0.0, 0.3),
        (s.EAST_ERROR, 0.0, s.RECEIVER_M_S),
        (s.NORTH_ERROR, 0.0, s.RECEIVER_M_S),
        (s.ANTENNA_X, x if has_antenna else 0.0, (0.1 if has_antenna else 0.7) * small),
        (s.ANTENNA_Y, y if has_antenna else 0.0, (0.1 if has_antenna else 0.5) * small),
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
    with_gnss = use_gnss and course_follows_gyro(rows)
    noise = sensor_noise(signals)
    alone = best = _smooth(rows, prior, noise, s.WITHOUT_GNSS)
    if with_gnss:
        rows = without_jumps(rows, alone.states)
        aided = rows.copy()
        aided[aided[:, s.LENGTH] > 0.0, s.SPEED] = np.nan  # the same measurement
        has_position = np.isfinite(rows[:, s.POSITION_EAST]).any()
        best = _smooth(aided, prior, noise, s.WITH_POSITION if has_position else s.WITH_GNSS)
    gnss_share = np.clip(1.0 - best.covariance[:, 2] / np.maximum(alone.covariance[:, 2], 1e-12), 0.0, 1.0)
    vx, vy = best.states[:, s.VX], best.states[:, s.VY]
    law_m_s = np.where(rows[:, s.LAW_STD] > 0.0, rows[:, s.LAW_STD] * np.abs(vx), np.inf)
    law = np.clip(alone.covariance[:, 2] / np.maximum((1.0 + s.LAW_WHITE**2) * law_m_s**2, 1e-12), 0.0, 1.0)
    rate, ax, ay = corrected_inputs(best.states, rows)
    parameters = _parameters(best, prior, tilts=bool(rows[0, s.TILT]))
    refused = _refusal(best, parameters)
    valid = (rows[:, s.GAP] == 0.0) & (sideslip_std(vx, vy, best.covariance) < LARGEST_STD_RAD)
    return SideslipReference(
        stamps_ns, vx, vy, rate, ax + vy * rate, ay - vx * rate, best.covariance, law * (1.0 - gnss_share), gnss_share,
        valid & (not refused), parameters, with_gnss, refused,
    )  # fmt: skip


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


def _smooth(rows: FloatArray, prior: ReferencePrior, noise: FloatArray, n: int) -> _Smoothed:
    mean, std = _priors(prior, n, tilts=bool(rows[0, s.TILT]))
    speed = rows[:, s.SPEED]
    first = np.flatnonzero(np.isfinite(speed))
    mean[s.VX] = speed[first[0]] if first.size else 0.0
    mean[s.VY] = prior.rear_m * rows[0, s.YAW_RATE]
    if n >= s.WITH_GNSS:
        mean[s.HEADING], std[s.HEADING] = first_heading(rows)
    if n == s.WITH_POSITION:
        k = int(np.flatnonzero(np.isfinite(rows[:, s.POSITION_EAST]))[0])
        std[s.EAST_OFFSET] = std[s.NORTH_OFFSET] = rows[k, s.POSITION_OFFSET_STD]
        std[s.EAST] = std[s.NORTH] = FIRST_POSITION_M + 60.0 * k / RATE_HZ
    states, covariance, last, moved, _ = s.smooth(
        1.0 / RATE_HZ, rows, prior.rear_m, mean, std**2, noise, MAX_ITERATIONS, TOLERANCE_M_S
    )
    return _Smoothed(states, covariance, last, moved)


def first_heading(rows: FloatArray) -> tuple[float, float]:
    """Return the heading at the first knot from the first course of a car that moves, with its 1-sigma."""
    fast = np.flatnonzero(np.hypot(rows[:, s.GNSS_EAST], rows[:, s.GNSS_NORTH]) > LEAST_COURSE_SPEED_M_S)
    if not fast.size:
        return 0.0, math.pi
    k = int(fast[0])
    turned = float(rows[: k + 1, s.MEAN_YAW_RATE].sum()) / RATE_HZ
    course = math.atan2(rows[k, s.GNSS_NORTH], rows[k, s.GNSS_EAST])
    return course - turned, 0.2


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


def sensor_noise(signals: Signals) -> FloatArray:
    """Return the white noise of a_x, a_y in m/s²/√Hz, at least 0.02, and of the gyro in rad/s/√Hz, at least 0.0007."""
    columns = (signals.ax_m_s2, 0.02), (signals.ay_m_s2, 0.02), (signals.yaw_rate_rad_s, 0.0007)
    return np.array([white_noise(signals.stamps_ns, values, least) for values, least in columns])


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
    for values, mean, value, derivative, slow in (
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
        if slow is not None:
            rows[:, slow] = (integral(knot_s + SLOW_S) - integral(knot_s - h - SLOW_S)) / (h + 2.0 * SLOW_S)
    rows[:, s.MEAN_YAW_ACCELERATION] = np.diff(rows[:, s.YAW_RATE], prepend=rows[0, s.YAW_RATE]) / h
    rows[:, s.GAP] = gap
    rows[:, s.SPEED] = _speed(t, signals.speed_m_s, knot_s)
    rows[:, s.SPEED_STD] = 0.15 + 0.01 * np.abs(np.nan_to_num(rows[:, s.SPEED])) + 0.05 * np.abs(rows[:, s.AX])
    rows[:, s.LENGTH] = is_length(signals)
    rows[:, s.LAW_STD] = np.where(gap, 0.0, law_std(rows, prior.friction))
    rows[:, s.STANDSTILL] = rows[:, s.SPEED] < STANDSTILL_M_S
    _add_tilt(rows, signals, t, knot_s)
    _add_gnss(rows, signals, knot_s)
    return signals.stamps_ns[0] + np.rint(knot_s * 1e9).astype(np.int64), rows


def law_std(rows: FloatArray, friction: float) -> FloatArray:
    """Return the 1-sigma of the axle law [K] in rad."""
    linear = LINEAR_AY_M_S2 * min(1.0, friction / LINEAR_FRICTION)
    ay, ay_rate = np.abs(rows[:, s.AY]), np.abs(rows[:, s.AY_RATE])
    beyond = np.maximum(ay - linear, 0.0) ** 2
    return np.radians(LAW_DEG[0] + LAW_DEG[1] * ay + LAW_DEG[2] * ay_rate + LAW_DEG[3] * beyond)


def is_length(signals: Signals) -> bool:
    """Return whether the speed is the length of GNSS velocity, and no measurement of its own."""
    length = np.hypot(*signals.gnss_velocity_m_s.T)
    both = np.isfinite(length) & np.isfinite(signals.speed_m_s)
    return bool(both.any()) and bool(np.abs(length - signals.speed_m_s)[both].max() < 1e-6)


def _add_tilt(rows: FloatArray, signals: Signals, t: FloatArray, knot_s: FloatArray) -> None:
    """Put roll and pitch rate without their means into the rows, where roll rate follows the change of a_y."""
    h = 1.0 / RATE_HZ
    rows[:, [s.TILT, s.MEAN_ROLL_RATE, s.MEAN_PITCH_RATE]] = 0.0
    rows[:, s.ROLL_RATE] = ROLL_PER_AY_RAD_S2_M * rows[:, s.AY_RATE]
    if not all(np.isfinite(v).sum() > 0.9 * len(t) for v in (signals.roll_rate_rad_s, signals.pitch_rate_rad_s)):
        return
    means = []
    for values in (signals.roll_rate_rad_s, signals.pitch_rate_rad_s):
        integral, _ = _integral(t, values - np.nanmedian(values))
        means.append((integral(knot_s) - integral(knot_s - h)) / h)
        at_knots = (integral(knot_s + 0.5 * h) - integral(knot_s - 0.5 * h)) / h
        means.append(at_knots)
    roll, roll_at, pitch, pitch_at = means
    signs = ((roll_at, rows[:, s.AY_RATE]), (-pitch_at, np.gradient(rows[:, s.SLOW_AX], h)))
    if not all(follows(rate, change) for rate, change in signs):
        return
    rows[:, s.TILT], rows[:, s.MEAN_ROLL_RATE], rows[:, s.MEAN_PITCH_RATE] = 1.0, roll, pitch
    rows[:, s.ROLL_RATE] = roll_at


def follows(rate: FloatArray, change: FloatArray) -> bool:
    """Return whether an angular rate [K] is that of a body which leans by what an acceleration changes by [K]."""
    if rate.std() == 0.0 or change.std() == 0.0:
        return False
    correlation = float(np.corrcoef(rate, change)[0, 1])
    gain = correlation * float(rate.std() / change.std())
    return correlation > LEAST_ROLL_CORRELATION and ROLL_GAINS_RAD_S2_M[0] < gain < ROLL_GAINS_RAD_S2_M[1]


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


def course_follows_gyro(rows: FloatArray) -> bool:
    """Return whether the GNSS course turns as the gyro does; not if its axes are swapped or those of the body.

    A course that turns with the gyro or, on a straight drive, not at all is accepted: only sideslip separates the two.
    """
    moves = np.hypot(rows[:, s.GNSS_EAST], rows[:, s.GNSS_NORTH]) > LEAST_COURSE_SPEED_M_S
    rolls = moves & (rows[:, s.LAW_STD] > 0.0) & (rows[:, s.LAW_STD] < COURSE_LAW_RAD)
    sampled = np.flatnonzero(rolls if rolls.sum() > 0.2 * moves.sum() else moves)
    if sampled.size < 2:
        return False
    course = np.unwrap(np.arctan2(rows[sampled, s.GNSS_NORTH], rows[sampled, s.GNSS_EAST]))
    turned = np.cumsum(rows[:, s.MEAN_YAW_RATE])[sampled] / RATE_HZ
    later = np.searchsorted(sampled, sampled + round(TURN_S * RATE_HZ))
    first = np.flatnonzero(later < sampled.size)
    if not first.size:
        return False
    by_course, by_gyro = course[later[first]] - course[first], turned[later[first]] - turned[first]
    apart = np.angle(np.exp(1j * (by_course - by_gyro)))
    return float(np.median(np.abs(apart))) < 0.5 * max(float(np.median(np.abs(by_gyro))), LEAST_TURN_RAD)


def without_jumps(rows: FloatArray, states: FloatArray) -> FloatArray:
    """Return the inputs without GNSS velocities between a jump against the IMU and one back (multipath).

    A jump is seen in the speed and in the course, which need no heading: the IMU's smoothed states [K, n] give the
    change of both between two samples.
    """
    sampled = np.flatnonzero(np.isfinite(rows[:, s.GNSS_EAST]))
    if sampled.size < 3:
        return rows
    east, north = rows[sampled, s.GNSS_EAST], rows[sampled, s.GNSS_NORTH]
    speed, course = np.hypot(east, north), np.arctan2(north, east)
    vx, vy = states[sampled, s.VX], states[sampled, s.VY]
    turned = np.cumsum(rows[:, s.MEAN_YAW_RATE] - states[:, s.YAW_RATE_BIAS])[sampled] / RATE_HZ
    along = np.diff(speed - np.hypot(vx, vy))
    change = np.angle(np.exp(1j * np.diff(course - turned - np.arctan2(vy, vx))))
    across = np.where(np.minimum(speed[1:], speed[:-1]) > LEAST_COURSE_SPEED_M_S, speed[1:] * change, 0.0)
    jump = (along + 1j * across) * np.exp(1j * course[1:])
    limit = (
        JUMP_M_S + 0.02 * np.hypot(rows[sampled[1:], s.AX], rows[sampled[1:], s.AY]) + 0.2 * np.diff(sampled) / RATE_HZ
    )
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
