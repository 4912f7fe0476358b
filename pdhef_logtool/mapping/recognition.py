"""Mapping by well-known message types; every ambiguity is reported."""

import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.mapping import navigation
from pdhef_logtool.mapping.can_frames import CanSignalLog, decoded_frames, holds_frames
from pdhef_logtool.mapping.candidates import MOST, Candidate, Role, anchors_of
from pdhef_logtool.mapping.checking import has_path, stamp_path_of
from pdhef_logtool.mapping.evidence import EVIDENCE, Pieces, Seen
from pdhef_logtool.mapping.fields import Fields, path_velocity
from pdhef_logtool.mapping.joints import is_joints, joint_names
from pdhef_logtool.mapping.mapping_file import missing_signals
from pdhef_logtool.mapping.naming import VOCABULARY, is_command, words_of
from pdhef_logtool.mapping.records import Mapping, QualityGate, SignalSource
from pdhef_logtool.mapping.vendors import Vendors, load_vendors, plain_type
from pdhef_logtool.mapping.weighing import Weighing, weigh
from pdhef_logtool.records.geometry import GRAVITY_M_S2
from pdhef_logtool.records.signals import FloatArray, has_gnss

#: Sources by signal.
_Sources: TypeAlias = dict[str, SignalSource]


def _source(name: str, field: str | list[str], scale: float = 1.0, offset: float = 0.0) -> SignalSource:
    return SignalSource(name, "", tuple(field) if isinstance(field, list) else field, scale=scale, offset=offset)


_TOPICS = {name: frozenset(words.split()) for name, words in VOCABULARY["topics"].items()}
_TYPES: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_name("types.toml").read_text(encoding="utf-8"))
#: Sources of well-known types by type and quantity, without a topic; quantities by the covariance that describes them.
SOURCES = {
    kind: {name: _source(name, **(e if isinstance(e, dict) else {"field": e})) for name, e in entries.items()}
    for kind, entries in _TYPES["quantities"].items()
}
COVARIANCES: dict[str, dict[str, list[str]]] = _TYPES["covariances"]
NO_SENSORS = tuple(VOCABULARY["topics"]["no_sensors"].split())
PERFECT_PREFIX = "/truth/perfect"
OWN_PREFIX = "/pdhef/"

#: Subject of a choice between runs, and formats of files that may contain several.
RUN, RUN_KINDS = "run", frozenset({"mat", "mat-7.3", "hdf5"})
#: Largest difference of the length of a quaternion from 1.
NEAR_UNIT = 0.01
#: Descriptions of quantities with a covariance, by the first of them.
_WHAT = {"ax_m_s2": "acceleration", "yaw_rate_rad_s": "angular rate", "vx_m_s": "velocity", "x_m": "pose"}

