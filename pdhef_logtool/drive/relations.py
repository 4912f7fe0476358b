"""Relations between pairs of signals, from rigid-body kinematics and rolling wheels."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.columns import derivative, fit, independent_samples, median_known, moving_at
from pdhef_logtool.drive.hypotheses import (
    BLOCKS,
    MIN_CORRELATION,
    MIN_SAMPLES,
    MOST_ENERGY,
    Relation,
    block_gains,
)
from pdhef_logtool.records.signals import WHEELS, BoolArray, FloatArray

#: Least correlation of two residuals of a regression: they are small, and sliding changes their relation.
MIN_PARTIAL_CORRELATION = 0.8
#: Column of the ground-truth v_y at the CG if v_y is mapped. The mapped v_y has its own column, because the lever-arm
#: term of v_y at the CG would hide a wrong unit.
CG_VY = "truth.vy_m_s at the CG"
#: Column of the course rate of the ground-truth path, named after the position that determines its sign.
COURSE_RATE = "truth.y_m"
#: Column of the rate of the mapped ground-truth heading, under the name of the heading.
TURNING = "truth.yaw_rad"
#: Column of the course rate of a GNSS receiver's velocity.
GNSS_COURSE_RATE = "gnss_course_rate_rad_s"
#: Columns of the course rate and the speed of a GNSS receiver's positions; their sign is that of the longitude.
GNSS_PATH = "gnss_path_rate_rad_s", "gnss_path_speed_m_s"
#: Columns of the velocity along the axes of the ground-truth positions.
POSITION = "truth.position_vx_m_s", "truth.position_vy_m_s"
#: A side that moves by more than this must also move the other side. Crossfall and grade alone move an accelerometer by
#: less (5 % are 0.5 m/s^2), and noise of 1 Hz bandwidth moves a gyro by less.
MOVES_M_S2 = 1.0
MOVES_RAD_S = 0.06
#: 1-sigma of the offset of a gyro, and of an accelerometer on a crossfall; the share of it that changes in a drive.
BIAS_RAD_S, BIAS_M_S2, DISTURBED = 0.01, 0.5, 0.6
#: Gains that tyres, roll, bank, grade and noise explain; outside, a unit is wrong.
GAIN_RANGE = (0.55, 1.8)
#: The same quantity measured twice.
SAME_RANGE = (0.75, 1.33)
#: a_y - v_x r over the derivative of v_y: small differences of large quantities, with body roll.
SIDESLIP_RANGE = (0.5, 2.0)
#: Slip of a rear axle at 1 m/s^2: cornering stiffness over load is 4 to 40 per rad, and much less for a drifting model
#: car. The range decides a sign, but not a unit.
COMPLIANCE_RAD_PER_M_S2 = (0.0005, 0.5)
#: Above this, sideslip times lateral acceleration is not small compared to the derivative of the speed.
STRAIGHT_M_S2 = 3.0
#: Least share of v_x in the speed if the heading is right.
AHEAD_SHARE = 0.9
#: Least ratio of the square of a position's scale to its standard error: along an axis on which the car hardly moves,
#: noise reached 4.6 in 500 drives.
SHOWN_STD = 8.0
#: No car reverses faster for long: the sign of a faster speed is known, but not its unit.
REVERSE_M_S = 10.0
#: In a bend, wheels differ by less; a wheel that differs by more spins or locks.
SPIN_SHARE = 0.2
#: Rim speed over ground speed, 5 % of slip and 5 % of radius; angular over rim speed, wheels of 4 cm to 80 cm radius.
WHEEL_RANGE = (0.88, 1.14)
WHEEL_PER_RADIAN_RANGE = (1.25, 25.0)
#: Effective wheelbase L (1 + K v²), m, from road-wheel and from steering-wheel angles: from a model car to a truck, and
#: for speeds that only full-size vehicles reach.
ROAD_WHEEL_LENGTH_M, FULL_SIZE_LENGTH_M = (0.15, 12.0), (1.2, 12.0)
STEERING_WHEEL_LENGTH_M, FULL_SIZE_STEERING_WHEEL_LENGTH_M = (12.0, 240.0), (22.0, 240.0)
FULL_SIZE_M_S = (12.0, 70.0)
#: The same divided by L + K v² of the vehicle file, and sideslip by that of its rear axle; the range includes a wrong
#: ratio in the file, and sliding front tyres, which lengthen it several times. A wrong speed must not lengthen it: the
#: lowest of speed, ground truth and a_y / r counts, up to ``FAST_M_S``.
KNOWN_LENGTH, KNOWN_SIDESLIP, FAST_M_S = (0.4, 6.0), (0.4, 2.5), 40.0
#: Track from a 1:10 car to a truck.
TRACK_M = (0.12, 3.0)
#: Share of the drive's lateral acceleration up to which the steering angle is compared with the curvature; above, the
#: front tyres slip.
STEERING_SHARE = 0.6

#: Values that no road car, race car or model car exceeds for more than a second: model cars spin at 5 rad/s and corner
#: at 15 m/s²; a body that keeps rolling at 4 rad/s overturns; a wheel of 5 cm radius turns with 600 rad/s at 30 m/s;
#: trucks have five turns of the steering wheel.
MOST = {
    **dict.fromkeys(("ax_m_s2", "ay_m_s2", "truth.ay_m_s2"), 30.0),
    **dict.fromkeys(("yaw_rate_rad_s", "truth.yaw_rate_rad_s"), 10.0),
    **dict.fromkeys(("roll_rate_rad_s", "pitch_rate_rad_s"), 4.0),
    "steer_rad": 1.3,
    "steering_wheel_rad": 20.0,
    **dict.fromkeys(("speed_m_s", "truth.vx_m_s"), 120.0),
    **{f"wheel_speed_{w}_m_s": 150.0 for w in WHEELS},
    **{f"wheel_speed_{w}_rad_s": 700.0 for w in WHEELS},
    "truth.vy_m_s": 40.0,
    "truth.sideslip_rad": math.pi,
}
#: Least share of the low-passed values below the limit: shocks and spins are short; a wheel spins in the air.
SHARE, WHEEL_SHARE = 0.95, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class _Pace:
    """The speed [N] of a drive by its column, and where the car moves, and moves gently."""

    columns: Mapping[str, FloatArray]
    name: str
    speed: FloatArray
    moving: BoolArray
    gentle: BoolArray

    @classmethod
    def of(cls, columns: Mapping[str, FloatArray], name: str) -> _Pace:
        """Return the pace by a column."""
        speed, yaw = columns[name], columns.get("yaw_rate_rad_s")
        moving = _moving(columns, speed)
        return cls(columns, name, speed, moving, moving if yaw is None else gentle_at(yaw * speed, moving))


@np.errstate(divide="ignore", invalid="ignore")
def measured_relations(
    columns: Mapping[str, FloatArray], speed_name: str | None, vehicle: VehicleParameters | None = None
) -> list[Relation]:
    """Return all relations between the columns, including uninformative ones.

    Parameters
    ----------
    columns : on the grid, SI, by signal name; names of ground truth begin with ``truth.``.
    speed_name : the column used as the speed. vehicle : of a file; None without a file.
    """
    relations = list(_limits(columns))
    of_path = {} if any(map(is_misscaled, position_factors(columns))) else columns
    for prefix in ("", "truth."):
        pace_name = f"{prefix}vx_m_s" if f"{prefix}vx_m_s" in columns else speed_name
        if pace_name is not None:
            relations += _motion(columns, prefix, pace_name)
    if speed_name is not None:
        pace = _Pace.of(columns, speed_name)
        relations += [*_steering(pace, vehicle), *_speeds(pace), *_wheel_differences(pace), *_courses(of_path, pace)]
    relations += _poses(of_path)
    rate = ("yaw_rate_rad_s", SAME_RANGE, MOVES_RAD_S, BIAS_RAD_S)
    lateral = ("truth.ay_m_s2", "ay_m_s2", GAIN_RANGE, MOVES_M_S2, BIAS_M_S2)
    for other, name, expected, moves, bias in (("truth.yaw_rate_rad_s", *rate), (TURNING, *rate), lateral):
        if name in columns and other in columns:
            text, everywhere = f"{other} against {name}", np.ones(columns[name].shape[0], np.bool_)
            sides = columns[name], columns[other]
            relations += compare(text, {other: 1, name: -1}, *sides, everywhere, expected, moves=moves, bias=bias)
    bends = {"ay_m_s2", "yaw_rate_rad_s"}
    agree = any(r.tells and r.accepts() for r in relations if r.powers.keys() >= bends)
    axle = _axle_sideslips(columns, vehicle, speed_name, agree)
    return relations + axle + _sideslips(columns, is_known=bool(axle))


# ------------------------------------------------------------------------------------------- relations


def compare(
    text: str,
    powers: dict[str, int],
    reference: FloatArray,
    measured: FloatArray,
    use: BoolArray,
    expected: tuple[float, float],
    *,
    moves: float | None = None,
    either: bool = True,
    gentle: BoolArray | None = None,
    bias: float = math.inf,
) -> list[Relation]:  # positional: the two sides of a relation and their expected gain
    """Return the relation between two columns where ``use`` and both are finite; an empty list without driving.

    ``moves``: both sides have one unit, and a side that moves by more than this, 1-sigma, must move the other; with
    ``either`` False only the reference must move the measured side. ``gentle``: samples of gentle driving. The relation
    of these is returned if only it is plausible: a wrong sign, unit or axis is wrong everywhere, sliding is not.
    ``bias``: 1-sigma of the offset between the sides. The means count as far as they exceed it: on a circle the mean is
    the signal. Sides that move by less count as fewer samples: the crossfall of a straight road moves them, too.
    """
    if gentle is not None:
        relations = compare(text, powers, reference, measured, use, expected, moves=moves, bias=bias)
        at_ease = compare(text, powers, reference, measured, gentle, expected, moves=moves, bias=bias)
        is_right = all(r.accepts() and not r.unrelated for r in relations)
        return at_ease if not is_right and at_ease and all(r.tells and r.accepts() for r in at_ease) else relations
    use = use & np.isfinite(reference) & np.isfinite(measured)
    samples = independent_samples(int(np.count_nonzero(use)))
    if samples < MIN_SAMPLES:
        return []
    a, b = reference[use] - reference[use].mean(), measured[use] - measured[use].mean()
    spread_a, spread_b = float(a.std()), float(b.std())
    if max(spread_a, spread_b) <= 1e-12:
        return []
    both = moves is not None and (max(spread_a, spread_b) if either else spread_a) > moves
    if min(spread_a, spread_b) <= 1e-12:
        return [Relation(text, powers, 0.0, float("nan"), expected, samples, both)]
    if math.isfinite(bias):  # below the disturbances, both sides follow the road
        samples *= min(1.0, max(spread_a, spread_b) / (DISTURBED * bias)) ** 2
    correlation = float(np.mean(a * b) / (spread_a * spread_b))
    left = max(0.0, 1.0 - correlation**2) * spread_b**2
    # Weight of the means in a regression with a normal prior of the offset.
    weight = left / (left + samples * bias**2)
    of_means = [math.sqrt(weight) * float(side[use].mean()) for side in (reference, measured)]
    rms_a, rms_b = math.hypot(spread_a, of_means[0]), math.hypot(spread_b, of_means[1])
    correlation = (correlation * spread_a * spread_b + of_means[0] * of_means[1]) / (rms_a * rms_b)
    # The ratio of the sizes lies between the two regressions, because either side may be noisy.
    gain = float(np.copysign(rms_b / rms_a, correlation))
    # The gain of a block with fewer samples is random, and a block on a circle has none.
    by_means = abs(of_means[0]) > spread_a
    blocks = () if by_means else block_gains(a, b, min(BLOCKS, max(1, int(samples / MIN_SAMPLES))))
    return [Relation(text, powers, correlation, gain, expected, samples, both, blocks=blocks)]


def _limits(columns: Mapping[str, FloatArray]) -> Iterator[Relation]:
    """Yield a relation for each signal with values that no vehicle reaches; it needs no second signal."""
    for name, most in MOST.items():
        column = columns.get(name, np.empty(0))
        finite = np.abs(column[np.isfinite(column)])
        share = WHEEL_SHARE if name.startswith("wheel") else SHARE
        if finite.size and (large := float(np.quantile(finite, share))) > most:
            text = f"{1.0 - share:.0%} of {name} are above {large:.3g}, vehicles reach {most:.3g}"
            samples = independent_samples(finite.size)
            ratio = large / most  # no sliding explains it
            yield Relation(text, {name: 1}, 1.0, ratio, (0.0, 1.0), samples, signless=True, most_energy=2 * MOST_ENERGY)


def _motion(columns: Mapping[str, FloatArray], prefix: str, pace_name: str) -> Iterator[Relation]:
    """Relate the accelerations to speed and yaw rate, of the sensors or of ground truth."""
    pace = columns[pace_name]
    moving = _moving(columns, pace)
    yaw, left, forward = (columns.get(f"{prefix}{n}") for n in ("yaw_rate_rad_s", "ay_m_s2", "ax_m_s2"))
    turns = None if yaw is None else yaw * pace
    if turns is not None and left is not None:
        powers = {f"{prefix}ay_m_s2": 1, f"{prefix}yaw_rate_rad_s": -1, pace_name: -1}
        text, gentle = f"{prefix}ay_m_s2 against {prefix}yaw_rate_rad_s x speed", gentle_at(turns, moving)
        moves = MOVES_M_S2
        yield from compare(text, powers, turns, left, moving, GAIN_RANGE, moves=moves, gentle=gentle, bias=BIAS_M_S2)
    if forward is not None:
        powers = {f"{prefix}ax_m_s2": 1, pace_name: -1}
        text = f"{prefix}ax_m_s2 against the derivative of the speed"
        straight = moving if turns is None else moving & (np.abs(turns) < STRAIGHT_M_S2)
        if turns is not None and not moving_at(pace).any():  # unknown unit
            straight = gentle_at(turns, moving)
        # Pitch changes a_x at constant speed, and noise changes the derivative of a GNSS speed.
        least = None if pace_name == "truth.vx_m_s" else MOVES_M_S2
        yield from compare(text, powers, derivative(pace), forward, straight, GAIN_RANGE, moves=least, either=False)


def _best(either: list[Relation]) -> list[Relation]:
    return sorted(either, key=lambda r: (r.tells and r.accepts(), abs(r.correlation)))[-1:]


def gentle_at(lateral_m_s2: FloatArray, moving: BoolArray) -> BoolArray:
    """Return where the car moves with a lateral acceleration that is small for this drive."""
    size = np.abs(lateral_m_s2)
    finite = moving & np.isfinite(size)
    if not finite.any():
        return moving
    with np.errstate(invalid="ignore"):
        return np.asarray(moving & (size <= STEERING_SHARE * np.quantile(size[finite], 0.95)))


def _moving(columns: Mapping[str, FloatArray], speed: FloatArray) -> BoolArray:
    """Return where the car moves; by the relative speed alone if it is too low and IMU or other speeds show motion."""
    moving = moving_at(speed)
    if moving.any():
        return moving
    moves = {"yaw_rate_rad_s": MOVES_RAD_S, "ay_m_s2": MOVES_M_S2, "ax_m_s2": MOVES_M_S2}
    finite = [(columns[n][np.isfinite(columns[n])], least) for n, least in moves.items() if n in columns]
    others = (c for n, c in columns.items() if n.startswith("wheel_speed_") or n in ("speed_m_s", "truth.vx_m_s"))
    is_driven = any(c.size and c.std() > least for c, least in finite) or any(moving_at(c).any() for c in others)
    return moving_at(speed, 0.0) if is_driven else moving


def _lengths(pace: _Pace, vehicle: VehicleParameters | None) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the plausible effective wheelbases by road-wheel and by steering-wheel angle, m."""
    columns, speed = pace.columns, pace.speed
    if vehicle is None:
        finite = np.abs(speed[np.isfinite(speed)])
        is_full_size = finite.size and FULL_SIZE_M_S[0] < np.quantile(finite, 0.9) < FULL_SIZE_M_S[1]
        full_size = FULL_SIZE_LENGTH_M, FULL_SIZE_STEERING_WHEEL_LENGTH_M
        return full_size if is_full_size else (ROAD_WHEEL_LENGTH_M, STEERING_WHEEL_LENGTH_M)
    paces = [median_known(np.abs(c)) for c in (speed, columns.get("truth.vx_m_s")) if c is not None]
    if "ay_m_s2" in columns:
        ay, rate = (columns[n] for n in ("ay_m_s2", "yaw_rate_rad_s"))
        finite = np.isfinite(ay) & np.isfinite(rate)
        paces.append(float(ay[finite].std() / max(rate[finite].std(), 1e-9)) if finite.any() else FAST_M_S)
    gradient = max(0.0, vehicle.understeer_gradient_rad_per_m_s2(vehicle.assumed_friction))
    low, high = (f * (vehicle.wheelbase_m + gradient * min(*paces, FAST_M_S) ** 2) for f in KNOWN_LENGTH)
    return (low, high), (low * vehicle.steering_ratio, high * vehicle.steering_ratio)


