"""JUnit XML of verdicts: one testsuite a log, one testcase a threshold and estimator, as CI systems read it.

Checks that did not pass are properties of the log's testsuite: they close no gate.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from pdhef_logtool.evaluation.thresholds import Verdict
from pdhef_logtool.storage.files import write_bytes


@dataclass(frozen=True, slots=True)
class Case:
    """One testcase. ``suite``, ``subject``: what it is of; ``output``: its figures, shown in any case.

    ``outcome`` is the type of a failure where it ``failed``; ``reason`` states why it failed or was skipped.
    """

    suite: str
    subject: str
    name: str
    outcome: str
    failed: bool = False
    reason: str = ""
    output: str | None = None


#: By log the checks of its report.
_Checks: TypeAlias = Mapping[str, Sequence[Mapping[str, Any]]]


def write_junit(path: Path, verdicts: Mapping[str, Sequence[Verdict]], checks: _Checks | None = None) -> None:
    """Write verdicts and checks by log through a temporary name; raises OutputError."""
    write_bytes(path, junit_bytes(verdicts, checks))


def junit_bytes(verdicts: Mapping[str, Sequence[Verdict]], checks: _Checks | None = None) -> bytes:
    """Return JUnit XML in UTF-8; the same verdicts give the same bytes, so that there is no time of day in it."""
    cases = {log: [_case(verdict) for verdict in of_log] for log, of_log in verdicts.items()}
    return cases_bytes(cases, {log: _check_properties(of_log) for log, of_log in (checks or {}).items()})


def _check_properties(checks: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Return the checks that did not pass as properties."""
    return {
        f"check {c['name']}": f"{'waived' if c['waived'] else c['verdict']}: {c['evidence']}"
        for c in checks
        if c["verdict"] != "passed"
    }


def cases_bytes(
    suites: Mapping[str, Sequence[Case]], properties: Mapping[str, Mapping[str, str]] | None = None
) -> bytes:
    """Return JUnit XML of testcases, and of properties, by suite, as :func:`junit_bytes`."""
    everything = [case for of_suite in suites.values() for case in of_suite]
    root = ET.Element("testsuites", {"name": "pdhef", **_counts(everything)})
    for name, of_suite in suites.items():
        suite = ET.SubElement(root, "testsuite", {"name": _text(name), **_counts(of_suite)})
        if entries := (properties or {}).get(name):
            element = ET.SubElement(suite, "properties")
            for key, value in entries.items():
                ET.SubElement(element, "property", {"name": _text(key), "value": _text(value)})
        for case in of_suite:
            _add_case(suite, case)
    ET.indent(root)
    document: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return document + b"\n"


def _case(verdict: Verdict) -> Case:
    note = f", {verdict.reason}" if verdict.reason and not verdict.failed else ""
    return Case(
        verdict.log,
        verdict.estimator,
        verdict.threshold.label,
        verdict.outcome,
        verdict.failed,
        verdict.reason,
        None
        if verdict.value is None
        else f"value {verdict.value:.9g} {verdict.threshold.unit}, margin {verdict.margin:.9g}, n={verdict.n}{note}",
    )


def _counts(cases: Sequence[Case]) -> dict[str, str]:
    return {
        "tests": str(len(cases)),
        "failures": str(sum(c.failed for c in cases)),
        "errors": "0",
        "skipped": str(sum(c.outcome == "skipped" for c in cases)),
        "time": "0",
    }


def _add_case(suite: ET.Element, case: Case) -> None:
    element = ET.SubElement(
        suite,
        "testcase",
        # Dots would be read as a hierarchy of packages.
        {
            "classname": _text(f"pdhef.{case.suite.replace('.', '_')}.{case.subject.replace('.', '_')}"),
            "name": _text(case.name),
            "time": "0",
        },
    )
    if case.failed:
        failure = ET.SubElement(element, "failure", {"message": _text(case.reason), "type": case.outcome})
        failure.text = _text(f"{case.suite}: {case.subject}: {case.name}: {case.reason}")
    elif case.outcome == "skipped":
        ET.SubElement(element, "skipped", {"message": _text(case.reason)})
    if case.output is not None:
        ET.SubElement(element, "system-out").text = _text(case.output)


def _text(text: str) -> str:
    """Replace what XML 1.0 cannot contain."""
    return re.sub("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]", "?", text)
