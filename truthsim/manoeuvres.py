"""The manoeuvres: steering tables, or paths with speeds, stops and roads, for the driver.

A manoeuvre is planned for a speed, a friction, a seed, a duration and a scale. Its amplitude is one of three things:
``peak_share`` of μ g, for which ``truthsim.drive`` searches the scale; a multiple of the angle at which a slow ramp
reaches 0.3 g (FMVSS 126 and NHTSA's fishhook), which is measured first; or the course.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from pdhef_logtool.records.signals import FloatArray
from truthsim.road_course import (
    CROSSFALL_RAD,
    LANE_M,
    TOUR,
    clothoid_bend,
    draw_course,
    integrate_course,
    speed_profile,
)

GRAVITY_M_S2 = 9.80665
CONTROL_STEP_S = 0.001
PATH_STEP_M = 0.5
#: Columns of a road table.
ROAD_FRICTION_LEFT, ROAD_FRICTION_RIGHT, ROAD_BANK, ROAD_GRADE = range(4)

WHEELBASE_M = 2.87
#: Steering wheel to road wheels, for the rates that the standards give at the steering wheel.
STEERING_RATIO = 16.0
#: Brake torque that slows the default car by 1 m/s²: 1440 kg · 0.30 m.
TORQUE_PER_BRAKING = 432.0
#: Understeer assumed in the initial guess of the scale, rad per m/s².
_GUESSED_UNDERSTEER = 0.0035
#: Friction of a dry test track, to which the standards' angles refer.
_TRACK_FRICTION = 0.9


@dataclass(frozen=True, slots=True)
class Request:
    """Input of a plan.

    Attributes
    ----------
    scale : multiplies the amplitude.
    reference_rad : road-wheel angle at which a slow ramp reaches :func:`reference_a_y_m_s2`; 0 where not needed.
    """

    speed_m_s: float
    friction: float
    seed: int
    duration_s: float
    scale: float
    reference_rad: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Plan of a drive for the driver.

    Attributes
    ----------
    start_speed_m_s : speed of straight running at time 0.
    steer_rad : mean road-wheel angle every 1 ms, [duration / 1 ms + 1]; empty if a path is followed.
    path : x, y (m), yaw (rad), speed (m/s) every ``PATH_STEP_M``, [P, 4]; empty if ``steer_rad`` is used.
    stops : arc length (m) and dwell (s) of the stops, [K, 2].
    torque_n_m : drive and brake torque (N m, all wheels, at least 0) every 1 ms, [duration / 1 ms + 1, 2]; rows of NaN
        leave the pedals to the driver, who controls the speed. Empty: the driver throughout.
    road : friction under the left and the right wheels, bank (rad) and grade (rad) every ``PATH_STEP_M`` of the
        distance driven (along the path if one is followed), [R, 4]; beyond its end the last row applies. Empty: level,
        the same friction everywhere. Bank is positive if the road leans to the right (its left edge higher), as a
        car's roll; grade is positive uphill.
    goal_window_s : interval for the mean |a_y| to scale; None: the peak over the whole drive.
    """

    start_speed_m_s: float
    duration_s: float
    steer_rad: FloatArray = field(default_factory=lambda: np.empty(0))
    path: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    stops: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    torque_n_m: FloatArray = field(default_factory=lambda: np.empty((0, 2)))
    road: FloatArray = field(default_factory=lambda: np.empty((0, 4)))
    goal_window_s: tuple[float, float] | None = None


