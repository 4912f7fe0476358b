"""An inspection as tables for a terminal of 80 columns or more."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from pdhef_logtool.logs.recording_span import shown_time
from pdhef_logtool.mapping.candidates import Candidate
from pdhef_logtool.records.printable import all_printable
from pdhef_logtool.records.signals import SIGNAL_UNITS, TRUTH_UNITS, is_dated
from pdhef_logtool.runs.inspection.report import Inspection, SignalReport, TopicReport, number_text
from pdhef_logtool.storage.templates import template

#: Candidates of a signal that are shown beside the one that was taken.
CANDIDATES_SHOWN = 2
#: Log time less stamp beyond which the stamps count another time than the recorder's: since boot or another clock, and
#: since the start of a simulation.
OTHER_CLOCK_S, SIMULATION_CLOCK_S = 60.0, 1e8


def render_inspection(inspection: Inspection, console: Console) -> None:
    """Print an inspection: topics, signals and ground truth, missing signals, and findings."""
    messages, topics = sum(t.messages for t in inspection.topics), len(inspection.topics)
    start = f"from {shown_time(inspection.start_ns)}" if is_dated(inspection.start_ns) else "without a date"
    console.print(Text(inspection.path, "bold"), soft_wrap=True)
    console.print(
        f"{inspection.kind}, {inspection.duration_s:.1f} s {start}, {messages} messages on {topics} "
        f"topic{'' if topics == 1 else 's'}"
    )
    if inspection.topics:
        console.print(_topics_table(inspection.topics))
    if inspection.signals or inspection.truth:
        console.print(_sources_table(inspection))
        console.print(_statistics_table(inspection))
    if inspection.candidates:
        console.print(_candidates_table(inspection.candidates))
    for head, style, text in findings_of(inspection):
        line = Table.grid(padding=(0, 1))
        line.add_column(width=9)
        line.add_column(overflow="fold")
        line.add_row(Text(head, style), Text(text))
        console.print(line)


def table_of(title: str, headings: Sequence[str | Text], rows: Iterable[Sequence[Any]], *, words: int) -> Table:
    """Return a table with ``words`` columns of text, then numbers."""
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
    for row in rows:
        table.add_row(*row)
    return table


def _topics_table(topics: tuple[TopicReport, ...]) -> Table:
    encodings = sorted({t.encoding for t in topics})
    name = Text.assemble("topic\n", ("type", "dim"))
    headings = (name, "count", "Hz", "jitter\nms", "longest gap\ns @ s", "delay\nms")

    def row(topic: TopicReport) -> tuple[str | Text, ...]:
        gap = f"{number_text(topic.largest_gap_s)} @ {topic.largest_gap_at_s:.1f}"
        delay, late = number_text(topic.delay_median_s * 1e3), number_text(topic.delay_p95_s * 1e3)
        kind = topic.type.replace("/msg/", "/") + (f" ({topic.encoding})" if len(encodings) > 1 else "")
        return (
            Text.assemble(f"{topic.name}\n", (kind, "dim")),
            str(topic.messages),
            number_text(topic.rate_hz),
            number_text(topic.jitter_p95_s * 1e3),
            gap if math.isfinite(topic.largest_gap_s) else "-",
            _delay_text(topic.delay_median_s) or (delay if delay == late else f"{delay} to {late}"),
        )

    return table_of(f"Topics ({', '.join(encodings)})", headings, map(row, topics), words=1)


def _delay_text(delay_s: float) -> str:
    """Return a remark on a delay that no transport has, or an empty string."""
    if abs(delay_s) > SIMULATION_CLOCK_S:
        return "simulation clock"
    return "other clock" if abs(delay_s) > OTHER_CLOCK_S else ""


def _by_section(
    inspection: Inspection, row: Callable[[SignalReport], Sequence[str | Text]]
) -> Iterator[Sequence[str | Text]]:
    """Yield the rows of signals, and of ground truth below a heading."""
    yield from map(row, inspection.signals.values())
    if inspection.truth:
        yield [Text("truth", "bold")]
        yield from map(row, inspection.truth.values())


def _sources_table(inspection: Inspection) -> Table:
    rows = "recognised types and candidates" if any(c.taken for c in inspection.candidates) else "recognised types"
    origin = rows if inspection.mapping.origin == "auto" else "mapping file"
    stamps = {clock["topic"]: clock["stamp"] for clock in inspection.clocks}

    def row(report: SignalReport) -> tuple[str | Text, ...]:
        return report.name, Text(report.topic), Text(_short(report.field)), stamps.get(report.topic, "")

    headings = ("signal", "topic", "field", "stamp")
    return table_of(f"Mapping ({origin})", headings, _by_section(inspection, row), words=4)


def _candidates_table(candidates: tuple[Candidate, ...]) -> Table:
    """Return the candidates beside recognised types: those taken, and the best others of each signal."""
    rows, shown = [], Counter[str]()
    order = [*SIGNAL_UNITS, *TRUTH_UNITS]
    for item in sorted(candidates, key=lambda c: (c.section, order.index(c.source.name), not c.taken, -c.score)):
        name = f"{'truth ' if item.section == 'truth' else ''}{item.source.name}"
        shown[name] += 1
        if shown[name] <= (1 + CANDIDATES_SHOWN):
            doubt = Text(f"\nunsure: {item.doubt}", "yellow") if item.doubt else ""
            text = Text.assemble(item.source.label, Text(f"\n{item.reason}", "dim"), doubt)
            rows.append((f"{'* ' if item.taken else '  '}{name}", text, f"{item.score:.2f}"))
    return table_of("Candidates by name and physics (* taken)", ("signal", "field and reason", "score"), rows, words=2)


def _statistics_table(inspection: Inspection) -> Table:
    headings = ("signal", "Hz", "delay\nms", "min", "mean", "max", "std", "gaps", "drop")

    def row(report: SignalReport) -> tuple[str, ...]:
        values = (report.rate_hz, report.latency_s * 1e3, report.minimum, report.mean, report.maximum, report.std)
        counts = (report.gaps, sum(report.dropped.values()))
        return report.name, *map(number_text, values), *(str(count or "-") for count in counts)

    return table_of("Values in SI units", headings, _by_section(inspection, row), words=1)


def findings_of(inspection: Inspection) -> list[list[str]]:
    """Return lines of findings: a heading, its style and the text."""
    path = Path(__file__).parents[1] / "templates" / "findings.txt"
    text = template(path).render(i=all_printable(inspection))
    return [line.split("\t") for line in text.splitlines()]


def _short(field: str) -> str:
    """Write several fields of one struct as ``struct.{w,x,y,z}``."""
    stems, _, leaves = zip(*(path.rpartition(".") for path in field.split(", ")), strict=True)
    return f"{stems[0]}.{{{','.join(leaves)}}}" if len(leaves) > 1 and stems[0] and len(set(stems)) == 1 else field
