"""A comparison in words, the same in the terminal, on the page and in JUnit."""

from __future__ import annotations

import math

from pdhef_logtool.evaluation.requirement_verdicts import next_steps
from pdhef_logtool.evaluation.units import SCORED_SIGNALS, read_unit
from pdhef_logtool.results.changed_signals import ChangedSignal
from pdhef_logtool.results.comparing import INDEPENDENT, ComparedFigure, Comparison
from pdhef_logtool.results.paired_change import LEAST_CLUSTERS
from pdhef_logtool.results.sink import TRUTH

_BY = {"signals": "the content of their signals", "content": "the hashes of their files", "name": "their names alone"}


def paired_text(comparison: Comparison) -> str:
    """Return the number of drives in both runs, and how they were paired."""
    pairs = sum(comparison.pairs.values())
    by = ", ".join(f"{count} by {_BY[key]}" for key, count in comparison.pairs.items())
    if len(comparison.pairs) == 1:
        by = by.partition(" ")[2]
    return f"{pairs} drive{'s' * (pairs != 1)} in both, paired {by}"


def verdict_text(comparison: Comparison) -> str:
    """Return the verdict in a sentence."""
    if comparison.equal and comparison.verdict == "equal":
        return "equal: all figures of all pairs are the same bit for bit"
    text = {
        "worse": "B is worse",
        "better": "B is better",
        "not worse": "B is not worse",
        "equal": "no figure that was asked for changed",
        "inconclusive": "inconclusive with these drives",
        "no figure": "no drive has the figure on both sides (is there ground truth?)",
    }[comparison.verdict]
    decisive = [f for f in comparison.figures if f.verdict == comparison.verdict]
    if comparison.verdict == "no figure":
        return f"{text}: {', '.join(f.figure.label for f in decisive)}"
    changes = [f"{f.figure.short} {change_text(f)} of {f.change.drives} drives" for f in decisive]
    return f"{text}: {', '.join(changes)}" if changes and comparison.verdict != "equal" else text


def assumed_text(comparison: Comparison) -> str:
    """Return the assumptions of the verdict."""
    dependence = next((dependence_text(f, comparison.cluster) for f in comparison.figures if f.drives), "")
    differences = "the other differences (below) count as part of B"
    return "; ".join(
        filter(None, [dependence.rstrip("."), paired_text(comparison), differences if comparison.differences else ""])
    )


def next_text(comparison: Comparison) -> str:
    """Return the next step."""
    plan, verdict = comparison.requirements, comparison.verdict
    steps = next_steps(None if plan is None else plan.to_dict())
    if comparison.unpaired and not comparison.allow_unpaired:
        steps = ["run both on the same drives, or accept the difference: --allow-unpaired", *steps]
    if verdict == "worse":
        worst = next(f for f in comparison.figures if f.verdict == "worse").drives[0]
        steps.append(f"look at {worst.drive} first: its error increased most")
    elif verdict == "inconclusive":
        detectable = [f.detectable for f in comparison.figures if f.verdict == verdict and math.isfinite(f.detectable)]
        steps.append(
            f"compare more drives; these detect an increase of {percent(max(detectable))} with 80 % power"
            if detectable
            else f"compare at least {LEAST_CLUSTERS} independent drives or clusters (design effect)"
        )
    elif verdict == "no figure":
        steps.append("compare drives with ground truth, or another --metric")
    return steps[0] if steps else "nothing is needed"


def notes_of(comparison: Comparison) -> list[str]:
    """Return remarks on the requested figures, a line each."""
    asked = [f for f in comparison.figures if f.drives and not comparison.equal]
    texts = {f.figure.label: dependence_text(f, comparison.cluster) for f in asked}
    alike = len(set(texts.values())) == 1
    notes = [*dict.fromkeys(text if alike else f"{label}: {text}" for label, text in texts.items())]
    for figure in comparison.figures:
        notes += [f"{figure.figure.label}: {note}" for note in figure.notes]
        if figure.neither and figure.drives:
            notes.append(f"{figure.figure.label}: {figure.neither} drives have it on neither side")
        if math.isfinite(figure.detectable):
            least = percent(figure.detectable)
            notes.append(f"{figure.figure.label}: smallest increase that these drives detect with 80 % power: {least}")
    return notes


def change_text(figure: ComparedFigure) -> str:
    """Return the median change with its interval: ``+3.1 % (+1.0 % to +5.2 %)``."""
    median, interval = percent(math.expm1(figure.change.median)), interval_text(figure)
    return median if interval == "-" else f"{median} ({interval})"


def dependence_text(figure: ComparedFigure, cluster: str | None) -> str:
    """Return the design effect of the drives and its known causes."""
    of = figure.change.dependence
    if cluster == INDEPENDENT:
        return "Drives are assumed independent (--cluster none)."
    if cluster is not None:
        return f"Design effect {of.design_effect:.2g} of {figure.change.clusters} clusters by {cluster}."
    return of.text(figure.change.drives)


def interval_text(figure: ComparedFigure) -> str:
    """Return the 95 % interval of the median change, a dash without."""
    low, high = (math.expm1(x) for x in (figure.change.low, figure.change.high))
    return f"{percent(low)} to {percent(high)}" if math.isfinite(figure.change.low) else "-"


def one_signal_a_drive(comparison: Comparison) -> list[ChangedSignal]:
    """Return the signal that was asked about of each drive, else its first, and the first of a changed ground truth."""
    asked = comparison.figures[0].figure.signal
    shown: dict[tuple[str, bool], ChangedSignal] = {}
    for signal in comparison.signals:
        key = (signal.drive, signal.track == TRUTH)
        if key not in shown or (signal.signal == asked and signal.track != TRUTH):
            shown[key] = signal
    return list(shown.values())


def largest_text(signal: ChangedSignal) -> str:
    """Return the largest difference with its unit."""
    unit, factor = read_unit(SCORED_SIGNALS.get(signal.signal.replace("_std", ""), "1"))
    return "-" if signal.largest is None else f"{signal.largest * factor:.3g} {unit}".strip()


def percent(share: float) -> str:
    """Return a share with its sign; one too small for a digit keeps its sign, so that it does not pass for none."""
    if not math.isfinite(share):
        return "-" if math.isnan(share) else "+∞"
    if share and abs(share) < 5e-4:
        return f"{'+' if share > 0 else '-'}<0.1 %"
    return f"{share * 100:+.1f} %" if share else "0 %"