@dataclass(frozen=True, slots=True)
class Manoeuvre:
    """Definition of a manoeuvre.

    Attributes
    ----------
    default_duration_s : duration in s by speed in m/s.
    rtk_rate_hz : default rate of the ground truth; lower for long drives.
    peak_share : goal of |a_y| over μ g for the search of the scale; None for no search.
    least_share : minimum peak |a_y| over μ g for a meaningful manoeuvre.
    uses_reference : the amplitude is a multiple of the angle at 0.3 g.
    top_speed_km_h : highest speed at which the course can be driven.
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
    uses_reference: bool = False
    top_speed_km_h: float = 250.0

    @property
    def duration_s(self) -> float:
        """Duration at the default speed."""
        return self.default_duration_s(self.speed_km_h / 3.6)


def reference_a_y_m_s2(friction: float) -> float:
    """Return the lateral acceleration of the slow ramp for the reference angle (FMVSS 126): 0.3 g, less if slippery."""
    return 0.3 * GRAVITY_M_S2 * min(1.0, friction / _TRACK_FRICTION)


def steer_for(a_y_m_s2: float, speed_m_s: float) -> float:
    """Return the road-wheel angle (rad) for a lateral acceleration, for a linear car with a guessed understeer."""
    return a_y_m_s2 * (WHEELBASE_M / speed_m_s**2 + _GUESSED_UNDERSTEER)


def _times_s(duration_s: float) -> FloatArray:
    return np.arange(round(duration_s / CONTROL_STEP_S) + 1, dtype=np.float64) * CONTROL_STEP_S


def _coasting_from(start_s: float, duration_s: float) -> FloatArray:
    """Return the pedal torques of a driver who releases the throttle at a time."""
    late = _times_s(duration_s) >= start_s
    return np.where(late[:, None], 0.0, np.full((1, 2), np.nan))


def _smooth_step(u: FloatArray) -> FloatArray:
    """Quintic from 0 to 1 with no slope and no curvature at the ends."""
    u = np.clip(u, 0.0, 1.0)
    return np.asarray(u**3 * (10.0 - 15.0 * u + 6.0 * u**2), dtype=np.float64)


def _path_from_offset(offset_m: FloatArray, speed_m_s: float) -> FloatArray:
    """Path table [P, 4] of a lateral offset given every ``PATH_STEP_M`` along x."""
    x = np.arange(offset_m.shape[0]) * PATH_STEP_M
    yaw = np.arctan(np.gradient(offset_m, PATH_STEP_M))
    return np.stack([x, offset_m, yaw, np.full_like(x, speed_m_s)], axis=1)


# ---- lane changes ----

#: ISO 3888-1: entry lane, first change, side lane, second change, exit lane, run-out, in metres.
ISO_3888_1_M = (15.0, 30.0, 25.0, 25.0, 15.0, 15.0)
ISO_3888_1_OFFSET_M = LANE_M
_RUN_IN_S = 2.0
_RUN_OUT_S = 3.0


def _double_lane_change(request: Request) -> Plan:
    """Plan the ISO 3888-1 course, lateral offset times ``scale``, driven closed loop after two seconds straight."""
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


#: ISO 3888-2: entry lane, first change, side lane, second change, exit lane, in metres.
ISO_3888_2_M = (12.0, 13.5, 11.0, 12.5, 12.0)
CAR_WIDTH_M = 1.80
#: Lane widths of ISO 3888-2 by the car's width; 1 m lies between the entry lane and the side lane.
ISO_3888_2_WIDTHS_M = (1.1 * CAR_WIDTH_M + 0.25, CAR_WIDTH_M + 1.0, max(3.0, 1.3 * CAR_WIDTH_M + 0.25))
ISO_3888_2_GAP_M = 1.0
_LINE_RUN_M = 20.0


def iso_3888_2_corridor_m(along_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the lateral limits [N] for the middle of a car in the lanes, by the distance along the course.

    The entry lane's middle is 0; between the lanes the limits are infinite.
    """
    entry, side, leave = ISO_3888_2_WIDTHS_M
    edges = np.cumsum([0.0, *ISO_3888_2_M])
    low, high = np.full(along_m.shape, -np.inf), np.full(along_m.shape, np.inf)
    for start, end, right, width in (
        (edges[0], edges[1], -0.5 * entry, entry),
        (edges[2], edges[3], 0.5 * entry + ISO_3888_2_GAP_M, side),
        (edges[4], edges[5], -0.5 * entry, leave),
    ):
        inside = (along_m >= start) & (along_m <= end)
        low[inside] = right + 0.5 * CAR_WIDTH_M
        high[inside] = right + width - 0.5 * CAR_WIDTH_M
    return low, high