def _steering(pace: _Pace, vehicle: VehicleParameters | None) -> Iterator[Relation]:
    columns, speed, gentle = pace.columns, pace.speed, pace.gentle
    yaw = columns.get("yaw_rate_rad_s")
    if yaw is None:
        return
    driven = yaw[gentle & np.isfinite(yaw)]
    is_turning = driven.size > 0 and bool(driven.std() > max(MOVES_RAD_S, abs(driven.mean())))  # to both sides
    for name, lengths in zip(("steer_rad", "steering_wheel_rad"), _lengths(pace, vehicle), strict=True):
        steer, typical = columns.get(name), float(np.sqrt(lengths[0] * lengths[1]))
        if steer is None:
            continue
        powers, text = {name: 1, "yaw_rate_rad_s": -1, pace.name: 1}, f"{name} against yaw_rate_rad_s / speed"
        either = [r for use in (pace.moving, gentle) for r in compare(text, powers, yaw / speed, steer, use, lengths)]
        either = [replace(r, typical=typical, moves=r.correlation == 0.0 and is_turning) for r in either]  # dead sensor
        # Sliding front tyres break the relation at large angles, and noise breaks it at small ones.
        yield from _best(either)
        if "ay_m_s2" in columns:
            powers, text = {"ay_m_s2": 1, name: -1, pace.name: -2}, f"ay_m_s2 against {name} x speed^2"
            inverse = (1.0 / lengths[1], 1.0 / lengths[0])
            lateral = compare(text, powers, steer * speed**2, columns["ay_m_s2"], gentle, inverse)
            yield from (replace(r, typical=1.0 / typical) for r in lateral)


