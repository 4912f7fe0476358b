"""The sideslip reference of one drive: priors, smoothing with and without GNSS, rejection, its track."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeAlias

import numpy as np

from pdhef_logtool.estimators import kinematic_filter as s, rts
from pdhef_logtool.estimators.prediction import sideslip_std
from pdhef_logtool.estimators.reference.gnss import (
    first_guess,
    gnss_follows_imu,
    scanned_delay,
    with_gnss_speed,
    without_jumps,
)
from pdhef_logtool.estimators.reference.inputs import ANTENNA_Y_STD_M, LINEAR_FRICTION, RATE_HZ, knots, sensor_noise
from pdhef_logtool.records.running_mean import running_mean
from pdhef_logtool.records.signals import LEAST_DIVISOR, S_PER_NS, BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.tracks import INDEPENDENT_SHARE, REFERENCE, StateTrack, make_track

#: Wheelbase for the priors of lengths; for smaller cars they are scaled by the wheelbase.
WHEELBASE_M = 2.7
#: 1-sigma of the distance of the rear axle, of the gain of the gyro, of the gains of accelerometers with known tilt,
#: and of the mounting of the IMU.
REAR_AXLE_STD_M, YAW_RATE_GAIN_STD, TILT_GAIN_STD, IMU_YAW_STD_RAD = 0.1, 0.003, 0.02, 0.015
MAX_ITERATIONS, TOLERANCE_M_S, UNSETTLED_M_S = 8, 2e-3, 0.05
#: The drive is rejected if a parameter is further than this from its prior mean, in prior 1-sigmas. Lengths and the
#: gain of the gyro have narrow priors (bank in bends has the same effect) and limits of 0.45 m, 0.3 m and 3 %.
FAR_STD = 3.0
FAR_STD_OF = {s.REAR_AXLE: 4.5, s.IMU_X: 6.0, s.YAW_RATE_GAIN: 10.0}
#: 1-sigma of sideslip below which a knot is sure; time around sure knots within which the reference is valid;
#: additional 1-sigma as a share of the sideslip (gains of the sensors, sliding wheels).
SURE_STD_RAD, REACH_S, SIDESLIP_SHARE = math.radians(0.5), 5.0, 0.05


@dataclass(frozen=True, slots=True)
class ReferencePrior:
    """Prior knowledge on the car and its sensors; all entries but the axle's refer to the sensors.

    ``rear_m``, ``wheelbase_m``: geometry. ``friction``: of the road, for the end of the linear range. ``imu_x_m``,
    ``ay_gain``, ``ay_bias_m_s2``, ``yaw_rate_bias_rad_s``: errors of the sensors as the log was read, with 1-sigmas of
    the first two. ``unknown_imu_x_m``: 1-sigma of a position that is not observable in the drive; it only widens the
    intervals, as a free position would absorb errors of the axle law. ``antenna_m``: position x, y of the antenna from
    the CG, NaN if unknown. ``speed_over_ground``: the speed is the length of a velocity over ground, not a wheel speed.
    """

    rear_m: float
    wheelbase_m: float
    friction: float = LINEAR_FRICTION
    imu_x_m: float = 0.0
    imu_x_std_m: float = 0.1
    unknown_imu_x_m: float = 0.0
    ay_gain: float = 1.05
    ay_gain_std: float = 0.04
    ay_bias_m_s2: float = 0.0
    yaw_rate_bias_rad_s: float = 0.0
    antenna_m: tuple[float, float] = (math.nan, math.nan)
    speed_over_ground: bool = False


@dataclass(frozen=True, slots=True)
class ReferenceParameter:
    """An estimated parameter, with its prior mean and the deviation that rejects the drive."""

    name: str
    unit: str
    value: float
    std: float
    prior: float
    limit: float


@dataclass(frozen=True, slots=True, eq=False)
class SideslipReference:
    """The reference of a drive at its knots [K].

    ``vx_m_s``, ``vy_m_s`` at the CG and their kinematic derivatives; ``covariance`` [K, 3] (xx, xy, yy);
    ``law_share``, ``gnss_share`` of the information on v_y, kinematics has the rest; ``valid``: usable knots;
    ``refused``: why the drive is rejected, empty if it is accepted.
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

    def between(self, start_ns: int | None, end_ns: int | None) -> "SideslipReference":
        """Return the knots in [start_ns, end_ns]; None for an open end."""
        first = 0 if start_ns is None else int(np.searchsorted(self.stamps_ns, start_ns))
        last = len(self.stamps_ns) if end_ns is None else int(np.searchsorted(self.stamps_ns, end_ns, side="right"))
        columns: dict[str, Any] = {
            f.name: values[first:last] for f in fields(self) if isinstance(values := getattr(self, f.name), np.ndarray)
        }
        return replace(self, **columns)


