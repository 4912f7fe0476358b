"""Simulate a drive: plan, scale, drive, sense; and write it as the log that a recorder would leave."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool import __version__
from pdhef_logtool.errors import SimulationError
from pdhef_logtool.logs.drive_log import windows
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.signals import FloatArray
from truthsim.manoeuvres import GRAVITY_M_S2, MANOEUVRES, Manoeuvre, Plan, Request
from truthsim.motion import Motion, simulate_motion
from truthsim.recording import topics_of
from truthsim.sensors import IMU_PERIOD_S, STEER_PHASE_S, WHEEL_PHASE_S, SensorChannel, SensorNoise, sense
from truthsim.vehicle import OBSERVED, Vehicle

#: 2026-01-01T00:00:00Z, when every simulated drive begins.
START_NS = 1_767_225_600_000_000_000

SPIN_RAD = math.radians(20.0)
#: Sideslip of a car that hardly moves says nothing about a spin.
_SPIN_MIN_SPEED_M_S = 3.0
_STEER_LIMIT_RAD = 0.6


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A simulated drive.

    Attributes
    ----------
    manoeuvre, speed_km_h, friction, seed, duration_s, scale : what was driven; ``scale`` is the amplitude found.
    start_ns : time 0 of the log.
    times_s : [N], 100 Hz.
    truth : by the names of ``truthsim.vehicle.OBSERVED`` and ``sideslip_rad``, each [N].
    channels : ``imu``, ``steering``, ``wheels``, ``rtk``, ``fix``.
    vehicle, noise : what they were made with.
    rtk_rate_hz : rate of ``rtk`` and of the perfect truth in a written log.
    peak_ay_m_s2, peak_sideslip_rad : largest absolute values; sideslip where the car moves faster than 3 m/s.
    spun : the peak sideslip went beyond 20 degrees.
    notes : what a user must know of this drive, one sentence each.
    """

    manoeuvre: str
    speed_km_h: float
    friction: float
    seed: int
    duration_s: float
    scale: float
    start_ns: int
    times_s: FloatArray
    truth: dict[str, FloatArray]
    channels: dict[str, SensorChannel]
    vehicle: Vehicle
    noise: SensorNoise
    rtk_rate_hz: int
    peak_ay_m_s2: float
    peak_sideslip_rad: float
    spun: bool
    notes: tuple[str, ...] = field(default=())

    @property
    def command(self) -> str:
        """The command line that makes this drive again."""
        text = f"pdhef simulate {self.manoeuvre} --speed {self.speed_km_h:g} --mu {self.friction:g} --seed {self.seed}"
        default = MANOEUVRES[self.manoeuvre].default_duration_s(self.speed_km_h / 3.6)
        return text if self.duration_s == default else f"{text} --duration {self.duration_s:g}"

    def facts(self) -> dict[str, float | int | str | bool | list[str]]:
        """What to tell who asked for the drive."""
        return {
            "command": self.command,
            "duration_s": self.duration_s,
            "scale": self.scale,
            "peak_ay_m_s2": self.peak_ay_m_s2,
            "peak_sideslip_deg": math.degrees(self.peak_sideslip_rad),
            "spun": self.spun,
            "notes": list(self.notes),
        }

    def metadata(self) -> dict[str, str]:
        """What the log's metadata record ``truthsim`` holds."""
        import json

        import numba

        return {
            "command": self.command,
            "manoeuvre": self.manoeuvre,
            "speed_km_h": repr(self.speed_km_h),
            "friction": repr(self.friction),
            "seed": str(self.seed),
            "duration_s": repr(self.duration_s),
            "scale": repr(self.scale),
            "peak_ay_m_s2": repr(self.peak_ay_m_s2),
            "peak_sideslip_rad": repr(self.peak_sideslip_rad),
            "spun": json.dumps(self.spun),
            "notes": json.dumps(list(self.notes)),
            "vehicle": json.dumps(_plain(self.vehicle._asdict())),
            "noise": json.dumps(self.noise._asdict()),
            "versions": json.dumps({"pdhef-logtool": __version__, "numpy": np.__version__, "numba": numba.__version__}),
        }


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Turn the tyres inside a vehicle's values into dictionaries too, by name and not by place."""
    return {name: _plain(value._asdict()) if hasattr(value, "_asdict") else value for name, value in values.items()}