def _speeds(pace: _Pace) -> Iterator[Relation]:
    """Relate wheel speeds and ground-truth speeds to the speed: their ratio needs no manoeuvre."""
    wanted = {f"wheel_speed_{w}_m_s": WHEEL_RANGE for w in WHEELS}
    wanted |= {f"wheel_speed_{w}_rad_s": WHEEL_PER_RADIAN_RANGE for w in WHEELS}
    of_paths = ("truth.position_speed_m_s", GNSS_PATH[1])
    wanted |= dict.fromkeys(("truth.vx_m_s", *of_paths), SAME_RANGE)
    speed = pace.speed
    for name in (n for n in wanted if n in pace.columns and n != pace.name):
        column = pace.columns[name]
        if name.startswith("wheel"):
            column = np.where(np.isfinite(_scaled_to(column, pace)), column, np.nan)
        # Near the limit, wheel speeds differ from the speed of the car.
        uses = [where & np.isfinite(column) for where in (pace.gentle, pace.moving)]
        counts = [independent_samples(int(np.count_nonzero(use))) for use in uses]
        use, samples = next(((u, s) for u, s in zip(uses, counts, strict=True) if s >= MIN_SAMPLES), (None, 0.0))
        if use is None:
            continue
        ratios = column[use] / speed[use]
        powers = {pace.name: -1} | ({} if name == GNSS_PATH[1] else {name: 1})
        blocks = tuple(float(np.median(b)) for b in np.array_split(ratios, BLOCKS) if b.size)
        gain, signless, text = float(np.median(ratios)), name in of_paths, f"{name} over {pace.name}"
        yield Relation(text, powers, 1.0, gain, wanted[name], samples, signless=signless, blocks=blocks)
    of_wheels = (
        any(n.startswith("wheel") and n.endswith("_rad_s") for n in pace.columns) and pace.name == "wheel_speeds"
    )
    fast = speed[np.abs(speed) > REVERSE_M_S * (3.0 if of_wheels else 1.0)]
    if (samples := independent_samples(fast.size)) >= 2.0 * MIN_SAMPLES:
        text, ahead = f"{pace.name} at speeds too high for reversing", float(np.sign(np.median(fast)))
        yield Relation(text, {pace.name: 1}, 1.0, ahead, (0.0, np.inf), samples)


