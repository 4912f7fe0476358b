"""Mapping by well-known message types; every ambiguity is reported."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.mapping import navigation
from pdhef_logtool.mapping.can_frames import CanSignalLog, decoded_frames, holds_frames
from pdhef_logtool.mapping.candidates import MOST, Candidate, Role, anchors_of
from pdhef_logtool.mapping.checking import has_path, stamp_path_of
from pdhef_logtool.mapping.evidence import Pieces, Seen
from pdhef_logtool.mapping.fields import PLACES, Fields, path_velocity
from pdhef_logtool.mapping.joints import is_joints, joint_names
from pdhef_logtool.mapping.mapping_file import missing_signals
from pdhef_logtool.mapping.naming import G_M_S2, VOCABULARY, is_command, words_of
from pdhef_logtool.mapping.records import Mapping, QualityGate, SignalSource
from pdhef_logtool.mapping.vendors import Vendors, load_vendors, plain_type
from pdhef_logtool.mapping.weighing import Weighing, weigh
from pdhef_logtool.records.signals import FloatArray, has_gnss

_TOPICS = {name: frozenset(words.split()) for name, words in VOCABULARY["topics"].items()}
_FIELDS: dict[str, dict[str, str]] = VOCABULARY["types"]
#: Path of the velocity by type, and first covariance entries; −1 there marks a quantity as not provided (REP 145).
TWIST_FIELDS, TWIST_COVARIANCES = _FIELDS["twist"], _FIELDS["twist_covariance"]
NO_SENSORS = tuple(VOCABULARY["topics"]["no_sensors"].split())
PERFECT_PREFIX = "/truth/perfect"
OWN_PREFIX = "/pdhef/"

#: Subject of a choice between runs, and formats of files that may contain several.
RUN, RUN_KINDS = "run", frozenset({"mat", "mat-7.3", "hdf5"})
#: Largest difference of the mean acceleration from 1 for accelerations in g.
NEAR_1_G = 0.08

#: Types with velocities in the body frame by convention.
BODY_TWIST_TYPES = frozenset({"nav_msgs/Odometry", "foxglove/Odometry"})
IMU_TYPES = frozenset({"sensor_msgs/Imu"})
FIX_TYPES = frozenset({"sensor_msgs/NavSatFix", "foxglove/LocationFix"})
_GRAVITY_PATHS = tuple(f"linear_acceleration.{axis}" for axis in "xyz")


#: Sources by signal.
_Sources: TypeAlias = dict[str, SignalSource]


@dataclass(frozen=True, slots=True)
class Ambiguity:
    """Several readings of a log for one subject.

    Attributes
    ----------
    subject : name of the subject, for example ``imu``.
    candidates : topics (and fields).
    chosen : the selected candidate, or None.
    reason : reason for the choice.
    remedy : how to decide.
    """

    subject: str
    candidates: tuple[str, ...]
    chosen: str | None
    reason: str
    remedy: str = "name the topic in a mapping file (pdhef inspect --write-mapping writes one)"

    def __str__(self) -> str:
        """Return one line for a report."""
        taken = f"took {self.chosen}" if self.chosen else "took none"
        return f"{self.subject}: {', '.join(self.candidates)}; {taken}: {self.reason}; {self.remedy}"


@dataclass(frozen=True, slots=True)
class AutoMapping:
    """A recognised or given mapping and its open points.

    Attributes
    ----------
    ambiguities : subjects with several readings. missing : signals without a topic.
    candidates : fields evaluated for signals without a recognised type, the taken ones first.
    """

    mapping: Mapping
    ambiguities: tuple[Ambiguity, ...]
    missing: tuple[str, ...]
    candidates: tuple[Candidate, ...] = ()


@dataclass(slots=True)
class _Draft:
    """A mapping under construction by :func:`auto_map`."""

    log: DriveLog
    samples: dict[tuple[str, str], Seen]
    signals: dict[str, SignalSource] = field(default_factory=dict)
    truth: dict[str, SignalSource] = field(default_factory=dict)
    quality: QualityGate | None = None
    ambiguities: list[Ambiguity] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def values(self, topic: str, path: str) -> FloatArray:
        seen = self.samples.get((topic, path))
        return np.empty(0) if seen is None else seen.values

    def is_given(self, topic: str, path: str) -> bool:
        """Return whether the type has a field and its samples, if any, are not all NaN."""
        if not has_path(self.log.fields(topic), path):
            return False
        seen = self.values(topic, path)
        return seen.shape[0] == 0 or bool(np.isfinite(seen).any())

    def is_disowned(self, topic: str, covariance: str) -> bool:
        """Return whether a covariance of −1 marks a quantity as not provided (REP 145)."""
        seen = self.values(topic, covariance)
        return seen.shape[0] > 0 and bool((seen == -1.0).all())

    def take(self, into: _Sources, name: str, topic: str, path: str, scale: float = 1.0, offset: float = 0.0) -> None:
        """Add a source of one field for a signal or a truth channel."""
        into[name] = SignalSource(name, topic, path, self.stamp(topic), scale, offset)

    def stamp(self, topic: str) -> str:
        """Return the path of a topic's measurement time."""
        return stamp_path_of(self.log.fields(topic))

    def doubt(self, subject: str, candidates: tuple[str, ...], chosen: str | None, reason: str) -> None:
        """Note an ambiguity."""
        self.ambiguities.append(Ambiguity(subject, candidates, chosen, reason))

    def replace_truth(self, truth: dict[str, SignalSource]) -> None:
        """Replace the ground truth; drop the quality gate, which belongs to the previous one."""
        self.truth, self.quality = truth, None
        self.notes = [n for n in self.notes if not n.startswith("ground truth is used where")]

    def choose(
        self, subject: str, topics: list[TopicInfo], rank: Callable[[TopicInfo], tuple[object, ...]], why: str
    ) -> TopicInfo | None:
        """Return the best topic; record an ambiguity if there are several."""
        if not topics:
            return None
        ordered = sorted(topics, key=lambda t: (*rank(t), -t.messages, len(t.name), t.name))
        if len(ordered) > 1:
            self.doubt(subject, tuple(t.name for t in ordered), ordered[0].name, f"{why}, then most messages")
        return ordered[0]


