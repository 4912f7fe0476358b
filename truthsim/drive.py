"""Simulate a drive: plan, scale, drive, measure; and write it as a recorder's log."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from pdhef_logtool.logs.drive_log import windows
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.records.errors import SimulationError, UsageError
from pdhef_logtool.records.signals import WHEELS, FloatArray
from pdhef_logtool.records.version import __version__
from truthsim.faults import Fault, apply_faults, rtk_outages
from truthsim.manoeuvres import (
    CONTROL_STEP_S,
    GRAVITY_M_S2,
    MANOEUVRES,
    STEERING_RATIO,
    Manoeuvre,
    Plan,
    Request,
    reference_a_y_m_s2,
    steer_for,
)
from truthsim.motion import Motion, simulate_motion
from truthsim.recording import PARTS, topics_of
from truthsim.sensors import IMU_PERIOD_S, STEER_PHASE_S, WHEEL_PHASE_S, SensorChannel, SensorNoise, sense
from truthsim.vehicle import OBSERVED, Vehicle

#: 2026-01-01T00:00:00Z, the start of every simulated drive.
START_NS = 1_767_225_600_000_000_000

#: Name of the default vehicle.
DEFAULT_VEHICLE = "sedan"

SPIN_RAD = math.radians(20.0)
#: Sideslip at walking speed does not indicate a spin.
_SPIN_MIN_SPEED_M_S = 3.0
_STEER_LIMIT_RAD = 0.6


#: Minimum time without load for a wheel to count as lifted; a shorter time is a bounce.
_LIFT_S = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A simulated drive.

    Attributes
    ----------
    manoeuvre, speed_km_h, friction, seed, duration_s, amplitude : requested values.
    scale : the resulting amplitude, in the unit of the manoeuvre.
    start_ns : time 0 of the log.
    times_s : [N], 100 Hz.
    truth : ground truth [N] by the names of ``truthsim.vehicle.OBSERVED``, ``sideslip_rad`` and ``friction`` (mean of
        the wheels).
    channels : ``imu``, ``steering``, ``wheels``, ``rtk``, ``fix``, with the faults in them.
    vehicle, vehicle_name, noise, faults : settings of the simulation.
    rtk_rate_hz : rate of ``rtk`` and of the exact ground truth in a written log.
    peak_ay_m_s2, peak_sideslip_rad : largest absolute values; sideslip where the car moves faster than 3 m/s.
    spun : the peak sideslip exceeded 20 degrees.
    lifted : a wheel left the road for 50 ms or longer.
    notes : remarks for the user, one sentence each.
    """

    manoeuvre: str
    speed_km_h: float
    friction: float
    seed: int
    duration_s: float
    amplitude: float
    scale: float
    start_ns: int
    times_s: FloatArray
    truth: dict[str, FloatArray]
    channels: dict[str, SensorChannel]
    vehicle: Vehicle
    vehicle_name: str
    noise: SensorNoise
    faults: tuple[Fault, ...]
    rtk_rate_hz: int
    peak_ay_m_s2: float
    peak_sideslip_rad: float
    spun: bool
    lifted: bool
    notes: tuple[str, ...] = field(default=())

    @property
    def command(self) -> str:
        """The command line that repeats this drive."""
        chosen = MANOEUVRES[self.manoeuvre]
        words = [
            f"pdhef simulate {self.manoeuvre} --speed {_exact(self.speed_km_h)} --mu {_exact(self.friction)}",
            f"--seed {self.seed}",
        ]
        if self.duration_s != chosen.default_duration_s(self.speed_km_h / 3.6):
            words.append(f"--duration {_exact(self.duration_s)}")
        if self.amplitude != 1.0:
            words.append(f"--amplitude {_exact(self.amplitude)}")
        if self.vehicle_name != DEFAULT_VEHICLE:
            words.append(f"--vehicle {self.vehicle_name}")
        if self.rtk_rate_hz != chosen.rtk_rate_hz:
            words.append(f"--rtk-rate {self.rtk_rate_hz}")
        words += [f"--fault {fault}" for fault in self.faults]
        words += [
            f"--sensor {name}={_exact(value)}"
            for name, value in self.noise._asdict().items()
            if value != SensorNoise._field_defaults[name]
        ]
        if self.spun or self.lifted:
            words.append("--keep-spins")
        return " ".join(words)

    def facts(self) -> dict[str, float | int | str | bool | list[str]]:
        """Remarks for the user."""
        return {
            "command": self.command,
            "duration_s": self.duration_s,
            "scale": self.scale,
            "peak_ay_m_s2": self.peak_ay_m_s2,
            "peak_sideslip_deg": math.degrees(self.peak_sideslip_rad),
            "spun": self.spun,
            "lifted": self.lifted,
            "notes": list(self.notes),
        }

    def metadata(self) -> dict[str, str]:
        """Content of the metadata record ``truthsim`` of the log."""
        import json

        import numba

        vehicle = {k: v._asdict() if hasattr(v, "_asdict") else v for k, v in self.vehicle._asdict().items()}
        end_s = float(self.times_s[-1])
        faults = [
            {"fault": str(f), "start_s": f.start_s, "end_s": min(f.end_s, end_s), "kind": f.kind, "target": f.target}
            for f in self.faults
        ]
        return {
            "command": self.command,
            "manoeuvre": self.manoeuvre,
            "speed_km_h": repr(self.speed_km_h),
            "friction": repr(self.friction),
            "seed": str(self.seed),
            "duration_s": repr(self.duration_s),
            "amplitude": repr(self.amplitude),
            "scale": repr(self.scale),
            "peak_ay_m_s2": repr(self.peak_ay_m_s2),
            "peak_sideslip_rad": repr(self.peak_sideslip_rad),
            "spun": json.dumps(self.spun),
            "lifted": json.dumps(self.lifted),
            "notes": json.dumps(list(self.notes)),
            "vehicle_name": self.vehicle_name,
            "vehicle": json.dumps(vehicle),
            "noise": json.dumps(self.noise._asdict()),
            "faults": json.dumps(faults),
            "versions": json.dumps({"pdhef-logtool": __version__, "numpy": np.__version__, "numba": numba.__version__}),
        }