#: Entry of the state, mean and 1-sigma of its first value; of a parameter, name and unit (others have empty ones).
_Entry: TypeAlias = tuple[int, float, float, str, str]


def _entries(prior: ReferencePrior, *, tilts: bool) -> Iterator[_Entry]:
    """Yield the entries of the first state, except those that :func:`_smooth` sets.

    ``tilts``: roll and pitch rate provide the tilt of the accelerometers, so that a_y and a_x have no gain.
    """
    small = min(1.0, prior.wheelbase_m / WHEELBASE_M)
    has_antenna = math.isfinite(prior.antenna_m[0])
    x, y = prior.antenna_m if has_antenna else (0.0, 0.0)
    ay_gain = (0.0, TILT_GAIN_STD) if tilts else (prior.ay_gain - 1.0, prior.ay_gain_std)
    ax_gain = (0.0, TILT_GAIN_STD) if tilts else (0.02, 0.02)
    yield from ((i, 0.0, 1.0, "", "") for i in (s.VX, s.VY, s.LAW_ERROR))
    yield from ((i, 0.0, s.BIAS_M_S2, "", "") for i in (s.AX_BIAS, s.AY_BIAS))
    yield from ((i, 0.0, 0.01, "", "") for i in (s.ROLL_RATE_BIAS, s.PITCH_RATE_BIAS))
    yield from ((i, 0.0, s.RECEIVER_M_S, "", "") for i in (s.EAST_ERROR, s.NORTH_ERROR))
    yield s.COMPLIANCE, 0.006, 0.004, "rear axle compliance", "rad s^2/m"
    yield s.YAW_COMPLIANCE, 0.003, 0.004, "rear slip per yaw acceleration", "s^2"
    yield s.RATE_COMPLIANCE, 0.006 * small, 0.006 * small, "lag of the rear axle", "s^2"
    yield s.LAW_ANGLE, 0.0, math.radians(0.2), "rear axle angle", "rad"
    yield s.REAR_AXLE, 0.0, REAR_AXLE_STD_M * small, "rear axle distance error", "m"
    yield s.ROLL_GAIN, *ay_gain, "roll gain of a_y", "1"
    yield s.AX_GAIN, *ax_gain, "pitch gain of a_x", "1"
    yield s.IMU_YAW, 0.0, IMU_YAW_STD_RAD, "IMU yaw", "rad"
    yield s.SPEED_SCALE, 0.0, 0.02, "speed scale error", "1"
    yield s.IMU_X, prior.imu_x_m, prior.imu_x_std_m, "accelerometer x", "m"
    yield s.IMU_Y, 0.0, 0.2 * small, "accelerometer y", "m"
    yield s.YAW_RATE_BIAS, prior.yaw_rate_bias_rad_s, 0.005, "yaw rate bias", "rad/s"
    yield s.YAW_RATE_GAIN, 0.0, YAW_RATE_GAIN_STD, "yaw rate gain error", "1"
    yield s.ANTENNA_X, x, (0.1 if has_antenna else 0.7) * small, "antenna x", "m"
    yield s.ANTENNA_Y, y, (0.1 if has_antenna else ANTENNA_Y_STD_M) * small, "antenna y", "m"
    yield s.GNSS_DELAY, 0.0, 0.06, "GNSS delay", "s"
    yield s.ANTENNA_HEIGHT, 1.2 * small, 0.6 * small, "antenna height over the roll axis", "m"