@cache
def iso_3888_2_line_m() -> tuple[float, ...]:
    """Return the lateral position every ``PATH_STEP_M`` of the line through the lanes with the least maximum curvature.

    A practised driver uses the full width of the lanes. Linear programme: minimize the largest second derivative, plus
    some of the largest third derivative, which corresponds to the steering rate.
    """
    from scipy.optimize import linprog

    margin_m, settle_m = 0.10, 10.0
    total = sum(ISO_3888_2_M)
    x = np.arange(-_LINE_RUN_M, total + _LINE_RUN_M + 0.5 * PATH_STEP_M, PATH_STEP_M)
    n = x.shape[0]
    low, high = iso_3888_2_corridor_m(x)
    second = (np.eye(n, k=1) - 2.0 * np.eye(n) + np.eye(n, k=-1))[1:-1] / PATH_STEP_M**2
    third = np.diff(second, axis=0) / PATH_STEP_M
    blocks = []
    for column, matrix in enumerate((second, third)):
        bound = np.zeros((2 * matrix.shape[0], 2))
        bound[:, column] = -1.0
        blocks.append(np.hstack([np.vstack([matrix, -matrix]), bound]))
    rows = np.vstack(blocks)
    middle = 0.5 * (ISO_3888_2_WIDTHS_M[2] - ISO_3888_2_WIDTHS_M[0])
    low, high = low + margin_m, high - margin_m
    before, after = x <= -settle_m, x >= total + settle_m
    low[before], high[before] = 0.0, 0.0
    low[after], high[after] = middle, middle
    solution = linprog(
        np.concatenate([np.zeros(n), [1.0, 3.0]]),
        A_ub=rows,
        b_ub=np.zeros(rows.shape[0]),
        bounds=[*zip(low.tolist(), high.tolist(), strict=True), (0.0, None), (0.0, None)],
    )
    return tuple(solution.x[:n].tolist())


def iso_3888_2_start_m(speed_m_s: float) -> float:
    """Distance at which the entry lane begins, on the path's grid."""
    return max(_LINE_RUN_M, round(_RUN_IN_S * speed_m_s / PATH_STEP_M) * PATH_STEP_M)


def _severe_lane_change(request: Request) -> Plan:
    """ISO 3888-2 course, driven closed loop; the throttle is released two metres into the entry lane."""
    line = np.array(iso_3888_2_line_m())
    start_m = iso_3888_2_start_m(request.speed_m_s)
    before = np.zeros(round((start_m - _LINE_RUN_M) / PATH_STEP_M))
    after = np.full(int(request.speed_m_s * request.duration_s / PATH_STEP_M), line[-1])
    offset = request.scale * np.concatenate([before, line, after])
    return Plan(
        request.speed_m_s,
        request.duration_s,
        path=_path_from_offset(offset, request.speed_m_s),
        torque_n_m=_coasting_from((start_m + 2.0) / request.speed_m_s, request.duration_s),
    )


# ---- open loop ----


def _swept_sine(request: Request, low_hz: float, high_hz: float, *, share: float, first: float) -> Plan:
    """Open-loop sine after one second straight; its frequency grows, and its amplitude from the share ``first`` on."""
    t = np.maximum(_times_s(request.duration_s) - 1.0, 0.0)
    span = max(request.duration_s - 1.0, CONTROL_STEP_S)
    top = steer_for(share * request.friction * GRAVITY_M_S2, request.speed_m_s)
    phase = 2.0 * np.pi * (low_hz * t + 0.5 * (high_hz - low_hz) / span * t**2)
    steer = request.scale * top * (first + (1.0 - first) * t / span) * np.sin(phase)
    return Plan(request.speed_m_s, request.duration_s, steer_rad=steer)


SINE_WITH_DWELL_HZ = 0.7
SINE_DWELL_S = 0.5
SINE_FACTOR = 4.0


