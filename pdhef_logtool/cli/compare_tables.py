"""Output of ``pdhef compare``: other differences, verdicts, and their drives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.text import Text

from pdhef_logtool.cli.console import print_indented, table, three_lines
from pdhef_logtool.cli.plan_tables import plan_line, render_plan
from pdhef_logtool.evaluation.units import read_unit
from pdhef_logtool.results.comparing import ComparedFigure, Comparison
from pdhef_logtool.results.comparison_words import (
    assumed_text,
    interval_text,
    next_text,
    notes_of,
    percent,
    verdict_text,
)
from pdhef_logtool.results.junit import Case, cases_bytes, plan_cases
from pdhef_logtool.storage.files import write_bytes

if TYPE_CHECKING:
    from rich.console import Console

#: Number of drives at either end of a list.
_MOST_DRIVES = 5


def render_comparison(comparison: Comparison, console: Console) -> None:
    """Print a comparison: verdict, assumptions and next step, then their basis."""
    requirements = comparison.requirements
    said = "; gate closed: ".join((verdict_text(comparison), *comparison.failures))
    result = said if requirements is None else Text.assemble(said, "; ", plan_line(requirements))
    console.print(three_lines(result, assumed_text(comparison), next_text(comparison)))
    console.print()
    console.print(Text.assemble(("A ", "bold"), comparison.a, ("  B ", "bold"), comparison.b), soft_wrap=True)
    for line in comparison.unpaired:
        print_indented(f"without partner: {line}", console)
    if comparison.differences:
        console.print("\nOther differences", style="bold")
        for line in comparison.differences:
            print_indented(line, console)
    if comparison.changed:
        which = "another changed figure" if comparison.verdict == "equal" else "a changed figure"
        console.print(f"\n{comparison.changed} of {sum(comparison.pairs.values())} drives have {which}")
    if comparison.figures and not comparison.equal:
        _print_figures(comparison, console)
    if any(f.drives for f in comparison.figures) and not comparison.equal:
        _print_drives(comparison.figures[0], console)
    if comparison.others:
        _print_others(comparison.others, console)
    if requirements is not None:
        console.print("\nPlan on B", style="bold")
        render_plan(requirements, console)


def _print_figures(comparison: Comparison, console: Console) -> None:
    made = table("\nfigure", ">\ndrives", ">median\nchange", ">95 %\ninterval", ">\nlimit", "\nverdict", fold=1)
    for row in comparison.figures:
        limit = row.figure.limit
        may_be = "-" if limit is None else percent(limit)
        interval = interval_text(row)
        drives = str(row.change.drives) + (f" ({row.change.clusters})" if comparison.cluster else "")
        made.add_row(row.figure.label, drives, percent(math.expm1(row.change.median)), interval, may_be, row.verdict)
    console.print()
    console.print(made)
    for note in notes_of(comparison):
        print_indented(note, console)


def _print_drives(figure: ComparedFigure, console: Console) -> None:
    changed = [d for d in figure.drives if d.a != d.b]
    if not changed:
        return
    unit, factor = read_unit(figure.unit)
    shown = changed if len(changed) <= 2 * _MOST_DRIVES else [*changed[:_MOST_DRIVES], *changed[-_MOST_DRIVES:]]
    made = table("drive", f">A {unit}", f">B {unit}", ">change", fold=1)
    for place, drive in enumerate(shown):
        if len(shown) < len(changed) and place == _MOST_DRIVES:
            made.add_row(f"… {len(changed) - len(shown)} more …", "", "", "")
        name = drive.drive if drive.drive == drive.drive_b else f"{drive.drive} ({drive.drive_b} in B)"
        change = "-" if drive.change is None else percent(drive.change)
        made.add_row(name, f"{drive.a * factor:.3g}", f"{drive.b * factor:.3g}", change)
    console.print(f"\nDrives by {figure.figure.label}, worst first", style="bold")
    console.print(made)


def _print_others(others: Sequence[ComparedFigure], console: Console) -> None:
    made = table("other figures", ">drives", ">median", ">p (Holm)", "", fold=1)
    for figure in others:
        p = 1.0 if figure.corrected_p is None else figure.corrected_p
        made.add_row(
            f"{figure.figure.signal} {figure.figure.metric} ({figure.figure.segment})",
            str(figure.change.drives),
            percent(math.expm1(figure.change.median)),
            f"{p:.2g}",
            "changed" if p < 0.05 else "",
        )
    console.print()
    console.print(made)


def write_comparison_junit(path: Path, comparison: Comparison) -> None:
    """Write the verdicts of the figures, and of the drives' partners, as JUnit XML; raises OutputError."""
    cases = [_figure_case(row, comparison) for row in comparison.figures]
    lost = () if comparison.allow_unpaired or not comparison.gated else comparison.unpaired
    reason = "; ".join(comparison.unpaired)
    partners = "drives without partner"
    cases.append(Case("compare", "drives", "every drive has a partner", partners, bool(lost), reason, reason or None))
    plan = {} if comparison.requirements is None else plan_cases(comparison.requirements)
    write_bytes(path, cases_bytes({**plan, "compare": cases}))


def _figure_case(row: ComparedFigure, comparison: Comparison) -> Case:
    closed = [line for line in comparison.failures if line.startswith(f"{row.figure.label}: ")]
    median = percent(math.expm1(row.change.median))
    limit = "no limit" if row.figure.limit is None else f"limit {percent(row.figure.limit)}"
    text = f"{row.verdict}: median {median} (95 %: {interval_text(row)}) of {row.change.drives} drives, {limit}"
    return Case("compare", row.figure.estimator, row.figure.label, row.verdict, bool(closed), text, text)
