"""Logs with faults, and logs in the layouts of published message definitions and exports: ``layouts.txt``."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from pdhef_logtool.records.geometry import GRAVITY_M_S2
from pdhef_logtool.records.signals import FloatArray
from studies.pages import paragraphs
from studies.strangers import recordings
from studies.strangers.cars import Car, Series, drive
from studies.strangers.containers import Topic
from studies.strangers.recordings import DEG, DOWN, KMH, SCORING, Recording, answers, message
from truthsim.recording import quaternion

#: Patterns of messages that name a cause.
CAUSES: dict[str, str] = SCORING["causes"]


def rotation(axis: tuple[float, float, float], angle_rad: float) -> FloatArray:
    """Return the matrix of a rotation about an axis."""
    return np.asarray(Rotation.from_rotvec(angle_rad * np.array(axis) / np.linalg.norm(axis)).as_matrix())


_NUMPY = ("clip", "cos", "cumsum", "diag", "floor", "gradient", "maximum", "pi", "rint", "sin", "sqrt", "stack", "tan")
#: Names of expressions beside the columns of the car. ``shift`` is a command ahead of its measurement.
_NAMES = {
    "DEG": DEG, "DOWN": DOWN, "FORWARD": np.diag([1.0, 0.0]), "G": GRAVITY_M_S2, "KMH": KMH, "RPM": 2.0 * np.pi / 60.0,
    "quaternion": quaternion, "rng": np.random.default_rng, "shift": np.roll,
    **{name: getattr(np, name) for name in _NUMPY},
}  # fmt: skip
_MAKERS = ("Topic", "fix", "imu", "odometry", "road_car", "scalar", "steering", "velocity")
_TOPICS = {name: getattr(recordings, name) for name in _MAKERS}


class Columns(dict[str, Any]):
    """Columns of a car on the times of a clock, by name; each is computed when an expression needs it."""

    def __init__(self, car: Car, clock: Series) -> None:
        stamps_ns = clock.stamps_ns
        # Microseconds since the device was switched on, 100 s before the drive.
        micros = (stamps_ns - stamps_ns[0]) / 1000.0 + 1e8
        super().__init__(stamps_ns=stamps_ns, count=np.arange(len(stamps_ns)), micros=micros)
        self.car, self.clock = car, clock

    def __missing__(self, name: str) -> FloatArray:
        """Return a column; raise KeyError for an unknown name, which Python then searches elsewhere."""
        return self.car.sensors[name].along(self.clock).values


def layouts(*groups: str) -> Iterator[Recording]:
    """Yield the logs of some groups, by default all."""
    for head, what, page, *lines in paragraphs(Path(__file__).with_name("layouts.txt")):
        name, group, container, kind = head.split()
        if groups and group not in groups:
            continue
        vehicle, _, imu_x = kind.partition(",")
        car = drive(vehicle, float(imu_x)) if imu_x else drive(vehicle)
        names = {**_NAMES, **_TOPICS, "car": car, "drive": drive, "rotation": rotation}
        entries = [line.partition(": ")[::2] for line in lines]
        about = dict(entries)
        also = (value.partition(" = ")[::2] for key, value in entries if key == "also")
        cause = re.sub("|".join(CAUSES), lambda match: CAUSES[match[0]], about.get("cause", ""))
        right = _answers(car, about["right"]) | {n: eval(value, dict(names)) for n, value in also}
        allowed, at_fault = _answers(car, about.get("allowed", "")), frozenset(about.get("fault", "").split())
        topics = tuple(_topics(car, lines, names))
        yield Recording(name, group, what, right, allowed, cause, at_fault, page.strip("-"), container, topics)


def mountings() -> Iterator[Recording]:
    """Yield 24 logs with an IMU rotated in steps of 90 degrees; the first has the axes of the car."""
    car, turns = drive("short"), np.rint(Rotation.create_group("O").as_matrix())
    for i, turn in enumerate(sorted(turns, key=np.trace, reverse=True)):
        topics = recordings.road_car(car, imu=recordings.imu(car.force.times(turn), car.rate.times(turn)))
        right = answers(car, "imu", "steer", "speed", "truth", "truth rate")
        at_fault = frozenset({"ax_m_s2", "ay_m_s2", "yaw_rate_rad_s"} if i else ())
        told = (f"mounting-{i:02}", "fault", "IMU turned in steps of 90 degrees, all 24 ways")
        cause = CAUSES["MOUNTING"] if i else ""
        yield Recording(*told, right, {}, cause, at_fault, topics=topics, kind="mounting-90")


def layout(name: str) -> Recording:
    """Return one log."""
    return next(r for r in layouts() if r.name == name)


def _answers(car: Car, text: str) -> dict[str, tuple[Series, ...]]:
    by_channel: dict[str, tuple[Series, ...]] = {}
    for item in filter(None, text.split(", ")):
        if item.startswith("-"):
            del by_channel[item[1:]]
        elif item.startswith("truth."):
            by_channel[item] = answers(car, "truth")[item]
        else:
            by_channel |= answers(car, item)
    return by_channel


def _topics(car: Car, lines: Sequence[str], names: dict[str, Any]) -> Iterator[Topic]:
    for i, line in enumerate(lines):
        if line.startswith("= "):
            topics = eval(line[2:], dict(names))
            yield from (topics,) if isinstance(topics, Topic) else topics
        elif line.startswith("/"):
            name, type_name, clock_name, *stamp = line.split()
            sensor, _, step = clock_name.partition("/")
            clock = car.sensors[sensor].every(int(step or 1))
            columns = Columns(car, clock)
            fields: dict[str, Any] = {}
            for field_line in lines[i + 1 :]:
                if not field_line.startswith("  "):
                    break
                field, _, expression = field_line.strip().partition(" = ")
                fields |= _fields(field, eval(expression, dict(_NAMES), columns), len(clock.stamps_ns))
            constants = {field: value for field, value in fields.items() if isinstance(value, str)}
            fields = {field: value for field, value in fields.items() if field not in constants}
            stamp_field = stamp[0] if stamp else None
            yield message(name, type_name.strip("-"), clock, fields, stamp=stamp_field, constants=constants)


def _fields(field: str, values: Any, count: int) -> dict[str, Any]:
    """Return the columns of a field; names in braces take a column each, a number is a constant."""
    if isinstance(values, str):
        return {field: values}
    if np.ndim(values) == 0:
        return {field: np.full(count, float(values))}
    if braces := re.search(r"{(.*)}", field):
        return {field.replace(braces[0], n): values[:, i] for i, n in enumerate(braces[1].split(","))}
    return {field: values}