#: Types with velocities in the body frame by convention.
BODY_TWIST_TYPES = frozenset({"nav_msgs/Odometry", "foxglove/Odometry"})
IMU_TYPES = frozenset({"sensor_msgs/Imu"})
FIX_TYPES = frozenset({"sensor_msgs/NavSatFix", "foxglove/LocationFix"})
_FORCES, _RATES = ("ax_m_s2", "ay_m_s2", "az_m_s2"), ("yaw_rate_rad_s", "roll_rate_rad_s", "pitch_rate_rad_s")


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
    """A mapping under construction by :func:`auto_map`.

    ``given`` has the sources of topics of well-known types, by topic and quantity; ``samples`` has their values.
    """

    log: DriveLog
    samples: dict[tuple[str, str], Seen] = field(default_factory=dict)
    given: dict[str, _Sources] = field(default_factory=dict)
    signals: dict[str, SignalSource] = field(default_factory=dict)
    truth: dict[str, SignalSource] = field(default_factory=dict)
    quality: QualityGate | None = None
    ambiguities: list[Ambiguity] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def values(self, topic: TopicInfo, name: str, column: int = 0) -> FloatArray:
        """Return the finite raw values of a quantity of a well-known type, or of a column of it; empty without any."""
        source = self.given.get(topic.name, {}).get(name)
        seen = None if source is None else self.samples.get((topic.name, source.paths[column]))
        return np.empty(0) if seen is None else seen.values[np.isfinite(seen.values)]

    def span(self, topic: TopicInfo, name: str) -> float:
        """Return the range of the values of a quantity; 0 of a filler."""
        values = self.values(topic, name)
        return float(np.ptp(values)) if values.shape[0] else 0.0

    def has(self, topic: TopicInfo, *names: str) -> bool:
        """Return whether a topic gives all of these quantities by its type."""
        return set(names) <= self.given.get(topic.name, {}).keys()

    def take(self, into: _Sources, topic: TopicInfo, *names: str, scale: float = 1.0) -> None:
        """Add these quantities of a topic, as far as its type gives them, to signals or ground truth."""
        for source in (self.given[topic.name][name] for name in names if self.has(topic, name)):
            into[source.name] = source
            if isinstance(source.scale, float):
                into[source.name] = replace(source, scale=scale * source.scale)

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
    draft = _Draft(log)
    reasons: dict[str, list[str]] = {}
    for topic in there:
        reasons.setdefault(_why_unused(log, topic, vendors), []).append(topic.name)
    used = {*reasons.pop("", ())}
    topics = [t for t in there if t.name in used]
    draft.notes += [f"{', '.join(names)} is not used: {why}" for why, names in reasons.items()]
    _probe(draft, topics)
    draft.notes += [
        f"{t.name} ({type_of(t)}) has no messages" for t in log.topics if not t.messages and _is_well_known(t)
    ]
    topics, decoded = _decode(draft, _of_one_run(draft, topics))
    _map_imu(draft, topics)
    _map_speed(draft, topics)
    _map_truth(draft, topics, prefer_truth)
    _map_truth_friction(draft, topics, prefer_truth)
    _map_documented_truth(draft, topics, vendors)
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
    times = log.read({name: () for t, base in pairs for name in (t.name, base)}) if pairs else {}
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


def _why_unused(log: DriveLog, topic: TopicInfo, vendors: Vendors) -> str:
    """Return why a topic is not used; empty if it may be. The name of a type alone is no proof of its fields."""
    needed = _TYPES["fields"].get(type_of(topic), ())
    fields = log.fields(topic.name, quiet=not needed)
    if not fields and (needed or not type_of(topic).startswith(NO_SENSORS)) and (why := log.unreadable(topic.name)):
        return why
    if not all(any(has_path(fields, path) for path in either.split()) for either in needed):
        return f"its fields differ from {topic.type_name}"
    return vendors.of(topic.type_name).left_out


# ------------------------------------------------------------------------------------------------ candidates


def _weigh_the_rest(draft: _Draft, topics: list[TopicInfo], vendors: Vendors) -> Weighing:
    """Take candidates for signals without a well-known type."""
    rest = [(t, _role(t)) for t in topics if not _is_well_known(t) and not type_of(t).startswith(NO_SENSORS)]
    weighed = weigh(draft.log, rest, draft.signals, draft.truth, vendors)
    draft.signals |= weighed.sources("signals")
    joints = (t for t, role in rest if is_joints(t) and role != "command" and not joint_names(draft.log, t))
    draft.notes += [f"{t.name} is not used: the joints or their order differ between messages" for t in joints]
    if truth := weighed.sources("truth"):
        draft.replace_truth(truth)
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
    """Take GNSS as a sensor: from ground truth without heading, from receivers, else from a twist over ground."""
    draft.signals |= navigation.gnss_signals(draft.signals, draft.truth)
    is_ins = navigation.has_heading(draft.truth)
    instruments = {_device(source.topic) for source in draft.truth.values() if is_ins}
    others = [t for t in topics if not _named(t, "truth") and _device(t.name) not in instruments]
    readings = sorted(_receivers(draft, others, vendors, named), key=lambda s: not has_gnss(s))
    if not any(map(has_gnss, (draft.signals, *readings))):
        readings.insert(0, _twist_over_ground(draft, others))
    is_place_true = is_ins and bool({"lat_deg", "x_m"} & set(draft.truth))
    for signals in readings:
        is_useful = has_gnss(signals) or has_gnss(draft.signals) or not is_place_true
        if is_useful and not set(signals) & set(draft.signals):
            draft.signals |= signals


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


