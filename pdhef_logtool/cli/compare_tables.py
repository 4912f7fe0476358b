"""What ``pdhef compare`` prints: what else differs, verdicts, the drives behind them, where their tracks part."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.padding import Padding
from rich.text import Text

from pdhef_logtool.cli.console import table
from pdhef_logtool.records.files import write_bytes
from pdhef_logtool.results.changed_signals import TRUTH, ChangedSignal
from pdhef_logtool.results.comparing import ComparedFigure, Comparison
from pdhef_logtool.sinks.junit import Case, cases_bytes

if TYPE_CHECKING:
    from rich.console import Console

_DEG = math.degrees(1.0)
_SHOWN_UNITS = {"rad": ("°", _DEG), "rad/s": ("°/s", _DEG), "m/s^2": ("m/s²", 1.0), "1": ("", 1.0)}
_COLUMN_UNITS = {"rad": "rad", "rad_s": "rad/s", "m_s": "m/s", "m_s2": "m/s^2"}
_BY = {"signals": "what their signals held", "content": "their files", "name": "their names alone"}
#: Drives at either end that are named, tracks that are followed, names that are listed.
_MOST_DRIVES, _MOST_SIGNALS = 5, 8


def render_comparison(found: Comparison, console: Console) -> None:
    """Print a comparison, the verdict last."""
    console.print(Text.assemble(("A ", "bold"), found.a, ("  B ", "bold"), found.b), soft_wrap=True)
    by = ", ".join(f"{count} by {_BY[key]}" for key, count in found.pairs.items())
    pairs = sum(found.pairs.values())
    _line(f"{pairs} drive{'s' * (pairs != 1)} in both, paired {by}", console)
    for line in found.unpaired:
        _line(f"without partner: {line}", console)
    if found.differences:
        console.print("\nWhat else differs", style="bold")
        for line in found.differences:
            _line(line, console)
    if found.changed:
        console.print(f"\n{found.changed} of {pairs} drives have a figure that is not the same bit for bit")
    if found.figures and not found.equal:
        _print_figures(found, console)
    if any(f.drives for f in found.figures) and not found.equal:
        _print_drives(found.figures[0], console)
    if found.signals:
        _print_signals(found, console)
    if found.others:
        _print_others(found.others, console)
    console.print(Text.assemble("\n", ("Verdict: ", "bold"), _verdict(found)))
    for line in found.failures:
        _line(f"gate closed: {line}", console)


def _line(text: str, console: Console) -> None:
    console.print(Padding(text, (0, 0, 0, 2), expand=False))


def _verdict(found: Comparison) -> str:
    if found.verdict == "equal":
        return "equal: all figures of all pairs are the same bit for bit"
    told = {
        "worse": "B is worse",
        "better": "B is better",
        "not worse": "B is not worse",
        "equal": "no figure that was asked for changed",
        "cannot tell": "these drives cannot tell",
        "no figure": "no drive has the figure on both sides (is there truth?)",
    }[found.verdict]
    detectable = [f.detectable for f in found.figures if f.verdict == "cannot tell"]
    if any(math.isfinite(d) for d in detectable):
        told += f"; a worsening of {max(d for d in detectable if math.isfinite(d)):.1%} would have shown"
    elif detectable:
        told += ", as they are too few: at least 5 drives (clusters) are needed"
    return told


def _print_figures(found: Comparison, console: Console) -> None:
    made = table("\nfigure", ">\ndrives", ">median\nchange", ">95 %\ninterval", ">\nmay be", "\nverdict", fold=1)
    for one in found.figures:
        limit = one.figure.limit
        may_be = "-" if limit is None else _percent(limit)
        low, high = (math.expm1(x) for x in (one.change.low, one.change.high))
        interval = f"{_percent(low)} to {_percent(high)}" if math.isfinite(one.change.low) else "-"
        drives = str(one.change.drives) + (f" ({one.change.clusters})" if found.cluster else "")
        made.add_row(one.figure.label, drives, _percent(math.expm1(one.change.median)), interval, may_be, one.verdict)
    console.print()
    console.print(made)
    if found.cluster:
        _line(f"in brackets: clusters by {found.cluster}, which are drawn whole", console)
    for one in found.figures:
        for note in one.notes:
            _line(f"{one.figure.label}: {note}", console)
        if one.neither and one.drives:
            _line(f"{one.figure.label}: {one.neither} drives have it on neither side", console)
        if math.isfinite(one.detectable):
            least = f"{one.detectable:.1%}"
            _line(
                f"{one.figure.label}: the smallest worsening that so many drives show in 4 of 5 cases: {least}", console
            )


def _print_drives(one: ComparedFigure, console: Console) -> None:
    changed = [d for d in one.drives if d.a != d.b]
    if not changed:
        return
    unit, factor = _SHOWN_UNITS.get(one.unit, (one.unit, 1.0))
    shown = changed if len(changed) <= 2 * _MOST_DRIVES else [*changed[:_MOST_DRIVES], *changed[-_MOST_DRIVES:]]
    made = table("drive", f">A {unit}", f">B {unit}", ">change", fold=1)
    for place, drive in enumerate(shown):
        if len(shown) < len(changed) and place == _MOST_DRIVES:
            made.add_row(f"… {len(changed) - len(shown)} more …", "", "", "")
        name = drive.drive if drive.drive == drive.drive_b else f"{drive.drive} ({drive.drive_b} in B)"
        change = "-" if drive.change is None else _percent(drive.change)
        made.add_row(name, f"{drive.a * factor:.4g}", f"{drive.b * factor:.4g}", change)
    console.print(f"\nDrives by {one.figure.label}, worst first", style="bold")
    console.print(made)


def _print_signals(found: Comparison, console: Console) -> None:
    made = table("drive", "track", "signal", ">first, s", ">stamps", ">largest", fold=3)
    shown = _one_a_drive(found)
    for one in shown[:_MOST_SIGNALS]:
        unit, factor = _SHOWN_UNITS.get(_unit_of(one.signal), (_unit_of(one.signal), 1.0))
        largest = "-" if one.largest is None else f"{one.largest * factor:.3g} {unit}"
        made.add_row(one.drive, one.track, one.signal, f"{one.first_s:.2f}", f"{one.stamps}/{one.of}", largest)
    console.print(
        f"\nWhere the tracks part ({found.followed} of {found.changed} changed drives looked at)", style="bold"
    )
    console.print(made)
    if more := len(found.signals) - len(shown[:_MOST_SIGNALS]):
        _line(f"{more} more signals of these drives in --json", console)


def _one_a_drive(found: Comparison) -> list[ChangedSignal]:
    """Return the signal that was asked about of each drive, else its first, and of a truth that changed its first."""
    asked = found.figures[0].figure.signal
    shown: dict[tuple[str, bool], ChangedSignal] = {}
    for one in found.signals:
        key = (one.drive, one.track == TRUTH)
        if key not in shown or (one.signal == asked and one.track != TRUTH):
            shown[key] = one
    return list(shown.values())


def _unit_of(column: str) -> str:
    plain = column.replace("_std", "")
    return next((unit for end, unit in sorted(_COLUMN_UNITS.items(), reverse=True) if plain.endswith(f"_{end}")), "1")


def _print_others(others: Sequence[ComparedFigure], console: Console) -> None:
    made = table("beside it, no gate", ">drives", ">median", ">p (Holm)", "", fold=1)
    for one in others:
        p = 1.0 if one.corrected_p is None else one.corrected_p
        made.add_row(
            f"{one.figure.signal} {one.figure.metric} ({one.figure.segment})",
            str(one.change.drives),
            _percent(math.expm1(one.change.median)),
            f"{p:.2g}",
            "changed" if p < 0.05 else "",
        )
    console.print()
    console.print(made)


def _percent(share: float) -> str:
    """Return a share with its sign; one too small for a digit keeps its sign, so that it does not pass for none."""
    if not math.isfinite(share):
        return "-" if math.isnan(share) else "+∞"
    if share and abs(share) < 5e-4:
        return f"{'+' if share > 0 else '-'}<0.1 %"
    return f"{share * 100:+.1f} %" if share else "0 %"


def write_comparison_junit(path: Path, found: Comparison) -> None:
    """Write the verdicts of the figures, and of the drives' partners, as JUnit XML; raises OutputError."""
    cases = [_figure_case(one, found) for one in found.figures]
    lost = () if found.allow_unpaired or not found.gated else found.unpaired
    reason = "; ".join(found.unpaired)
    partners = "drives without partner"
    cases.append(Case("compare", "drives", "every drive has a partner", partners, bool(lost), reason, reason or None))
    write_bytes(path, cases_bytes({"compare": cases}))


def _figure_case(one: ComparedFigure, found: Comparison) -> Case:
    closed = [line for line in found.failures if line.startswith(f"{one.figure.label}: ")]
    median, low, high = (_percent(math.expm1(x)) for x in (one.change.median, one.change.low, one.change.high))
    limit = "no limit" if one.figure.limit is None else f"limit {_percent(one.figure.limit)}"
    told = f"{one.verdict}: median {median} (95 %: {low} to {high}) of {one.change.drives} drives, {limit}"
    return Case("compare", one.figure.estimator, one.figure.label, one.verdict, bool(closed), told, told)