def auto_map(
    log: DriveLog, *, prefer_truth: Literal["perfect", "rtk"] = "perfect", vendors: Vendors | None = None
) -> AutoMapping:
    """Map a log's topics to signals and ground truth, by well-known types first, then by candidates.

    Parameters
    ----------
    prefer_truth : ground truth to use from a simulated log: the perfect one under ``/truth/perfect`` or the RTK-like
        one. A log with only one of them uses that one.
    vendors : documented types; by default the shipped ones and the user's.
    """
    vendors = load_vendors() if vendors is None else vendors
    there = [
        t
        for t in log.topics
        if t.messages > 0 and not (t.name.startswith(OWN_PREFIX) or type_of(t).startswith("pdhef_msgs/"))
    ]
    there = [vendors.typed(t, log.fields(t.name, quiet=True)) for t in there]
    unlike = [t for t in there if not _has_its_fields(log, t)]
    topics = [t for t in there if t not in unlike]
    draft = _Draft(log=log, samples=_probe(log, topics))
    why = {t.name: log.unreadable(t.name) or f"its fields differ from {t.type_name}" for t in unlike}
    draft.notes += [f"{name} is not used: {reason}" for name, reason in why.items()]
    draft.notes += _what_cannot_be_read(log, [t for t in topics if not type_of(t).startswith(NO_SENSORS)])
    draft.notes += [
        f"{t.name} ({type_of(t)}) has no messages" for t in log.topics if not t.messages and _is_well_known(t)
    ]
    topics, decoded = _decode(draft, _of_one_run(draft, topics))
    _map_imu(draft, topics)
    _map_speed(draft, topics)
    _map_truth(draft, topics, prefer_truth)
    _map_truth_friction(draft, topics, prefer_truth)
    _map_documented_truth(draft, topics, vendors)
    unusable = ((t, vendors.of(t.type_name).left_out) for t in topics)
    draft.notes += [f"{t.name} ({t.type_name.replace('/msg/', '/')}) is left out: {why}" for t, why in unusable if why]
    weighed = _weigh_the_rest(draft, topics, vendors)
    _map_navigation(draft, topics, vendors, weighed.fields)
    _map_yaw_rate_of_twist(draft, topics)
    _map_gnss(draft, topics, vendors, weighed.fields)
    _map_speed_over_ground(draft, topics)
    mapping = Mapping(draft.signals, draft.truth, draft.quality, "auto", tuple(draft.notes))
    mapping = replace(mapping, checks=tuple(weighed.checks), open_signs=weighed.open_signs)
    candidates = weighed.candidates
    if decoded is not None:
        mapping = decoded.as_mapped(mapping)
        candidates = tuple(replace(c, source=decoded.as_source(c.source)) for c in candidates)
    return AutoMapping(mapping, tuple(draft.ambiguities), missing_signals(mapping), candidates)


def _of_one_run(draft: _Draft, topics: list[TopicInfo]) -> list[TopicInfo]:
    """Return the topics of the run with most of them; note the choice if a table contains several runs.

    A run is a common beginning of names (``run_1/imu``, ``run_1/gnss``) that repeats with equal devices and fields.
    """
    if repeated := _repeated_groups(draft.log, topics):
        runs = ["1", *sorted({t.name.rpartition("_")[2] for t in repeated}, key=int)]
        draft.doubt(RUN, tuple(runs), runs[0], "signals and ground truth are of one run, here the first")
        return [t for t in topics if t not in repeated]
    devices: dict[str, set[tuple[str, frozenset[str]]]] = {}
    for topic in topics if draft.log.kind in RUN_KINDS else ():
        fields = frozenset(f.path for f in draft.log.fields(topic.name, quiet=True))
        for place in (i for i, letter in enumerate(topic.name) if letter == "_"):
            if len(topic.name) > place + 2:  # a letter is an axis
                devices.setdefault(topic.name[:place], set()).add((topic.name[place:], fields))
    runs = [run for run, d in devices.items() if any(len(d & o) > 1 for r, o in devices.items() if r != run)]
    runs = sorted(r for r in runs if not any(r.startswith(f"{o}_") for o in runs))
    if not runs:
        return topics
    draft.doubt(RUN, tuple(runs), runs[0], "signals and ground truth are of one run, here the first")
    return [t for t in topics if t.name.startswith(f"{runs[0]}_")]