def simulate_drive(
    manoeuvre: str,
    *,
    speed_km_h: float | None = None,
    friction: float | None = None,
    seed: int = 0,
    duration_s: float | None = None,
    vehicle: Vehicle | None = None,
    noise: SensorNoise | None = None,
    rtk_rate_hz: int | None = None,
) -> Drive:
    """Simulate a manoeuvre of ``truthsim.manoeuvres.MANOEUVRES``; what is None takes the manoeuvre's default.

    Raises
    ------
    SimulationError
        The manoeuvre is unknown, or a value is outside what the simulator can do.
    """
    chosen = MANOEUVRES.get(manoeuvre)
    if chosen is None:
        raise SimulationError(
            expected=f"one of {', '.join(MANOEUVRES)}",
            got=repr(manoeuvre),
            where="manoeuvre",
            remedy="pdhef simulate --list shows what each does",
        )
    speed_km_h = chosen.speed_km_h if speed_km_h is None else float(speed_km_h)
    friction = chosen.friction if friction is None else float(friction)
    rtk_rate_hz = chosen.rtk_rate_hz if rtk_rate_hz is None else rtk_rate_hz
    _check(speed_km_h, friction, seed, duration_s, rtk_rate_hz)
    speed_m_s = speed_km_h / 3.6
    duration_s = chosen.default_duration_s(speed_m_s) if duration_s is None else float(duration_s)
    vehicle = Vehicle() if vehicle is None else vehicle
    noise = SensorNoise() if noise is None else noise

    notes: list[str] = []
    scale = 1.0
    if chosen.peak_share is not None:
        scale = _search_scale(chosen, Request(speed_m_s, friction, seed, duration_s, 1.0), vehicle, notes)
    plan = chosen.plan(Request(speed_m_s, friction, seed, duration_s, scale))
    motion = simulate_motion(
        plan, friction, vehicle=vehicle, period_s=IMU_PERIOD_S, phases_s=(0.0, STEER_PHASE_S, WHEEL_PHASE_S)
    )
    if not np.isfinite(motion.observed).all():
        raise SimulationError(
            expected="finite motion", got="NaN or infinity", where=manoeuvre, remedy="try a lower speed"
        )
    peak_ay, peak_sideslip = _peaks(motion)
    spun = peak_sideslip > SPIN_RAD
    if spun:
        notes.append(f"the car spun: sideslip reached {math.degrees(peak_sideslip):.0f} degrees")
    truth = {name: motion.column(name) for name in OBSERVED}
    truth["sideslip_rad"] = np.arctan2(truth["vy_m_s"], truth["vx_m_s"])
    return Drive(
        manoeuvre=manoeuvre,
        speed_km_h=speed_km_h,
        friction=friction,
        seed=seed,
        duration_s=duration_s,
        scale=scale,
        start_ns=START_NS,
        times_s=motion.times_s,
        truth=truth,
        channels=sense(motion, vehicle, noise, seed, rtk_rate_hz),
        vehicle=vehicle,
        noise=noise,
        rtk_rate_hz=rtk_rate_hz,
        peak_ay_m_s2=peak_ay,
        peak_sideslip_rad=peak_sideslip,
        spun=spun,
        notes=tuple(notes),
    )


def _check(speed_km_h: float, friction: float, seed: int, duration_s: float | None, rtk_rate_hz: int) -> None:
    def require(holds: bool, where: str, expected: str, got: float) -> None:
        if not holds:
            raise SimulationError(expected=expected, got=f"{got:g}", where=where)

    require(10.0 <= speed_km_h <= 250.0, "speed", "10 to 250 km/h", speed_km_h)
    require(0.05 <= friction <= 1.5, "friction", "0.05 to 1.5", friction)
    require(seed >= 0, "seed", "a number of at least 0", seed)
    if duration_s is not None:
        require(1.0 <= duration_s <= 36_000.0, "duration", "1 to 36000 s", duration_s)
    require(rtk_rate_hz in (10, 20, 50, 100), "RTK rate", "10, 20, 50 or 100 Hz", rtk_rate_hz)


