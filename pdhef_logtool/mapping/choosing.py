"""The mapping in effect for one log: the given mapping, or the recognised one with its ambiguities."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.reduced_log import ReducedLog
from pdhef_logtool.mapping.checking import check_mapping
from pdhef_logtool.mapping.recognition import Ambiguity, AutoMapping, auto_map
from pdhef_logtool.mapping.records import Mapping
from pdhef_logtool.records.errors import LogError, MappingError
from pdhef_logtool.records.signals import ALIGNED_SIGNALS
from pdhef_logtool.storage.documents import jsonable


@dataclass(frozen=True, slots=True)
class ChosenMapping:
    """The mapping in effect and its open points.

    Attributes
    ----------
    missing : signals that it lacks. ambiguities : what may be wrong. remarks : what else is worth knowing.
    prefer_truth : which ground truth of a simulated log was to count.
    """

    mapping: Mapping
    missing: tuple[str, ...]
    prefer_truth: Literal["perfect", "rtk"]
    ambiguities: tuple[Ambiguity, ...] = ()
    remarks: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON-able values, from which :func:`recorded_mapping` makes it again; DBC files by name."""
        document: dict[str, Any] = jsonable(self)
        if self.mapping.can is not None:
            document["mapping"]["can"]["dbc"] = list(self.dbc_names)
        return document

    @property
    def dbc_names(self) -> tuple[str, ...]:
        """What the DBC files of the mapping are called in a reduced log."""
        dbc = () if self.mapping.can is None else self.mapping.can.dbc
        return tuple(f"dbc-{number}-{path.name}" for number, path in enumerate(dbc))


def recorded_mapping(log: ReducedLog, prefer_truth: Literal["perfect", "rtk"]) -> ChosenMapping:
    """Return the mapping of a reduced log.

    Raises
    ------
    LogError : its record contains none that is one. MappingError : it was made for another ground truth.
    """
    from pydantic import TypeAdapter, ValidationError

    try:
        chosen = TypeAdapter(ChosenMapping).validate_python(log.record.mapped)
    except ValidationError as error:
        raise LogError(
            expected="the mapping of a reduced log",
            got="; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()[:3]),
            where=str(log.path),
            remedy="delete it; pdhef run LOG --cache DIR writes it again",
        ) from error
    mapping = chosen.mapping
    if chosen.prefer_truth != prefer_truth and mapping.truth:
        raise MappingError(
            expected=f"prefer_truth = {chosen.prefer_truth}, which this reduced log was made with",
            got=prefer_truth,
            where=str(log.path),
            remedy="read the source log",
        )
    if mapping.can is not None:
        dbc = tuple(log.attached(path.name) for path in mapping.can.dbc)
        mapping = replace(mapping, can=replace(mapping.can, dbc=dbc))
    return replace(chosen, mapping=mapping)


def recognise(log: DriveLog, *, prefer_truth: Literal["perfect", "rtk"]) -> AutoMapping:
    """Return what :func:`auto_map` recognises, or for a reduced log what it was made with."""
    if log.reduced is None:
        return auto_map(log, prefer_truth=prefer_truth)
    recorded = recorded_mapping(log.reduced, prefer_truth)
    return AutoMapping(recorded.mapping, recorded.ambiguities, recorded.missing)


def choose_mapping(
    log: DriveLog, mapping: Mapping | None, *, prefer_truth: Literal["perfect", "rtk"], require_signals: bool = True
) -> ChosenMapping:
    """Return the mapping in effect: the one given, or what is recognised. Ambiguities are never settled silently.

    Raises
    ------
    MappingError : The mapping names what the log lacks; or, with ``require_signals``, no type of the log is recognised.
    """
    if mapping is not None:
        if mapping.fill_recognised:
            mapping = _filled(mapping, recognise(log, prefer_truth=prefer_truth).mapping)
        check_mapping(mapping, log)
        missing = tuple(n for n in ALIGNED_SIGNALS if n not in mapping.signals)
        return ChosenMapping(mapping, missing, prefer_truth, (), (*mapping.notes, *_borrowed(log, mapping)))
    if log.reduced is not None:
        return recorded_mapping(log.reduced, prefer_truth)
    auto = auto_map(log, prefer_truth=prefer_truth)
    if require_signals and not auto.mapping.signals:
        raise MappingError(
            expected="fields that are a car's sensors",
            got="; ".join(auto.mapping.notes) or _topics_there_are(log),
            where=str(log.path),
            remedy="pdhef inspect LOG --fields shows every number, pdhef map LOG helps to write a mapping.toml",
        )
    remarks = (*auto.mapping.notes, *_borrowed(log, auto.mapping))
    return ChosenMapping(auto.mapping, auto.missing, prefer_truth, auto.ambiguities, remarks)


def _filled(mapping: Mapping, auto: Mapping) -> Mapping:
    """Return the mapping with missing signals, or all of missing ground truth, from recognised types."""
    return replace(
        mapping,
        signals={**auto.signals, **mapping.signals},
        truth=mapping.truth or auto.truth,
        quality=mapping.quality if mapping.truth else mapping.quality or auto.quality,
        notes=(*mapping.notes, *auto.notes),
        checks=tuple(c for c in auto.checks if c.subject not in mapping.signals),
    )


def _borrowed(log: DriveLog, mapping: Mapping) -> list[str]:
    """Report which topics are read by definitions of this machine, which may be another version's."""
    files = {source.topic: log.borrowed(source.topic) for source in mapping.sources()}
    return [
        f"{topic} is read by {', '.join(map(str, paths))} of this machine, as the log does not define its type: "
        "right only if that is the version that was recorded"
        for topic, paths in files.items()
        if paths
    ]


def _topics_there_are(log: DriveLog) -> str:
    """Return what a log without sensors has instead: its types, and whether they have messages."""
    if not log.topics:
        return "no topics"
    types = ", ".join(sorted({t.type_name.replace("/msg/", "/") for t in log.topics}))
    empty = [t.name for t in log.topics if not t.messages]
    return types + (f"; {', '.join(empty)} without messages" if empty else "")