def _repeated_groups(log: DriveLog, topics: list[TopicInfo]) -> list[TopicInfo]:
    """Return the channel groups of an MDF that repeat another one, with its name and a number, at later times."""
    fields = {t.name: [f.path for f in log.fields(t.name, quiet=True)] for t in topics} if "mdf" in log.kind else {}
    pairs = [(t, base) for t in topics for base, _, n in [t.name.rpartition("_")] if n.isdigit() and base in fields]
    pairs = [(t, base) for t, base in pairs if fields[t.name] == fields[base]]
    times = log.read({}, stamps={name for t, base in pairs for name in (t.name, base)}) if pairs else {}
    return [t for t, base in pairs if times[t.name].log_time_ns[:1] > times[base].log_time_ns[-1:]]


def _decode(draft: _Draft, topics: list[TopicInfo]) -> tuple[list[TopicInfo], CanSignalLog | None]:
    """Replace topics of raw CAN frames by the messages of DBC files; return the topics and the log with these views."""
    log = draft.log
    frames = [
        t
        for t in topics
        if not any(o.type_name.startswith("can/msg/") and o.name != t.name for o in topics)
        if "can" in words_of(f"{t.name} {t.type_name}") and holds_frames(t.name, log.fields(t.name, quiet=True))
    ]
    decoded = decoded_frames(log, frames)
    names = ", ".join(path.name for path in log.databases) if frames else ""
    if decoded is not None:
        draft.log = decoded
        there = {t.name for t in log.topics}
        topics = [t for t in topics if t not in frames] + [t for t in decoded.topics if t.name not in there]
        draft.notes.append(f"the frames of {', '.join(t.name for t in frames)} are decoded by {names}")
    else:
        remedy = "describe them by --set msgs=car.dbc or [can] dbc of a mapping file"
        remedy = f"{names} contains none of their identifiers" if names else remedy
        draft.notes += [f"{t.name} contains raw CAN frames: {remedy}" for t in frames]
    return topics, decoded


def _what_cannot_be_read(log: DriveLog, topics: list[TopicInfo]) -> list[str]:
    """Return notes on the topics without readable fields, grouped by reason."""
    by_reason: dict[str, list[str]] = {}
    for topic in topics:
        reason = "" if log.fields(topic.name, quiet=True) else log.unreadable(topic.name)
        if reason:
            by_reason.setdefault(reason, []).append(topic.name)
    return [f"{', '.join(names)}: {reason}" for reason, names in by_reason.items()]


# ------------------------------------------------------------------------------------------------ candidates


def _weigh_the_rest(draft: _Draft, topics: list[TopicInfo], vendors: Vendors) -> Weighing:
    """Take candidates for signals without a well-known type."""
    rest = [(t, _role(t)) for t in topics if not _is_well_known(t) and not type_of(t).startswith(NO_SENSORS)]
    weighed = weigh(draft.log, rest, draft.signals, draft.truth, vendors)
    draft.signals.update(weighed.signals)
    joints = (t for t, role in rest if is_joints(t) and role != "command" and not joint_names(draft.log, t))
    draft.notes += [f"{t.name} is not used: the joints or their order differ between messages" for t in joints]
    if weighed.truth:
        draft.replace_truth(weighed.truth)
    draft.notes += weighed.notes
    for name, fields in weighed.rivals:
        draft.doubt(name, fields, fields[0], "the best score, then most messages")
    return weighed


def _map_documented_truth(draft: _Draft, topics: list[TopicInfo], vendors: Vendors) -> None:
    """Take ground truth from an INS of a documented type if recognised types provide at most a position."""
    if {"vx_m_s", "enu_velocity_m_s", "quat_wxyz", "yaw_rad", "x_m"} & set(draft.truth):
        return
    whole: dict[str, _Sources] = {}
    for topic in topics:
        fields = draft.log.fields(topic.name, quiet=True)
        its = [s for s in vendors.of(topic.type_name).truth if all(has_path(fields, p) for p in s.paths)]
        if any(s.columns > 1 for s in its):
            whole[topic.name] = {s.name: replace(s, topic=topic.name, stamp=stamp_path_of(fields)) for s in its}
    candidates = [t for t in topics if t.name in whole]
    chosen = draft.choose("truth", candidates, lambda t: (-len(whole[t.name]),), "the one with most quantities")
    if chosen is None:
        return
    if draft.truth:
        others = ", ".join(sorted({s.topic for s in draft.truth.values()}))
        draft.notes.append(f"ground truth comes from {chosen.name}, which also has a velocity; {others} is not used")
    draft.replace_truth(whole[chosen.name])


