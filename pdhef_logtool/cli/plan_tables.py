"""Output of a validation plan: a summary line, and a table of its requirements."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from rich.console import Console
from rich.text import Text

from pdhef_logtool.cli.console import print_indented, table
from pdhef_logtool.evaluation.requirement_verdicts import joint_notes
from pdhef_logtool.evaluation.validation_plan import shown
from pdhef_logtool.results.plan_verdicts import PlanVerdicts

STYLES = {"PASS": "green", "FAIL": "bold red", "INCONCLUSIVE": "dim"}


def plan_line(plan_result: PlanVerdicts) -> Text:
    """Return the numbers of passed, failed and inconclusive requirements."""
    return outcomes_text(Counter[str](v.outcome for v in plan_result.verdicts), plan_result.plan.file)


def outcomes_text(counts: Mapping[str, int], file: str) -> Text:
    """Return the number of requirements by outcome, and the name of the plan."""
    parts = [Text(f"{counts[outcome]} {outcome}", style) for outcome, style in STYLES.items() if counts.get(outcome)]
    name = f"plan {file}" if file else "default plan, no gate"
    return Text.assemble(Text(", ").join(parts), f" ({name})")


def render_plan(plan_result: PlanVerdicts, console: Console) -> None:
    """Print the requirements in a table, and the next steps for inconclusive ones."""
    made = table("", "id", "requirement", ">value", ">margin", fold=3)
    for v in plan_result.verdicts:
        unit = v.requirement.unit
        value, margin = ("-" if x is None else shown(x, unit) for x in (v.value, v.margin))
        made.add_row(Text(v.outcome, STYLES[v.outcome]), v.requirement.id, v.requirement.label, value, margin)
    console.print(made)
    to_do: dict[str, list[str]] = {}
    for v in plan_result.verdicts:
        if v.outcome != "PASS":
            what = v.reason.removeprefix(f"{shown(v.value, v.requirement.unit)}; ") if v.value is not None else v.reason
            to_do.setdefault(f"{what}. Next: {v.next}" if v.next else what, []).append(v.requirement.id)
    for what, ids in to_do.items():
        print_indented(f"{', '.join(ids)}: {what}", console)
    for note in joint_notes({v.requirement.id: v.notes for v in plan_result.verdicts}):
        print_indented(f"note: {note}", console)
    console.print()
