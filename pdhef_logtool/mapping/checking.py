"""Check a mapping against a log: missing names with near matches, and the stamp of each source."""

import re
from dataclasses import replace
from itertools import product
from typing import TypeVar

from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.mapping.can_frames import with_can_signals
from pdhef_logtool.mapping.records import AUTO_STAMP, RECORDER_STAMPS, Mapping, QualityGate, SignalSource, near
from pdhef_logtool.records.errors import MappingError

#: Paths of the measurement time in messages, best first.
STAMP_PATHS = ("header.stamp", "stamp", "timestamp")

#: Names of seconds and nanoseconds in encodings without a time type.
SECONDS_NAMES = ("sec", "secs", "seconds")
NANOSECONDS_NAMES = ("nanosec", "nsec", "nsecs", "nanos", "nanoseconds")

TimedT = TypeVar("TimedT", SignalSource, QualityGate)

_INDEX = re.compile(r"\[\d*\]")


def stamp_path_of(fields: tuple[FieldInfo, ...]) -> str:
    """Return the path of the measurement time in a schema, or ``log_time`` without one."""
    times = {f.path for f in fields if f.kind == "time"}
    paths = {f.path for f in fields}
    for path in STAMP_PATHS:
        if path in times or split_stamp(path, paths) is not None:
            return path
    return RECORDER_STAMPS[0]


def has_path(fields: tuple[FieldInfo, ...], path: str) -> bool:
    """Return whether a schema has a leaf at a path, or an array with the element that the path names."""
    return _kind_of(path, {f.path: f.kind for f in fields}) not in (None, "struct")


def split_stamp(path: str, paths: set[str]) -> tuple[str, str] | None:
    """Return the paths of seconds and nanoseconds of a stamp that a schema stores as two numbers."""
    pairs = ((f"{path}.{s}", f"{path}.{ns}") for s, ns in product(SECONDS_NAMES, NANOSECONDS_NAMES))
    return next((pair for pair in pairs if paths.issuperset(pair)), None)


def resolve_mapping(log: DriveLog, mapping: Mapping) -> Mapping:
    """Return the mapping with every ``auto`` stamp replaced by the best stamp in the log's schema."""
    if all(s.stamp != AUTO_STAMP for s in mapping.sources()):
        return mapping
    names = {t.name for t in log.topics}

    def resolved(source: TimedT) -> TimedT:
        is_auto = source.stamp == AUTO_STAMP and source.topic in names
        return replace(source, stamp=stamp_path_of(log.fields(source.topic))) if is_auto else source

    quality = None if mapping.quality is None else resolved(mapping.quality)
    return replace(mapping.changed(resolved), quality=quality)


def check_mapping(mapping: Mapping, log: DriveLog) -> None:
    """Check that the log contains every topic and field of the mapping.

    Raises
    ------
    MappingError
        Topics, fields or stamps are not in the log, or messages or signals not in the DBC. The error lists all of
        them, each with the nearest existing name.
    """
    log = with_can_signals(log, mapping)
    topics = {t.name: t for t in log.topics}
    recorded = {s.name for s in log.topics if s.encoding != "can"}
    problems: list[str] = []
    for source in mapping.sources():
        if source.read_topic not in topics:
            problems.append(f"{source.name}: no topic {source.topic}{_near(source.topic, recorded)}")
            continue
        fields = log.fields(source.read_topic)
        if not fields:
            continue  # The encoding has no schema: the fields are unknown until messages are read.
        problems += [f"{source.name}: {text}" for text in _field_problems(source, fields)]
    if problems:
        raise MappingError(
            expected="topics and fields of this log",
            got="; ".join(dict.fromkeys(problems)),
            where=str(log.path),
            remedy="pdhef inspect lists the topics, --write-mapping writes a mapping to start from",
        )


def _field_problems(source: SignalSource, fields: tuple[FieldInfo, ...]) -> list[str]:
    kinds = {f.path: f.kind for f in fields}
    problems = [_path_problem(source, path, kinds) for path in source.paths]
    if source.stamp not in (*RECORDER_STAMPS, AUTO_STAMP):
        problems.append(_stamp_problem(source, kinds))
    return [problem for problem in problems if problem]


def _path_problem(source: SignalSource, path: str, kinds: dict[str, str]) -> str:
    kind = _kind_of(path, kinds)
    if kind is None:
        return f"{source.topic} has no field {path}{_near(path, set(kinds))}"
    if kind not in ("number", "bool", "struct"):
        return f"{source.topic}.{path} is a {kind}, not a number"
    if kind == "struct" and (source.columns == 1 or len(source.paths) > 1):
        below = next(p for p in kinds if p.startswith((f"{path}.", f"{path}[")))
        return f"{source.topic}.{path} contains several numbers: name one, such as {below}"
    if kind != "struct" and source.columns > len(source.paths) == 1 and f"{path}[]" not in kinds:
        return f"{source.topic}.{path} is one number, {source.name} needs {source.columns}"
    return ""


def _stamp_problem(source: SignalSource, kinds: dict[str, str]) -> str:
    stamp, kind = f"{source.topic}.{source.stamp}", _kind_of(source.stamp, kinds)
    if kind is None:
        times = {p for p, k in kinds.items() if k == "time"} | set(RECORDER_STAMPS)
        return f"{source.topic} has no stamp {source.stamp}{_near(source.stamp, times)}"
    if source.stamp_unit != "ros":
        return "" if kind == "number" else f'stamp {stamp} is a {kind}: stamp_unit = "{source.stamp_unit}" is wrong'
    if kind == "number":
        return f"stamp {stamp} is a number: give stamp_unit (s, ms, us or ns)"
    if kind == "struct" and split_stamp(source.stamp, set(kinds)) is None:
        return f"stamp {stamp} is no time"
    return ""


def _kind_of(path: str, kinds: dict[str, str]) -> str | None:
    """Return the kind of a path: the kind of a leaf or sequence element, or ``struct`` for a path with leaves below."""
    if path in kinds:
        return kinds[path]
    as_sequence = _INDEX.sub("[]", path)
    for names, kind in kinds.items():
        if _INDEX.sub("[]", names) == as_sequence and (names == as_sequence or "[]" in names):
            return kind
    if any(k.startswith((f"{path}.", f"{path}[")) for k in kinds):
        return "struct"
    return None


def _near(name: str, names: set[str]) -> str:
    tail = name.rsplit(".", 1)[-1].rsplit("/", 1)[-1]
    same_tail = sorted(k for k in names if k.rsplit(".", 1)[-1].rsplit("/", 1)[-1] == tail)
    return near(name, sorted(names), 0.5) or (f" (did you mean {same_tail[0]}?)" if same_tail else "")