def _map_navigation(draft: _Draft, topics: list[TopicInfo], vendors: Vendors, fields: Fields) -> None:
    """Take ground truth from a navigation system by the names of its vectors, if there is at most a position so far."""
    if set(draft.truth) - {"lat_deg", "lon_deg", "alt_m", "course_rad"}:
        return
    unknown = [t for t in topics if not _is_well_known(t) and not vendors.of(t.type_name).fields]
    # A table has no topic with the name of an instrument: velocity north and east with a heading are those of an INS.
    instruments = [t for t in unknown if _role(t) in ("navigation", "truth")]
    tables = [t for t in unknown if _role(t) == "sensor"]
    truth = navigation.navigation_truth(draft.log, fields, instruments)
    truth = truth or navigation.navigation_truth(draft.log, fields, tables, whole=True)
    if truth is None or (draft.truth and len(truth[0]) <= len(draft.truth)):
        return
    draft.replace_truth(truth[0])
    draft.notes.append(truth[1])


def _map_gnss(draft: _Draft, topics: list[TopicInfo], vendors: Vendors, named: Fields) -> None:
    """Take GNSS as a sensor, from ground truth without heading, else from a receiver that is not ground truth."""
    draft.signals |= navigation.gnss_signals(draft.signals, draft.truth)
    is_ins = navigation.has_heading(draft.truth)
    instruments = {_device(source.topic) for source in draft.truth.values() if is_ins}
    others = [t for t in topics if not _named(t, "truth") and _device(t.name) not in instruments]
    receivers = list(_receivers(draft, others, vendors, named))
    for signals in sorted(receivers, key=lambda s: not has_gnss(s)):
        if has_gnss(signals) if not has_gnss(draft.signals) else not set(signals) & set(draft.signals):
            draft.signals |= signals
    if not has_gnss(draft.signals):
        _map_twist(draft, others)
        if has_gnss(draft.signals) or not (is_ins and {"lat_deg", "x_m"} & set(draft.truth)):
            draft.signals |= next((signals for signals in receivers if not has_gnss(signals)), {})


def _receivers(draft: _Draft, topics: list[TopicInfo], vendors: Vendors, named: Fields) -> Iterator[_Sources]:
    """Yield the signals of each receiver."""
    for topic in topics:
        fields = () if type_of(topic).startswith(NO_SENSORS) else draft.log.fields(topic.name, quiet=True)
        if fields:
            signals = navigation.receiver_signals(topic.name, stamp_path_of(fields), {f.path for f in fields}, vendors)
            by_name = not signals and not _is_well_known(topic) and _role(topic) in ("navigation", "sensor")
            signals = navigation.named_gnss(named, topic.name) if by_name else signals
            if signals:
                yield signals


def _map_twist(draft: _Draft, topics: list[TopicInfo]) -> None:
    """Take the GNSS velocity from a twist over ground, of a navigation system first."""
    twists = [t for t in topics if type_of(t) in TWIST_FIELDS and type_of(t) not in BODY_TWIST_TYPES]
    twists = [t for t in twists if not is_command(t.name)]
    for topic in sorted(twists, key=lambda t: (_named(t, "estimate"), not _is_truth(t))):
        paths = tuple(_twist(topic, "linear", axis) for axis in "xy")
        axes = _axes(draft, topic, topics)
        if axes not in ("", "body"):
            for name, path in zip(("east", "north"), paths[::-1] if axes == "north, east" else paths, strict=True):
                draft.take(draft.signals, f"gnss_velocity_{name}_m_s", topic.name, path)
            return


def _axes(draft: _Draft, twist: TopicInfo, topics: list[TopicInfo]) -> navigation.Axes:
    """Return the axes of a twist by the path of its pose or of a fix, and by the yaw rate."""
    references = {n: s for n, s in draft.signals.items() if n == "yaw_rate_rad_s"}
    if _has_pose(draft, twist):
        for axis in "xy":
            draft.take(references, f"{axis}_m", twist.name, _pose(twist, f"position.{axis}"))
    elif fix := next((t for t in topics if _has_fix(draft, t)), None):
        for name, path in (("lat_deg", "latitude"), ("lon_deg", "longitude")):
            draft.take(references, name, fix.name, path)
    pieces, sources = Pieces(draft.log), [*references.values()]
    fields = [(source.topic, source.paths[0]) for source in sources]
    draft.samples |= pieces.read(f for f in fields if f not in draft.samples)
    x, y = (draft.samples.get((twist.name, _twist(twist, "linear", axis))) for axis in "xy")
    if x is None or y is None:
        return ""
    anchors = anchors_of(draft.log, sources, draft.samples)
    rate = next((f.si for f in anchors if f.meaning.quantity == "rate"), None)
    steps = path_velocity(pieces, [f for f in anchors if f.meaning.quantity in PLACES])
    return navigation.axes_of(pieces, x.cells, y.cells, steps, rate)


def _device(topic: str) -> str:
    """Return the common prefix of the topics of one instrument: the name without its last element."""
    return topic.rpartition("/")[0] or topic


