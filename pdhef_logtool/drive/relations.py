"""Relations between signals by rigid-body kinematics and rolling wheels: their sides, and ``relations.toml``."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.columns import derivative, fit, independent_samples, median_known, moving_at
from pdhef_logtool.drive.hypotheses import BLOCKS, MIN_SAMPLES, TABLE, Law, Relation, block_gains, kind_of
from pdhef_logtool.mapping.naming import CACHED_NAMES
from pdhef_logtool.records.signals import LEAST_DIVISOR, WHEELS, BoolArray, FloatArray

LENGTHS: dict[str, Any] = TABLE["lengths"]
MOST: dict[str, float] = TABLE["most"]
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
#: Quantities that sensors and ground truth measure, by their relation.
TWICE = (
    ("rate", "yaw_rate_rad_s", "truth.yaw_rate_rad_s"),
    ("rate", "yaw_rate_rad_s", TURNING),
    ("acceleration", "ay_m_s2", "truth.ay_m_s2"),
)
#: Columns of the velocity along the axes of the ground-truth positions.
POSITION = "truth.position_vx_m_s", "truth.position_vy_m_s"
#: A signal that moves by more, 1-sigma, shows that the car is driven.
DRIVEN = {"yaw_rate_rad_s": 0.06, "ay_m_s2": 1.0, "ax_m_s2": 1.0}
#: Largest residual of a difference that has a cause.
EXPLAINED_SHARE: float = TABLE["explained_share"]
#: Share of the offset between two sides that changes in a drive.
DISTURBED = 0.6
_STEERING = ("steer_rad", "steering_wheel_rad")
#: Above this, sideslip times lateral acceleration is not small compared to the derivative of the speed.
STRAIGHT_M_S2 = 3.0
#: Least share of v_x in the speed if the heading is right; quantile used as the largest value.
AHEAD_SHARE, HIGH = 0.9, 0.9
#: Least ratio of the square of a position's scale to its standard error: along an axis on which the car hardly moves,
#: noise reached 4.6 in 500 drives.
SHOWN_STD = 8.0
#: No car reverses faster for long: the sign of a faster speed is known, but not its unit.
REVERSE_M_S = 10.0
#: In a bend, wheels differ by less; a wheel that differs by more spins or locks.
SPIN_SHARE = 0.2
#: Speeds of full-size vehicles. A wrong speed must not lengthen the wheelbase by the vehicle file: the lowest of speed,
#: ground truth and a_y / r counts, up to ``FAST_M_S``.
FULL_SIZE_M_S, FAST_M_S = (12.0, 70.0), 40.0
#: Share of the drive's lateral acceleration up to which the steering angle is compared with the curvature; above, the
#: front tyres slip.
STEERING_SHARE = 0.6
#: Least share of the low-passed values below the limit: shocks and spins are short; a wheel spins in the air.
SHARE, WHEEL_SHARE = 0.95, 0.5


@lru_cache(maxsize=CACHED_NAMES)
def law(key: str, **signals: str) -> Law:
    """Return an entry of the table for these signals; one without a name is left out."""
    entry: dict[str, Any] = {n: tuple(v) if isinstance(v, list) else v for n, v in TABLE[key].items()}
    powers = {name.format(**signals): power for name, power in entry.pop("powers").items()}
    powers.pop("", None)
    late = tuple(name.format(**signals) for name in entry.pop("late", ()))
    return Law(entry.pop("text").format(**signals), powers, late=late, **entry)


@dataclass(frozen=True, slots=True, eq=False)
class _Pace:
    """The speed [N] of a drive by its column, and where the car moves, and moves gently."""

    columns: Mapping[str, FloatArray]
    name: str
    speed: FloatArray
    moving: BoolArray
    gentle: BoolArray

    @classmethod
    def of(cls, columns: Mapping[str, FloatArray], name: str) -> "_Pace":
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
    # The correction factor of a position in another unit is far from 1 (feet: 3.3).
    of_path = {} if any(factor < 0.6 or factor > 1.7 for factor in position_factors(columns)) else columns
    for of in ("", "truth."):
        pace_name = f"{of}vx_m_s" if f"{of}vx_m_s" in columns else speed_name
        if pace_name is not None:
            relations += motion(columns, of, pace_name)
    if speed_name is not None:
        pace = _Pace.of(columns, speed_name)
        relations += [*_steering(pace, vehicle), *_speeds(pace), *_wheel_differences(pace), *_courses(of_path, pace)]
    relations += _poses(of_path)
    for key, name, other in TWICE:
        if {name, other} <= columns.keys():
            relations += compare(law(key, other=other, name=name), columns[name], columns[other])
    bends = {"ay_m_s2", "yaw_rate_rad_s"}
    agree = any(r.tells and r.accepts() for r in relations if r.powers.keys() >= bends)
    return relations + _axle_sideslips(columns, vehicle, speed_name, agree) + _sideslips(columns)


# ------------------------------------------------------------------------------------------- relations


def compare(law: Law, predicted: FloatArray, measured: FloatArray, use: BoolArray | None = None) -> list[Relation]:
    """Return the relation between two columns where ``use`` and both are finite; an empty list without driving.

    The means of the sides count as far as they exceed the ``bias`` of the law: on a circle the mean is the signal.
    Sides that move by less count as fewer samples: the crossfall of a straight road moves them, too.
    """
    sides, finite = (predicted, measured), np.isfinite(predicted) & np.isfinite(measured)
    use = finite if use is None else use & finite
    samples = independent_samples(use)
    if samples < MIN_SAMPLES:
        return []
    a, b = predicted[use] - predicted[use].mean(), measured[use] - measured[use].mean()
    spread_a, spread_b = float(a.std()), float(b.std())
    if max(spread_a, spread_b) <= LEAST_DIVISOR:
        return []
    both = (max(spread_a, spread_b) if law.either else spread_a) > law.moves
    if min(spread_a, spread_b) <= LEAST_DIVISOR:
        return [Relation(law, 0.0, float("nan"), samples, both)]
    if math.isfinite(law.bias):  # below the disturbances, both sides follow the road
        samples *= min(1.0, max(spread_a, spread_b) / (DISTURBED * law.bias)) ** 2
    correlation = float(np.mean(a * b) / (spread_a * spread_b))
    left = max(0.0, 1.0 - correlation**2) * spread_b**2
    # Weight of the means in a regression with a normal prior of the offset.
    weight = left / (left + samples * law.bias**2)
    of_means = [math.sqrt(weight) * float(side[use].mean()) for side in sides]
    rms_a, rms_b = math.hypot(spread_a, of_means[0]), math.hypot(spread_b, of_means[1])
    correlation = (correlation * spread_a * spread_b + of_means[0] * of_means[1]) / (rms_a * rms_b)
    # The ratio of the sizes lies between the two regressions, because either side may be noisy.
    gain = float(np.copysign(rms_b / rms_a, correlation))
    # The gain of a block with fewer samples is random; on a circle it is undefined.
    by_means = abs(of_means[0]) > spread_a
    blocks = () if by_means else block_gains(a, b, min(BLOCKS, max(1, int(samples / MIN_SAMPLES))))
    return [Relation(law, correlation, gain, samples, both, blocks, sides)]


def _limits(columns: Mapping[str, FloatArray]) -> Iterator[Relation]:
    """Yield a relation for each signal with values that no vehicle reaches; it needs no second signal."""
    for name in (n for n in columns if kind_of(n) in MOST):
        most, finite = MOST[kind_of(name)], np.isfinite(columns[name])
        share = WHEEL_SHARE if name.startswith("wheel") else SHARE
        if finite.any() and (large := float(np.quantile(np.abs(columns[name][finite]), share))) > most:
            reached = law("limit", name=name, share=f"{1.0 - share:.0%}", large=f"{large:.3g}", most=f"{most:.3g}")
            yield Relation(reached, 1.0, large / most, independent_samples(finite))


def motion(columns: Mapping[str, FloatArray], of: str, pace_name: str) -> Iterator[Relation]:
    """Relate the accelerations to speed and yaw rate, of the sensors or of ground truth."""
    pace = columns[pace_name]
    moving = _moving(columns, pace)
    yaw, left, forward = (columns.get(f"{of}{n}") for n in ("yaw_rate_rad_s", "ay_m_s2", "ax_m_s2"))
    turns = None if yaw is None else yaw * pace
    if turns is not None and left is not None:
        yield from compare(law("lateral", of=of, pace=pace_name), turns, left, moving)
    if forward is not None:
        along = law("longitudinal", of=of, pace=pace_name)
        straight = moving if turns is None else moving & (np.abs(turns) < STRAIGHT_M_S2)
        if turns is not None and not moving_at(pace).any():  # unknown unit
            straight = gentle_at(turns, moving)
        # Noise changes the derivative of a GNSS speed.
        along = replace(along, moves=math.inf) if pace_name == "truth.vx_m_s" else along
        yield from compare(along, derivative(pace), forward, straight)


def _best(either: list[Relation]) -> list[Relation]:
    return sorted(either, key=lambda r: (r.tells and r.accepts(), abs(r.correlation)))[-1:]


def gentle_at(lateral_m_s2: FloatArray, moving: BoolArray) -> BoolArray:
    """Return where the car moves with a lateral acceleration that is small for this drive."""
    size = np.abs(lateral_m_s2)
    finite = moving & np.isfinite(size)
    if not finite.any():
        return moving
    return np.asarray(moving & (size <= STEERING_SHARE * np.quantile(size[finite], 0.95)))


def _moving(columns: Mapping[str, FloatArray], speed: FloatArray) -> BoolArray:
    """Return where the car moves; by the relative speed alone if it is too low and IMU or other speeds show motion."""
    moving = moving_at(speed)
    if moving.any():
        return moving
    finite = [(columns[n][np.isfinite(columns[n])], least) for n, least in DRIVEN.items() if n in columns]
    others = (c for n, c in columns.items() if n.startswith("wheel_speed_") or n in ("speed_m_s", "truth.vx_m_s"))
    is_driven = any(c.size and c.std() > least for c, least in finite) or any(moving_at(c).any() for c in others)
    return moving_at(speed, 0.0) if is_driven else moving


def _lengths(pace: _Pace, vehicle: VehicleParameters | None) -> dict[str, tuple[float, float]]:
    """Return the plausible effective wheelbases by road-wheel and by steering-wheel angle, m."""
    columns = pace.columns
    speeds = [np.abs(c[np.isfinite(c)]) for c in (pace.speed, columns.get("truth.vx_m_s")) if c is not None]
    if vehicle is None:
        is_full_size = all(c.size and FULL_SIZE_M_S[0] < np.quantile(c, HIGH) < FULL_SIZE_M_S[1] for c in speeds)
        lengths = LENGTHS["full_size"] if is_full_size else LENGTHS
        return {name: tuple(lengths[name]) for name in _STEERING}
    paces = [median_known(c) for c in speeds]
    if "ay_m_s2" in columns:
        ay, rate = (columns[n] for n in ("ay_m_s2", "yaw_rate_rad_s"))
        finite = np.isfinite(ay) & np.isfinite(rate)
        paces.append(float(ay[finite].std() / max(rate[finite].std(), LEAST_DIVISOR)) if finite.any() else FAST_M_S)
    gradient = max(0.0, vehicle.understeer_gradient_rad_per_m_s2(vehicle.assumed_friction))
    low, high = (f * (vehicle.wheelbase_m + gradient * min(*paces, FAST_M_S) ** 2) for f in LENGTHS["file"])
    return {
        name: (low * ratio, high * ratio) for name, ratio in zip(_STEERING, (1.0, vehicle.steering_ratio), strict=True)
    }


def effective_wheelbase_m(columns: Mapping[str, FloatArray], speed_name: str | None) -> float:
    """Return the ratio of the sizes of road-wheel angle and curvature in gentle driving; NaN if it is unknown.

    Neither signs nor delays of the sensors change it. Speeds that only full-size vehicles reach have none.
    """
    if speed_name is None or not {"steer_rad", "yaw_rate_rad_s"} <= columns.keys():
        return math.nan
    pace = _Pace.of(columns, speed_name)
    use = pace.gentle & np.isfinite(columns["steer_rad"])
    steer, rate, speed = (values[use] for values in (columns["steer_rad"], columns["yaw_rate_rad_s"], pace.speed))
    if not steer.size:
        return math.nan
    angle, curvature, turning, fast = np.quantile(np.abs([steer, rate / speed, rate, speed]), HIGH, axis=1).tolist()
    is_known = turning > DRIVEN["yaw_rate_rad_s"] and fast < FULL_SIZE_M_S[0]
    return float(f"{angle / curvature:.3g}") if is_known else math.nan


def _steering(pace: _Pace, vehicle: VehicleParameters | None) -> Iterator[Relation]:
    columns, speed, gentle = pace.columns, pace.speed, pace.gentle
    yaw = columns.get("yaw_rate_rad_s")
    if yaw is None:
        return
    driven = yaw[gentle & np.isfinite(yaw)]
    # To both sides, so that a steering angle that does not change is dead.
    is_turning = driven.size > 0 and bool(driven.std() > max(DRIVEN["yaw_rate_rad_s"], abs(driven.mean())))
    curvature = np.where(pace.moving, yaw / speed, np.nan)
    for name, lengths in _lengths(pace, vehicle).items():
        steer, typical = columns.get(name), float(np.sqrt(lengths[0] * lengths[1]))
        if steer is None:
            continue
        by_rate, by_ay = (law(key, steer=name, pace=pace.name) for key in ("steering", "steering_lateral"))
        by_rate = replace(by_rate, gains=lengths, typical=typical)
        either = [r for use in (pace.moving, gentle) for r in compare(by_rate, curvature, steer, use)]
        # Sliding front tyres break the relation at large angles, and noise breaks it at small ones.
        best = _best([replace(r, moves=r.correlation == 0.0 and is_turning) for r in either])  # dead sensor
        if abs(best[0].correlation if best else 0.0) < LENGTHS["rolling"]:
            lengths = lengths[0] * LENGTHS["sliding"][0], lengths[1] * LENGTHS["sliding"][1]
        yield from (replace(r, law=replace(by_rate, gains=lengths)) for r in best)
        if "ay_m_s2" in columns:
            by_ay = replace(by_ay, gains=(1.0 / lengths[1], 1.0 / lengths[0]), typical=1.0 / typical)
            yield from compare(by_ay, steer * speed**2, columns["ay_m_s2"], gentle)


def _speeds(pace: _Pace) -> Iterator[Relation]:
    """Relate wheel speeds and ground-truth speeds to the speed: their ratio needs no manoeuvre."""
    keys = {f"wheel_speed_{w}_{unit}": f"wheel_{unit}" for unit in ("m_s", "rad_s") for w in WHEELS}
    keys |= {"truth.vx_m_s": "speed", "truth.position_speed_m_s": "path_speed", GNSS_PATH[1]: "path_speed"}
    speed = pace.speed
    for name in (n for n in keys if n in pace.columns and n != pace.name):
        column = pace.columns[name]
        if name.startswith("wheel"):
            column = np.where(np.isfinite(_scaled_to(column, pace)), column, np.nan)
        # Near the limit, wheel speeds differ from the speed of the car.
        uses = [where & np.isfinite(column) for where in (pace.gentle, pace.moving)]
        use = next((u for u in uses if independent_samples(u) >= MIN_SAMPLES), None)
        if use is None:
            continue
        ratios = column[use] / speed[use]
        over = law(keys[name], name=name, pace=pace.name, mapped="" if name == GNSS_PATH[1] else name)
        blocks = tuple(float(np.median(b)) for b in np.array_split(ratios, BLOCKS) if b.size)
        yield Relation(over, 1.0, float(np.median(ratios)), independent_samples(use), blocks=blocks)
    is_fast = np.abs(speed) > REVERSE_M_S
    if (samples := independent_samples(is_fast)) >= 2.0 * MIN_SAMPLES:
        yield Relation(law("ahead", pace=pace.name), 1.0, float(np.sign(np.median(speed[is_fast]))), samples)


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
    """Relate the yaw rate to the speed differences of the axles, which have no mounting error."""
    if (yaw := pace.columns.get("yaw_rate_rad_s")) is None:
        return
    laws = [(law("axle", axle=text, pace=pace.name), difference) for text, difference in _axle_differences(pace)]
    related = [r for its, difference in laws for r in compare(its, yaw, difference, pace.moving)]
    # The rear axle shows a delay: the front wheels also move with the steering.
    yield from (replace(r, sides=related[0].sides) for r in _best(related))


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
    for path, key in ((COURSE_RATE, "course"), (GNSS_COURSE_RATE, "course"), (GNSS_PATH[0], "gnss_path")):
        turnings = [columns[path]] if path in columns else []
        # In a spin, the sideslip changes as well.
        if turnings and "truth.vx_m_s" in columns and "truth.vy_m_s" in columns:
            turnings.append(columns[path] - direction_rate(columns["truth.vx_m_s"], columns["truth.vy_m_s"]))
        line, mapped = ("course", "") if path == GNSS_COURSE_RATE else ("path", COURSE_RATE)
        for name in (n for n in ("yaw_rate_rad_s", "truth.yaw_rate_rad_s") if n in columns):
            its = law(key, name=name, line=line, mapped=mapped)
            yield from _best([r for t in turnings for r in compare(its, t, columns[name], pace.moving)])


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


def _poses(columns: Mapping[str, FloatArray]) -> list[Relation]:
    """Relate the mapped ground-truth sideslip, or v_y, to the sideslip or v_y from positions and heading of one device.

    The frame of a pose may be mirrored: heading and course then have the opposite sign of the yaw rates. If this
    applies to some of the yaw rates only, the sign is unknown.
    """
    subject = next((n for n, of in (("truth.sideslip_rad",) * 2, ("truth.vy_m_s", CG_VY)) if of in columns), "")
    of_pose = [f"truth.{n}" for n in ("pose_vx_m_s", "pose_vy_m_s", "heading_rate_rad_s")]
    if not {subject, *of_pose} <= columns.keys():  # a damaged one may have no values
        return []
    ahead, left, turning = (columns[n] for n in of_pose)
    moving = moving_at(ahead)
    speed = np.where(moving, np.hypot(ahead, left), np.nan)
    if median_known(ahead / speed) < AHEAD_SHARE:
        return []  # the heading is not the car's
    yaws = [columns[n] for n in ("yaw_rate_rad_s", "truth.yaw_rate_rad_s") if n in columns]
    anything = Law("", {}, (0.0, math.inf))
    signs = [np.sign(r.gain) for yaw in yaws for r in compare(anything, turning, yaw, moving) if r.tells]
    is_vy = subject == "truth.vy_m_s"
    its = law("pose", subject=subject, scaled="truth.position_speed_m_s" if is_vy else "")
    its = replace(its, signless=len(signs) < 2 or len(set(signs)) > 1)
    its = replace(its, bias=its.bias * median_known(speed)) if is_vy else its
    sides = (min(signs, default=1.0) * (left if is_vy else left / speed), columns[subject])
    # Velocity and position may refer to different points of the car; yaw adds a velocity between them.
    apart = _partial(its, *sides, [turning, np.ones_like(turning)], moving)
    difference = (sides[1] - sides[0]) * (1.0 if is_vy else speed)
    lever = fit(difference, [turning], moving)
    by_lever = (
        lever is not None and abs(lever[0][0]) < LENGTHS["lever"] and lever[2] < EXPLAINED_SHARE * np.nanstd(difference)
    )
    return _best([*(r for r in compare(its, *sides, moving) if r.accepts() or not by_lever), *apart])


def direction_rate(vx: FloatArray, vy: FloatArray) -> FloatArray:
    """Return the rate of a velocity's direction, rad/s [N]; NaN at low speed, where noise dominates."""
    ax, ay = derivative(vx), derivative(vy)
    speed = np.hypot(vx, vy)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(moving_at(speed) & (speed > 1.0), (vx * ay - vy * ax) / speed**2, np.nan)