def yaw_references(columns: Mapping[str, FloatArray], speed_name: str | None) -> list[tuple[str, FloatArray]]:
    """Return other measurements of the yaw rate than the gyro's, up to a factor; steering has no certain sign."""
    references = [
        (n, columns[n]) for n in (COURSE_RATE, GNSS_COURSE_RATE, GNSS_PATH[0], "truth.yaw_rate_rad_s") if n in columns
    ]
    return references + ([] if speed_name is None else _axle_differences(_Pace.of(columns, speed_name)))


def steering_references(columns: Mapping[str, FloatArray], speed_name: str | None) -> list[tuple[str, FloatArray]]:
    """Return steering angle times speed, which is in proportion to the yaw rate, often with the wrong sign."""
    steers = [] if speed_name is None else [n for n in ("steer_rad", "steering_wheel_rad") if n in columns]
    return [(f"{n} x speed", columns[n] * columns[str(speed_name)]) for n in steers]


def _axle_differences(pace: _Pace) -> list[tuple[str, FloatArray]]:
    """Return the speed difference (right minus left) of each axle, scaled to the speed to remove radii and units."""
    differences = []
    for unit in ("m_s", "rad_s"):
        for axle in ("r", "f"):
            pair = [pace.columns.get(f"wheel_speed_{axle}{side}_{unit}") for side in "lr"]
            scaled = [_scaled_to(w, pace) for w in pair if w is not None]
            if len(scaled) == 2:
                differences.append((f"wheel speeds {axle}r - {axle}l", scaled[1] - scaled[0]))
    return differences


