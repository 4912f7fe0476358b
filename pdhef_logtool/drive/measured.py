"""Signals and ground truth of a drive on one grid, and the kinematic relations between them."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.drive.columns import columns_on_grid, derivative, median_known, moving_at
from pdhef_logtool.drive.delays import LatencyEstimate, LateSensor, late_sensors, truth_latency
from pdhef_logtool.drive.hypotheses import Posterior, Relation, known_hypotheses, opened, posterior
from pdhef_logtool.drive.relations import (
    CG_VY,
    COURSE_RATE,
    GNSS_COURSE_RATE,
    GNSS_PATH,
    POSITION,
    SPIN_SHARE,
    TURNING,
    direction_rate,
    law,
    measured_relations,
    motion,
)
from pdhef_logtool.drive.truth import TruthTrack, channel_of, derive_truth
from pdhef_logtool.mapping.candidates import UNIT_NOT_GIVEN
from pdhef_logtool.mapping.naming import vector_of
from pdhef_logtool.mapping.records import Mapping as SignalMapping, SignalSource
from pdhef_logtool.records.geometry import DEGREE_M
from pdhef_logtool.records.signals import GNSS, GNSS_POSITION, WHEELS, Channel, FloatArray

#: Name of the column that is the mean of the wheel speeds.
WHEEL_SPEEDS = "wheel_speeds"
_EAST_NORTH = ("gnss_velocity_east_m_s", "gnss_velocity_north_m_s")
#: Positions of a receiver east and north, m.
_PATH = ("gnss_path.east", "gnss_path.north")
#: Components of a vector along and across.
_VECTORS = (("ax_m_s2", "ay_m_s2"), ("truth.vx_m_s", "truth.vy_m_s"))
_TRUTH = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "x_m", "y_m")


@dataclass(frozen=True, eq=False)
class Measured:
    """Channels of a drive, their columns on the grid, and the relations between them.

    Attributes
    ----------
    signals, truth : mapped channels by name. derived : ground truth at the CG, if any.
    columns : [N] by name; names of ground truth begin with ``truth.``. speed_name : the column used as the speed.
    vehicle : from a file; None without a file. scales : scales of the mapping, by name.
    open_signs : groups of signals with an undocumented common sign. open_units : signals with an assumed unit.
    is_mounted : whether the drive confirms the IMU's mounting.
    """

    signals: Mapping[str, Channel]
    truth: Mapping[str, Channel]
    derived: TruthTrack | None
    columns: Mapping[str, FloatArray]
    speed_name: str | None
    relations: tuple[Relation, ...]
    vehicle: VehicleParameters | None
    scales: Mapping[str, float | tuple[float, ...]]
    open_signs: tuple[tuple[str, ...], ...] = ()
    open_units: frozenset[str] = frozenset()
    is_mounted: bool = False

    @property
    def positions(self) -> tuple[str, str]:
        """Names of the ground-truth positions east and north as mapped."""
        is_place = "truth.lat_deg" in self.scales and "truth.y_m" not in self.scales
        return ("truth.lon_deg", "truth.lat_deg") if is_place else ("truth.x_m", "truth.y_m")

    @cached_property
    def sensors(self) -> "Measured":
        """The columns and relations of the signals alone."""
        columns = {n: c for n, c in self.columns.items() if not n.startswith("truth.")}
        if len(columns) == len(self.columns) and not self.truth:
            return self
        speed = None if (self.speed_name or "").startswith("truth.") else self.speed_name
        relations = tuple(r for r in self.relations if not any(n.startswith("truth.") for n in r.powers))
        return replace(self, truth={}, derived=None, columns=columns, speed_name=speed, relations=relations)

    def without(self, names: Iterable[str]) -> "Measured":
        """Return the measurements without these columns, which have no relations."""
        gone = set(names)
        columns = {n: c for n, c in self.columns.items() if n not in gone}
        return replace(self, columns=columns, signals={n: c for n, c in self.signals.items() if n not in gone})

    @property
    def topics(self) -> dict[str, str]:
        """Topics of the signals, by name."""
        return {n: c.source.split(".")[0] for n, c in self.signals.items()}

    @cached_property
    def latency(self) -> LatencyEstimate | None:
        """Latency of ground truth against the gyro, or of the gyro; None if one is missing."""
        return truth_latency(self.signals, self.truth, self.derived)

    @cached_property
    def late(self) -> tuple[LateSensor, ...]:
        """Sensors with late time stamps, from the signals alone."""
        return late_sensors(self.relations, self.topics) if self.sensors is self else self.sensors.late

    @cached_property
    def posterior(self) -> Posterior:
        """Probabilities of the mistakes that mappings make with these signals."""
        mistakes = known_hypotheses((*self.columns,), tuple(self.groups), self.open_signs)
        return posterior(self.relations, [opened(m, self.open_units) for m in mistakes], self.scales)

    @property
    def groups(self) -> list[tuple[str, ...]]:
        """Groups of signals with a common error of sign or unit: per topic, and of ground truth."""
        columns = self.columns
        topics: dict[str, list[str]] = {}
        for name, topic in () if self.is_mounted else self.topics.items():
            if name in columns and not name.startswith(("wheel_speed_", GNSS)):
                topics.setdefault(topic, []).append(name)
        wheels = [n for n in columns if n.startswith("wheel_speed")]
        truth = [
            n for n in ("truth.yaw_rate_rad_s", "truth.vy_m_s", "truth.sideslip_rad", "truth.ay_m_s2") if n in columns
        ]
        speeds = [n for n in ("truth.vx_m_s", "truth.vy_m_s", "truth.position_speed_m_s") if n in columns]
        groups = [tuple(g) for g in (*topics.values(), truth, speeds) if 2 <= len(g) <= 6]
        return [*groups, *([tuple(wheels)] if len(wheels) > 1 else [])]


def measure(
    signals: Mapping[str, Channel],
    truth: Mapping[str, Channel] | None = None,
    derived: TruthTrack | None = None,
    vehicle: VehicleParameters | None = None,
    mapping: SignalMapping | None = None,
) -> Measured:
    """Bring signals and ground truth, as mapped, to one grid and relate them.

    Parameters
    ----------
    derived : ground truth at the CG. vehicle : not used if it is the default car. mapping : of the channels, if known.
    """
    truth, vehicle = truth or {}, None if vehicle == default_vehicle() else vehicle
    columns = drive_columns(signals, truth, derived)
    speed_name = _speed_of(columns, vehicle)
    sources = {} if mapping is None else mapping.by_subject
    related = measured_relations(columns, speed_name, vehicle)
    # Two quantities of ground truth from the same field agree trivially.
    of_truth = {n: (s.topic, s.paths) for n, s in sources.items() if n.startswith("truth.")}
    read = [[of_truth[n] for n in r.powers if n in of_truth] for r in related]
    related = [r for r, fields in zip(related, read, strict=True) if len(set(fields)) == len(fields)]
    scales, mapping = {n: s.scale for n, s in sources.items()}, mapping or SignalMapping()
    if mapping.origin == "file":  # recognised scales are those of the units that the log states
        related += [r for r in _scales_of_vectors(sources) if not r.accepts()]
    open_units = frozenset(c.subject for c in mapping.checks if UNIT_NOT_GIVEN in c.evidence)
    of_mapping = mapping.open_signs, open_units
    return Measured(signals, truth, derived, columns, speed_name, tuple(related), vehicle, scales, *of_mapping)


def _scales_of_vectors(sources: Mapping[str, SignalSource]) -> Iterator[Relation]:
    """Yield the relation between the scales of two components of one vector."""
    for other, name in _VECTORS:
        a, b = (sources.get(n) for n in (other, name))
        if a and b and a.topic == b.topic and {*map(vector_of, a.paths)} == {*map(vector_of, b.paths)}:
            gain = float(np.linalg.norm(b.scale) / np.linalg.norm(a.scale))
            yield Relation(law("vector", name=name, other=other), 1.0, gain, math.inf)


def drive_columns(
    signals: Mapping[str, Channel], truth: Mapping[str, Channel], derived: TruthTrack | None
) -> dict[str, FloatArray]:
    """Return signals and ground truth on one grid."""
    channels = {n: c for n, c in signals.items() if c.values.ndim == 1}
    if derived is not None:
        for name in _TRUTH:
            channels[f"truth.{name}"] = channel_of(derived, name)
        # Mapped values replace derived ones: wrapping hides a wrong unit, and a derived a_y adds no information.
        if "vy_m_s" in truth and "truth.vy_m_s" in channels:
            channels[CG_VY] = channels["truth.vy_m_s"]
        channels |= {f"truth.{n}": truth[n] for n in ("vy_m_s", "sideslip_rad", "ay_m_s2") if n in truth}
        channels |= _pose_velocity(truth)
        if "yaw_rad" in truth:
            heading = truth["yaw_rad"].take(np.isfinite(truth["yaw_rad"].values))
            channels[TURNING] = replace(heading, values=np.unwrap(heading.values))
    channels |= _over_ground(channels)
    columns = columns_on_grid(channels)
    if TURNING in columns:
        columns[TURNING] = derivative(columns[TURNING])
    if set(_EAST_NORTH) <= set(columns):
        columns[GNSS_COURSE_RATE] = direction_rate(*(columns[n] for n in _EAST_NORTH))
    if {*_PATH} <= columns.keys():
        east, north = (derivative(columns.pop(n)) for n in _PATH)
        columns |= {GNSS_PATH[0]: direction_rate(east, north), GNSS_PATH[1]: np.hypot(east, north)}
    if "truth.x_m" in columns and "truth.y_m" in columns:
        vx, vy = derivative(columns.pop("truth.x_m")), derivative(columns.pop("truth.y_m"))
        columns |= {POSITION[0]: vx, POSITION[1]: vy, "truth.position_speed_m_s": np.hypot(vx, vy)}
        columns[COURSE_RATE] = direction_rate(vx, vy)
    return columns


def _over_ground(channels: Mapping[str, Channel]) -> dict[str, Channel]:
    """Return positions of a receiver in m, and speed and course as components, which do not jump at ±π."""
    metres: dict[str, Channel] = {}
    if set(GNSS_POSITION) <= channels.keys():
        latitude, longitude = (channels[n] for n in GNSS_POSITION)
        shrunk = math.cos(math.radians(float(np.nanmedian(latitude.values))))
        for name, place, factor in zip(_PATH, (longitude, latitude), (DEGREE_M * shrunk, DEGREE_M), strict=True):
            values = (place.values - np.nanmedian(place.values)) * factor
            metres[name] = replace(place, name=name, values=values)
    speed, course = (channels.get(n) for n in ("gnss_speed_m_s", "gnss_course_rad"))
    if speed is None or course is None or not np.array_equal(speed.stamps_ns, course.stamps_ns):
        return metres
    sides = zip(_EAST_NORTH, (np.cos, np.sin), strict=True)
    return metres | {n: replace(speed, name=n, values=speed.values * side(course.values)) for n, side in sides}


def _pose_velocity(truth: Mapping[str, Channel]) -> dict[str, Channel]:
    """Return body velocities from positions and heading of one topic; empty without them."""
    pose = {n: truth[n] for n in ("x_m", "y_m", "yaw_rad", "quat_wxyz") if n in truth}
    if not {"x_m", "y_m"} < pose.keys() or len({c.source.split(".")[0] for c in pose.values()}) > 1:
        return {}
    derived = derive_truth(pose)
    names = {"pose_vx_m_s": "vx_m_s", "pose_vy_m_s": "vy_m_s", "heading_rate_rad_s": "yaw_rate_rad_s"}
    return {f"truth.{n}": channel_of(derived, of) for n, of in names.items()}


def _speed_of(columns: dict[str, FloatArray], vehicle: VehicleParameters | None) -> str | None:
    """Return the name of the speed column. Without a speed sensor, a robust mean of the wheel speeds is added."""
    if "speed_m_s" in columns:
        return "speed_m_s"
    for unit in ("m_s", "rad_s"):
        wheels = [columns[n] for w in WHEELS if (n := f"wheel_speed_{w}_{unit}") in columns]
        if wheels:
            middle = np.median(wheels, axis=0)
            most = SPIN_SHARE * np.abs(middle)
            with np.errstate(divide="ignore", invalid="ignore"):
                # The deviation of one spinning or locked wheel is limited to ``most``; with two, the speed is unknown.
                shares = wheels / np.where(moving_at(middle), middle, np.nan)
                typical = [[median_known(share)] for share in shares]  # a wheel in another unit does not spin
                spin = np.sum(np.abs(shares - typical) > SPIN_SHARE, axis=0) > 1
            mean = np.mean(np.clip(wheels, middle - most, middle + most), axis=0)
            speed = np.asarray(np.where(spin, np.nan, mean))
            columns[WHEEL_SPEEDS] = speed * (1.0 if unit == "m_s" else _radius_m(speed, columns, vehicle))
            return WHEEL_SPEEDS
    return "truth.vx_m_s" if "truth.vx_m_s" in columns else None


def _radius_m(rotation: FloatArray, columns: Mapping[str, FloatArray], vehicle: VehicleParameters | None) -> float:
    """Return the radius of wheels with this mean rotation [N], rad/s: of the file, else by a_y = v r or a_x = v̇."""
    if vehicle is not None:
        return vehicle.wheel_radius_m
    low, high = (1.0 / gain for gain in reversed(law("wheel_rad_s", name="", pace="").gains))
    for relation in motion({**columns, WHEEL_SPEEDS: rotation}, "", WHEEL_SPEEDS):
        if relation.tells:
            return min(max(abs(relation.gain), low), high)
    return default_vehicle().wheel_radius_m
