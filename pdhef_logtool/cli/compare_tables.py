"""What ``pdhef compare`` prints: what else differs, verdicts, the drives behind them, where their tracks part."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.padding import Padding
from rich.text import Text

from pdhef_logtool.cli.console import table
from pdhef_logtool.cli.plan_tables import plan_line, render_plan
from pdhef_logtool.evaluation.units import read_unit
from pdhef_logtool.results.comparing import ComparedFigure, Comparison
from pdhef_logtool.results.comparison_words import (
    interval_text,
    largest_text,
    notes_of,
    one_signal_a_drive,
    paired_text,
    percent,
    verdict_text,
)
from pdhef_logtool.results.junit import Case, cases_bytes, plan_cases
from pdhef_logtool.storage.files import write_bytes

if TYPE_CHECKING:
    from rich.console import Console

#: Drives at either end that are named, tracks that are followed, names that are listed.
_MOST_DRIVES, _MOST_SIGNALS = 5, 8


def render_comparison(found: Comparison, console: Console) -> None:
    """Print a comparison, the verdict last."""
    console.print(Text.assemble(("A ", "bold"), found.a, ("  B ", "bold"), found.b), soft_wrap=True)
    _line(paired_text(found), console)
    for line in found.unpaired:
        _line(f"without partner: {line}", console)
    if found.differences:
        console.print("\nWhat else differs", style="bold")
        for line in found.differences:
            _line(line, console)
    if found.changed:
        console.print(
            f"\n{found.changed} of {sum(found.pairs.values())} drives have a figure that is not the same bit for bit"
        )
    if found.figures and not found.equal:
        _print_figures(found, console)
    if any(f.drives for f in found.figures) and not found.equal:
        _print_drives(found.figures[0], console)
    if found.signals:
        _print_signals(found, console)
    if found.others:
        _print_others(found.others, console)
    console.print(Text.assemble("\n", ("Verdict: ", "bold"), verdict_text(found)))
    for line in found.failures:
        _line(f"gate closed: {line}", console)
    if found.requirements is not None:
        console.print(Text.assemble("\n", ("Plan on B: ", "bold"), plan_line(found.requirements)))
        render_plan(found.requirements, console)


def _line(text: str, console: Console) -> None:
    console.print(Padding(text, (0, 0, 0, 2), expand=False))


def _print_figures(found: Comparison, console: Console) -> None:
    made = table("\nfigure", ">\ndrives", ">median\nchange", ">95 %\ninterval", ">\nmay be", "\nverdict", fold=1)
    for one in found.figures:
        limit = one.figure.limit
        may_be = "-" if limit is None else percent(limit)
        interval = interval_text(one)
        drives = str(one.change.drives) + (f" ({one.change.clusters})" if found.cluster else "")
        made.add_row(one.figure.label, drives, percent(math.expm1(one.change.median)), interval, may_be, one.verdict)
    console.print()
    console.print(made)
    for note in notes_of(found):
        _line(note, console)


def _print_drives(one: ComparedFigure, console: Console) -> None:
    changed = [d for d in one.drives if d.a != d.b]
    if not changed:
        return
    unit, factor = read_unit(one.unit)
    shown = changed if len(changed) <= 2 * _MOST_DRIVES else [*changed[:_MOST_DRIVES], *changed[-_MOST_DRIVES:]]
    made = table("drive", f">A {unit}", f">B {unit}", ">change", fold=1)
    for place, drive in enumerate(shown):
        if len(shown) < len(changed) and place == _MOST_DRIVES:
            made.add_row(f"… {len(changed) - len(shown)} more …", "", "", "")
        name = drive.drive if drive.drive == drive.drive_b else f"{drive.drive} ({drive.drive_b} in B)"
        change = "-" if drive.change is None else percent(drive.change)
        made.add_row(name, f"{drive.a * factor:.4g}", f"{drive.b * factor:.4g}", change)
    console.print(f"\nDrives by {one.figure.label}, worst first", style="bold")
    console.print(made)


def _print_signals(found: Comparison, console: Console) -> None:
    made = table("drive", "track", "signal", ">first, s", ">stamps", ">largest", fold=3)
    shown = one_signal_a_drive(found)
    for one in shown[:_MOST_SIGNALS]:
        made.add_row(
            one.drive, one.track, one.signal, f"{one.first_s:.2f}", f"{one.stamps}/{one.of}", largest_text(one)
        )
    console.print(
        f"\nWhere the tracks part ({found.followed} of {found.changed} changed drives looked at)", style="bold"
    )
    console.print(made)
    if more := len(found.signals) - len(shown[:_MOST_SIGNALS]):
        _line(f"{more} more signals of these drives in --json", console)


def _print_others(others: Sequence[ComparedFigure], console: Console) -> None:
    made = table("beside it, no gate", ">drives", ">median", ">p (Holm)", "", fold=1)
    for one in others:
        p = 1.0 if one.corrected_p is None else one.corrected_p
        made.add_row(
            f"{one.figure.signal} {one.figure.metric} ({one.figure.segment})",
            str(one.change.drives),
            percent(math.expm1(one.change.median)),
            f"{p:.2g}",
            "changed" if p < 0.05 else "",
        )
    console.print()
    console.print(made)


def write_comparison_junit(path: Path, found: Comparison) -> None:
    """Write the verdicts of the figures, and of the drives' partners, as JUnit XML; raises OutputError."""
    cases = [_figure_case(one, found) for one in found.figures]
    lost = () if found.allow_unpaired or not found.gated else found.unpaired
    reason = "; ".join(found.unpaired)
    partners = "drives without partner"
    cases.append(Case("compare", "drives", "every drive has a partner", partners, bool(lost), reason, reason or None))
    plan = {} if found.requirements is None else plan_cases(found.requirements)
    write_bytes(path, cases_bytes({**plan, "compare": cases}))


def _figure_case(one: ComparedFigure, found: Comparison) -> Case:
    closed = [line for line in found.failures if line.startswith(f"{one.figure.label}: ")]
    median = percent(math.expm1(one.change.median))
    limit = "no limit" if one.figure.limit is None else f"limit {percent(one.figure.limit)}"
    told = f"{one.verdict}: median {median} (95 %: {interval_text(one)}) of {one.change.drives} drives, {limit}"
    return Case("compare", one.figure.estimator, one.figure.label, one.verdict, bool(closed), told, told)