def _wheel_differences(pace: _Pace) -> Iterator[Relation]:
    """Relate yaw rate and a_y to the speed differences of the axles, which have no mounting error."""
    pairs = _axle_differences(pace)
    for name, power in (("yaw_rate_rad_s", 1), ("ay_m_s2", 2)):
        powers, factor, either = {name: -1, pace.name: power}, pace.speed ** (power - 1), list[Relation]()
        for text, difference in pairs if name in pace.columns else ():
            sides = pace.columns[name], factor * difference
            said = f"{text} against {name}"
            either += compare(said, powers, *sides, pace.moving, TRACK_M, gentle=pace.gentle)
        yield from _best(either)


def _scaled_to(wheel: FloatArray, pace: _Pace) -> FloatArray:
    """Return a wheel's speed [N], scaled to the speed of the car; NaN where the wheel spins or locks."""
    speed = pace.speed
    use = pace.moving & np.isfinite(wheel) & np.isfinite(speed)
    ratio = float(np.median(wheel[use] / speed[use])) if use.any() else 0.0
    if ratio == 0.0:
        return np.full(wheel.shape[0], np.nan)
    return np.where(np.abs(wheel / ratio - speed) <= SPIN_SHARE * np.abs(speed), wheel / ratio, np.nan)


def _courses(columns: Mapping[str, FloatArray], pace: _Pace) -> Iterator[Relation]:
    """Relate the yaw rates to the course rates of the ground truth, and of a GNSS receiver's velocity and positions."""
    # Positions of a receiver are too noisy to show that something does not turn.
    paths: tuple[tuple[str, dict[str, int], float | None], ...] = (
        (COURSE_RATE, {COURSE_RATE: -1}, MOVES_RAD_S),
        (GNSS_COURSE_RATE, {}, MOVES_RAD_S),
        (GNSS_PATH[0], {"gnss_longitude_deg": -1}, None),
    )
    for path, signs, moves in (p for p in paths if p[0] in columns):
        turnings = [columns[path]]
        if "truth.vx_m_s" in columns and "truth.vy_m_s" in columns:  # in a spin, the sideslip changes as well
            turnings.append(columns[path] - direction_rate(columns["truth.vx_m_s"], columns["truth.vy_m_s"]))
        for name in (n for n in ("yaw_rate_rad_s", "truth.yaw_rate_rad_s") if n in columns):
            text = f"{name} against the turning of the {'course' if path == GNSS_COURSE_RATE else 'path'} over ground"
            yaw, powers, either = columns[name], {name: 1, **signs}, list[Relation]()
            limits: dict[str, Any] = {
                "moves": moves,
                "gentle": gentle_at(yaw * pace.speed, pace.moving),
                "bias": BIAS_RAD_S,
            }
            for turning in turnings:
                either += compare(text, powers, turning, yaw, pace.moving, GAIN_RANGE, **limits)
            yield from _best(either)


