"""The first screen of a page: verdict per requirement and next steps."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pdhef_logtool.evaluation.requirement_verdicts import joint_notes, next_steps, of_documents
from pdhef_logtool.evaluation.validation_plan import shown

#: Class of the style by outcome.
_KINDS = {"PASS": "pass", "FAIL": "fail", "INCONCLUSIVE": "unknown"}
#: The interval in brackets after a value.
_INTERVAL = re.compile(r"^\((.*?)\)")


@dataclass(frozen=True, slots=True)
class PlanHead:
    """The verdicts of a plan: ``kind`` of the worst, one sentence, requirements, and limitations of the verdicts.

    ``lines``: the requirements in display form; all values are texts with their unit.
    """

    kind: str
    text: str
    lines: Sequence[Mapping[str, str]]
    notes: Sequence[str]


def plan_head(plan: Mapping[str, Any] | None) -> PlanHead | None:
    """Return the verdicts of a report.json or run.json; None without any."""
    if not plan or not plan.get("requirements"):
        return None
    requirements = plan["requirements"]
    counts = Counter(r["outcome"] for r in requirements)
    parts = [f"{counts[outcome]} {outcome}" for outcome in ("FAIL", "INCONCLUSIVE", "PASS") if counts[outcome]]
    name = f"Plan {plan['file']}" if plan.get("file") else "Default plan (for orientation; no effect on the exit code)"
    worst = next((k for o, k in (("FAIL", "fail"), ("INCONCLUSIVE", "unknown")) if counts[o]), "pass")
    order = [r for outcome in ("FAIL", "INCONCLUSIVE", "PASS") for r in of_documents(requirements, outcome)]
    notes = joint_notes({str(r["id"]): r.get("notes") or () for r in requirements})
    return PlanHead(worst, f"{name}: {', '.join(parts)}", [_line(r) for r in order], notes)


def _line(requirement: Mapping[str, Any]) -> dict[str, str]:
    unit = str(requirement["unit"])
    value, margin = requirement["value"], requirement["margin"]
    sign = "≥" if requirement.get("at_least") else "≤"
    of = f" × {requirement['baseline']}" if requirement.get("baseline") else ""
    text = "" if value is None else shown(value, unit)
    return {
        **{key: str(requirement[key]) for key in ("id", "title", "label", "outcome", "next")},
        "kind": _KINDS.get(str(requirement["outcome"]), "unknown"),
        "limit": f"{sign} {shown(requirement['bound'], unit)}{of}",
        "value": f"{text}{of}" if text else "–",
        "margin": "–" if margin is None else f"{'+' if margin >= 0 else '−'}{shown(abs(margin), unit)}",
        "exposure": _exposure(requirement["exposure"]),
        "reason": _INTERVAL.sub(r"\1", str(requirement["reason"]).removeprefix(text).lstrip("; ")),
    }


def _exposure(exposure: Mapping[str, Any]) -> str:
    if not exposure["drives"]:
        return "nothing"
    parts = [f"{exposure['drives']} {'drive' if exposure['drives'] == 1 else 'drives'}"]
    if exposure["minutes"] is not None:
        parts.append(duration(60.0 * exposure["minutes"]))
    if exposure["km"] is not None:
        parts.append(f"{exposure['km']:.1f} km" if exposure["km"] < 100.0 else f"{exposure['km']:.0f} km")
    return ", ".join(parts)


def steps_of(report: Mapping[str, Any]) -> list[str]:
    """Return the recommended next steps from the report.json of a drive."""
    texts = (report.get("answer") or {}).get("texts") or {}
    return next_steps(report.get("plan"), (texts.get("next") or "").split("; "))


def duration(seconds: float) -> str:
    """Return a duration for display."""
    if seconds < 120.0:
        return f"{seconds:.1f} s"
    hours = seconds / 3600.0
    return f"{seconds / 60.0:.1f} min" if hours < 2.0 else f"{hours:.1f} h" if hours < 100.0 else f"{hours:.0f} h"