def sine_with_dwell(t_s: FloatArray) -> FloatArray:
    """FMVSS 126's steering over its amplitude: 0.7 Hz, held for 500 ms at the second peak; 0 before and after."""
    hold_at_s = 0.75 / SINE_WITH_DWELL_HZ
    sine_s = np.where(t_s < hold_at_s, t_s, np.maximum(hold_at_s, t_s - SINE_DWELL_S))
    steer = np.sin(2.0 * np.pi * SINE_WITH_DWELL_HZ * sine_s)
    return np.where((t_s >= 0.0) & (sine_s <= 1.0 / SINE_WITH_DWELL_HZ), steer, 0.0)


def _sine_with_dwell(request: Request) -> Plan:
    t = _times_s(request.duration_s)
    top = request.scale * SINE_FACTOR * request.reference_rad
    return Plan(
        request.speed_m_s,
        request.duration_s,
        steer_rad=top * sine_with_dwell(t - 1.0),
        torque_n_m=_coasting_from(1.0, request.duration_s),
    )


FISHHOOK_FACTOR = 6.5
#: NHTSA's fishhook with fixed timing: rate at the road wheels, first and second dwell, return.
FISHHOOK_RATE_RAD_S = float(np.deg2rad(720.0)) / STEERING_RATIO
FISHHOOK_DWELLS_S = (0.25, 3.0)
FISHHOOK_RETURN_S = 2.0


def fishhook(t_s: FloatArray, amplitude_rad: float) -> FloatArray:
    """Road-wheel angle of NHTSA's fishhook: ramp, 250 ms, ramp to the other side, 3 s, back within 2 s."""
    ramp = abs(amplitude_rad) / FISHHOOK_RATE_RAD_S
    first, second = FISHHOOK_DWELLS_S
    knots = np.cumsum([0.0, ramp, first, 2.0 * ramp, second, FISHHOOK_RETURN_S])
    return np.interp(t_s, knots, amplitude_rad * np.array([0.0, 1.0, 1.0, -1.0, -1.0, 0.0]))


def _fishhook(request: Request) -> Plan:
    top = request.scale * FISHHOOK_FACTOR * request.reference_rad
    return Plan(
        request.speed_m_s,
        request.duration_s,
        steer_rad=fishhook(_times_s(request.duration_s) - 1.0, top),
        torque_n_m=_coasting_from(1.0, request.duration_s),
    )


STEP_RISE_S = 0.15


def _step_steer(request: Request) -> Plan:
    """ISO 7401 step input: one second straight, then to a constant angle within 0.15 s."""
    top = steer_for(0.48 * request.friction * GRAVITY_M_S2, request.speed_m_s)
    rise = np.clip((_times_s(request.duration_s) - 1.0) / STEP_RISE_S, 0.0, 1.0)
    return Plan(
        request.speed_m_s,
        request.duration_s,
        steer_rad=request.scale * top * rise,
        goal_window_s=(max(request.duration_s - 1.0, 0.5 * request.duration_s), request.duration_s),
    )


def _ramp_steer(request: Request) -> Plan:
    """Steering angle growing linearly after one second straight, slow enough to count as steady state."""
    t = _times_s(request.duration_s)
    top = steer_for(request.friction * GRAVITY_M_S2, request.speed_m_s)
    rise = np.clip((t - 1.0) / max(request.duration_s - 1.0, CONTROL_STEP_S), 0.0, 1.0)
    return Plan(request.speed_m_s, request.duration_s, steer_rad=request.scale * top * rise)


#: ISO 7975: when the brake is pressed, how long its pressure rises, and the deceleration on a dry road.
BRAKE_AT_S = 5.0
BRAKE_RISE_S = 0.2
BRAKING_M_S2 = 3.0


def _brake_in_turn(request: Request) -> Plan:
    """ISO 7975: a steady bend, the steering held, then the throttle released and the brake pressed at once."""
    return _slowed_in_turn(request, BRAKING_M_S2, rise_s=BRAKE_RISE_S)