def position_factors(columns: Mapping[str, FloatArray]) -> tuple[float, float]:
    """Return the correction factors of the scales of the ground-truth x and y; NaN if the drive does not show them.

    v_x² = a² ẋ² + b² ẏ². v_y² is neglected, because its unit may be wrong; a car that drifts at 45 degrees gives 0.7. A
    drive along one axis shows only the scale of that axis.
    """
    vx = columns.get("truth.vx_m_s")
    squares = [columns[n] ** 2 for n in POSITION if n in columns]
    if vx is None or not squares or (result := fit(vx**2, squares, moving_at(vx))) is None:
        return math.nan, math.nan
    x, y = (math.sqrt(s) if s > SHOWN_STD * e else math.nan for s, e in zip(*result[:2], strict=True))
    return x, y


def is_misscaled(factor: float) -> bool:
    """Return whether the correction factor of a position is due to another unit (feet: 3.3)."""
    return factor < 0.6 or factor > 1.7


def _poses(columns: Mapping[str, FloatArray]) -> list[Relation]:
    """Relate the mapped ground-truth sideslip, or v_y, to the sideslip or v_y from positions and heading of one device.

    The frame of a pose may be mirrored: heading and course then have the opposite sign of the yaw rates. If this
    applies to some of the yaw rates only, the sign is unknown.
    """
    subject = next((n for n, of in (("truth.sideslip_rad",) * 2, ("truth.vy_m_s", CG_VY)) if of in columns), "")
    if not {subject, "truth.pose_vy_m_s"} <= columns.keys():
        return []
    ahead, left, turning = (columns[f"truth.{n}"] for n in ("pose_vx_m_s", "pose_vy_m_s", "heading_rate_rad_s"))
    moving = moving_at(ahead)
    speed = np.where(moving, np.hypot(ahead, left), np.nan)
    if median_known(ahead / speed) < AHEAD_SHARE:
        return []  # the heading is not the car's
    yaws = [columns[n] for n in ("yaw_rate_rad_s", "truth.yaw_rate_rad_s") if n in columns]
    signs = [np.sign(r.gain) for yaw in yaws for r in compare("", {}, turning, yaw, moving, GAIN_RANGE) if r.tells]
    is_vy = subject == "truth.vy_m_s"
    powers = {subject: 1} | ({"truth.position_speed_m_s": -1} if is_vy else {})
    expected = min(signs, default=1.0) * (left if is_vy else left / speed)
    sides = (f"{subject} against ground-truth positions and heading", powers, expected, columns[subject])
    # Velocity and position may refer to different points of the car; yaw adds a velocity between them.
    apart = _partial(*sides, [turning, np.ones_like(turning)], moving, SAME_RANGE)
    best = _best([*compare(*sides, moving, SAME_RANGE), *apart])
    return [replace(r, signless=len(signs) < 2 or len(set(signs)) > 1) for r in best]


