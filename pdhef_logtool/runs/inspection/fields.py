"""All numeric fields of a log: type, rate, and minimum, mean and maximum."""

import re
from collections.abc import Mapping, Sequence
from contextlib import closing
from typing import Any

import numpy as np

from pdhef_logtool.drive.options import AS_IT_IS, ReadOptions
from pdhef_logtool.evaluation.statistics import gathered
from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.mapping.evidence import PIECE_NS, Pieces, Seen
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, FloatArray
from pdhef_logtool.runs.inspection.report import COVARIANCE, INDEX, collapsed

#: Arrays inside of arrays, or of structs.
INNER_ARRAY = re.compile(r"\[\].")
#: Fields of one topic that are read.
MOST_FIELDS = 2000
_STATISTICS = ("minimum", "mean", "maximum")


def fields_of_log(path: LogPlace | str, topic: str | None = None, options: ReadOptions = AS_IT_IS) -> dict[str, Any]:
    """Return the numeric fields of a topic, or of all, over a few pieces of the log: ``pdhef inspect --fields --json``.

    ``topics`` are over ``seconds`` of the log; ``whole`` if that is all of it. A topic has ``fields``, or the
    ``reason`` why not; a field has statistics in raw units over the read part, NaN without a finite value.

    Raises
    ------
    LogError : The file is no log.
    UsageError : The log has no such topic.
    """
    with closing(open_log(path, options.limits, options.msgs, options.tables)) as log:
        topics = [t for t in log.topics if topic in (None, t.name)]
        if topic is not None and not topics:
            names = ", ".join(t.name for t in log.topics) or "none"
            raise UsageError(expected="a topic of the log", got=repr(topic), where=str(path), remedy=f"topics: {names}")
        pieces = Pieces(log)
        seconds = min(log.end_ns - log.start_ns, len(pieces.starts) * PIECE_NS) * S_PER_NS
        whole = log.end_ns - log.start_ns <= seconds * NS_PER_S + 1
        reports = [_topic_fields(log, pieces, t) for t in topics]
        return {"path": str(path), "seconds": seconds, "whole": whole, "topics": reports}


def _topic_fields(log: DriveLog, pieces: Pieces, topic: TopicInfo) -> dict[str, Any]:
    lines = [line for line in collapsed(log.fields(topic.name)) if not any(map(INNER_ARRAY.search, line[2]))]
    lines = lines[:MOST_FIELDS]
    paths = {p.removesuffix("[]") for _, _, every in lines for p in every}
    samples = pieces.read((topic.name, path) for path in paths) if topic.messages else {}
    values = _values_by_path(samples, paths)
    reports = []
    for line, kind, every in lines:
        parts = [v for p in every for v in values.get(p.removesuffix("[]"), [])]
        reports.append(_report(line, kind, parts))
        if line.endswith("[]") and len(parts) > 1 and not COVARIANCE.search(line):
            columns = [p for p in values if INDEX.sub("", p) == line.removesuffix("[]") and p not in paths]
            reports += [_report(p, kind, values[p]) for p in columns]
    reason = ""
    if not (reports and topic.messages):
        reason = log.unreadable(topic.name) or "no numeric fields" if topic.messages else "no messages"
    rate_hz = max((sample.rate_hz for sample in samples.values()), default=float("nan"))
    facts = {"name": topic.name, "type": topic.type_name.replace("/msg/", "/"), "messages": topic.messages}
    return {**facts, "rate_hz": rate_hz, "fields": reports, "reason": reason}


def _values_by_path(samples: Mapping[tuple[str, str], Seen], paths: set[str]) -> dict[str, list[FloatArray]]:
    """Return values by path; elements of an array also by the array's path."""
    names = {path: {path} if path in paths else {path, INDEX.sub("", path)} for _, path in samples}
    return gathered((name, sample.values) for (_, path), sample in samples.items() for name in names[path])


def _report(path: str, kind: str, values: Sequence[FloatArray]) -> dict[str, Any]:
    every = np.concatenate([np.empty(0), *values])
    every = every[np.isfinite(every)]
    with np.errstate(over="ignore"):
        figures = (float(f(every)) if every.size else np.nan for f in (np.min, np.mean, np.max))
        return {"path": path, "type": kind, **dict(zip(_STATISTICS, figures, strict=True))}