def refer(signals: Signals, prior: ReferencePrior, *, use_gnss: bool = True) -> SideslipReference:
    """Estimate v_x and v_y of a whole drive from all of its samples, including later ones, without tyre data.

    ``signals`` [N] need a_y and yaw rate, and speed or GNSS velocity.
    """
    stamps_ns, rows = knots(signals, prior.friction, prior.ay_bias_m_s2, speed_over_ground=prior.speed_over_ground)
    rows[:, s.GNSS_OFFSET] -= scanned_delay(rows)
    with_gnss = use_gnss and gnss_follows_imu(rows)
    noise = sensor_noise(signals, rows)
    rows = without_jumps(rows) if with_gnss else rows
    alone, best = _solve(rows, prior, noise, gnss=with_gnss)
    if prior.unknown_imu_x_m > 0.0:
        moved = replace(prior, imu_x_m=prior.imu_x_m + prior.unknown_imu_x_m)
        vx, vy = (_solve(rows, moved, noise, gnss=with_gnss)[1].states - best.states)[:, [s.VX, s.VY]].T
        best = replace(best, covariance=best.covariance + np.stack([vx * vx, vx * vy, vy * vy], axis=1))
    gnss_share = np.clip(1.0 - best.covariance[:, 2] / np.maximum(alone.covariance[:, 2], LEAST_DIVISOR), 0.0, 1.0)
    vx, vy = best.states[:, s.VX], best.states[:, s.VY]
    law_m_s = np.where(rows[:, s.LAW_STD] > 0.0, rows[:, s.LAW_STD] * np.hypot(vx, vy), np.inf)
    law = np.clip(alone.covariance[:, 2] / np.maximum((1.0 + s.LAW_WHITE**2) * law_m_s**2, LEAST_DIVISOR), 0.0, 1.0)
    rate, ax, ay = corrected_inputs(best.states, rows)
    parameters = _parameters(best, prior, tilts=bool(rows[0, s.TILT]))
    refused = _refusal(best, parameters)
    measured = rows[:, s.GAP] == 0.0
    sure = measured & (sideslip_std(vx, vy, best.covariance[:, [[0, 1], [1, 2]]]) < SURE_STD_RAD)
    error = SIDESLIP_SHARE * np.arctan2(vy, np.abs(vx))
    covariance = best.covariance + (error**2 * np.stack([vy * vy, -vx * vy, vx * vx])).T
    return SideslipReference(
        stamps_ns, vx, vy, rate, ax + vy * rate, ay - vx * rate, covariance, law * (1.0 - gnss_share), gnss_share,
        measured & _near(sure) & (not refused), parameters, with_gnss, refused,
    )  # fmt: skip


def _near(sure: BoolArray) -> BoolArray:
    """Return the mask of the knots [K] with a sure one within ``REACH_S``."""
    return np.asarray(running_mean(sure.astype(np.float64), round(REACH_S * RATE_HZ)) > 0.0)