def direction_rate(vx: FloatArray, vy: FloatArray) -> FloatArray:
    """Return the rate of a velocity's direction, rad/s [N]; NaN at low speed, where noise dominates."""
    ax, ay = derivative(vx), derivative(vy)
    speed = np.hypot(vx, vy)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(moving_at(speed) & (speed > 1.0), (vx * ay - vy * ax) / speed**2, np.nan)


def _sideslips(columns: Mapping[str, FloatArray], *, is_known: bool) -> list[Relation]:
    """Relate the ground-truth sideslip to a_y, by kinematics and by the rear axle.

    a_y - v_x r is the derivative of v_y, plus terms of the accelerometer's lever arm, of body roll and of a bias, which
    are in proportion to the yaw acceleration, to v_x r and to 1. In gentle driving, sideslip is the curvature times a
    lever arm minus a_y times the compliance of the rear tyres; this relation is used unless both are known
    (``is_known``) from a file.
    """
    turning = next((n for n in ("truth.yaw_rate_rad_s", "yaw_rate_rad_s") if n in columns), "")
    names = ("ay_m_s2", "truth.vx_m_s", "truth.vy_m_s", turning)
    if not all(n in columns for n in names):
        return []
    ay, vx, vy, rate = (columns[n] for n in names)
    subject = "truth.sideslip_rad" if "truth.sideslip_rad" in columns else "truth.vy_m_s"
    moving, ones = _moving(columns, vx), np.ones_like(ay)
    text = f"ay_m_s2 - v_x r against the derivative of {subject}"
    of_vx = subject != "truth.sideslip_rad"  # sideslip from v_y and v_x, otherwise v_y from sideslip and v_x
    powers = {subject: -1, "ay_m_s2": 1} | ({} if of_vx else {"truth.vx_m_s": -1})
    relations = _partial(text, powers, derivative(vy), ay, [derivative(rate), vx * rate, ones], moving, SIDESLIP_RANGE)
    if is_known:
        return relations
    curvature, ratio = rate / vx, vy / vx  # linear in a wrong v_y, unlike the angle
    sideslip = columns.get("truth.sideslip_rad", ratio)
    text = f"{subject} against -ay_m_s2, apart from curvature"
    gentle = gentle_at(vx * rate, moving)
    powers = {subject: 1, "ay_m_s2": -1} | ({"truth.vx_m_s": -1} if of_vx else {})
    return relations + _partial(text, powers, -ay, sideslip, [curvature, ones], gentle, COMPLIANCE_RAD_PER_M_S2)


