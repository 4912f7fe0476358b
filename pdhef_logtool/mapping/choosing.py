"""The mapping in effect for one log: the one given, or what its types tell, with every ambiguity said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping.checking import check_mapping
from pdhef_logtool.mapping.recognition import auto_map
from pdhef_logtool.mapping.records import Mapping
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.signals import ALIGNED_SIGNALS


def _filled(mapping: Mapping, found: Mapping) -> Mapping:
    """Return the mapping with what recognised types give for the signals, and the truth as a whole, that it lacks."""
    return replace(
        mapping,
        signals={**found.signals, **mapping.signals},
        truth=mapping.truth or found.truth,
        quality=mapping.quality if mapping.truth else mapping.quality or found.quality,
        notes=(*mapping.notes, *found.notes),
        checks=tuple(c for c in found.checks if c.subject not in mapping.signals),
    )


def choose_mapping(
    log: DriveLog,
    mapping: Mapping | None,
    tell: Callable[[str], None],
    remark: Callable[[str], None],
    *,
    prefer_truth: Literal["perfect", "rtk"],
    require_signals: bool = True,
) -> tuple[Mapping, tuple[str, ...]]:
    """Return the mapping in effect and the signals that it lacks; ambiguities are told, never settled silently.

    ``tell`` is called with what may be wrong, ``remark`` with what else is worth knowing.

    Raises
    ------
    MappingError : The mapping names what the log lacks; or, with ``require_signals``, no type of the log is recognised.
    """
    if mapping is not None and mapping.fill_recognised:
        mapping = _filled(mapping, auto_map(log, prefer_truth=prefer_truth).mapping)
    if mapping is not None:
        check_mapping(mapping, log)
        for note in (*mapping.notes, *_borrowed(log, mapping)):
            remark(note)
        return mapping, tuple(n for n in ALIGNED_SIGNALS if n not in mapping.signals)
    found = auto_map(log, prefer_truth=prefer_truth)
    for ambiguity in found.ambiguities:
        tell(str(ambiguity))
    for note in (*found.mapping.notes, *_borrowed(log, found.mapping)):
        remark(note)
    if require_signals and not found.mapping.signals:
        raise MappingError(
            expected="fields that are a car's sensors",
            got="; ".join(found.mapping.notes) or _topics_there_are(log),
            where=str(log.path),
            remedy="pdhef inspect LOG --fields shows every number, pdhef map LOG helps to write a mapping.toml",
        )
    return found.mapping, found.missing


def _borrowed(log: DriveLog, mapping: Mapping) -> list[str]:
    """Say which topics are read by definitions of this machine, which may be another version's."""
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