def _is_well_known(topic: TopicInfo) -> bool:
    """Return whether a topic was mapped by its type already."""
    tables = (TWIST_FIELDS, _FIELDS["pose"], _FIELDS["speed"], _FIELDS["several_positions"])
    kind = type_of(topic)
    return kind in IMU_TYPES | FIX_TYPES or any(kind in table for table in tables)


def _role(topic: TopicInfo) -> Role:
    """Return the kind of data in a topic by its name; a device of a navigation system is a sensor, too."""
    words = set(words_of(topic.name))
    is_drive = type_of(topic).startswith("ackermann_msgs/") and not words & _TOPICS["measured"]
    if is_drive or is_command(topic.name, topic.type_name.rpartition("/")[2]):
        return "command"
    if words & _TOPICS["truth"]:
        return "truth"
    navigates = {*words, *words_of(topic.type_name)} & _TOPICS["navigation"]
    if words & _TOPICS["estimate"] and not navigates:
        return "estimate"
    return "navigation" if navigates else "sensor"


def _map_yaw_rate_of_twist(draft: _Draft, topics: list[TopicInfo]) -> None:
    """Without a sensor, take the yaw rate from an odometry of the vehicle or a velocity report, with a note."""
    if "yaw_rate_rad_s" in draft.signals:
        return
    twists = [t for t in topics if type_of(t) in TWIST_FIELDS and _named(t, "vehicle") and not is_command(t.name)]
    odometries = [t for t in twists if not (_is_truth(t) or _named(t, "estimate"))]
    paths = {t: _twist(t, "angular", "z") for t in odometries}
    paths |= {t: "heading_rate" for t in topics if type_of(t) in _FIELDS["speed"]}
    turning = [t for t, path in paths.items() if _span(draft.values(t.name, path)) > 0.0]
    chosen = draft.choose("yaw rate", turning, lambda _: (), "the first of its kind")
    if chosen is not None:
        draft.take(draft.signals, "yaw_rate_rad_s", chosen.name, paths[chosen])
        draft.notes.append(f"yaw_rate_rad_s comes from the twist {chosen.name}, as no IMU gives it")


def _map_speed_over_ground(draft: _Draft, topics: list[TopicInfo]) -> None:
    """Without another speed, take that of a navigation system that is ground truth, or of a receiver, with a note."""
    if not draft.signals or any(n.startswith(("speed_m_s", "wheel_speed_")) for n in draft.signals):
        return
    names = ("vx_m_s", "enu_velocity_m_s", "ecef_velocity_m_s")
    truth = next((draft.truth[n] for n in names if n in draft.truth), None)
    topic = next((t for t in topics if truth is not None and t.name == truth.topic), None)
    role = "" if topic is None else "truth" if _is_well_known(topic) and _role(topic) == "sensor" else _role(topic)
    sides = [s for n in ("east", "north") if (s := draft.signals.get(f"gnss_velocity_{n}_m_s")) is not None]
    scales = tuple(s.scale for s in sides if isinstance(s.scale, float))
    if truth is not None and role in ("navigation", "sensor"):
        source = replace(truth, name="speed_m_s") if truth.name == "vx_m_s" else navigation.length_of(truth)
        why = ", which is also the ground truth, as nothing else gives a speed: the estimator's input is the true speed"
    elif len(scales) == 2:
        paths = tuple(path for s in sides for path in s.paths)
        source, why = navigation.length_of(replace(sides[0], field=paths, scale=scales)), ""
    else:
        return
    why += f"; it is {navigation.NEVER_NEGATIVE}" if source.combine == "norm" else ""
    draft.signals["speed_m_s"] = source
    draft.notes.append(f"speed_m_s comes from {source.topic}{why}")
    draft.ambiguities = [a for a in draft.ambiguities if (a.subject, a.chosen) != ("speed", None)]


def type_of(topic: TopicInfo) -> str:
    """Return a topic's type in the spelling of the tables, independent of its encoding."""
    return plain_type(topic.type_name)


def _twist(topic: TopicInfo, part: str, axis: str) -> str:
    return f"{TWIST_FIELDS[type_of(topic)].format(part)}.{axis}"


def _has_its_fields(log: DriveLog, topic: TopicInfo) -> bool:
    """Return whether a topic has the fields of its type; the name of the type alone is no proof."""
    needed, either = (_FIELDS[which].get(type_of(topic), "").split() for which in ("needed", "either"))
    fields = log.fields(topic.name) if needed or either else ()
    return all(has_path(fields, p) for p in needed) and (not either or any(has_path(fields, p) for p in either))


def _named(topic: TopicInfo, kind: str) -> bool:
    """Return whether the name of a topic contains a word of a kind."""
    return not _TOPICS[kind].isdisjoint(words_of(topic.name))


def _is_truth(topic: TopicInfo) -> bool:
    return _named(topic, "truth") or _named(topic, "navigation")


def _pose(topic: TopicInfo, part: str) -> str:
    return f"{_FIELDS['pose'][type_of(topic)]}.{part}".removeprefix(".")


