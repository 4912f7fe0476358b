"""An inspection as an HTML page: each signal with its candidate fields, clocks, checks, and the mapping to paste."""

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from markupsafe import Markup

from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping.channels import si_of
from pdhef_logtool.mapping.evidence import Pieces, Seen
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.records.printable import printable
from pdhef_logtool.records.signals import SIGNAL_UNITS, TRUTH_UNITS, FloatArray
from pdhef_logtool.reports.page import render
from pdhef_logtool.runs.inspection.report import Inspection, findings_of, mapping_text, number_text
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.outputs import check_no_input

#: Height of a sparkline in units of the drawing.
_HEIGHT = 60
#: Parts of the shown pieces of the log with their extremes, and alternatives of one signal.
_PARTS, _ALTERNATIVES = 100, 6


#: A field with its picture, range and rate, the candidate that it was, and the checks that it does not pass.
_Card: TypeAlias = dict[str, Any]


def inspection_page(inspection: Inspection, log: DriveLog) -> bytes:
    """Return the HTML page of an inspection of the open ``log``. The figures show short sections of the log."""
    sources = (*inspection.mapping.sources(), *(c.source for c in inspection.candidates if not c.taken))
    samples = Pieces(log).read((source.topic, path) for source in sources for path in source.paths)
    return render(
        "inspection.html",
        inspection=inspection,
        name=Path(inspection.path).name,
        types={t.name: t.type.replace("/msg/", "/") for t in inspection.topics},
        sections=[
            ("Signals", SIGNAL_UNITS, _cards(inspection, "signals", samples)),
            ("Ground truth", TRUTH_UNITS, _cards(inspection, "truth", samples)),
        ],
        findings=findings_of(inspection),
        # As it is, for it is pasted: render() would cut it and join its lines.
        mapping=Markup("\n").join(printable(line, len(line) * 10 + 1) for line in mapping_text(inspection).split("\n")),
        text=number_text,
    )


def _cards(inspection: Inspection, section: str, samples: Mapping[tuple[str, str], Seen]) -> dict[str, list[_Card]]:
    """Return the fields of each quantity: the mapped one first, then its best alternatives."""
    cards: dict[str, list[_Card]] = {}
    prefix = "" if section == "signals" else "truth."
    candidates = sorted((c for c in inspection.candidates if c.section == section), key=lambda c: -c.score)
    for name, source in getattr(inspection.mapping, section).items():
        report = getattr(inspection, section)[name]
        chosen = next((c for c in candidates if c.taken and c.source.name == name), None)
        bad = [c for c in inspection.checks if c.subject == f"{prefix}{name}" and c.verdict != "passed"]
        picture, low, high = sparkline(_cells(source, samples)), report.minimum, report.maximum
        shown = {"source": source, "candidate": chosen, "picture": picture, "low": low, "high": high}
        cards[name] = [{**shown, "rate_hz": report.rate_hz, "taken": True, "checks": bad}]
    for candidate in candidates:
        source, cells = candidate.source, _cells(candidate.source, samples)
        others = sum(not card["taken"] for card in cards.get(source.name, ()))
        if not candidate.taken and cells.size and others < _ALTERNATIVES:
            low, high = float(np.nanmin(cells, initial=np.inf)), float(np.nanmax(cells, initial=-np.inf))
            rate_hz = samples[source.topic, source.paths[0]].rate_hz
            shown = {"source": source, "candidate": candidate, "picture": sparkline(cells), "low": low, "high": high}
            cards.setdefault(source.name, []).append({**shown, "rate_hz": rate_hz, "taken": False, "checks": ()})
    return cards


def _cells(source: SignalSource, samples: Mapping[tuple[str, str], Seen]) -> FloatArray:
    """Return the values of a source on the grid of the pieces [M], of a vector its length; empty if not sampled."""
    parts = [samples[key].cells for path in source.paths if (key := (source.topic, path)) in samples]
    if len(parts) < len(source.paths):
        return np.empty(0)
    cells = si_of(source, parts)
    return cells if cells.ndim == 1 else np.linalg.norm(cells, axis=1)


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
    goes_on = use & np.append(False, use[:-1])
    path = [
        f"{'L' if on else 'M'}{2 * i} {y_high}" + (f"V{y_low}" if y_low != y_high or not on else "")
        for i, (on, y_low, y_high) in enumerate(zip(goes_on, *ys, strict=True))
        if use[i]
    ]
    return Markup('<svg class="spark" viewBox="0 0 {} 60" preserveAspectRatio="none" aria-hidden="true">'
                  '<path d="{}"/></svg>').format(max(2, 2 * len(use) - 2), "".join(path))  # fmt: skip


def write_page(inspection: Inspection, log: DriveLog, file: Path) -> None:
    """Write :func:`inspection_page`. Raise UsageError if ``file`` is the log, OutputError if writing fails."""
    check_no_input([Path(inspection.path)], [file])
    write_bytes(file, inspection_page(inspection, log))
