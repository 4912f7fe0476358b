"""The manoeuvres: what the driver is asked to do, as steering tables or as paths with speeds and stops.

A manoeuvre is planned for a speed, a friction, a seed, a duration and a scale. Where it names a share of μ g for its
peak lateral acceleration, ``truthsim.drive`` searches the scale that reaches it; scale 1 is a plain guess.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from pdhef_logtool.signals import FloatArray

GRAVITY_M_S2 = 9.80665
CONTROL_STEP_S = 0.001
PATH_STEP_M = 0.5
#: Columns of a road table.
ROAD_FRICTION_LEFT, ROAD_FRICTION_RIGHT, ROAD_BANK, ROAD_GRADE = range(4)

WHEELBASE_M = 2.87
#: Understeer that the guesses of scale 1 assume, rad per m/s².
_GUESSED_UNDERSTEER = 0.0035


@dataclass(frozen=True, slots=True)
class Request:
    """What a plan is made for. ``scale`` multiplies the amplitude."""

    speed_m_s: float
    friction: float
    seed: int
    duration_s: float
    scale: float


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What the driver will do.

    Attributes
    ----------
    start_speed_m_s : running straight at this speed at time 0.
    steer_rad : mean road-wheel angle every 1 ms, [duration / 1 ms + 1]; empty when a path is followed.
    path : x, y (m), yaw (rad), speed (m/s) every ``PATH_STEP_M``, [P, 4]; empty when the steering is given.
    stops : arc length (m) and dwell (s) of the places to stand still at, [K, 2].
    torque_n_m : drive and brake torque (N m, all wheels, at least 0) every 1 ms, [duration / 1 ms + 1, 2]; rows of NaN
        leave the pedals to the driver, who holds the speed. Empty: the driver's throughout.
    road : friction under the left and the right wheels, bank (rad) and grade (rad) every ``PATH_STEP_M`` of the
        distance driven (along the path where one is followed), [R, 4]; beyond its end the last row holds. Empty: level,
        the same friction everywhere. Bank is positive where the road leans to the right (its left edge higher), as a
        car's roll; grade is positive uphill.
    """

    start_speed_m_s: float
    duration_s: float
    steer_rad: FloatArray = field(default_factory=lambda: np.empty(0))
    path: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    stops: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    torque_n_m: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    road: FloatArray = field(default_factory=lambda: np.empty((0, 4)))


@dataclass(frozen=True, slots=True)
class Manoeuvre:
    """One entry of the catalogue.

    Attributes
    ----------
    default_duration_s : duration in s by speed in m/s.
    rtk_rate_hz : default rate of the truth; long drives take less.
    peak_share : peak |a_y| over μ g that the scale is searched for; None where nothing is scaled.
    least_share : peak |a_y| over μ g below which the manoeuvre has failed its purpose.
    """

    name: str
    description: str
    speed_km_h: float
    friction: float
    peak_share: float | None
    least_share: float
    default_duration_s: Callable[[float], float]
    plan: Callable[[Request], Plan]
    rtk_rate_hz: int = 100

    @property
    def duration_s(self) -> float:
        """Duration at the default speed."""
        return self.default_duration_s(self.speed_km_h / 3.6)


def _steer_for(a_y_m_s2: float, speed_m_s: float) -> float:
    """Road-wheel angle (rad) that a linear car with a guessed understeer needs for a lateral acceleration."""
    return a_y_m_s2 * (WHEELBASE_M / speed_m_s**2 + _GUESSED_UNDERSTEER)


def _times_s(duration_s: float) -> FloatArray:
    return np.arange(round(duration_s / CONTROL_STEP_S) + 1, dtype=np.float64) * CONTROL_STEP_S