def corrected_inputs(states: FloatArray, rows: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return yaw rate and accelerations of the CG at the knots [K], without the estimated errors of the sensors."""
    columns = (s.AX, s.AY, s.SLOW_AX, s.SLOW_AY, s.YAW_ACCELERATION)
    ax, ay, slow_ax, slow_ay, turning = rows.T[list(columns)]
    rate = s.yaw_rate.py_func(states.T, rows[:, s.YAW_RATE])
    return rate, *s.accelerations.py_func(states.T, ax, ay, slow_ax, slow_ay, rate, turning)


@dataclass(frozen=True, slots=True, eq=False)
class _Smoothed:
    states: FloatArray
    covariance: FloatArray
    last_variance: FloatArray
    moved_m_s: float


def _solve(rows: FloatArray, prior: ReferencePrior, noise: FloatArray, *, gnss: bool) -> tuple[_Smoothed, _Smoothed]:
    """Return the smoothed states without GNSS, and with GNSS if it is used."""
    alone = _smooth(rows, prior, noise, s.WITHOUT_GNSS)
    if not gnss:
        return alone, alone
    return alone, _smooth(with_gnss_speed(rows), prior, noise, s.WITH_GNSS, first_guess(rows, alone.states))


def _smooth(
    rows: FloatArray, prior: ReferencePrior, noise: FloatArray, n: int, velocity: FloatArray | None = None
) -> _Smoothed:
    """Smooth with n states; ``velocity`` [K, 3] is an optional first estimate of v_x, v_y and heading."""
    mean, std = np.zeros(n), np.zeros(n)
    for entry, value, sigma, *_ in _entries(prior, tilts=bool(rows[0, s.TILT])):
        if entry < n:
            mean[entry], std[entry] = value, sigma
    speed = rows[:, s.SPEED]
    first = np.flatnonzero(np.isfinite(speed))
    mean[s.VX] = speed[first[0]] if first.size else 0.0
    mean[s.VY] = prior.rear_m * rows[0, s.YAW_RATE]
    points = np.empty((0, n))
    if n == s.WITH_GNSS:
        mean[s.HEADING], std[s.HEADING] = (0.0, math.pi) if velocity is None else (velocity[0, 2], 0.3)
    if velocity is not None:
        points = np.tile(mean, (len(rows), 1))
        points[:, [s.VX, s.VY, s.HEADING]] = velocity
    for iteration in range(MAX_ITERATIONS):
        x, p, predicted_x, predicted_p, cross = s.forward_pass(
            1.0 / RATE_HZ, rows, prior.rear_m, mean, std**2, tuple(noise), points, iteration > 1 or velocity is not None
        )
        smoothed = rts.smooth_states(x, predicted_x, predicted_p, cross)
        before, points = points if len(points) else x, smoothed
        moved = float(np.sqrt(np.mean((smoothed[:, s.VY] - before[:, s.VY]) ** 2)))
        if iteration > 2 and moved < TOLERANCE_M_S:
            break
    last, p = np.diag(p[-1]), rts.smooth_covariances(p, predicted_p, cross)
    return _Smoothed(smoothed, p[:, [s.VX, s.VX, s.VY], [s.VX, s.VY, s.VY]], last, moved)


def _parameters(smoothed: _Smoothed, prior: ReferencePrior, *, tilts: bool) -> tuple[ReferenceParameter, ...]:
    value, std = smoothed.states[-1], np.sqrt(np.maximum(smoothed.last_variance, 0.0))
    return tuple(
        ReferenceParameter(name, unit, float(value[i]), float(std[i]), mean, FAR_STD_OF.get(i, FAR_STD) * sigma)
        for i, mean, sigma, name, unit in _entries(prior, tilts=tilts)
        if name and i < len(value)
    )


def _refusal(smoothed: _Smoothed, parameters: tuple[ReferenceParameter, ...]) -> str:
    if not np.isfinite(smoothed.states).all() or smoothed.moved_m_s > UNSETTLED_M_S:
        return f"the smoother has not settled (v_y still moves by {smoothed.moved_m_s:.2g} m/s)"
    for p in parameters:
        if abs(p.value - p.prior) > p.limit:
            value = f"{p.name} {p.value:.3g} {p.unit}".removesuffix(" 1")  # a number without a unit
            return f"{value} is implausible (expected {p.prior:.3g} ± {p.limit:.2g})"
    return ""


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceEstimator:
    """Returns the reference of spans of a drive, interpolated between knots by cubics with kinematic slopes."""

    algorithm = "sideslip-reference"
    version = 1

    spans: Sequence[SideslipReference]
    notes: tuple[str, ...] = ()
    name: str = REFERENCE
    causal: bool = False
    intervals_note: str = "intervals of the smoother itself"

    def smooth(self, signals: Signals) -> StateTrack:
        """Return the track of a drive (see :class:`~..base.Smoother`)."""
        return self.at(signals.stamps_ns)

    def at(self, stamps_ns: IntArray) -> StateTrack:
        """Return the track at stamps [N], from the first span that contains the stamp; NaN outside of all spans."""
        n = len(stamps_ns)
        states, covariance, shares = (np.full((n, 3), np.nan) for _ in range(3))
        valid, filled = np.zeros(n, dtype=np.bool_), np.zeros(n, dtype=np.bool_)
        for span in self.spans:
            inside = ~filled & (stamps_ns >= span.stamps_ns[0]) & (stamps_ns <= span.stamps_ns[-1])
            if inside.any() and len(span.stamps_ns) > 1:
                filled |= inside
                columns = _interpolated(span, stamps_ns[inside])
                states[inside], covariance[inside], shares[inside], valid[inside] = columns
        vx, vy, yaw_rate = states.T
        full = np.full((n, 3, 3), np.nan)
        full[:, 0, 0], full[:, 0, 1], full[:, 1, 0], full[:, 1, 1] = covariance[:, [0, 1, 1, 2]].T
        law, kinematics, gnss = shares.T
        return make_track(
            self.name,
            stamps_ns,
            vx_m_s=vx,
            vy_m_s=vy,
            yaw_rate_rad_s=yaw_rate,
            covariance=full,
            sideslip_std_rad=sideslip_std(vx, vy, full),
            share_law=law,
            share_kinematics=kinematics,
            share_gnss=gnss,
            independent=np.where(np.isnan(gnss), np.nan, gnss > INDEPENDENT_SHARE),
            valid=valid,
        )


def _interpolated(span: SideslipReference, stamps_ns: IntArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return v_x, v_y, r [K, 3], covariance of v_x, v_y and shares [K, 3] each, and validity at stamps of a span."""
    left = np.clip(np.searchsorted(span.stamps_ns, stamps_ns, side="right") - 1, 0, len(span.stamps_ns) - 2)
    step_s = np.asarray((span.stamps_ns[left + 1] - span.stamps_ns[left]) * S_PER_NS, dtype=np.float64)
    share = (stamps_ns - span.stamps_ns[left]) * S_PER_NS / step_s

    def between(column: FloatArray) -> FloatArray:
        weight = share.reshape(-1, *[1] * (column.ndim - 1))
        return np.asarray(column[left] * (1.0 - weight) + column[left + 1] * weight)

    vx = _cubic(span.vx_m_s, span.vx_rate_m_s2, left, share, step_s)
    vy = _cubic(span.vy_m_s, span.vy_rate_m_s2, left, share, step_s)
    law, gnss = between(span.law_share), between(span.gnss_share)
    states, shares = (
        np.stack(c, axis=1) for c in ((vx, vy, between(span.yaw_rate_rad_s)), (law, 1.0 - law - gnss, gnss))
    )
    return states, between(span.covariance), shares, span.valid[left] & span.valid[left + 1]


def _cubic(y: FloatArray, slope: FloatArray, left: IntArray, share: FloatArray, step_s: FloatArray) -> FloatArray:
    """Return the cubic through two knots with their slopes (Hermite) at a share [N] of the interval."""
    y0, y1, m0, m1 = y[left], y[left + 1], slope[left] * step_s, slope[left + 1] * step_s
    s, s2, s3 = share, share**2, share**3
    return np.asarray(
        (2.0 * s3 - 3.0 * s2 + 1.0) * y0 + (s3 - 2.0 * s2 + s) * m0 + (3.0 * s2 - 2.0 * s3) * y1 + (s3 - s2) * m1
    )