def _peaks(motion: Motion) -> tuple[float, float]:
    """Largest |a_y| (m/s²) and, where the car moves, largest |β| (rad)."""
    v_x, v_y = motion.column("vx_m_s"), motion.column("vy_m_s")
    sideslip = np.where(np.hypot(v_x, v_y) > _SPIN_MIN_SPEED_M_S, np.abs(np.arctan2(v_y, v_x)), 0.0)
    return float(np.abs(motion.column("ay_m_s2")).max()), float(sideslip.max())


def _search_scale(chosen: Manoeuvre, request: Request, vehicle: Vehicle, notes: list[str]) -> float:
    """Find the scale at which the peak |a_y| reaches the manoeuvre's share of μ g without a spin.

    Doubling by parts up to the target, then bisection to 0.2 %. Where the target cannot be had, the scale with the
    highest peak is taken and a note says so.
    """
    assert chosen.peak_share is not None
    unit = request.friction * GRAVITY_M_S2
    target = chosen.peak_share * unit

    def peak(scale: float) -> float:
        """Peak |a_y| at a scale; infinite for a spin, so that the search stays below it."""
        plan: Plan = chosen.plan(Request(request.speed_m_s, request.friction, request.seed, request.duration_s, scale))
        if plan.steer_rad.size and np.abs(plan.steer_rad).max() > _STEER_LIMIT_RAD:
            return math.inf
        a_y, sideslip = _peaks(simulate_motion(plan, request.friction, vehicle=vehicle))
        return math.inf if not math.isfinite(a_y) or sideslip > SPIN_RAD else a_y

    low, high = 0.0, 0.25
    best_scale, best_peak = 0.0, 0.0
    for _ in range(14):
        value = peak(high)
        if math.isfinite(value) and value > best_peak:
            best_scale, best_peak = high, value
        if value >= target:
            break
        low, high = high, high * 1.35
    for _ in range(24):
        if abs(best_peak / target - 1.0) < 0.002:
            break
        middle = 0.5 * (low + high)
        value = peak(middle)
        if math.isfinite(value) and abs(value - target) < abs(best_peak - target):
            best_scale, best_peak = middle, value
        low, high = (low, middle) if value >= target else (middle, high)
    if best_scale == 0.0:
        raise SimulationError(
            expected=f"a speed at which the car can do {chosen.name}",
            got=f"{request.speed_m_s * 3.6:g} km/h",
            where="speed",
            remedy="choose another speed",
        )
    if best_peak < chosen.least_share * unit:
        notes.append(
            f"|a_y| reaches only {best_peak / unit:.2f} mu g of the {chosen.peak_share:.2f} that {chosen.name} asks for"
        )
    return best_scale


#: Length of the pieces that a log is written in, so that the messages of a long drive never stand in memory at once.
_WRITE_NS = 60_000_000_000


def write_drive(drive: Drive, path: Path) -> None:
    """Write a drive as ROS 2 MCAP: sensors, RTK truth, perfect truth, and how it was made as metadata ``truthsim``.

    ``header.stamp`` and publish time are the measurement time, log time is the arrival.

    Raises
    ------
    OutputError : the file cannot be written.
    """
    topics = list(
        topics_of(
            drive.channels,
            drive.times_s,
            drive.truth,
            friction=drive.friction,
            noise=drive.noise,
            rtk_rate_hz=drive.rtk_rate_hz,
            start_ns=drive.start_ns,
        )
    )
    with McapLogWriter(path) as writer:
        for topic in topics:
            writer.add_topic(topic.name, topic.type_name, constants=topic.constants, definition=topic.definition)
        writer.metadata("truthsim", drive.metadata())
        end_ns = 1 + max(int(topic.arrival_ns[-1]) for topic in topics)
        for start, end in windows(drive.start_ns, end_ns, _WRITE_NS):
            writer.write([topic.between(start, end) for topic in topics])