def _twist_over_ground(draft: _Draft, topics: list[TopicInfo]) -> _Sources:
    """Return the GNSS velocity from a twist over ground, of a navigation system first."""
    twists = [t for t in topics if draft.has(t, "vx_m_s", "vy_m_s") and type_of(t) not in BODY_TWIST_TYPES]
    for topic in sorted(twists, key=lambda t: (_named(t, "estimate"), not _is_truth(t))):
        axes = "body" if is_command(topic.name) else _axes(draft, topic, topics)
        if axes not in ("", "body"):
            sides = ("north", "east") if axes == "north, east" else ("east", "north")
            names = zip((f"gnss_velocity_{side}_m_s" for side in sides), ("vx_m_s", "vy_m_s"), strict=True)
            return {name: replace(draft.given[topic.name][axis], name=name) for name, axis in names}
    return {}


def _axes(draft: _Draft, twist: TopicInfo, topics: list[TopicInfo]) -> navigation.Axes:
    """Return the axes of a twist by the path of its pose or of a fix, and by the yaw rate."""
    references = {n: s for n, s in draft.signals.items() if n == "yaw_rate_rad_s"}
    if _has_pose(draft, twist):
        draft.take(references, twist, "x_m", "y_m")
    elif fix := next((t for t in topics if type_of(t) in FIX_TYPES and draft.has(t, "lat_deg", "lon_deg")), None):
        draft.take(references, fix, "lat_deg", "lon_deg")
    pieces, sources = Pieces(draft.log), [*references.values()]
    fields = [(source.topic, source.paths[0]) for source in sources]
    draft.samples |= pieces.read(f for f in fields if f not in draft.samples)
    its = draft.given.get(twist.name, {})
    x, y = (draft.samples.get((twist.name, its[n].paths[0])) if n in its else None for n in ("vx_m_s", "vy_m_s"))
    if x is None or y is None:
        return ""
    anchors = anchors_of(draft.log, sources, draft.samples)
    rate = anchors.pop("yaw_rate_rad_s", None)
    if rate is not None and _is_down(draft, rate.topic):
        rate.sign = -1.0
    steps = path_velocity(pieces, [*anchors.values()])
    return navigation.axes_of(pieces, x.cells, y.cells, steps, None if rate is None else rate.si)


def _is_down(draft: _Draft, imu: TopicInfo) -> bool:
    """Return whether gravity shows that the z axis of an IMU is downward, in m/s² or g."""
    return _mean(draft.values(imu, "az_m_s2")) < -0.5


def _device(topic: str) -> str:
    """Return the common prefix of the topics of one instrument: the name without its last element."""
    return topic.rpartition("/")[0] or topic


def _is_well_known(topic: TopicInfo) -> bool:
    """Return whether a topic was mapped by its type already."""
    return type_of(topic) in (*SOURCES, *_TYPES["several_positions"])


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
    twists = [t for t in topics if draft.has(t, "vx_m_s") and _named(t, "vehicle") and not is_command(t.name)]
    odometries = [t for t in twists if not (_is_truth(t) or _named(t, "estimate"))]
    reports = [t for t in topics if draft.has(t, "speed_m_s")]
    turning = [t for t in (*odometries, *reports) if draft.span(t, "yaw_rate_rad_s") > 0.0]
    chosen = draft.choose("yaw rate", turning, lambda _: (), "the first of its kind")
    if chosen is not None:
        draft.take(draft.signals, chosen, "yaw_rate_rad_s")
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


def _named(topic: TopicInfo, kind: str) -> bool:
    """Return whether the name of a topic contains a word of a kind."""
    return not _TOPICS[kind].isdisjoint(words_of(topic.name))


def _is_truth(topic: TopicInfo) -> bool:
    return _named(topic, "truth") or _named(topic, "navigation")