def _probe(log: DriveLog, topics: list[TopicInfo]) -> dict[tuple[str, str], Seen]:
    """Read pieces of the fields of well-known types that may contain constant fillers."""
    probed = {t.name: _FIELDS["probed"].get(type_of(t), "").split() for t in topics}
    fields = {name: log.fields(name) for name, paths in probed.items() if paths}
    return Pieces(log).read((n, p) for n, paths in probed.items() for p in paths if has_path(fields[n], p))


# ------------------------------------------------------------------------------------------------ sensors


def _map_imu(draft: _Draft, topics: list[TopicInfo]) -> None:
    imus = [t for t in topics if type_of(t) in IMU_TYPES and not _named(t, "truth")]
    in_g = in_deg = False
    why = "an IMU of the vehicle is preferred to one of a camera or lidar"
    # Drivers with a message for each sensor leave the vectors of the other one at zero.
    forces = [t for t in imus if any(_span(draft.values(t.name, path)) > 0.0 for path in _GRAVITY_PATHS)]
    imu = draft.choose("imu", forces or imus, lambda t: (_named(t, "device"),), why)
    if imu is None:
        return
    gyros = [t for t in imus if _span(draft.values(t.name, "angular_velocity.z")) > 0.0]
    gyro = imu if imu in gyros else next(iter(gyros), imu)
    if draft.is_disowned(imu.name, "linear_acceleration_covariance[0]"):
        draft.notes.append(f"{imu.name} provides no acceleration (covariance -1)")
    else:
        means = [_mean(draft.values(imu.name, path)) for path in _GRAVITY_PATHS]
        in_g = abs(abs(means[2]) - 1.0) < NEAR_1_G and np.hypot(means[0], means[1]) < 0.5 * abs(means[2])
        if in_g:
            fast = np.abs(draft.values(gyro.name, "angular_velocity.z"))
            in_deg = bool(np.isfinite(fast).any()) and float(np.nanquantile(fast, 0.995)) > MOST["rate"]
            also = ", its rates in deg/s, as no car turns so fast in rad/s" if in_deg else ""
            reason = f"its accelerations are in g, as gravity is 1{also}; its type's unit is m/s²"
            draft.doubt("imu", (imu.name,), imu.name, reason)
        for name, path in zip(("ax_m_s2", "ay_m_s2"), _GRAVITY_PATHS, strict=False):
            if draft.is_given(imu.name, path):
                draft.take(draft.signals, name, imu.name, path, G_M_S2 if in_g else 1.0)
    _map_rates(draft, gyro, float(np.radians(1.0)) if in_deg else 1.0)


def _map_rates(draft: _Draft, gyro: TopicInfo, scale: float) -> None:
    if draft.is_disowned(gyro.name, "angular_velocity_covariance[0]"):
        draft.notes.append(f"{gyro.name} provides no angular rate (covariance -1)")
    elif draft.is_given(gyro.name, "angular_velocity.z"):
        draft.take(draft.signals, "yaw_rate_rad_s", gyro.name, "angular_velocity.z", scale)
        for name, axis in (("roll_rate_rad_s", "x"), ("pitch_rate_rad_s", "y")):
            if _span(draft.values(gyro.name, f"angular_velocity.{axis}")) > 0.0:  # fillers are constant
                draft.take(draft.signals, name, gyro.name, f"angular_velocity.{axis}", scale)


def _map_speed(draft: _Draft, topics: list[TopicInfo]) -> None:
    reports = [t for t in topics if type_of(t) in _FIELDS["speed"] and not is_command(t.name)]
    twists = []
    for topic in topics:
        if type_of(topic) not in TWIST_FIELDS or _is_truth(topic) or is_command(topic.name):
            continue
        words = set(words_of(topic.name))
        is_body = type_of(topic) in BODY_TWIST_TYPES or _axes(draft, topic, topics) in ("", "body")
        if is_body and words & _TOPICS["vehicle"] and not words & _TOPICS["estimate"]:
            twists.append(topic)
            continue
        if not is_body:
            continue  # a velocity over ground: _map_twist
        draft.doubt("speed", (topic.name,), None, "its name suggests neither a speed sensor nor ground truth")
    why = "a velocity report is preferred to an odometry or a twist"
    chosen = draft.choose("speed", [*reports, *twists], lambda t: (type_of(t) not in _FIELDS["speed"],), why)
    if chosen is None:
        return
    kind = type_of(chosen)
    path = _FIELDS["speed"][kind] if kind in _FIELDS["speed"] else _twist(chosen, "linear", "x")
    draft.take(draft.signals, "speed_m_s", chosen.name, path)
    if kind in TWIST_FIELDS and _span(draft.values(chosen.name, _twist(chosen, "linear", "y"))) > 0.0:
        why = "its name does not suggest ground truth"
        draft.notes.append(f"{chosen.name} contains a lateral velocity, which is not used: {why}")


# ------------------------------------------------------------------------------------------------ ground truth


def _truth_group(topic: TopicInfo) -> str:
    return "perfect" if topic.name.startswith(PERFECT_PREFIX) else "rtk"