def _sideslips(columns: Mapping[str, FloatArray]) -> list[Relation]:
    """Relate the ground-truth sideslip to a_y by kinematics.

    a_y - v_x r is the derivative of v_y, plus terms of the accelerometer's lever arm, of body roll and of a bias, which
    are in proportion to the yaw acceleration, to v_x r and to 1.
    """
    turning = next((n for n in ("truth.yaw_rate_rad_s", "yaw_rate_rad_s") if n in columns), "")
    names = ("ay_m_s2", "truth.vx_m_s", "truth.vy_m_s", turning)
    if not all(n in columns for n in names):
        return []
    ay, vx, vy, rate = (columns[n] for n in names)
    subject = "truth.sideslip_rad" if "truth.sideslip_rad" in columns else "truth.vy_m_s"
    moving, ones = _moving(columns, vx), np.ones_like(ay)
    of_vx = subject != "truth.sideslip_rad"  # sideslip from v_y and v_x, otherwise v_y from sideslip and v_x
    by_rate = law("sideslip_rate", subject=subject, scaled="" if of_vx else "truth.vx_m_s")
    return _partial(by_rate, derivative(vy), ay, [derivative(rate), vx * rate, ones], moving)


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
    speed, its = columns[speed_name], law("rear_axle", subject=subject)
    slip, gentle = compliance * ay * speed, gentle_at(speed * rate, _moving(columns, speed))
    expected, used = lever * rate - slip, gentle & np.isfinite(slip) & np.isfinite(rate)
    # Where the two terms cancel, the file's compliance, known to a quarter, decides the sign.
    if not used.any() or expected[used].std() < 0.25 * slip[used].std():
        return []
    if subject == "truth.sideslip_rad":
        expected /= speed
    # Files without a position of ground truth imply the CG, but it may be at any axle.
    high = its.gains[1] * max(1.0, vehicle.wheelbase_m / (2.0 * max(lever, 1e-3)))
    return compare(replace(its, gains=(its.gains[0], high)), expected, sideslip, gentle)


def _partial(
    law: Law, predicted: FloatArray, measured: FloatArray, others: list[FloatArray], use: BoolArray
) -> list[Relation]:
    """Return the relation between the residuals of two columns after regression on others; none with few samples."""
    finite = use & np.isfinite(np.stack([predicted, measured, *others])).all(axis=0)
    if independent_samples(finite) < 2.0 * MIN_SAMPLES:
        return []
    aside, left = np.stack(others, axis=1)[finite], np.full((2, len(finite)), np.nan)
    for rest, column in zip(left, (predicted, measured), strict=True):
        rest[finite] = column[finite] - aside @ np.linalg.lstsq(aside, column[finite], rcond=None)[0]
    strict = replace(law, least_correlation=MIN_PARTIAL_CORRELATION)
    # Agreement of most blocks on the sign is not random.
    return [
        r if len(r.blocks) > BLOCKS // 2 and len(set(np.sign(r.blocks))) == 1 else replace(r, law=strict)
        for r in compare(law, left[0], left[1], finite)
    ]