def _exact(value: float) -> str:
    """Return the shortest text that reads back as the same number, without an unnecessary fraction."""
    return str(int(value)) if value == int(value) else repr(float(value))


def simulate_drive(
    manoeuvre: str,
    *,
    speed_km_h: float | None = None,
    friction: float | None = None,
    seed: int = 0,
    duration_s: float | None = None,
    amplitude: float = 1.0,
    vehicle: Vehicle | None = None,
    vehicle_name: str = DEFAULT_VEHICLE,
    noise: SensorNoise | None = None,
    faults: Sequence[Fault] = (),
    rtk_rate_hz: int | None = None,
    keep_spins: bool = False,
    tolerance: float = 0.002,
) -> Drive:
    """Simulate a manoeuvre of ``truthsim.manoeuvres.MANOEUVRES``; None selects the manoeuvre's default.

    Parameters
    ----------
    amplitude : factor on the manoeuvre's amplitude: its share of μ g, its standard angle, or its course.
    vehicle, vehicle_name : the vehicle, and its name on the command line.
    keep_spins : keep a drive with a sideslip above 20 degrees or a lifted wheel. Otherwise, a manoeuvre defined by an
        angle is repeated with lower amplitudes until neither occurs (with a note), a manoeuvre scaled to μ g is limited
        to such amplitudes, and for a manoeuvre with a fixed course this is an error.
    tolerance : relative tolerance of the peak to its share of μ g.

    Raises
    ------
    UsageError
        The manoeuvre is unknown, or a value is outside the range of the simulator.
    SimulationError
        The car spun.
    """
    chosen = MANOEUVRES.get(manoeuvre)
    if chosen is None:
        raise UsageError(
            expected=f"one of {', '.join(MANOEUVRES)}",
            got=repr(manoeuvre),
            where="manoeuvre",
            remedy="pdhef simulate --list describes the manoeuvres",
        )
    speed_km_h = chosen.speed_km_h if speed_km_h is None else float(speed_km_h)
    friction = chosen.friction if friction is None else float(friction)
    rtk_rate_hz = chosen.rtk_rate_hz if rtk_rate_hz is None else rtk_rate_hz
    _check(chosen, speed_km_h, friction, seed, duration_s, amplitude, rtk_rate_hz)
    speed_m_s = speed_km_h / 3.6
    duration_s = chosen.default_duration_s(speed_m_s) if duration_s is None else float(duration_s)
    vehicle = Vehicle() if vehicle is None else vehicle
    noise = SensorNoise() if noise is None else noise

    notes: list[str] = []
    request = Request(speed_m_s, friction, seed, duration_s, amplitude)
    if chosen.uses_reference:
        request = replace(request, reference_rad=reference_steer_rad(speed_m_s, friction, vehicle))
    if chosen.peak_share is not None:
        goal = Goal(chosen, amplitude * chosen.peak_share * friction * GRAVITY_M_S2, tolerance, keep_spins)
        request = replace(request, scale=search_scale(goal, request, vehicle, notes))
    elif chosen.uses_reference and not keep_spins:
        request = replace(request, scale=_largest_safe_scale(chosen, request, vehicle, notes))
    motion = simulate_motion(
        chosen.plan(request),
        friction,
        vehicle=vehicle,
        period_s=IMU_PERIOD_S,
        phases_s=(0.0, STEER_PHASE_S, WHEEL_PHASE_S),
    )
    outcome = judge(motion)
    if outcome.lost and not keep_spins:
        raise SimulationError(
            expected="a drive without a spin and with all wheels on the road",
            got=outcome.describe(),
            where=manoeuvre,
            remedy="lower --speed or --amplitude, or keep it with --keep-spins",
        )
    if outcome.lost:
        notes.append(outcome.describe())
    truth = {name: motion.column(name) for name in OBSERVED}
    truth["sideslip_rad"] = np.arctan2(truth["vy_m_s"], truth["vx_m_s"])
    truth["friction"] = np.mean([truth[f"friction_{w}"] for w in WHEELS], axis=0)
    channels = sense(motion, vehicle, noise, seed, rtk_rate_hz, rtk_outages(faults))
    return Drive(
        manoeuvre=manoeuvre,
        speed_km_h=speed_km_h,
        friction=friction,
        seed=seed,
        duration_s=duration_s,
        amplitude=amplitude,
        scale=request.scale,
        start_ns=START_NS,
        times_s=motion.times_s,
        truth=truth,
        channels=apply_faults(channels, faults, noise, seed),
        vehicle=vehicle,
        vehicle_name=vehicle_name,
        noise=noise,
        faults=tuple(faults),
        rtk_rate_hz=rtk_rate_hz,
        peak_ay_m_s2=outcome.peak_ay_m_s2,
        peak_sideslip_rad=outcome.peak_sideslip_rad,
        spun=outcome.spun,
        lifted=outcome.lifted,
        notes=tuple(notes),
    )