def _map_truth(draft: _Draft, topics: list[TopicInfo], prefer: str) -> None:
    types = set(TWIST_FIELDS) | set(_FIELDS["pose"]) | FIX_TYPES
    candidates = [t for t in topics if type_of(t) in types and (_is_truth(t) or type_of(t) in FIX_TYPES)]
    if not any(type_of(t) in TWIST_FIELDS for t in candidates):
        odometry = [t for t in topics if type_of(t) in BODY_TWIST_TYPES and _named(t, "simulators")]
        # An odometry from wheels has no lateral velocity.
        simulated = [t for t in odometry if _span(draft.values(t.name, _twist(t, "linear", "y"))) > 0.0]
        candidates += [t for t in simulated if t not in candidates]
        draft.notes += [f"{t.name} is used as ground truth: a simulator's odometry with v_y" for t in simulated]
    groups = {_truth_group(t) for t in candidates}
    if len(groups) > 1:
        kept = [t for t in candidates if _truth_group(t) == prefer]
        left = sorted(t.name for t in candidates if _truth_group(t) != prefer)
        draft.notes.append(f"{prefer} ground truth used; {', '.join(left)} not used")
        candidates = kept
    for topic in topics:
        if _is_truth(topic) and type_of(topic) in _FIELDS["several_positions"]:
            draft.doubt("ground-truth position", (topic.name,), None, _FIELDS["several_positions"][type_of(topic)])
    velocity = _map_truth_velocity(draft, candidates)
    _map_truth_position(draft, candidates, velocity)


def _map_truth_friction(draft: _Draft, topics: list[TopicInfo], prefer: str) -> None:
    for topic in topics:
        path = _FIELDS["friction"].get(type_of(topic), "")
        if path and _truth_group(topic) == prefer and draft.is_given(topic.name, path):
            draft.take(draft.truth, "friction", topic.name, path)


def _map_truth_velocity(draft: _Draft, candidates: list[TopicInfo]) -> TopicInfo | None:
    twists = [t for t in candidates if type_of(t) in TWIST_FIELDS and _has_twist(draft, t)]
    why = "topics named as ground truth first, then topics with a pose"
    chosen = draft.choose(
        "ground-truth velocity", twists, lambda t: (not _named(t, "truth"), not _has_pose(draft, t)), why
    )
    if chosen is None:
        return None
    axes, is_body = _axes(draft, chosen, candidates), type_of(chosen) in BODY_TWIST_TYPES
    receives = not is_body and _named(chosen, "navigation")
    if axes in ("east, north", "north, east") or (receives and axes != "body"):
        return _take_earth_velocity(draft, chosen, axes, is_body=is_body)
    if axes == "not ahead":
        why = "the type's convention is the body frame, although x is mostly not the direction of travel"
        draft.doubt("ground-truth velocity frame", (f"{chosen.name} as body velocity",), chosen.name, why)
    imus = [t.name for t in draft.log.topics if type_of(t) in IMU_TYPES and _device(t.name) == _device(chosen.name)]
    down = any(_mean(draft.values(imu, _GRAVITY_PATHS[2])) < -0.5 for imu in imus)  # m/s² or g
    for name, part, axis in (("vx_m_s", "linear", "x"), ("vy_m_s", "linear", "y"), ("yaw_rate_rad_s", "angular", "z")):
        full = _twist(chosen, part, axis)
        values = draft.values(chosen.name, full)
        filler = name == "yaw_rate_rad_s" and values.shape[0] > 0 and bool((values == 0.0).all())
        if draft.is_given(chosen.name, full) and not filler:
            draft.take(draft.truth, name, chosen.name, full, -1.0 if down and axis != "x" else 1.0)
    if down:
        draft.doubt("ground-truth velocity", (chosen.name,), chosen.name, "z of its IMU is downward, as gravity shows")
    return chosen


def _take_earth_velocity(draft: _Draft, chosen: TopicInfo, axes: str, *, is_body: bool) -> TopicInfo | None:
    """Take a ground-truth velocity in axes of the earth; return None if too little motion identifies them."""
    # Receivers and some simulators publish their velocity in axes of the earth with the same type.
    is_down = axes == "north, east"
    earth = "north, east, down" if is_down else "east, north, up"
    readings = (f"{chosen.name} as body velocity", f"{chosen.name} as {earth}")
    up = draft.values(chosen.name, _twist(chosen, "linear", "z"))
    if not axes or (not is_body and not np.isfinite(up).any()):
        draft.doubt("ground-truth velocity frame", readings, None, "too little motion to identify the frame")
        return None
    why = "x is not the direction of travel" if axes == "not ahead" else "it has the direction of its path"
    draft.doubt("ground-truth velocity frame", readings, readings[1], why)
    paths = tuple(_twist(chosen, "linear", a) for a in ("yxz" if is_down else "xyz"))
    scale = (1.0, 1.0, -1.0) if is_down else 1.0
    name, stamp = "enu_velocity_m_s", draft.stamp(chosen.name)
    draft.truth[name] = SignalSource(name, chosen.name, paths, stamp, scale)
    rates = draft.values(chosen.name, _twist(chosen, "angular", "z"))
    if is_body and _span(rates) > 0.0:
        draft.take(draft.truth, "yaw_rate_rad_s", chosen.name, _twist(chosen, "angular", "z"))
    return chosen


