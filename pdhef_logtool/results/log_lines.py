"""Events of a drive as log lines, for the log panels of viewers."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pdhef_logtool.evaluation.manoeuvres import MANOEUVRES
from pdhef_logtool.evaluation.reasons import reason_intervals
from pdhef_logtool.records.reasons import REASONS
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.sink import Event

DEBUG, INFO, WARN, ERROR = 10, 20, 30, 40  #: of rcl_interfaces/msg/Log
LEVEL_NAMES = {DEBUG: "DEBUG", INFO: "INFO", WARN: "WARN", ERROR: "ERROR"}
_REASON_TEXTS = {r.name: r.text for r in REASONS}


@dataclass(frozen=True, slots=True)
class LogLine:
    """A line of the log: time, severity, subject and text."""

    stamp_ns: int
    level: int
    source: str
    text: str


def event_text(event: Event) -> str:
    """Return an event with its duration."""
    head = f"{event.name}, {(event.end_ns - event.start_ns) * 1e-9:.2f} s"
    return f"{head}: {event.text}" if event.text else head


def log_lines(report: Mapping[str, Any], events: Sequence[Event], tracks: Iterable[StateTrack]) -> list[LogLine]:
    """Return the lines in order of time: failed checks, losses, events and manoeuvres, and faults by estimator."""
    start_ns, end_ns = (int(report["log"].get(key, 0)) for key in ("start_ns", "end_ns"))
    lines = [LogLine(e.start_ns, _level(e), "pdhef", event_text(e)) for e in events]
    for check in report.get("checks", ()):
        if check["verdict"] == "failed":
            level, end = (WARN, " (waived)") if check["waived"] else (ERROR, "")
            text = f"check {check['name']} failed{end}: {check['evidence']}"
            lines.append(LogLine(start_ns, level, "pdhef", text))
    for loss in report.get("losses", ()):
        level = WARN if loss["severity"] == "lost" else INFO
        stamp_ns = start_ns if loss["start_ns"] is None else min(max(loss["start_ns"], start_ns), max(end_ns, start_ns))
        lines.append(LogLine(stamp_ns, level, "pdhef", f"{loss['kind']}: {loss['what']} ({loss['where']})"))
    for track in tracks:
        for reason, spans in reason_intervals(track).items():
            text = f"{track.name}: {_REASON_TEXTS[reason]}"
            lines += [
                LogLine(s.start_ns, WARN, track.name, f"{text}, {(s.end_ns - s.start_ns) * 1e-9:.2f} s") for s in spans
            ]
    return sorted(lines, key=lambda line: (line.stamp_ns, -line.level, line.text))


def _level(event: Event) -> int:
    if event.name.endswith(" diverged"):
        return ERROR
    return INFO if event.name in MANOEUVRES or event.text else DEBUG


def log_message(line: LogLine) -> bytes:
    """Return a line as ``rcl_interfaces/msg/Log`` in little-endian CDR."""
    seconds, rest_ns = divmod(line.stamp_ns, 1_000_000_000)
    data = bytearray(struct.pack("<iIB", seconds, rest_ns, line.level))
    for text in (line.source, line.text, "", ""):
        raw = text.encode() + b"\0"
        data += b"\0" * (-len(data) % 4) + struct.pack("<I", len(raw)) + raw
    data += b"\0" * (-len(data) % 4) + struct.pack("<I", 0)
    return b"\0\1\0\0" + bytes(data)