def _slowed_in_turn(request: Request, slowing_m_s2: float, *, rise_s: float) -> Plan:
    """Return a steady bend with constant steering, and a brake torque from ``BRAKE_AT_S`` on, scaled to μ."""
    t = _times_s(request.duration_s)
    top = steer_for(0.5 * request.friction * GRAVITY_M_S2, request.speed_m_s)
    press = np.clip((t - BRAKE_AT_S) / rise_s, 0.0, 1.0)
    brake = slowing_m_s2 * min(1.0, request.friction / 0.85) * TORQUE_PER_BRAKING
    torque = np.stack([np.zeros_like(t), brake * press], axis=1)
    torque[t < BRAKE_AT_S] = np.nan
    return Plan(
        request.speed_m_s,
        request.duration_s,
        steer_rad=request.scale * top * _smooth_step(t - 1.0),
        torque_n_m=torque,
        goal_window_s=(BRAKE_AT_S - 1.0, BRAKE_AT_S),
    )


#: Engine drag after the throttle is released, on a dry road.
ENGINE_DRAG_M_S2 = 0.8


def _power_off_in_turn(request: Request) -> Plan:
    """ISO 9816: a steady bend, the steering held, then the throttle released."""
    return _slowed_in_turn(request, ENGINE_DRAG_M_S2, rise_s=0.5)


#: Straight before a circle, and the way in which its curvature grows, in s of driving.
_CIRCLE_STRAIGHT_S, _CIRCLE_EASE_S = 1.5, 1.5


def _steady_circle(request: Request) -> Plan:
    """ISO 4138: a circle of constant radius at constant speed, driven closed loop."""
    a_y = request.scale * 0.5 * request.friction * GRAVITY_M_S2
    x = np.arange(int((request.speed_m_s * request.duration_s + 50.0) / PATH_STEP_M)) * PATH_STEP_M
    curvature = (
        a_y / request.speed_m_s**2 * np.clip((x / request.speed_m_s - _CIRCLE_STRAIGHT_S) / _CIRCLE_EASE_S, 0, 1)
    )
    course = integrate_course(curvature, PATH_STEP_M)
    path = np.concatenate([course, np.full((x.size, 1), request.speed_m_s)], axis=1)
    return Plan(
        request.speed_m_s,
        request.duration_s,
        path=path,
        goal_window_s=(0.5 * request.duration_s, request.duration_s),
    )


#: Distance of the cones of a slalom, and their number.
CONE_SPACING_M, CONES = 18.0, 10


def _slalom(request: Request) -> Plan:
    """Cones 18 m apart, passed left and right in turn on a sine, the sideways offset times ``scale``; closed loop."""
    start = _RUN_IN_S * request.speed_m_s
    x = np.arange(int((request.speed_m_s * request.duration_s + 50.0) / PATH_STEP_M)) * PATH_STEP_M
    along = np.clip((x - start) / CONE_SPACING_M, 0.0, CONES)
    eased = np.minimum(_smooth_step(along), _smooth_step(CONES - along))
    offset = request.scale * 0.5 * eased * np.sin(np.pi * along)
    return Plan(request.speed_m_s, request.duration_s, path=_path_from_offset(offset, request.speed_m_s))


def _slalom_duration_s(speed_m_s: float) -> float:
    return round(_RUN_IN_S + CONES * CONE_SPACING_M / speed_m_s + _RUN_OUT_S, 2)


#: Friction of the slippery part of a friction jump, over the rest's.
JUMP_SHARE = 0.5


def _friction_jump(request: Request) -> Plan:
    """Plan a slalom of 0.5 Hz over a road with half the friction in its second third."""
    t = np.maximum(_times_s(request.duration_s) - 1.0, 0.0)
    top = steer_for(0.6 * request.friction * GRAVITY_M_S2, request.speed_m_s)
    third_m = request.speed_m_s * request.duration_s / 3.0
    distance_m = np.arange(int(3.0 * third_m / PATH_STEP_M) + 1) * PATH_STEP_M
    friction = request.friction * np.where((distance_m >= third_m) & (distance_m < 2.0 * third_m), JUMP_SHARE, 1.0)
    flat = np.zeros_like(distance_m)
    return Plan(
        request.speed_m_s,
        request.duration_s,
        steer_rad=request.scale * top * np.minimum(t, 1.0) * np.sin(2.0 * np.pi * 0.5 * t),
        road=np.stack([friction, friction, flat, flat], axis=1),
    )