def _smooth_step(u: FloatArray) -> FloatArray:
    """Quintic from 0 to 1 with no slope and no curvature at the ends."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2), dtype=np.float64)


def _path_from_offset(offset_m: FloatArray, speed_m_s: float) -> FloatArray:
    """Path table [P, 4] of a lateral offset given every ``PATH_STEP_M`` along x."""
    x = np.arange(offset_m.shape[0]) * PATH_STEP_M
    yaw = np.arctan(np.gradient(offset_m, PATH_STEP_M))
    return np.stack([x, offset_m, yaw, np.full_like(x, speed_m_s)], axis=1)


#: ISO 3888-1: entry lane, first change, side lane, second change, exit lane, run-out, in metres.
ISO_3888_1_M = (15.0, 30.0, 25.0, 25.0, 15.0, 15.0)
ISO_3888_1_OFFSET_M = 3.5
_RUN_IN_S = 2.0
_RUN_OUT_S = 3.0


def _double_lane_change(request: Request) -> Plan:
    """ISO 3888-1 course, the sideways offset times ``scale``, driven closed loop after two seconds straight."""
    entry, first, side, second, _, _ = ISO_3888_1_M
    start = _RUN_IN_S * request.speed_m_s + entry
    length = request.speed_m_s * request.duration_s + 50.0
    x = np.arange(int(length / PATH_STEP_M) + 1, dtype=np.float64) * PATH_STEP_M
    there = _smooth_step((x - start) / first)
    back = _smooth_step((x - start - first - side) / second)
    offset = request.scale * ISO_3888_1_OFFSET_M * (there - back)
    return Plan(request.speed_m_s, request.duration_s, path=_path_from_offset(offset, request.speed_m_s))


def _dlc_duration_s(speed_m_s: float) -> float:
    return round(_RUN_IN_S + sum(ISO_3888_1_M) / speed_m_s + _RUN_OUT_S, 2)


def _sine_sweep(request: Request) -> Plan:
    """Open-loop sine after one second straight, its frequency growing from 0.6 to 1 Hz and its amplitude with it."""
    quiet_s = 1.0
    t = np.maximum(_times_s(request.duration_s) - quiet_s, 0.0)
    span = max(request.duration_s - quiet_s, CONTROL_STEP_S)
    phase = 2.0 * np.pi * (0.6 * t + 0.5 * (1.0 - 0.6) / span * t**2)
    top = _steer_for(request.friction * GRAVITY_M_S2, request.speed_m_s)
    steer = request.scale * top * (0.1 + 0.9 * t / span) * np.sin(phase)
    return Plan(request.speed_m_s, request.duration_s, steer_rad=steer)


def _step_steer(request: Request) -> Plan:
    """ISO 7401 step input: one second straight, then to a constant angle within 0.15 s."""
    t = _times_s(request.duration_s)
    top = _steer_for(0.48 * request.friction * GRAVITY_M_S2, request.speed_m_s)
    return Plan(
        request.speed_m_s, request.duration_s, steer_rad=request.scale * top * np.clip((t - 1.0) / 0.15, 0.0, 1.0)
    )


def _ramp_steer(request: Request) -> Plan:
    """Steering angle growing linearly after one second straight, slow enough to count as steady state."""
    t = _times_s(request.duration_s)
    top = _steer_for(request.friction * GRAVITY_M_S2, request.speed_m_s)
    rise = np.clip((t - 1.0) / max(request.duration_s - 1.0, CONTROL_STEP_S), 0.0, 1.0)
    return Plan(request.speed_m_s, request.duration_s, steer_rad=request.scale * top * rise)


def _road(request: Request) -> Plan:
    """Ordinary driving: town corners, country bends and lane changes by the seed, with stops of six to nine seconds."""
    rng = np.random.default_rng(np.random.SeedSequence(entropy=request.seed, spawn_key=(100,)))
    curvature, limit = _road_course(rng, request)
    yaw = np.concatenate([[0.0], np.cumsum(0.5 * (curvature[1:] + curvature[:-1]) * PATH_STEP_M)])
    middle = 0.5 * (yaw[1:] + yaw[:-1])
    x = np.concatenate([[0.0], np.cumsum(np.cos(middle) * PATH_STEP_M)])
    y = np.concatenate([[0.0], np.cumsum(np.sin(middle) * PATH_STEP_M)])

    grip = min(1.0, request.friction / 0.6)
    free = _speed_profile(limit, grip)
    time = np.concatenate([[0.0], np.cumsum(PATH_STEP_M / np.maximum(0.5 * (free[1:] + free[:-1]), 0.5))])
    stop_times = [min(0.3 * request.duration_s, 55.0)]
    while stop_times[-1] < request.duration_s:
        stop_times.append(stop_times[-1] + rng.uniform(80.0, 140.0))
    rows = np.searchsorted(time, np.array(stop_times[:-1]))
    rows = rows[rows < limit.shape[0] - 1]
    limit = limit.copy()
    limit[rows] = 0.0
    stops = np.stack([rows * PATH_STEP_M, rng.uniform(6.5, 9.5, rows.shape[0])], axis=1)
    speed = _speed_profile(limit, grip)
    return Plan(
        float(speed[0]), request.duration_s, path=np.stack([x, y, yaw, speed], axis=1), stops=stops.astype(np.float64)
    )


def _road_course(rng: np.random.Generator, request: Request) -> tuple[FloatArray, FloatArray]:
    """Curvature (1/m) and speed limit (m/s) every ``PATH_STEP_M`` of a course long enough for the duration."""
    curvature: list[FloatArray] = [np.zeros(60)]
    limit: list[FloatArray] = [np.full(60, min(request.speed_m_s, 50.0 / 3.6))]
    length = 0.0
    town = True
    until_m = rng.uniform(350.0, 700.0)
    comfort = min(1.0, request.friction / 0.6)
    while length < request.speed_m_s * request.duration_s + 200.0:
        if length > until_m:
            town = not town
            until_m = length + (rng.uniform(400.0, 900.0) if town else rng.uniform(1200.0, 2500.0))
        allowed = min(request.speed_m_s, rng.uniform(40.0, 55.0) / 3.6 if town else rng.uniform(70.0, 110.0) / 3.6)
        straight_m = rng.uniform(30.0, 150.0) if town else rng.uniform(40.0, 250.0)
        kind = rng.uniform()
        side = 1.0 if rng.uniform() < 0.5 else -1.0
        a_y = comfort * rng.uniform(1.2, 3.2)
        if kind < 0.2:
            bend = _lane_change(side, allowed, rng.uniform(3.0, 4.5))
            pace = allowed
        else:
            if town:
                radius, turn = rng.uniform(10.0, 40.0), rng.uniform(0.6, 1.6)
            else:
                radius, turn = rng.uniform(70.0, 450.0), rng.uniform(0.25, 1.2)
            pace = min(allowed, float(np.sqrt(a_y * radius)))
            bend = _clothoid_bend(side / radius, turn, max(6.0, 1.1 * pace))
        piece = np.concatenate([np.zeros(int(straight_m / PATH_STEP_M)), bend])
        speeds = np.full(piece.shape[0], allowed)
        speeds[-bend.shape[0] :] = pace
        curvature.append(piece)
        limit.append(speeds)
        length += piece.shape[0] * PATH_STEP_M
    return np.concatenate(curvature), np.concatenate(limit)


def _clothoid_bend(curvature_1_m: float, turn_rad: float, transition_m: float) -> FloatArray:
    """Curvature of a bend with a transition at each end, every ``PATH_STEP_M``."""
    transition_m = min(transition_m, turn_rad / abs(curvature_1_m))
    arc_m = max(turn_rad / abs(curvature_1_m) - transition_m, 0.0)
    s = np.arange(0.0, 2.0 * transition_m + arc_m, PATH_STEP_M)
    up = np.clip(s / transition_m, 0.0, 1.0)
    down = np.clip((2.0 * transition_m + arc_m - s) / transition_m, 0.0, 1.0)
    return np.asarray(curvature_1_m * np.minimum(up, down), dtype=np.float64)


def _lane_change(side: float, speed_m_s: float, seconds: float) -> FloatArray:
    """Curvature of a lane change of 3.5 m, every ``PATH_STEP_M``."""
    length = speed_m_s * seconds
    u = np.arange(0.0, length, PATH_STEP_M) / length
    second_derivative = 60.0 * u - 180.0 * u**2 + 120.0 * u**3
    return np.asarray(side * 3.5 / length**2 * second_derivative, dtype=np.float64)


def _speed_profile(limit_m_s: FloatArray, grip: float) -> FloatArray:
    """Fastest speed under a limit with 1.7 m/s² of acceleration and 1.9 m/s² of braking, times ``grip``."""
    speed = limit_m_s.copy()
    for i in range(1, speed.shape[0]):
        speed[i] = min(speed[i], np.sqrt(speed[i - 1] ** 2 + 2.0 * 1.7 * grip * PATH_STEP_M))
    for i in range(speed.shape[0] - 2, -1, -1):
        speed[i] = min(speed[i], np.sqrt(speed[i + 1] ** 2 + 2.0 * 1.9 * grip * PATH_STEP_M))
    return speed


_CATALOGUE = (
    Manoeuvre(
        name="dlc",
        description="double lane change on the ISO 3888-1 course, offset scaled so that |a_y| peaks at 0.82 mu g",
        speed_km_h=100.0,
        friction=0.85,
        peak_share=0.70 / 0.85,
        least_share=0.65 / 0.85,
        default_duration_s=_dlc_duration_s,
        plan=_double_lane_change,
    ),
    Manoeuvre(
        name="sine-sweep",
        description="open-loop steering sine, 0.6 to 1 Hz, growing until |a_y| reaches 0.92 mu g",
        speed_km_h=60.0,
        friction=0.3,
        peak_share=0.92,
        least_share=0.90,
        default_duration_s=lambda _: 12.0,
        plan=_sine_sweep,
    ),
    Manoeuvre(
        name="step-steer",
        description="ISO 7401 step of the steering, scaled so that |a_y| peaks at 0.48 mu g (4 m/s^2 at mu 0.85)",
        speed_km_h=100.0,
        friction=0.85,
        peak_share=4.0 / (0.85 * GRAVITY_M_S2),
        least_share=0.45,
        default_duration_s=lambda _: 6.0,
        plan=_step_steer,
    ),
    Manoeuvre(
        name="ramp-steer",
        description="steering angle growing slowly up to |a_y| = 0.84 mu g, quasi steady state",
        speed_km_h=80.0,
        friction=0.85,
        peak_share=0.84,
        least_share=0.80,
        default_duration_s=lambda _: 40.0,
        plan=_ramp_steer,
    ),
    Manoeuvre(
        name="road",
        description="ordinary driving in town and country by the seed, with stops; speed is the highest driven",
        speed_km_h=90.0,
        friction=0.85,
        peak_share=None,
        least_share=0.0,
        default_duration_s=lambda _: 300.0,
        plan=_road,
        rtk_rate_hz=50,
    ),
)

#: Every manoeuvre that can be simulated, by name.
MANOEUVRES: dict[str, Manoeuvre] = {m.name: m for m in _CATALOGUE}
