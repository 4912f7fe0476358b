"""An inspection as an HTML page: each signal with its candidate fields, clocks, checks, and the mapping to paste."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
from markupsafe import Markup

from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping.candidates import Candidate
from pdhef_logtool.mapping.channels import si_of
from pdhef_logtool.mapping.evidence import Pieces, Seen
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.records.printable import printable
from pdhef_logtool.records.signals import SIGNAL_UNITS, TRUTH_UNITS, FloatArray
from pdhef_logtool.reports.page import render
from pdhef_logtool.runs.inspection.fields import INNER_ARRAY
from pdhef_logtool.runs.inspection.rendering import findings_of, number_text
from pdhef_logtool.runs.inspection.report import COVARIANCE, Inspection, SignalReport, mapping_text
from pdhef_logtool.runs.inspection.step_statistics import COLUMNS
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.outputs import check_no_input

#: Height of a sparkline in units of the drawing.
_HEIGHT = 60
#: Alternatives of one signal, other fields of the log, and fields of one topic that are drawn.
_ALTERNATIVES, _OTHERS, _OF_TOPIC = 6, 150, 40
_LABEL_SIGNS = 160


@dataclass(frozen=True, slots=True)
class _Card:
    """A field: its place, its sketch, figures with units, and the reason for or against it."""

    label: str
    chip: str
    sketch: Markup
    figures: tuple[tuple[str, str], ...]
    why: str = ""
    doubt: str = ""
    taken: bool = False


@dataclass(frozen=True, slots=True)
class _Subject:
    """A signal or ground truth quantity with its cards, the selected one first."""

    name: str
    unit: str
    cards: list[_Card] = field(default_factory=list)


def inspection_page(inspection: Inspection, log: DriveLog) -> bytes:
    """Return the HTML page of an inspection of the open ``log``. The figures show short sections of the log."""
    others = [c for c in inspection.candidates if not c.taken]
    used = {(s.topic, p) for s in inspection.mapping.sources() for p in s.paths}
    used |= {(c.source.topic, p) for c in others for p in c.source.paths}
    pieces = Pieces(log)
    requests: dict[str, list[str]] = {}
    for candidate in others:
        requests.setdefault(candidate.source.topic, []).extend(candidate.source.paths)
    samples = pieces.read({topic: [*dict.fromkeys(paths)] for topic, paths in requests.items()})
    unused, left_out = _unused(log, pieces, used)
    return render(
        "inspection.html",
        inspection=inspection,
        name=Path(inspection.path).name,
        messages=sum(t.messages for t in inspection.topics),
        subjects=[
            ("Signals", _subjects(inspection, "signals", samples)),
            ("Ground truth", _subjects(inspection, "truth", samples)),
        ],
        findings=findings_of(inspection),
        unused=unused,
        left_out=left_out,
        # As it is, for it is pasted: render() would cut it and join its lines.
        mapping=Markup().join(
            Markup("{}\n").format(printable(line, len(line) * 10 + 1)) for line in mapping_text(inspection).splitlines()
        ),
        text=number_text,
    )


def _subjects(inspection: Inspection, section: str, samples: dict[tuple[str, str], Seen]) -> list[_Subject]:
    """Return the mapped signals, and unmapped signals with candidates."""
    reports = inspection.signals if section == "signals" else inspection.truth
    units = SIGNAL_UNITS if section == "signals" else TRUTH_UNITS
    subjects = []
    for name, unit in units.items():
        mine = [c for c in inspection.candidates if c.section == section and c.source.name == name]
        cards = [] if name not in reports else [_taken(inspection, section, reports[name], mine)]
        best = sorted((c for c in mine if not c.taken), key=lambda c: -c.score)[:_ALTERNATIVES]
        cards += [card for c in best for card in _alternative(c, unit, samples)]
        if cards:
            subjects.append(_Subject(name, unit, cards))
    return subjects


def _taken(inspection: Inspection, section: str, report: SignalReport, candidates: Sequence[Candidate]) -> _Card:
    sources = inspection.mapping.signals if section == "signals" else inspection.mapping.truth
    source, candidate = sources[report.name], next((c for c in candidates if c.taken), None)
    kind = next((t.type for t in inspection.topics if t.name == source.topic), "")
    if inspection.mapping.origin == "file":
        why = "named by the mapping file"
    else:
        why = f"recognised type {kind.replace('/msg/', '/')}" if candidate is None else candidate.reason
    doubts = [] if candidate is None or not candidate.doubt else [candidate.doubt]
    if candidate is not None and candidate.source.paths != source.paths:  # the mounting gives another axis
        why, doubts = f"in place of {_label(candidate.source)}, which is {candidate.reason}", []
    subject = report.name if section == "signals" else f"truth.{report.name}"
    bad = [c for c in inspection.checks if c.subject == subject and c.verdict != "passed"]
    doubts += [f"{c.name} {c.verdict}: {c.evidence}" for c in bad if not (doubts and c.name.endswith(".candidate"))]
    low, high = inspection.lines.get((section, report.name), (np.empty(0), np.empty(0)))
    length = "length of the vector" if source.columns > 1 else ""
    figures = _figures(report.minimum, report.maximum, report.unit, report.rate_hz, source)
    return _Card(
        _label(source), "taken" if candidate is None else f"taken {candidate.score:.2f}",
        sparkline(low, high), figures, "; ".join(t for t in (why, length) if t), "; ".join(doubts), taken=True,
    )  # fmt: skip


def _alternative(candidate: Candidate, unit: str, samples: dict[tuple[str, str], Seen]) -> Iterator[_Card]:
    source = candidate.source
    parts = [samples[key] for path in source.paths if (key := (source.topic, path)) in samples]
    if len(parts) < len(source.paths):
        return
    cells = si_of(source, [p.cells for p in parts])
    low, high = float(np.nanmin(cells, initial=np.inf)), float(np.nanmax(cells, initial=-np.inf))
    figures = _figures(low, high, unit, parts[0].rate_hz, source)
    yield _Card(
        _label(source), f"{candidate.score:.2f}", _sketch(cells), figures, candidate.reason, candidate.doubt
    )  # fmt: skip


def _unused(log: DriveLog, pieces: Pieces, used: set[tuple[str, str]]) -> tuple[list[tuple[str, list[_Card]]], int]:
    """Return cards of fields that are neither mapped nor candidates, by topic, and how many are left out."""
    topics: list[tuple[str, list[_Card]]] = []
    left_out = shown = 0
    for topic in log.topics:
        paths = [
            f.path.removesuffix("[]")
            for f in log.fields(topic.name, quiet=True)
            if f.kind in ("number", "bool") and not INNER_ARRAY.search(f.path) and not COVARIANCE.search(f.path)
        ]
        paths = [p for p in paths if (topic.name, p) not in used]
        room = min(_OF_TOPIC, _OTHERS - shown) if topic.messages else 0
        samples = pieces.read({topic.name: paths[:room]}) if paths[:room] else {}
        cards: list[_Card] = []
        for (_, path), seen in samples.items():
            finite = seen.values[np.isfinite(seen.values)]
            if finite.shape[0] and len(cards) < room and (topic.name, path) not in used:
                figures = _figures(float(finite.min()), float(finite.max()), "", seen.rate_hz, None)
                cards.append(_Card(path[:_LABEL_SIGNS], "", _sketch(seen.cells), figures))
        shown += len(cards)
        left_out += max(0, len(paths) - room)
        if cards:
            topics.append((topic.name[:_LABEL_SIGNS], cards))
    return topics, left_out


def _label(source: SignalSource) -> str:
    return printable(source.label, _LABEL_SIGNS)


def _figures(
    low: float, high: float, unit: str, rate_hz: float, source: SignalSource | None
) -> tuple[tuple[str, str], ...]:
    """Return range with unit, rate, and the conversion of raw values to SI."""
    shown = "" if unit == "1" else unit.replace("^2", "²")
    text = f"{number_text(low)} to {number_text(high)} {shown}".strip() if math.isfinite(low) else "no value"
    figures = [("range", text), ("rate", f"{number_text(rate_hz)} Hz")]
    if source is not None and source.scale != 1.0:
        scales = source.scale if isinstance(source.scale, tuple) else (source.scale,)
        figures.append(("scale", ", ".join(f"{s:.6g}" for s in scales)))
    if source is not None and source.offset != 0.0:
        figures.append(("offset", str(source.offset)))
    return tuple(figures)


def _sketch(cells: FloatArray) -> Markup:
    """Draw values on a grid [M] by the smallest and the largest of each column."""
    edges = np.linspace(0, cells.shape[0], min(COLUMNS, cells.shape[0]) + 1).astype(int)
    parts = [cells[a:b] for a, b in pairwise(edges)]
    low = np.array([np.nanmin(p, initial=np.inf) for p in parts])
    high = np.array([np.nanmax(p, initial=-np.inf) for p in parts])
    return sparkline(low, high)


def sparkline(low: FloatArray, high: FloatArray) -> Markup:
    """Return an SVG of columns between ``low`` and ``high`` [C]; those without finite values are gaps."""
    use = np.isfinite(low) & np.isfinite(high)
    if not use.any():
        return Markup('<svg class="spark" viewBox="0 0 200 60" aria-hidden="true"></svg>')
    least, most = float(low[use].min()), float(high[use].max())
    room = most - least if most > least else 1.0
    ys = [np.where(use, 2 + (_HEIGHT - 4) * (most - v) / room, 0.0).round().astype(int) for v in (low, high)]
    if most == least:
        ys = [np.full_like(ys[0], _HEIGHT // 2)] * 2
    path, before = [], False
    for i, (x, y_low, y_high) in enumerate(zip(range(0, 2 * len(use), 2), *ys, strict=True)):
        if use[i]:
            path.append(
                f"{'L' if before else 'M'}{x} {y_high}" + (f"V{y_low}" if y_low != y_high or not before else "")
            )
        before = bool(use[i])
    return Markup('<svg class="spark" viewBox="0 0 {} 60" preserveAspectRatio="none" aria-hidden="true">'
                  '<path d="{}"/></svg>').format(max(2, 2 * len(use) - 2), "".join(path))  # fmt: skip


def write_page(inspection: Inspection, log: DriveLog, file: Path) -> None:
    """Write :func:`inspection_page`. Raise UsageError if ``file`` is the log, OutputError if writing fails."""
    check_no_input([Path(inspection.path)], [file])
    write_bytes(file, inspection_page(inspection, log))