def _axle_sideslips(
    columns: Mapping[str, FloatArray], vehicle: VehicleParameters | None, speed_name: str | None, agree: bool
) -> list[Relation]:
    """Relate the ground-truth sideslip to the rear axle model of the vehicle file, v_y = l r - C a_y v.

    The relation needs a_y and r that ``agree``; otherwise either term may be wrong.
    """
    subject = next((n for n in ("truth.sideslip_rad", "truth.vy_m_s") if n in columns), "")
    ay, rate, sideslip = (columns.get(n) for n in ("ay_m_s2", "yaw_rate_rad_s", subject))
    if vehicle is None or speed_name is None or not agree or ay is None or rate is None or sideslip is None:
        return []
    is_moved = subject == "truth.vy_m_s" and CG_VY not in columns
    lever = vehicle.cg_to_rear_axle_m + (0.0 if is_moved else vehicle.truth_position_m[0])
    stiffness = vehicle.cornering_stiffness_n_per_rad(False, vehicle.assumed_friction)
    compliance = vehicle.mass_kg * vehicle.cg_to_front_axle_m / (vehicle.wheelbase_m * stiffness)
    speed, text = columns[speed_name], f"{subject} against the rear axle of the vehicle file"
    slip, gentle = compliance * ay * speed, gentle_at(speed * rate, _moving(columns, speed))
    expected, used = lever * rate - slip, gentle & np.isfinite(slip) & np.isfinite(rate)
    # Where the two terms cancel, the file's compliance, known to a quarter, decides the sign.
    if not used.any() or expected[used].std() < 0.25 * slip[used].std():
        return []
    if subject == "truth.sideslip_rad":
        expected /= speed
    low, high = KNOWN_SIDESLIP
    # Files without a position of ground truth imply the CG, but it may be at any axle.
    high *= max(1.0, vehicle.wheelbase_m / (2.0 * max(lever, 1e-3)))
    return compare(text, {subject: 1, "ay_m_s2": -1}, expected, sideslip, gentle, (low, high))


def _partial(
    text: str,
    powers: dict[str, int],
    reference: FloatArray,
    measured: FloatArray,
    others: list[FloatArray],
    use: BoolArray,
    expected: tuple[float, float],
) -> list[Relation]:  # positional: the two sides of a relation and their expected gain
    """Return the relation between the residuals of two columns after regression on others; none with few samples."""
    finite = use & np.isfinite(np.stack([reference, measured, *others])).all(axis=0)
    if independent_samples(int(np.count_nonzero(finite))) < 2.0 * MIN_SAMPLES:
        return []
    aside = np.stack(others, axis=1)[finite]
    left = []
    for column in (reference, measured):
        out = np.full(column.shape[0], np.nan)
        out[finite] = column[finite] - aside @ np.linalg.lstsq(aside, column[finite], rcond=None)[0]
        left.append(out)
    relations = compare(text, powers, left[0], left[1], finite, expected)
    # Agreement of most blocks on the sign is not random.
    is_steady = [len(r.blocks) > BLOCKS // 2 and len(set(np.sign(r.blocks))) == 1 for r in relations]
    least = [MIN_CORRELATION if steady else MIN_PARTIAL_CORRELATION for steady in is_steady]
    return [replace(r, least_correlation=n) for r, n in zip(relations, least, strict=True)]