def _has_twist(draft: _Draft, topic: TopicInfo) -> bool:
    forward, left = _twist(topic, "linear", "x"), _twist(topic, "linear", "y")
    if draft.is_disowned(topic.name, TWIST_COVARIANCES.get(type_of(topic), "")):
        return False
    if not (draft.is_given(topic.name, forward) and draft.is_given(topic.name, left)):
        return False
    v = np.concatenate([draft.values(topic.name, forward), draft.values(topic.name, left)])
    if v.shape[0] and (v == 0.0).all() and type_of(topic) in _FIELDS["pose"]:
        # Converters from fixes to odometry leave the twist at zero while the pose changes.
        return all(_span(draft.values(topic.name, _pose(topic, f"position.{a}"))) <= 1.0 for a in "xy")
    return True


def _mean(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.mean(finite)) if finite.shape[0] else 0.0


def _span(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.ptp(finite)) if finite.shape[0] else 0.0


def _has_pose(draft: _Draft, topic: TopicInfo) -> bool:
    kind = type_of(topic)
    if kind not in _FIELDS["pose"] or draft.is_disowned(topic.name, _FIELDS["pose_covariance"].get(kind, "")):
        return False
    paths = [_pose(topic, f"position.{a}") for a in "xy"]
    # A pose that stays at the origin is a filler.
    xy = np.concatenate([draft.values(topic.name, path) for path in paths])
    return all(draft.is_given(topic.name, path) for path in paths) and (xy.shape[0] == 0 or bool((xy != 0.0).any()))


def _has_fix(draft: _Draft, topic: TopicInfo) -> bool:
    return type_of(topic) in FIX_TYPES and all(draft.is_given(topic.name, p) for p in ("latitude", "longitude"))


def _map_truth_position(draft: _Draft, candidates: list[TopicInfo], velocity: TopicInfo | None) -> None:
    if velocity is not None and _has_pose(draft, velocity):
        chosen: TopicInfo | None = velocity
    else:
        positions = [t for t in candidates if _has_pose(draft, t) or _has_fix(draft, t)]
        why = "topics named as ground truth first, then poses before satellite fixes"
        chosen = draft.choose(
            "ground-truth position", positions, lambda t: (not _named(t, "truth"), type_of(t) in FIX_TYPES), why
        )
    if chosen is None:
        return
    if type_of(chosen) in FIX_TYPES:
        _map_fix(draft, chosen, alone=velocity is None)
        return
    for name, axis in (("x_m", "x"), ("y_m", "y")):
        draft.take(draft.truth, name, chosen.name, _pose(chosen, f"position.{axis}"))
    paths = tuple(_pose(chosen, f"orientation.{a}") for a in "wxyz")
    if not all(draft.is_given(chosen.name, path) for path in paths):  # the log's own definition decides
        return
    norms = np.linalg.norm(np.stack([draft.values(chosen.name, path) for path in paths]), axis=0)
    if norms.shape[0] == 0 or bool(np.any(np.abs(norms - 1.0) < 0.01)):
        draft.truth["quat_wxyz"] = SignalSource("quat_wxyz", chosen.name, paths, draft.stamp(chosen.name))


def _map_fix(draft: _Draft, fix: TopicInfo, *, alone: bool) -> None:
    for name, path in (("lat_deg", "latitude"), ("lon_deg", "longitude"), ("alt_m", "altitude")):
        if draft.is_given(fix.name, path):
            draft.take(draft.truth, name, fix.name, path)
    # Angles of Foxglove's fixes are clockwise from north; angles of vehicles are counter-clockwise from east.
    angles = {p: draft.values(fix.name, p) for p in ("heading", "course")}
    given = {p for p, values in angles.items() if np.isfinite(values).any()}
    if given == {"heading", "course"} and np.array_equal(angles["heading"], angles["course"], equal_nan=True):
        given.remove("heading")
        draft.notes.append(f"{fix.name}.heading is not used: it repeats the course, so that it gives no sideslip")
    for name, path in (("yaw_rad", "heading"), ("course_rad", "course")):
        if path in given:
            draft.take(draft.truth, name, fix.name, path, -1.0, np.pi / 2.0)
    if "heading" in given:
        draft.notes.append(
            f"ground-truth yaw comes from {fix.name}.heading: it is one only with two antennas or an INS"
        )
    status = draft.values(fix.name, "status.status")
    if not alone or status.shape[0] == 0:
        return
    # 0 is any fix; 2 is a ground-based augmented fix, which receivers report for RTK.
    lowest = 2.0 if "rtk" in words_of(fix.name) and bool((status == 2.0).any()) else 0.0
    draft.quality = QualityGate(fix.name, "status.status", min=lowest, stamp=draft.stamp(fix.name))
    draft.notes.append(f"ground truth is used where {fix.name}.status.status is at least {lowest:g}")
