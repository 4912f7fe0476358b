"""Choose the mapping for one log: the given mapping, or the recognised one with its ambiguities."""

from dataclasses import replace
from typing import Literal

from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.table_file import TableSettings
from pdhef_logtool.mapping.checking import check_mapping
from pdhef_logtool.mapping.recognition import RUN, AutoMapping, auto_map
from pdhef_logtool.mapping.records import Mapping
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.signals import ALIGNED_SIGNALS


def choose_mapping(
    log: DriveLog, mapping: Mapping | None, *, prefer_truth: Literal["perfect", "rtk"], require_signals: bool = True
) -> AutoMapping:
    """Return the given mapping, or the recognised one; ambiguities are reported, never resolved silently.

    Raises
    ------
    MappingError : The log lacks a mapped source; or, with ``require_signals``, no type of the log is recognised.
    """
    if mapping is not None:
        mapping = mapping_for_recorder(log, mapping)
        if mapping.fill_recognised:
            mapping = _filled(mapping, auto_map(log, prefer_truth=prefer_truth).mapping)
        check_mapping(mapping, log)
        missing = tuple(n for n in ALIGNED_SIGNALS if n not in mapping.signals)
        return AutoMapping(mapping, (), missing)
    auto = auto_map(log, prefer_truth=prefer_truth)
    if runs := next((a.candidates for a in auto.ambiguities if a.subject == RUN), ()):
        expected, got = "signals and ground truth of one run", f"{len(runs)} runs: {', '.join(runs)}"
        remedy = f'choose one: --set group={runs[0]}, or group = "{runs[0]}" in the mapping file'
        raise MappingError(expected=expected, got=got, where=str(log.path), remedy=remedy)
    if require_signals and not auto.mapping.signals:
        expected, got = "fields that are a car's sensors", "; ".join(auto.mapping.notes) or _topics_there_are(log)
        remedy = "pdhef inspect LOG --fields shows every number, pdhef map LOG helps to write a mapping.toml"
        raise MappingError(expected=expected, got=got, where=str(log.path), remedy=remedy)
    return auto


def tables_for(mapping: Mapping | None, settings: TableSettings) -> TableSettings:
    """Return settings for logs of tables, completed by a mapping file."""
    if mapping is None:
        return settings
    return replace(settings, rate_hz=settings.rate_hz or mapping.rate_hz, group=settings.group or mapping.group)


def mapping_for_recorder(log: DriveLog, mapping: Mapping) -> Mapping:
    """Return the mapping of a folder that fits the topics, fields and types of the log; of several the largest.

    Raises
    ------
    MappingError : No mapping fits this recorder, or several do and none contains all sources of the others.
    """
    if not mapping.recorders:
        if mapping.recorder and (problem := _misfit(log, mapping)):
            raise MappingError(
                expected=f"a log of the recorder that {mapping.file} is for", got=problem, where=str(log.path),
                remedy="give the mapping of this recorder, or a folder with the mappings of all",
            )  # fmt: skip
        return mapping
    problems = {m.file: _misfit(log, m) for m in mapping.recorders}
    sources = {m.file: {(s.topic, s.field) for s in m.sources()} for m in mapping.recorders if not problems[m.file]}
    best = [m for m in mapping.recorders if m.file in sources and all(sources[m.file] >= s for s in sources.values())]
    if len(best) == 1:
        return replace(best[0], notes=(*best[0].notes, f"mapping {best[0].file}: it is for this recorder"))
    names = f"{len(sources)} ({', '.join(sources)})" if sources else "; ".join(f"{n}: {p}" for n, p in problems.items())
    remedy = "add one: pdhef inspect LOG --write-mapping FOLDER/NAME.toml"
    remedy = "[recorder] in a mapping file names the types of its topics" if sources else remedy
    expected = f"one mapping in {mapping.file} for the recorder of this log"
    raise MappingError(expected=expected, got=names, where=str(log.path), remedy=remedy)


def _misfit(log: DriveLog, mapping: Mapping) -> str:
    """Return why a mapping does not fit the recorder of a log; empty if it does."""
    types = {t.name: t.type_name.replace("/msg/", "/") for t in log.topics}
    for topic, kind in mapping.recorder:
        if types.get(topic) != kind.replace("/msg/", "/"):
            return f"{topic} is {types.get(topic, 'not in the log')}, not {kind}"
    try:
        check_mapping(mapping, log)
    except MappingError as error:
        return error.got
    return ""


def _filled(mapping: Mapping, auto: Mapping) -> Mapping:
    """Return the mapping, with missing signals, or all ground truth if missing, filled in from recognised types."""
    signals, truth = {**auto.signals, **mapping.signals}, mapping.truth or auto.truth
    quality = mapping.quality if mapping.truth else mapping.quality or auto.quality
    notes = (*mapping.notes, *auto.notes)
    checks = tuple(c for c in auto.checks if c.subject not in mapping.signals)
    return replace(mapping, signals=signals, truth=truth, quality=quality, notes=notes, checks=checks)


def _topics_there_are(log: DriveLog) -> str:
    """Return the types of a log without sensors, and its topics without messages."""
    if not log.topics:
        return "no topics"
    types = ", ".join(sorted({t.type_name.replace("/msg/", "/") or t.name for t in log.topics}))
    empty = [t.name for t in log.topics if not t.messages]
    return types + (f"; {', '.join(empty)} without messages" if empty else "")
