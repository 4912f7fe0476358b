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
from pdhef_logtool.runs.inspection.rendering import findings_of
from pdhef_logtool.runs.inspection.report import Inspection, SignalReport, mapping_text
from pdhef_logtool.runs.inspection.step_statistics import number_text
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.outputs import check_no_input

#: Height of a sparkline in units of the drawing.
_HEIGHT = 60
#: Parts of the shown pieces of the log with their extremes, and alternatives of one signal.
_PARTS, _ALTERNATIVES = 100, 6
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
    requests: dict[str, list[str]] = {}
    for source in (*inspection.mapping.sources(), *(c.source for c in inspection.candidates if not c.taken)):
        requests.setdefault(source.topic, []).extend(source.paths)
    samples = Pieces(log).read(requests)
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
        cards = [] if name not in reports else [_taken(inspection, section, reports[name], mine, samples)]
        best = sorted((c for c in mine if not c.taken), key=lambda c: -c.score)[:_ALTERNATIVES]
        cards += [card for c in best for card in _alternative(c, unit, samples)]
        if cards:
            subjects.append(_Subject(name, unit, cards))
    return subjects


def _taken(
    inspection: Inspection,
    section: str,
    report: SignalReport,
    candidates: Sequence[Candidate],
    samples: dict[tuple[str, str], Seen],
) -> _Card:
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
    figures = _figures(report.minimum, report.maximum, report.unit, report.rate_hz, source)
    chip = "taken" if candidate is None else f"taken {candidate.score:.2f}"
    cells = _cells(source, samples)
    return _Card(_label(source), chip, sparkline(cells), figures, why, "; ".join(doubts), taken=True)


def _cells(source: SignalSource, samples: dict[tuple[str, str], Seen]) -> FloatArray:
    """Return the values of a source on the grid of the pieces [M], of a vector its length; empty if not sampled."""
    parts = [samples[key].cells for path in source.paths if (key := (source.topic, path)) in samples]
    if len(parts) < len(source.paths):
        return np.empty(0)
    cells = si_of(source, parts)
    return cells if cells.ndim == 1 else np.linalg.norm(cells, axis=1)


def _alternative(candidate: Candidate, unit: str, samples: dict[tuple[str, str], Seen]) -> Iterator[_Card]:
    source, cells = candidate.source, _cells(candidate.source, samples)
    if cells.size:
        low, high = float(np.nanmin(cells, initial=np.inf)), float(np.nanmax(cells, initial=-np.inf))
        figures = _figures(low, high, unit, samples[source.topic, source.paths[0]].rate_hz, source)
        chip = f"{candidate.score:.2f}"
        yield _Card(_label(source), chip, sparkline(cells), figures, candidate.reason, candidate.doubt)


def _label(source: SignalSource) -> str:
    return printable(source.label, _LABEL_SIGNS)


def _figures(low: float, high: float, unit: str, rate_hz: float, source: SignalSource) -> tuple[tuple[str, str], ...]:
    """Return range with unit, rate, and the conversion of raw values to SI."""
    shown = "" if unit == "1" else unit.replace("^2", "²")
    text = f"{number_text(low)} to {number_text(high)} {shown}".strip() if math.isfinite(low) else "no value"
    figures = [("range", text), ("rate", f"{number_text(rate_hz)} Hz")]
    if source.scale != 1.0:
        scales = source.scale if isinstance(source.scale, tuple) else (source.scale,)
        figures.append(("scale", ", ".join(f"{s:.6g}" for s in scales)))
    if source.offset != 0.0:
        figures.append(("offset", str(source.offset)))
    return tuple(figures)


def sparkline(cells: FloatArray) -> Markup:
    """Return an SVG of values on a grid [M]: the extremes of each part; parts without finite values are gaps."""
    edges = np.linspace(0, cells.shape[0], min(_PARTS, cells.shape[0]) + 1).astype(int)
    parts = [cells[a:b] for a, b in pairwise(edges)]
    low = np.array([np.nanmin(p, initial=np.inf) for p in parts])
    high = np.array([np.nanmax(p, initial=-np.inf) for p in parts])
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
