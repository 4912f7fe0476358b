"""The first screen of a page: verdict per requirement, test conditions, next steps."""

from __future__ import annotations

import datetime as dt
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pdhef_logtool.evaluation.requirement_verdicts import joint_notes, next_steps, of_documents
from pdhef_logtool.evaluation.units import LABELS
from pdhef_logtool.evaluation.validation_plan import shown
from pdhef_logtool.records.printable import listed, printable
from pdhef_logtool.results.selected_estimate import friction_text

#: Class of the style by outcome.
_KINDS = {"PASS": "pass", "FAIL": "fail", "INCONCLUSIVE": "unknown"}
#: Versions on a first screen; the appendix lists all.
_VERSIONS = ("pdhef-logtool", "python", "numpy")
#: The interval in brackets after a value.
_INTERVAL = re.compile(r"^\((.*?)\)")
_UNIT = re.compile(r"_(rad_s|rad|m_s2|m_s)$")


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


def tested_drive(report: Mapping[str, Any], outcome: str = "") -> list[tuple[str, str]]:
    """Return the test conditions of one drive as terms and texts."""
    log, vehicle, answer = report["log"], report["vehicle"], report.get("answer") or {}
    file = f" ({vehicle['file']})" if vehicle.get("file") else ""
    state = f"taught by {vehicle['taught']}" if vehicle.get("taught") else "parameters not validated"
    state = "validated on drives with ground truth" if vehicle.get("proven") else state
    if not vehicle.get("file"):
        state = "no car given: default sedan"
    ran = ", ".join(e["name"] for e in report["estimators"] if e["outcome"] == "ran")
    facts = [
        ("Car", f"{vehicle['name']}{file}; {state}"),
        ("Estimate", f"{answer['main']} ({answer['why']})" if answer.get("main") else ran or "none"),
        ("Outcome", outcome if outcome != "ok" else ""),
        (
            "Drive",
            f"{log['file']}, {duration(log['duration_s'])} from {_day(log['start_ns'])}; sha256 {log['sha256'][:12]}",
        ),
        ("Road", _road(report)),
        ("Sensors", _sensors(report)),
        ("Reference", _reference(report)),
        ("Versions", versions(report.get("versions") or {})),
    ]
    return [(term, text) for term, text in facts if text]


def duration(seconds: float) -> str:
    """Return a duration for display."""
    if seconds < 120.0:
        return f"{seconds:.1f} s"
    hours = seconds / 3600.0
    return f"{seconds / 60.0:.1f} min" if hours < 2.0 else f"{hours:.1f} h" if hours < 100.0 else f"{hours:.0f} h"


def versions(installed: Mapping[str, str]) -> str:
    """Return the versions for a first screen."""
    return ", ".join(f"{name} {installed[name]}" for name in _VERSIONS if name in installed)


def _day(stamp_ns: int) -> str:
    try:
        return f"{dt.datetime.fromtimestamp(stamp_ns * 1e-9, dt.UTC):%Y-%m-%d %H:%M} UTC"
    except (OverflowError, ValueError, OSError):
        return str(stamp_ns)


def _road(report: Mapping[str, Any]) -> str:
    space, friction = report.get("operating_space") or {}, report.get("friction") or {}
    speed, ay = space.get("speed_max_m_s"), space.get("ay_max_m_s2")
    parts = [
        "" if speed is None else f"speed up to {speed:.1f} m/s",
        "" if ay is None else f"lateral acceleration up to {ay:.1f} m/s²",
        f"friction: {friction_text(friction)}" if friction.get("source") else "",
    ]
    return ", ".join(filter(None, parts))


def _sensors(report: Mapping[str, Any]) -> str:
    names = [str(s["name"]) for s in report["mapping"]["signals"]]
    wheels = [n for n in names if n.startswith("wheel_speed_")]
    others = [LABELS.get(n, _UNIT.sub("", n).replace("_", " ").replace("ax", "a_x")) for n in names if n not in wheels]
    return ", ".join([*others, *([f"{len(wheels)} wheel speeds"] if wheels else [])])


def _reference(report: Mapping[str, Any]) -> str:
    truth, reference = report["truth"], report.get("reference") or {}
    if truth["available"]:
        topics = dict.fromkeys(
            str(q["source"]).partition(".")[0] for q in truth["quantities"] if str(q["source"]).startswith("/")
        )
        return f"ground truth: {', '.join(topics) or 'derived'}"
    if reference and not reference.get("refused"):
        return "estimated reference (no ground truth in the log)"
    return "no ground truth"


def tested_run(run: Mapping[str, Any], hours: float) -> list[tuple[str, str]]:
    """Return the test conditions of a run of several drives as terms and texts."""
    logs = run.get("logs") or ()
    cars = Counter(str((log.get("car") or {}).get("name")) for log in logs if log.get("car"))
    mains = Counter(str(log["main"]) for log in logs if log.get("main"))

    def counted(counts: Mapping[str, int]) -> str:
        named = [f"{printable(k)} ({n})" if len(counts) > 1 else printable(k) for k, n in counts.items()]
        return listed(named)

    failed = sum(str(log.get("outcome", "")).startswith("failed") for log in logs)
    lost = sum(str(log.get("outcome", "")).startswith("lost") for log in logs)
    notes = [f"{failed} failed" if failed else "", f"{lost} with input lost" if lost else ""]
    drives = ", ".join(
        [f"{len(logs)} {'log' if len(logs) == 1 else 'logs'}", duration(3600.0 * hours), *filter(None, notes)]
    )
    facts = [
        ("Cars", counted(cars)),
        ("Estimate", counted(mains)),
        ("Drives", drives),
        ("Versions", versions(run.get("versions") or {})),
    ]
    return [(term, text) for term, text in facts if text]
