"""Output of ``pdhef events``, and of ``compare``: history, other differences, verdicts, and their drives."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.console import Console
from rich.text import Text

from pdhef_logtool.cli.console import print_indented, table, three_lines
from pdhef_logtool.cli.run_tables import plan_line, render_plan
from pdhef_logtool.evaluation.statistics import gathered
from pdhef_logtool.evaluation.units import read_unit
from pdhef_logtool.records.printable import listed
from pdhef_logtool.results import comparing
from pdhef_logtool.results.comparing import ComparedFigure, Comparison
from pdhef_logtool.results.events import FoundEvents

#: Number of drives at either end of a list.
_MOST_DRIVES = 5


def render_comparison(comparison: Comparison, console: Console) -> None:
    """Print a comparison: verdict, assumptions and next step, then their basis."""
    requirements = comparison.requirements
    verdict = "; gate closed: ".join((comparing.sentence("verdict", comparison), *comparison.failures))
    result = verdict if requirements is None else Text.assemble(verdict, "; ", plan_line(requirements.to_dict()))
    console.print(
        three_lines(result, comparing.sentence("assumed", comparison), comparing.sentence("next", comparison))
    )
    if comparison.history:
        heads, rows = comparing.history_table(comparison)
        _print(rows, console, *heads, fold=4)
    console.print()
    console.print(Text.assemble(("A ", "bold"), comparison.a, ("  B ", "bold"), comparison.b), soft_wrap=True)
    for line in comparison.unpaired:
        print_indented(f"without partner: {line}", console)
    if comparison.differences:
        console.print("\nOther differences", style="bold")
        for line in comparison.differences:
            print_indented(line, console)
    console.print(f"\n{comparing.sentence('changes', comparison)}")
    if not comparison.equal:
        _print_figures(comparison, console)
        _print_drives(comparison.figures[0], console)
    if comparison.others:
        _print_others(comparison.others, console)
    if requirements is not None:
        console.print("\nPlan on B", style="bold")
        render_plan(requirements, console)


def _print(rows: Sequence[Sequence[str]], console: Console, *heads: str, fold: int = 1) -> None:
    console.print()
    console.print(table(*heads, rows=rows, fold=fold))


def _print_figures(comparison: Comparison, console: Console) -> None:
    rows = []
    for row in comparison.figures:
        may_be = "-" if row.limit is None else comparing.percent(row.limit)
        drives = str(row.change.drives) + (f" ({row.change.clusters})" if comparison.cluster else "")
        median = comparing.percent(math.expm1(row.change.median))
        rows.append([row.requirement.name, drives, median, comparing.interval_text(row), may_be, row.verdict])
    _print(rows, console, "figure", ">drives", ">median\nchange", ">95 %\ninterval", ">limit", "verdict")
    for note in comparing.notes_of(comparison):
        print_indented(note, console)


def _print_drives(figure: ComparedFigure, console: Console) -> None:
    changed = [d for d in figure.drives if d["a"] != d["b"]]
    if not changed:
        return
    unit, factor = read_unit(figure.unit)
    rows = []
    for drive in changed:
        name = drive["drive"] + ("" if drive["drive"] == drive["drive_b"] else f" ({drive['drive_b']} in B)")
        change = "-" if drive["change"] is None else comparing.percent(drive["change"])
        rows.append([name, *(f"{drive[side] * factor:.3g}" for side in "ab"), change])
    if (more := len(rows) - 2 * _MOST_DRIVES) > 0:
        rows[_MOST_DRIVES:-_MOST_DRIVES] = [[f"… {more} more …", "", "", ""]]
    console.print(f"\nDrives by {figure.requirement.name}, worst first", style="bold", end="")
    _print(rows, console, "drive", f">A {unit}", f">B {unit}", ">change")


def _print_others(others: Sequence[ComparedFigure], console: Console) -> None:
    rows = []
    for row in others:
        p = 1.0 if row.corrected_p is None else row.corrected_p
        median, changed = comparing.percent(math.expm1(row.change.median)), "changed" if p < 0.05 else ""
        rows.append([row.requirement.name, str(row.change.drives), median, f"{p:.2g}", changed])
    _print(rows, console, "other figures", ">drives", ">median", ">p (Holm)", "")


#: Largest number of events in the output.
_MOST_EVENTS = 50


def render_events(events: FoundEvents, console: Console) -> None:
    """Print the events, and the drives that were not searched."""
    total_s = sum(e.end_s - e.start_s for e in events.events)
    drives, count = len({e.drive for e in events.events}), len(events.events)
    summary = f"{count} event{'s' * (count != 1)} in {drives} of {events.searched} drives, {total_s:.2f} s in all"
    left_out = f"; {len(events.left_out)} drives are not searched, see below" if events.left_out else ""
    following = "no action needed" if not count or events.clips else "--clip writes one MCAP file per event"
    console.print(three_lines(summary, f"{events.where} of {events.of}{left_out}", following))
    console.print()
    if events.events:
        made = table("drive", ">from, s", ">to, s", ">for, s", ">peak", fold=1)
        for event in events.events[:_MOST_EVENTS]:
            peak = "-" if event.peak is None else f"{event.peak:.4g}"
            lasts = f"{event.end_s - event.start_s:.2f}"
            made.add_row(event.drive, f"{event.start_s:.2f}", f"{event.end_s:.2f}", lasts, peak)
        console.print(made)
        if (more := len(events.events) - _MOST_EVENTS) > 0:
            console.print(f"  and {more} more: --json")
    for reason, names in gathered((reason, drive) for drive, reason in events.left_out.items()).items():
        console.print(f"not searched, {reason}: {listed(names)}")
    for clip in events.clips:
        console.print(f"clip: {clip}", soft_wrap=True)