def _probe(draft: _Draft, topics: list[TopicInfo]) -> None:
    """Read pieces of the fields of well-known types, and find the quantities that they give.

    A quantity without a number, or with a covariance of -1 (REP 145), is not given.
    """
    fields = {t: draft.log.fields(t.name) for t in topics if type_of(t) in SOURCES}
    paths = {t: [p for s in SOURCES[type_of(t)].values() for p in s.paths] for t in fields}
    paths = {t: [*its, *COVARIANCES.get(type_of(t), {})] for t, its in paths.items()}
    draft.samples = Pieces(draft.log).read((t.name, p) for t in paths for p in paths[t] if has_path(fields[t], p))
    for topic, its in fields.items():
        seen = {path: s.values for (name, path), s in draft.samples.items() if name == topic.name}
        absent = {p for p in paths[topic] if not has_path(its, p) or not np.isfinite(seen.get(p, np.zeros(1))).any()}
        sources = {n: s for n, s in SOURCES[type_of(topic)].items() if absent.isdisjoint(s.paths)}
        for path, names in COVARIANCES.get(type_of(topic), {}).items():
            if path in seen and bool((seen[path] == -1.0).all()) and sources.keys() & set(names):
                draft.notes.append(f"{topic.name} provides no {_WHAT[names[0]]} (covariance -1)")
                sources = {n: s for n, s in sources.items() if n not in names}
        draft.given[topic.name] = {
            n: replace(s, topic=topic.name, stamp=stamp_path_of(its)) for n, s in sources.items()
        }


# ------------------------------------------------------------------------------------------------ sensors


def _map_imu(draft: _Draft, topics: list[TopicInfo]) -> None:
    imus = [t for t in topics if type_of(t) in IMU_TYPES and not _named(t, "truth")]
    in_g = in_deg = False
    why = "an IMU of the vehicle is preferred to one of a camera or lidar"
    # Drivers with a message for each sensor leave the vectors of the other one at zero.
    forces = [t for t in imus if any(draft.span(t, name) > 0.0 for name in _FORCES)]
    imu = draft.choose("imu", forces or imus, lambda t: (_named(t, "device"),), why)
    if imu is None:
        return
    gyro = next((t for t in (imu, *imus) if draft.span(t, "yaw_rate_rad_s") > 0.0), imu)
    if draft.has(imu, *_FORCES):
        means = [_mean(draft.values(imu, name)) for name in _FORCES]
        is_level = np.hypot(means[0], means[1]) < 0.5 * abs(means[2])
        in_g = bool(is_level and abs(abs(means[2]) - 1.0) < EVIDENCE["gravity"]["in_g"])
    if in_g:
        in_deg = Seen.of(draft.values(gyro, "yaw_rate_rad_s"), np.empty(0), 0.0).largest > MOST["rate"]
        also = ", its rates in deg/s, as no car turns so fast in rad/s" if in_deg else ""
        reason = f"its accelerations are in g, as gravity is 1{also}; its type's unit is m/s²"
        draft.doubt("imu", (imu.name,), imu.name, reason)
    draft.take(draft.signals, imu, *_FORCES[:2], scale=GRAVITY_M_S2 if in_g else 1.0)
    yaw, *others = _RATES
    turns = [yaw, *(name for name in others if draft.span(gyro, name) > 0.0)]  # fillers are constant
    draft.take(draft.signals, gyro, *turns, scale=float(np.radians(1.0)) if in_deg else 1.0)


def _map_speed(draft: _Draft, topics: list[TopicInfo]) -> None:
    reports = [t for t in topics if draft.has(t, "speed_m_s") and not is_command(t.name)]
    twists = []
    for topic in topics:
        if not draft.has(topic, "vx_m_s") or _is_truth(topic) or is_command(topic.name):
            continue
        words = set(words_of(topic.name))
        is_body = type_of(topic) in BODY_TWIST_TYPES or _axes(draft, topic, topics) in ("", "body")
        if is_body and words & _TOPICS["vehicle"] and not words & _TOPICS["estimate"]:
            twists.append(topic)
            continue
        if not is_body:
            continue  # a velocity over ground: _twist_over_ground
        draft.doubt("speed", (topic.name,), None, "its name suggests neither a speed sensor nor ground truth")
    why = "a velocity report is preferred to an odometry or a twist"
    chosen = draft.choose("speed", [*reports, *twists], lambda t: (t not in reports,), why)
    if chosen is None:
        return
    its = draft.given[chosen.name]
    draft.signals["speed_m_s"] = replace(its.get("speed_m_s") or its["vx_m_s"], name="speed_m_s")
    if draft.span(chosen, "vy_m_s") > 0.0:
        why = "its name does not suggest ground truth"
        draft.notes.append(f"{chosen.name} contains a lateral velocity, which is not used: {why}")


