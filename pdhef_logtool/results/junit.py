"""JUnit XML of a validation plan: one testsuite, one testcase per requirement, as CI systems read it.

An INCONCLUSIVE requirement is a skipped test. Checks that did not pass are properties: they fail no test.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from pdhef_logtool.evaluation.requirement_verdicts import RequirementVerdict
from pdhef_logtool.evaluation.validation_plan import shown
from pdhef_logtool.results.plan_verdicts import PlanVerdicts
from pdhef_logtool.results.selected_estimate import TEMPLATES
from pdhef_logtool.results.tables import checks_of
from pdhef_logtool.storage.files import write_bytes
from pdhef_logtool.storage.templates import template


@dataclass(frozen=True, slots=True)
class Case:
    """One testcase. ``suite``, ``subject``: its classname and name; ``output``: figures, always shown.

    ``outcome`` is the type of a failure where it ``failed``; ``reason`` states why it failed or was skipped.
    """

    suite: str
    subject: str
    name: str
    outcome: str
    failed: bool = False
    reason: str = ""
    output: str | None = None


#: Characters that XML 1.0 cannot contain.
_NOT_IN_XML = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]")
#: By log the rows of its checks (checks.parquet).
_Checks: TypeAlias = Mapping[str, Sequence[Mapping[str, Any]]]


def write_junit(path: Path, verdicts: PlanVerdicts, parts: Mapping[str, Any]) -> None:
    """Write the verdicts of a plan, and the checks of the logs' parts of tables; raises OutputError."""
    write_bytes(path, junit_bytes(verdicts, {log: checks_of(part) for log, part in parts.items()}))


def junit_bytes(verdicts: PlanVerdicts, checks: _Checks | None = None) -> bytes:
    """Return JUnit XML in UTF-8, with checks that did not pass as properties.

    The same verdicts give the same bytes, so that there is no time of day in it.
    """
    cases = plan_cases(verdicts)
    logs = checks or {}
    properties = {
        f"check {c['name']}" if len(logs) == 1 else f"{log}: check {c['name']}": (
            f"{'waived' if c['waived'] else c['verdict']}: {c['evidence']}"
        )
        for log, of_log in logs.items()
        for c in of_log
        if c["verdict"] != "passed"
    }
    return cases_bytes(cases, dict.fromkeys(cases, properties))


def plan_cases(verdicts: PlanVerdicts) -> dict[str, list[Case]]:
    """Return the testcases of a plan by the name of its suite."""
    name = verdicts.plan.title or verdicts.plan.file or "validation plan"
    return {name: [_case(v, name, strict=verdicts.strict) for v in verdicts.verdicts]}


def cases_bytes(
    suites: Mapping[str, Sequence[Case]], properties: Mapping[str, Mapping[str, str]] | None = None
) -> bytes:
    """Return JUnit XML of testcases, and of properties, by suite, as :func:`junit_bytes`."""
    text = template(TEMPLATES / "junit.xml").render(suites=suites, properties=properties or {})
    return _NOT_IN_XML.sub("?", text).encode()


def _case(verdict: RequirementVerdict, suite: str, *, strict: bool) -> Case:
    requirement = verdict.requirement
    unit, exposure = requirement.unit, verdict.exposure
    failed = verdict.outcome == "FAIL" or (strict and verdict.outcome == "INCONCLUSIVE")
    margin = "none" if verdict.margin is None else shown(verdict.margin, unit)
    minutes = "unknown" if exposure.minutes is None else f"{exposure.minutes:.1f}"
    return Case(
        suite,
        requirement.id,
        requirement.title or requirement.label,
        "skipped" if verdict.outcome == "INCONCLUSIVE" and not failed else verdict.outcome,
        failed,
        f"{verdict.outcome}: {verdict.reason}" + (f"; {verdict.next}" if verdict.next else ""),
        f"{requirement.label}: {verdict.outcome}, {verdict.reason}; margin {margin}; "
        f"{exposure.drives} drives, {minutes} minutes scored",
    )