# ---- roads ----


def _plan_of_course(
    request: Request,
    curvature_1_m: FloatArray,
    speed_m_s: FloatArray,
    *,
    bank_rad: FloatArray,
    grade_rad: FloatArray,
    stops: FloatArray,
) -> Plan:
    friction = np.full(curvature_1_m.shape[0], request.friction)
    return Plan(
        float(speed_m_s[0]),
        request.duration_s,
        path=np.concatenate([integrate_course(curvature_1_m, PATH_STEP_M), speed_m_s[:, None]], axis=1),
        stops=stops,
        road=np.stack([friction, friction, bank_rad, grade_rad], axis=1),
    )


#: Lean of the bends of a banked road, positive outward (adverse camber), and the grade under them; in turn.
BANKED_BENDS = ((-0.10, 0.06), (0.0, 0.0), (0.06, -0.06))


def _banked_road(request: Request) -> Plan:
    """Bends to both sides, banked inward, level and outward, up and down; driven closed loop at one speed."""
    rng = np.random.default_rng(np.random.SeedSequence(entropy=request.seed, spawn_key=(101,)))
    speed = request.speed_m_s
    straight = np.zeros(int(1.5 * speed / PATH_STEP_M))
    curvature, bank, grade = [straight], [np.full_like(straight, CROSSFALL_RAD)], [np.zeros_like(straight)]
    first_side = 1.0 if rng.uniform() < 0.5 else -1.0
    length, bends = PATH_STEP_M * straight.shape[0], 0
    while length < speed * request.duration_s + 100.0:
        outward, slope = BANKED_BENDS[bends % len(BANKED_BENDS)]
        side = first_side * (1.0 if bends % 2 == 0 else -1.0)
        a_y = request.scale * rng.uniform(0.35, 0.5) * request.friction * GRAVITY_M_S2
        bend = clothoid_bend(side * a_y / speed**2, 4.0 * a_y / speed, 1.2 * speed, PATH_STEP_M)
        # Leaning outward of a left-hand bend is leaning to the right, which is positive.
        lean = side * outward * np.abs(bend) / np.abs(bend).max()
        curvature += [bend, straight]
        bank += [lean, np.full_like(straight, CROSSFALL_RAD)]
        grade += [np.full_like(bend, slope), np.zeros_like(straight)]
        length += PATH_STEP_M * (bend.shape[0] + straight.shape[0])
        bends += 1
    return _plan_of_course(
        request,
        np.concatenate(curvature),
        np.full(sum(c.shape[0] for c in curvature), speed),
        bank_rad=_eased(np.concatenate(bank)),
        grade_rad=_eased(np.concatenate(grade)),
        stops=np.empty((0, 2)),
    )