# ------------------------------------------------------------------------------------------------ ground truth


def _truth_group(topic: TopicInfo) -> str:
    return "perfect" if topic.name.startswith(PERFECT_PREFIX) else "rtk"


def _map_truth(draft: _Draft, topics: list[TopicInfo], prefer: str) -> None:
    quantities = {t: SOURCES.get(type_of(t), {}).keys() for t in topics}
    places = [t for t in topics if {"vx_m_s", "x_m", "lat_deg"} & quantities[t]]
    candidates = [t for t in places if _is_truth(t) or type_of(t) in FIX_TYPES]
    if not any("vx_m_s" in quantities[t] for t in candidates):
        odometry = [t for t in topics if type_of(t) in BODY_TWIST_TYPES and _named(t, "simulators")]
        # An odometry from wheels has no lateral velocity.
        simulated = [t for t in odometry if draft.span(t, "vy_m_s") > 0.0]
        candidates += [t for t in simulated if t not in candidates]
        draft.notes += [f"{t.name} is used as ground truth: a simulator's odometry with v_y" for t in simulated]
    groups = {_truth_group(t) for t in candidates}
    if len(groups) > 1:
        kept = [t for t in candidates if _truth_group(t) == prefer]
        left = sorted(t.name for t in candidates if _truth_group(t) != prefer)
        draft.notes.append(f"{prefer} ground truth used; {', '.join(left)} not used")
        candidates = kept
    for topic in topics:
        if _is_truth(topic) and type_of(topic) in _TYPES["several_positions"]:
            draft.doubt("ground-truth position", (topic.name,), None, _TYPES["several_positions"][type_of(topic)])
    velocity = _map_truth_velocity(draft, candidates)
    _map_truth_position(draft, candidates, velocity)


def _map_truth_friction(draft: _Draft, topics: list[TopicInfo], prefer: str) -> None:
    for topic in topics:
        path = _TYPES["friction"].get(type_of(topic), "")
        if path and _truth_group(topic) == prefer and has_path(fields := draft.log.fields(topic.name), path):
            draft.truth["friction"] = SignalSource("friction", topic.name, path, stamp_path_of(fields))


def _map_truth_velocity(draft: _Draft, candidates: list[TopicInfo]) -> TopicInfo | None:
    twists = [t for t in candidates if _has_twist(draft, t)]
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
    imus = [t for t in draft.log.topics if type_of(t) in IMU_TYPES and _device(t.name) == _device(chosen.name)]
    down = any(_is_down(draft, imu) for imu in imus)
    rates = draft.values(chosen, "yaw_rate_rad_s")
    is_filler = rates.shape[0] > 0 and not rates.any()
    draft.take(draft.truth, chosen, "vx_m_s")
    draft.take(draft.truth, chosen, "vy_m_s", *_RATES[: not is_filler], scale=-1.0 if down else 1.0)
    if down:
        draft.doubt("ground-truth velocity", (chosen.name,), chosen.name, "z of its IMU is downward, as gravity shows")
    return chosen


def _take_earth_velocity(draft: _Draft, chosen: TopicInfo, axes: str, *, is_body: bool) -> TopicInfo | None:
    """Take a ground-truth velocity in axes of the earth; return None if too little motion identifies them."""
    # Receivers and some simulators publish their velocity in axes of the earth with the same type.
    is_down = axes == "north, east"
    earth = "north, east, down" if is_down else "east, north, up"
    readings = (f"{chosen.name} as body velocity", f"{chosen.name} as {earth}")
    if not axes or not (is_body or draft.values(chosen, "vz_m_s").shape[0]):
        draft.doubt("ground-truth velocity frame", readings, None, "too little motion to identify the frame")
        return None
    why = "x is not the direction of travel" if axes == "not ahead" else "it has the direction of its path"
    draft.doubt("ground-truth velocity frame", readings, readings[1], why)
    its = SOURCES[type_of(chosen)]
    paths = tuple(its[f"v{axis}_m_s"].paths[0] for axis in ("yxz" if is_down else "xyz"))
    scale = (1.0, 1.0, -1.0) if is_down else 1.0
    stamp = draft.given[chosen.name]["vx_m_s"].stamp
    draft.truth["enu_velocity_m_s"] = SignalSource("enu_velocity_m_s", chosen.name, paths, stamp, scale)
    if is_body and draft.span(chosen, "yaw_rate_rad_s") > 0.0:
        draft.take(draft.truth, chosen, "yaw_rate_rad_s")
    return chosen


