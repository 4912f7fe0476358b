"""An inspection as tables for a terminal of 80 columns or more."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from rich import box
from rich.table import Table
from rich.text import Text

from pdhef_logtool.logs.recording_span import shown_time
from pdhef_logtool.mapping.candidates import Candidate
from pdhef_logtool.records.signals import SIGNAL_UNITS, TRUTH_UNITS
from pdhef_logtool.runs.inspection.report import Inspection, TopicReport

if TYPE_CHECKING:
    from rich.console import Console

#: Candidates of a signal that are shown beside the one that was taken.
CANDIDATES_SHOWN = 2
#: Log time less stamp beyond which the stamps count another time than the recorder's: since boot or another clock, and
#: since the start of a simulation.
OTHER_CLOCK_S, SIMULATION_CLOCK_S = 60.0, 1e8


def render_inspection(inspection: Inspection, console: Console) -> None:
    """Print an inspection: topics, signals and ground truth, missing signals, and findings."""
    messages = sum(t.messages for t in inspection.topics)
    console.print(Text(inspection.path, "bold"), soft_wrap=True)
    console.print(
        f"{inspection.kind}, {inspection.duration_s:.1f} s from {shown_time(inspection.start_ns)}, {messages} messages "
        f"on {len(inspection.topics)} topics"
    )
    if inspection.sample is not None:
        console.print(Text(str(inspection.sample), "cyan"))
    if inspection.topics:
        console.print(_topics_table(inspection.topics))
    if inspection.signals or inspection.truth:
        console.print(_sources_table(inspection))
        console.print(_statistics_table(inspection))
    if inspection.candidates:
        console.print(_candidates_table(inspection.candidates))
    for head, style, text in (*findings_of(inspection), *_uses(inspection)):
        line = Table.grid(padding=(0, 1))
        line.add_column(width=9)
        line.add_column(overflow="fold")
        line.add_row(Text(head, style), Text(text))
        console.print(line)


def empty_table(title: str, *headings: str | Text, words: int) -> Table:
    """Return an empty table with ``words`` columns of text, then numbers."""
    table = Table(
        title=Text(title),
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for i, heading in enumerate(headings):
        if i < words:
            # Names of signals are short and are looked up; topics and fields may be of any length.
            table.add_column(heading, overflow="fold", no_wrap=heading == "signal")
        else:
            table.add_column(heading, justify="right", no_wrap=True)
    return table


def _topics_table(topics: tuple[TopicReport, ...]) -> Table:
    encodings = sorted({t.encoding for t in topics})
    headings = (
        Text.assemble("topic\n", ("type", "dim")),
        "count",
        "Hz",
        "jitter\nms",
        "longest gap\ns @ s",
        "delay\nms",
    )
    table = empty_table(f"Topics ({', '.join(encodings)})", *headings, words=1)
    for topic in topics:
        gap = "-"
        if math.isfinite(topic.largest_gap_s):
            gap = f"{number_text(topic.largest_gap_s)} @ {topic.largest_gap_at_s:.1f}"
        delay, late = number_text(topic.delay_median_s * 1e3), number_text(topic.delay_p95_s * 1e3)
        kind = topic.type.replace("/msg/", "/") + (f" ({topic.encoding})" if len(encodings) > 1 else "")
        table.add_row(
            Text.assemble(f"{topic.name}\n", (kind, "dim")),
            str(topic.messages),
            number_text(topic.rate_hz),
            number_text(topic.jitter_p95_s * 1e3),
            gap,
            _delay_text(topic.delay_median_s) or (delay if delay == late else f"{delay} to {late}"),
        )
    return table


def _delay_text(delay_s: float) -> str:
    """Return a remark on a delay that no transport has, or an empty string."""
    if abs(delay_s) > SIMULATION_CLOCK_S:
        return "simulation clock"
    return "other clock" if abs(delay_s) > OTHER_CLOCK_S else ""


def _sources_table(inspection: Inspection) -> Table:
    rows = "recognised types and candidates" if any(c.taken for c in inspection.candidates) else "recognised types"
    origin = rows if inspection.mapping.origin == "auto" else "mapping file"
    table = empty_table(f"Mapping ({origin})", "signal", "topic", "field", "stamp", words=4)
    stamps = {clock.topic: clock.stamp for clock in inspection.clocks}
    for section in (inspection.signals, inspection.truth):
        for report in section.values():
            table.add_row(report.name, Text(report.topic), Text(_short(report.field)), stamps.get(report.topic, ""))
        if section is inspection.signals and inspection.truth:
            table.add_row(Text("truth", "bold"), "", "", "")
    return table


def _candidates_table(candidates: tuple[Candidate, ...]) -> Table:
    """Return the candidates beside recognised types: those taken, and the best others of each signal."""
    table = empty_table("Candidates by name and physics (* taken)", "signal", "field and reason", "score", words=2)
    shown: dict[str, int] = {}
    order = [*SIGNAL_UNITS, *TRUTH_UNITS]
    for item in sorted(candidates, key=lambda c: (c.section, order.index(c.source.name), not c.taken, -c.score)):
        name = f"{'truth ' if item.section == 'truth' else ''}{item.source.name}"
        shown[name] = shown.get(name, 0) + 1
        if shown[name] <= (1 + CANDIDATES_SHOWN):
            doubt = Text(f"\nunsure: {item.doubt}", "yellow") if item.doubt else ""
            text = Text.assemble(item.source.label, Text(f"\n{item.reason}", "dim"), doubt)
            table.add_row(f"{'* ' if item.taken else '  '}{name}", text, f"{item.score:.2f}")
    return table


def _uses(inspection: Inspection) -> list[tuple[str, str, str]]:
    """Return the last lines: uses of the log, and missing signals."""
    uses = inspection.uses
    lines = [("can", "green", f"Possible uses of this log: {uses['can']}")]
    if uses["sideslip_needs"]:
        lines.append(("needs", "yellow", f"sideslip estimation still needs: {uses['sideslip_needs']}"))
        if any(not c.taken for c in inspection.candidates):
            lines.append(("next", "cyan", "pdhef map LOG builds a mapping.toml interactively from the candidates"))
        else:
            lines.append(("next", "cyan", "pdhef inspect LOG --fields lists all numeric fields of the log"))
    return lines


def _statistics_table(inspection: Inspection) -> Table:
    headings = ("signal", "Hz", "delay\nms", "min", "mean", "max", "std", "gaps", "drop")
    table = empty_table("Values in SI units", *headings, words=1)
    for section in (inspection.signals, inspection.truth):
        for report in section.values():
            dropped = sum(report.dropped.values())
            values = (report.rate_hz, report.latency_s * 1e3, report.minimum, report.mean, report.maximum, report.std)
            table.add_row(report.name, *map(number_text, values), str(report.gaps or "-"), str(dropped or "-"))
        if section is inspection.signals and inspection.truth:
            table.add_row(Text("truth", "bold"), *[""] * 8)
    return table


def findings_of(inspection: Inspection) -> list[tuple[str, str, str]]:
    """Return lines of findings: a heading, its style and the text."""
    rows: list[tuple[str, str, str]] = []
    if inspection.missing:
        rows.append(("missing", "yellow", ", ".join(inspection.missing)))
    if not inspection.truth:
        rows.append(("missing", "yellow", "ground truth: needed to score an estimate"))
    rows += [("ambiguous", "yellow", str(a)) for a in inspection.ambiguities]
    for verdict, style in (("failed", "red"), ("undecided", "yellow")):
        checks = [c for c in inspection.checks if c.verdict == verdict]
        rows += [(verdict, style, f"{c.name}: {c.evidence}; {c.remedy}") for c in checks]
    if passed := [c for c in inspection.checks if c.verdict == "passed"]:
        subjects = ", ".join(dict.fromkeys(c.subject for c in passed))
        rows.append(("passed", "green", f"{len(passed)} checks of {subjects}"))
    for loss in inspection.lost:
        facts = [f"{loss.count} times"] if loss.count is not None and loss.count != 1 else []
        if loss.start_ns is not None:
            until = "" if loss.end_ns is None else f" to {(loss.end_ns - inspection.start_ns) * 1e-9:.2f} s"
            facts.append(f"from {(loss.start_ns - inspection.start_ns) * 1e-9:.2f} s{until}")
        head, style = ("lost", "red") if loss.severity == "lost" else ("note", "cyan")
        rows.append((head, style, f"{loss.where}: {loss.what}{' (' + ', '.join(facts) + ')' if facts else ''}"))
    rows += [("note", "cyan", n) for n in inspection.notes]
    if inspection.mapping.quality is not None:
        rows.append(("note", "cyan", f"ground truth is used where {inspection.mapping.quality.describe()}"))
    return rows


def _short(field: str) -> str:
    """Write several fields of one struct as ``struct.{w,x,y,z}``."""
    stems, _, leaves = zip(*(path.rpartition(".") for path in field.split(", ")), strict=True)
    return f"{stems[0]}.{{{','.join(leaves)}}}" if len(leaves) > 1 and stems[0] and len(set(stems)) == 1 else field


def number_text(value: float) -> str:
    """Return a number in few digits, a dash without one."""
    if not math.isfinite(value):
        return "-"
    if value == 0.0:
        return "0"
    if 100.0 <= abs(value) < 1e5:
        return f"{value:.0f}"
    return f"{value:.3g}" if 1e-4 <= abs(value) < 1e4 else f"{value:.1e}"