def _eased(values: FloatArray) -> FloatArray:
    """Moving average over 30 m, so that no bank or grade begins at once."""
    width = int(30.0 / PATH_STEP_M)
    padded = np.concatenate([np.full(width // 2, values[0]), values, np.full(width - width // 2 - 1, values[-1])])
    return np.convolve(padded, np.full(width, 1.0 / width), mode="valid")


def _stop_and_go(request: Request) -> Plan:
    """Standstill, drive, standstill, again and again, on a road with gentle bends; the first stop lasts 3 s."""
    rng = np.random.default_rng(np.random.SeedSequence(entropy=request.seed, spawn_key=(102,)))
    grip = min(1.0, request.friction / 0.6)
    curvature, limit, stops = [np.zeros(10)], [np.full(10, request.speed_m_s)], [(0.0, 3.0)]
    left_s, distance_m = request.duration_s, 10 * PATH_STEP_M
    while left_s > 0.0:
        top = request.speed_m_s * rng.uniform(0.4, 1.0)
        a_y, side = grip * rng.uniform(0.5, 2.0), 1.0 if rng.uniform() < 0.5 else -1.0
        bend = clothoid_bend(side * a_y / top**2, rng.uniform(0.1, 0.5), top, PATH_STEP_M)
        straight = np.zeros(int(rng.uniform(0.3, 1.0) * top / PATH_STEP_M) + 4)
        piece = np.concatenate([straight, bend, straight])
        curvature.append(piece)
        limit.append(np.full(piece.shape[0], top))
        distance_m += piece.shape[0] * PATH_STEP_M
        stops.append((distance_m, float(rng.uniform(2.0, 6.0))))
        left_s -= piece.shape[0] * PATH_STEP_M / top + top / (1.8 * grip) + stops[-1][1]
    curvature.append(np.zeros(40))
    limit.append(np.full(40, request.speed_m_s))
    speeds, halts = np.concatenate(limit), np.array(stops, dtype=np.float64)
    speeds[np.round(halts[:, 0] / PATH_STEP_M).astype(np.int64)] = 0.0
    flat = np.zeros(speeds.shape[0])
    return _plan_of_course(
        request,
        np.concatenate(curvature),
        speed_profile(speeds, grip, PATH_STEP_M),
        bank_rad=flat,
        grade_rad=flat,
        stops=halts,
    )


#: A drive shorter than this may begin anywhere; a longer one begins in town and has its first stop within a minute.
_LONG_ROAD_S = 60.0


def _road(request: Request) -> Plan:
    """Ordinary driving by the seed: town, country, motorway, country, and again, with stops where towns have them."""
    rng = np.random.default_rng(np.random.SeedSequence(entropy=request.seed, spawn_key=(100,)))
    long = request.duration_s >= _LONG_ROAD_S
    course = draw_course(
        rng,
        length_m=request.speed_m_s * request.duration_s + 200.0,
        step_m=PATH_STEP_M,
        top_speed_m_s=request.speed_m_s,
        friction=request.friction,
        first=0 if long else int(rng.integers(len(TOUR))),
    )
    grip = min(1.0, request.friction / 0.6)
    limit, stops = course.limit_m_s.copy(), course.stops
    if long:
        free = speed_profile(limit, grip, PATH_STEP_M)
        time = np.concatenate([[0.0], np.cumsum(PATH_STEP_M / np.maximum(0.5 * (free[1:] + free[:-1]), 0.5))])
        row = int(np.searchsorted(time, min(0.3 * request.duration_s, 55.0)))
        early = np.array([[row * PATH_STEP_M, rng.uniform(6.5, 9.5)]])
        stops = np.concatenate([early, stops[stops[:, 0] > early[0, 0] + 40.0]])
    limit[np.round(stops[:, 0] / PATH_STEP_M).astype(np.int64)] = 0.0
    return _plan_of_course(
        request,
        course.curvature_1_m,
        speed_profile(limit, grip, PATH_STEP_M),
        bank_rad=course.bank_rad,
        grade_rad=course.grade_rad,
        stops=stops,
    )


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
        name="dlc-3888-2",
        description="severe lane change on the ISO 3888-2 course at up to 70 km/h, throttle released at its entry",
        speed_km_h=60.0,
        friction=0.85,
        peak_share=None,
        least_share=0.45,
        default_duration_s=lambda speed_m_s: round(_RUN_IN_S + sum(ISO_3888_2_M) / speed_m_s + _RUN_OUT_S, 2),
        plan=_severe_lane_change,
        top_speed_km_h=70.0,
    ),
    Manoeuvre(
        name="sine-sweep",
        description="open-loop steering sine, 0.6 to 1 Hz, growing until |a_y| reaches 0.92 mu g",
        speed_km_h=60.0,
        friction=0.3,
        peak_share=0.92,
        least_share=0.90,
        default_duration_s=lambda _: 12.0,
        plan=lambda request: _swept_sine(request, 0.6, 1.0, share=1.0, first=0.1),
    ),
    Manoeuvre(
        name="sine-sweep-wide",
        description="open-loop steering sine of one amplitude, 0.5 to 2 Hz, |a_y| to 0.4 mu g",
        speed_km_h=80.0,
        friction=0.85,
        peak_share=0.40,
        least_share=0.38,
        default_duration_s=lambda _: 20.0,
        plan=lambda request: _swept_sine(request, 0.5, 2.0, share=0.4, first=1.0),
    ),
    Manoeuvre(
        name="sine-with-dwell",
        description="FMVSS 126: a sine of 0.7 Hz, 500 ms at its second peak, 4 times the angle at 0.3 g, coasting",
        speed_km_h=80.0,
        friction=0.85,
        peak_share=None,
        least_share=0.5,
        default_duration_s=lambda _: 6.0,
        plan=_sine_with_dwell,
        uses_reference=True,
    ),
    Manoeuvre(
        name="fishhook",
        description="NHTSA fishhook, 6.5 times the angle at 0.3 g to one side and then to the other, coasting",
        speed_km_h=80.0,
        friction=0.85,
        peak_share=None,
        least_share=0.6,
        default_duration_s=lambda _: 8.0,
        plan=_fishhook,
        uses_reference=True,
    ),
    Manoeuvre(
        name="step-steer",
        description="ISO 7401 step of the steering to a steady |a_y| of 0.48 mu g (4 m/s^2 at mu 0.85)",
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
        name="brake-in-turn",
        description="ISO 7975: steady bend at 0.5 mu g, steering held, braking with 3 m/s^2 (scaled to mu) after 5 s",
        speed_km_h=80.0,
        friction=0.85,
        peak_share=0.50,
        least_share=0.45,
        default_duration_s=lambda _: 10.0,
        plan=_brake_in_turn,
    ),
    Manoeuvre(
        name="power-off-in-turn",
        description="ISO 9816: steady bend at 0.5 mu g, steering held, throttle released after 5 s",
        speed_km_h=80.0,
        friction=0.85,
        peak_share=0.50,
        least_share=0.45,
        default_duration_s=lambda _: 10.0,
        plan=_power_off_in_turn,
    ),
    Manoeuvre(
        name="steady-circle",
        description="ISO 4138: circle of constant radius at constant speed, |a_y| at 0.5 mu g",
        speed_km_h=80.0,
        friction=0.85,
        peak_share=0.50,
        least_share=0.45,
        default_duration_s=lambda _: 40.0,
        plan=_steady_circle,
    ),
    Manoeuvre(
        name="slalom",
        description="ten cones 18 m apart, offset scaled so that |a_y| peaks at 0.6 mu g",
        speed_km_h=55.0,
        friction=0.85,
        peak_share=0.60,
        least_share=0.55,
        default_duration_s=_slalom_duration_s,
        plan=_slalom,
        top_speed_km_h=80.0,
    ),
    Manoeuvre(
        name="mu-jump",
        description="slalom of 0.5 Hz over a road that has half the friction in its second third",
        speed_km_h=80.0,
        friction=0.85,
        peak_share=0.60,
        least_share=0.55,
        default_duration_s=lambda _: 12.0,
        plan=_friction_jump,
    ),
    Manoeuvre(
        name="banked-road",
        description="bends banked inward, level and outward, uphill and down, at one speed",
        speed_km_h=80.0,
        friction=0.85,
        peak_share=None,
        least_share=0.25,
        default_duration_s=lambda _: 40.0,
        plan=_banked_road,
    ),
    Manoeuvre(
        name="stop-and-go",
        description="standstill, drive, standstill by the seed; speed is the highest driven",
        speed_km_h=50.0,
        friction=0.85,
        peak_share=None,
        least_share=0.0,
        default_duration_s=lambda _: 60.0,
        plan=_stop_and_go,
    ),
    Manoeuvre(
        name="road",
        description="ordinary driving in town, country and motorway by the seed, with stops; speed is the highest",
        speed_km_h=110.0,
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