def _has_twist(draft: _Draft, topic: TopicInfo) -> bool:
    if not draft.has(topic, "vx_m_s", "vy_m_s"):
        return False
    v = np.concatenate([draft.values(topic, name) for name in ("vx_m_s", "vy_m_s")])
    # Converters from fixes to odometry leave the twist at zero while the pose changes.
    is_filler = v.shape[0] > 0 and not v.any()
    return not (is_filler and any(draft.span(topic, name) > 1.0 for name in ("x_m", "y_m")))


def _mean(values: FloatArray) -> float:
    return float(np.mean(values)) if values.shape[0] else 0.0


def _has_pose(draft: _Draft, topic: TopicInfo) -> bool:
    # A pose that stays at the origin is a filler.
    xy = np.concatenate([draft.values(topic, name) for name in ("x_m", "y_m")])
    return draft.has(topic, "x_m", "y_m") and (xy.shape[0] == 0 or bool(xy.any()))


def _map_truth_position(draft: _Draft, candidates: list[TopicInfo], velocity: TopicInfo | None) -> None:
    if velocity is not None and _has_pose(draft, velocity):
        chosen: TopicInfo | None = velocity
    else:
        positions = [t for t in candidates if _has_pose(draft, t) or draft.has(t, "lat_deg", "lon_deg")]
        why = "topics named as ground truth first, then poses before satellite fixes"
        chosen = draft.choose(
            "ground-truth position", positions, lambda t: (not _named(t, "truth"), type_of(t) in FIX_TYPES), why
        )
    if chosen is None:
        return
    if type_of(chosen) in FIX_TYPES:
        _map_fix(draft, chosen, alone=velocity is None)
        return
    draft.take(draft.truth, chosen, "x_m", "y_m")
    parts = [draft.values(chosen, "quat_wxyz", column) for column in range(4)] if draft.has(chosen, "quat_wxyz") else []
    # Damaged messages may lack some components; without values, the log's own definition decides.
    shortest = min(map(len, parts), default=0)
    norms = np.linalg.norm([part[:shortest] for part in parts], axis=0) if parts else np.zeros(1)
    if norms.shape[0] == 0 or bool(np.any(np.abs(norms - 1.0) < NEAR_UNIT)):
        draft.take(draft.truth, chosen, "quat_wxyz")


def _map_fix(draft: _Draft, fix: TopicInfo, *, alone: bool) -> None:
    draft.take(draft.truth, fix, "lat_deg", "lon_deg", "alt_m", "course_rad")
    heading, course = (draft.values(fix, name) for name in ("yaw_rad", "course_rad"))
    if heading.shape[0] and np.array_equal(heading, course):
        draft.notes.append(f"{fix.name}.heading is not used: it repeats the course, so that it gives no sideslip")
    elif draft.has(fix, "yaw_rad"):
        draft.take(draft.truth, fix, "yaw_rad")
        draft.notes.append(
            f"ground-truth yaw comes from {fix.name}.heading: it is one only with two antennas or an INS"
        )
    status = draft.values(fix, "truth_quality")
    if not alone or status.shape[0] == 0:
        return
    # 0 is any fix; 2 is a ground-based augmented fix, which receivers report for RTK.
    lowest = 2.0 if "rtk" in words_of(fix.name) and bool((status == 2.0).any()) else 0.0
    gate = draft.given[fix.name]["truth_quality"]
    draft.quality = QualityGate(fix.name, gate.paths[0], min=lowest, stamp=gate.stamp)
    draft.notes.append(f"ground truth is used where {gate.label} is at least {lowest:g}")
