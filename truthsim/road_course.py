"""Courses of ordinary roads: town, country and motorway with curvature, speed limit, bank, grade and stops.

Radii, superelevation, crossfall and grades follow common road design guides (town junctions of 8 to 16 m, country
bends of 60 to 600 m, motorway curves of 700 m and more; crossfall 2 %, superelevation to 7 %, grades to 7 %).
"""

from dataclasses import dataclass

import numpy as np

from pdhef_logtool.records.signals import FloatArray

LANE_M = 3.5
#: Drainage: without superelevation, a road leans to its right edge.
CROSSFALL_RAD = 0.02
SUPERELEVATION_MAX_RAD = 0.07
#: Acceleration and braking of relaxed driving, m/s².
EASY_ACCELERATION_M_S2 = 1.7
EASY_BRAKING_M_S2 = 1.9


@dataclass(frozen=True, slots=True)
class Surroundings:
    """One kind of road: ranges as (low, high)."""

    name: str
    length_m: tuple[float, float]
    limit_km_h: tuple[float, float]
    straight_m: tuple[float, float]
    radius_m: tuple[float, float]
    turn_rad: tuple[float, float]
    #: Lateral acceleration that the driver allows in a bend, m/s², on a dry road.
    comfort_m_s2: tuple[float, float]
    lane_change_share: float
    junction_share: float
    stop_share: float
    grade_rad: float
    superelevated: bool


TOWN = Surroundings(
    "town",
    (350.0, 800.0),
    (35.0, 55.0),
    (30.0, 130.0),
    (25.0, 90.0),
    (0.3, 1.2),
    (1.2, 3.0),
    0.15,
    0.45,
    0.45,
    0.03,
    False,
)
RURAL = Surroundings(
    "rural",
    (1000.0, 2200.0),
    (70.0, 100.0),
    (30.0, 220.0),
    (60.0, 500.0),
    (0.25, 1.2),
    (1.5, 3.6),
    0.12,
    0.0,
    0.04,
    0.06,
    True,
)
MOTORWAY = Surroundings(
    "motorway",
    (1500.0, 3500.0),
    (100.0, 130.0),
    (100.0, 500.0),
    (700.0, 3500.0),
    (0.1, 0.5),
    (0.8, 1.6),
    0.45,
    0.0,
    0.0,
    0.035,
    True,
)
#: Sequence of the surroundings, which is repeated.
TOUR = (TOWN, RURAL, MOTORWAY, RURAL)


@dataclass(frozen=True, slots=True, eq=False)
class Course:
    """A road by distance, one row every step.

    Attributes
    ----------
    curvature_1_m, limit_m_s, bank_rad, grade_rad : [P]; bank positive leaning to the right, grade positive uphill.
    kind : [P], index into ``TOUR``.
    stops : distance (m) and dwell (s) of the stops, [K, 2].
    """

    curvature_1_m: FloatArray
    limit_m_s: FloatArray
    bank_rad: FloatArray
    grade_rad: FloatArray
    kind: FloatArray
    stops: FloatArray


def draw_course(
    rng: np.random.Generator, *, length_m: float, step_m: float, top_speed_m_s: float, friction: float, first: int
) -> Course:
    """Draw a course at least ``length_m`` long that begins in surroundings ``TOUR[first]``."""
    grip = min(1.0, friction / 0.6)
    lead = int(30.0 / step_m)
    curvature: list[FloatArray] = [np.zeros(lead)]
    limit = [np.full(lead, min(top_speed_m_s, TOUR[first].limit_km_h[0] / 3.6))]
    kind = [np.full(lead, float(first))]
    stops: list[tuple[float, float]] = []
    distance_m, place = lead * step_m, first
    until_m = rng.uniform(*TOUR[place].length_m)
    while distance_m < length_m:
        if distance_m > until_m:
            place = (place + 1) % len(TOUR)
            until_m = distance_m + rng.uniform(*TOUR[place].length_m)
        here = TOUR[place]
        allowed = min(top_speed_m_s, rng.uniform(*here.limit_km_h) / 3.6)
        straight = np.zeros(int(rng.uniform(*here.straight_m) / step_m))
        feature, pace = _draw_feature(rng, here, allowed, grip, step_m)
        if rng.uniform() < here.stop_share:
            stops.append((distance_m + straight.shape[0] * step_m, float(rng.uniform(3.0, 12.0))))
        curvature += [straight, feature]
        limit += [np.full(straight.shape[0], allowed), np.full(feature.shape[0], pace)]
        kind.append(np.full(straight.shape[0] + feature.shape[0], float(place)))
        distance_m += (straight.shape[0] + feature.shape[0]) * step_m
    bends, limits, kinds = np.concatenate(curvature), np.concatenate(limit), np.concatenate(kind)
    return Course(
        bends,
        limits,
        _bank(bends, limits, kinds, step_m),
        _grade(rng, kinds, step_m),
        kinds,
        np.array(stops, dtype=np.float64).reshape(-1, 2),
    )