def _check(
    chosen: Manoeuvre,
    speed_km_h: float,
    friction: float,
    seed: int,
    duration_s: float | None,
    amplitude: float,
    rtk_rate_hz: int,
) -> None:
    def require(holds: bool, where: str, expected: str, got: float) -> None:
        if not holds:
            raise UsageError(expected=expected, got=f"{got:g}", where=where)

    top = min(250.0, chosen.top_speed_km_h)
    require(10.0 <= speed_km_h <= top, f"speed of {chosen.name}", f"10 to {top:g} km/h", speed_km_h)
    require(0.05 <= friction <= 1.5, "friction", "0.05 to 1.5", friction)
    require(seed >= 0, "seed", "a number of at least 0", seed)
    require(0.01 <= amplitude <= 10.0, "amplitude", "0.01 to 10", amplitude)
    if duration_s is not None:
        require(1.0 <= duration_s <= 36_000.0, "duration", "1 to 36000 s", duration_s)
    require(rtk_rate_hz in (10, 20, 50, 100), "RTK rate", "10, 20, 50 or 100 Hz", rtk_rate_hz)


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of a motion: peaks, spin and lifted wheels."""

    peak_ay_m_s2: float
    peak_sideslip_rad: float
    spun: bool
    lifted: bool

    @property
    def lost(self) -> bool:
        """The car spun or a wheel left the road."""
        return self.spun or self.lifted

    def describe(self) -> str:
        """Return a description."""
        words = []
        if self.spun:
            words.append(f"the car spun: sideslip reached {math.degrees(self.peak_sideslip_rad):.0f} degrees")
        if self.lifted:
            words.append("a wheel left the road")
        return " and ".join(words)


def judge(motion: Motion) -> Outcome:
    """Return the outcome of a motion.

    Raises
    ------
    SimulationError
        The state is not finite.
    """
    if not np.isfinite(motion.observed[:, 0]).all():
        raise SimulationError(
            expected="finite motion", got="NaN or infinity", where="the vehicle", remedy="try a lower speed"
        )
    v_x, v_y = motion.column("vx_m_s"), motion.column("vy_m_s")
    moves = np.hypot(v_x, v_y) > _SPIN_MIN_SPEED_M_S
    sideslip = float(np.where(moves, np.abs(np.arctan2(v_y, v_x)), 0.0).max())
    step_s = float(motion.times_s[1] - motion.times_s[0])
    rows = max(1, math.ceil(_LIFT_S / step_s - 1e-9))
    lifted = False
    for wheel in WHEELS:
        off = (motion.column(f"fz_{wheel}_n") <= 0.0) & moves
        lifted |= bool(off.any()) and bool((np.convolve(off, np.ones(rows), mode="valid") >= rows - 0.5).any())
    return Outcome(float(np.abs(motion.column("ay_m_s2")).max()), sideslip, sideslip > SPIN_RAD, lifted)


def reference_steer_rad(speed_m_s: float, friction: float, vehicle: Vehicle) -> float:
    """Road-wheel angle at which a slow ramp (13.5 degrees a second at the steering wheel) reaches 0.3 g (FMVSS 126).

    Raises
    ------
    SimulationError
        The car does not reach it at this speed.
    """
    wanted = reference_a_y_m_s2(friction)
    rate = math.radians(13.5) / STEERING_RATIO
    duration_s = 2.0 * steer_for(wanted, speed_m_s) / rate + 1.0
    steer = rate * CONTROL_STEP_S * np.arange(round(duration_s / CONTROL_STEP_S) + 1, dtype=np.float64)
    motion = simulate_motion(Plan(speed_m_s, duration_s, steer_rad=steer), friction, vehicle=vehicle)
    a_y = motion.column("ay_m_s2")
    above = np.flatnonzero(a_y >= wanted)
    if above.size == 0 or above[0] == 0:
        raise SimulationError(
            expected=f"a speed at which the car reaches {wanted:.2g} m/s^2",
            got=f"{speed_m_s * 3.6:g} km/h",
            where="speed",
            remedy="choose a higher speed",
        )
    i = int(above[0])
    return float(np.interp(wanted, a_y[i - 1 : i + 1], motion.column("steer_rad")[i - 1 : i + 1]))


def _largest_safe_scale(chosen: Manoeuvre, request: Request, vehicle: Vehicle, notes: list[str]) -> float:
    """Lower the amplitude in steps of 10 % until the car keeps its course and its wheels on the road."""
    scale = request.scale
    for _ in range(20):
        outcome = judge(simulate_motion(chosen.plan(replace(request, scale=scale)), request.friction, vehicle=vehicle))
        if not outcome.lost:
            break
        if scale == request.scale:
            notes.append(f"{outcome.describe()} at the amplitude asked for; it was lowered until not")
        scale *= 0.9
    return scale


@dataclass(frozen=True, slots=True)
class Goal:
    """The |a_y| (m/s²) to scale a manoeuvre to, its tolerance, and whether spins are allowed."""

    chosen: Manoeuvre
    a_y_m_s2: float
    tolerance: float
    keep_spins: bool


def search_scale(goal: Goal, request: Request, vehicle: Vehicle, notes: list[str]) -> float:
    """Search for the scale with the |a_y| of the goal, without a spin or a lifted wheel unless they are allowed.

    The search starts from a guess, scales proportionally until the goal is bracketed, then interpolates. If the goal is
    not reached, the scale with the smallest difference is returned, with a note.
    """
    low, high = (0.0, 0.0), (math.inf, math.nan)
    best_scale, best_value = 0.0, 0.0
    scale = request.scale
    for _ in range(30):
        value = _achieved(goal, replace(request, scale=scale), vehicle)
        if math.isfinite(value) and abs(value - goal.a_y_m_s2) < abs(best_value - goal.a_y_m_s2):
            best_scale, best_value = scale, value
        if abs(value / goal.a_y_m_s2 - 1.0) < goal.tolerance:
            break
        if value < goal.a_y_m_s2:
            low = (scale, value)
        else:
            high = (scale, value)
        if math.isinf(high[0]):
            if scale > 8.0 * max(best_scale, 0.1) or scale > 100.0:
                break
            scale *= min(max(1.02 * goal.a_y_m_s2 / max(value, 1e-9), 1.1), 2.0)
        elif high[0] - low[0] < 0.25 * goal.tolerance * high[0]:
            break
        else:
            share = (goal.a_y_m_s2 - low[1]) / (high[1] - low[1]) if math.isfinite(high[1]) else 0.5
            scale = low[0] + min(max(share, 0.1), 0.9) * (high[0] - low[0])
    if best_scale == 0.0:
        raise SimulationError(
            expected=f"a speed at which the car can do {goal.chosen.name}",
            got=f"{request.speed_m_s * 3.6:g} km/h",
            where="speed",
            remedy="choose another speed",
        )
    asked = goal.a_y_m_s2 / (request.friction * GRAVITY_M_S2)
    least = goal.chosen.least_share / goal.chosen.peak_share if goal.chosen.peak_share else 0.0
    if best_value < min(least, 1.0 - goal.tolerance) * goal.a_y_m_s2:
        got = best_value / (request.friction * GRAVITY_M_S2)
        notes.append(f"|a_y| reaches only {got:.2f} mu g of the {asked:.2f} that was asked for")
    return best_scale


def _achieved(goal: Goal, request: Request, vehicle: Vehicle) -> float:
    """Return |a_y| at a scale; infinite for a lost car unless allowed, so that the search stays below this scale."""
    plan = goal.chosen.plan(request)
    if plan.steer_rad.size and np.abs(plan.steer_rad).max() > _STEER_LIMIT_RAD:
        return math.inf
    motion = simulate_motion(plan, request.friction, vehicle=vehicle)
    outcome = judge(motion)
    if outcome.lost and not goal.keep_spins:
        return math.inf
    if plan.goal_window_s is None:
        return outcome.peak_ay_m_s2
    start, end = plan.goal_window_s
    inside = (motion.times_s >= start) & (motion.times_s <= end)
    return float(np.abs(motion.column("ay_m_s2")[inside]).mean())


#: Length of the pieces of a log for writing, which limits the memory for the messages of a long drive.
_WRITE_NS = 60_000_000_000


def write_drive(drive: Drive, path: Path, *, without: Sequence[str] = (), steering_wheel: bool = False) -> None:
    """Write a drive as ROS 2 MCAP: sensors, RTK and exact ground truth, faults, and provenance.

    ``header.stamp`` and publish time are the measurement time, log time is the arrival. The metadata record
    ``truthsim`` contains its provenance.

    Parameters
    ----------
    without : parts (keys of ``truthsim.recording.PARTS``) to omit.
    steering_wheel : also record the angle at the steering wheel.

    Raises
    ------
    UsageError : a part is unknown.
    OutputError : the file cannot be written.
    """
    unknown = [part for part in without if part not in PARTS]
    if unknown:
        raise UsageError(expected=f"parts of {', '.join(PARTS)}", got=", ".join(unknown), where="--without")
    left_out = {name for part in without for name in PARTS[part]}
    topics = [
        topic
        for topic in topics_of(
            drive.channels,
            drive.times_s,
            drive.truth,
            noise=drive.noise,
            faults=drive.faults,
            rtk_rate_hz=drive.rtk_rate_hz,
            start_ns=drive.start_ns,
            steering_wheel=steering_wheel,
        )
        if topic.name not in left_out
    ]
    with McapLogWriter(path) as writer:
        for topic in topics:
            writer.add_topic(topic.name, topic.type_name, constants=topic.constants, definition=topic.definition)
        writer.metadata("truthsim", drive.metadata())
        end_ns = 1 + max(
            (int(topic.arrival_ns[-1]) for topic in topics if topic.arrival_ns.size), default=drive.start_ns
        )
        for start, end in windows(drive.start_ns, end_ns, _WRITE_NS):
            writer.write([topic.between(start, end) for topic in topics])