def _draw_feature(
    rng: np.random.Generator, here: Surroundings, allowed_m_s: float, grip: float, step_m: float
) -> tuple[FloatArray, float]:
    """Curvature of a lane change, a junction or a bend, and the speed in it."""
    kind = rng.uniform()
    side = 1.0 if rng.uniform() < 0.5 else -1.0
    a_y = grip * rng.uniform(*here.comfort_m_s2)
    if kind < here.lane_change_share:
        return lane_change(side, allowed_m_s, rng.uniform(3.0, 5.0) / np.sqrt(grip), step_m), allowed_m_s
    if kind < here.lane_change_share + here.junction_share:
        radius, turn = rng.uniform(8.0, 16.0), rng.uniform(1.2, 1.7)
    else:
        # Bends are uniformly distributed over the logarithm of the radius.
        radius = float(np.exp(rng.uniform(*np.log(here.radius_m))))
        turn = rng.uniform(*here.turn_rad)
    pace = min(allowed_m_s, float(np.sqrt(a_y * radius)))
    return clothoid_bend(side / radius, turn, max(6.0, 1.3 * pace), step_m), pace


def clothoid_bend(curvature_1_m: float, turn_rad: float, transition_m: float, step_m: float) -> FloatArray:
    """Curvature of a bend with a clothoid at each end, every ``step_m``."""
    transition_m = min(transition_m, turn_rad / abs(curvature_1_m))
    arc_m = max(turn_rad / abs(curvature_1_m) - transition_m, 0.0)
    s = np.arange(0.0, 2.0 * transition_m + arc_m, step_m)
    up = np.clip(s / transition_m, 0.0, 1.0)
    down = np.clip((2.0 * transition_m + arc_m - s) / transition_m, 0.0, 1.0)
    return np.asarray(curvature_1_m * np.minimum(up, down), dtype=np.float64)


def lane_change(side: float, speed_m_s: float, seconds: float, step_m: float) -> FloatArray:
    """Curvature of a change to the next lane (second derivative of a quintic), every ``step_m``."""
    length = speed_m_s * seconds
    u = np.arange(0.0, length, step_m) / length
    return np.asarray(side * LANE_M / length**2 * (60.0 * u - 180.0 * u**2 + 120.0 * u**3), dtype=np.float64)


def _smoothed(values: FloatArray, length_m: float, step_m: float) -> FloatArray:
    """Return the moving average over a length, with constant extrapolation at the ends."""
    half = max(1, int(0.5 * length_m / step_m))
    padded = np.concatenate([np.full(half, values[0]), values, np.full(half, values[-1])])
    total = np.cumsum(np.concatenate([[0.0], padded]))
    width = 2 * half
    return np.asarray((total[width:] - total[:-width])[: values.shape[0]] / width)


def _bank(curvature: FloatArray, limit_m_s: FloatArray, kind: FloatArray, step_m: float) -> FloatArray:
    """Return crossfall on straights and, outside towns, superelevation, in full for bends of 1.5 m/s² or more."""
    inward = -np.sign(curvature) * SUPERELEVATION_MAX_RAD * np.clip(np.abs(curvature) * limit_m_s**2 / 1.5, 0.0, 1.0)
    superelevated = np.array([s.superelevated for s in TOUR])[kind.astype(np.int64)]
    # Exclude lane changes: the curvature of a bend of the road lasts longer than its transitions.
    bends = superelevated & (np.abs(_smoothed(curvature, 60.0, step_m)) > 0.5 * np.abs(curvature)) & (curvature != 0.0)
    return _smoothed(np.where(bends, inward, CROSSFALL_RAD), 40.0, step_m)


def _grade(rng: np.random.Generator, kind: FloatArray, step_m: float) -> FloatArray:
    """Return slopes that change every 150 to 400 m, with rounded crests and dips."""
    steepest = np.array([s.grade_rad for s in TOUR])[kind.astype(np.int64)]
    end_m = kind.shape[0] * step_m
    nodes = [0.0]
    while nodes[-1] < end_m:
        nodes.append(nodes[-1] + rng.uniform(150.0, 400.0))
    slopes = np.concatenate([[0.0], rng.uniform(-1.0, 1.0, len(nodes) - 1)])
    return _smoothed(np.interp(np.arange(kind.shape[0]) * step_m, nodes, slopes) * steepest, 60.0, step_m)


def speed_profile(limit_m_s: FloatArray, grip: float, step_m: float) -> FloatArray:
    """Fastest speed [P] under a limit with easy acceleration and braking, times ``grip``."""
    gain = 2.0 * EASY_ACCELERATION_M_S2 * grip * step_m
    loss = 2.0 * EASY_BRAKING_M_S2 * grip * step_m
    squared = (limit_m_s**2).tolist()
    for i in range(1, len(squared)):
        squared[i] = min(squared[i], squared[i - 1] + gain)
    for i in range(len(squared) - 2, -1, -1):
        squared[i] = min(squared[i], squared[i + 1] + loss)
    return np.sqrt(np.array(squared, dtype=np.float64))


def integrate_course(curvature_1_m: FloatArray, step_m: float) -> FloatArray:
    """Return x, y (m) and yaw (rad) of a course [P, 3] from the origin, heading east."""
    yaw = np.concatenate([[0.0], np.cumsum(0.5 * (curvature_1_m[1:] + curvature_1_m[:-1]) * step_m)])
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    x = np.concatenate([[0.0], np.cumsum(np.cos(middle) * step_m)])
    y = np.concatenate([[0.0], np.cumsum(np.sin(middle) * step_m)])
    return np.stack([x, y, yaw], axis=1)
