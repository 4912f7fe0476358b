"""JUnit XML of verdicts: one testsuite a log, one testcase a threshold and estimator, as CI systems read it."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path

from pdhef_logtool.evaluation.thresholds import Verdict
from pdhef_logtool.records.files import write_bytes


def write_junit(path: Path, verdicts: Mapping[str, Sequence[Verdict]]) -> None:
    """Write the verdicts by log through a temporary name; raises OutputError."""
    write_bytes(path, junit_bytes(verdicts))


def junit_bytes(verdicts: Mapping[str, Sequence[Verdict]]) -> bytes:
    """Return JUnit XML in UTF-8; the same verdicts give the same bytes, so that there is no time of day in it."""
    everything = [v for of_log in verdicts.values() for v in of_log]
    root = ET.Element("testsuites", {"name": "pdhef", **_counts(everything)})
    for log, of_log in verdicts.items():
        suite = ET.SubElement(root, "testsuite", {"name": _text(log), **_counts(of_log)})
        for verdict in of_log:
            _add_case(suite, verdict)
    ET.indent(root)
    document: bytes = ET.tostring(root, encoding="utf-8", xml_declaration=True)
    return document + b"\n"


def _counts(verdicts: Sequence[Verdict]) -> dict[str, str]:
    return {
        "tests": str(len(verdicts)),
        "failures": str(sum(v.failed for v in verdicts)),
        "errors": "0",
        "skipped": str(sum(v.outcome == "skipped" for v in verdicts)),
        "time": "0",
    }


def _add_case(suite: ET.Element, verdict: Verdict) -> None:
    threshold = verdict.threshold
    case = ET.SubElement(
        suite,
        "testcase",
        # Dots would be read as a hierarchy of packages.
        {
            "classname": _text(f"pdhef.{verdict.log.replace('.', '_')}.{verdict.estimator.replace('.', '_')}"),
            "name": _text(threshold.label),
            "time": "0",
        },
    )
    if verdict.failed:
        failure = ET.SubElement(case, "failure", {"message": _text(verdict.reason), "type": verdict.outcome})
        failure.text = _text(f"{verdict.log}: {verdict.estimator}: {threshold.label}: {verdict.reason}")
    elif verdict.outcome == "skipped":
        ET.SubElement(case, "skipped", {"message": _text(verdict.reason)})
    if verdict.value is not None:
        output = ET.SubElement(case, "system-out")
        note = f", {verdict.reason}" if verdict.reason and not verdict.failed else ""
        output.text = _text(
            f"value {verdict.value:.9g} {threshold.unit}, margin {verdict.margin:.9g}, n={verdict.n}{note}"
        )


def _text(text: str) -> str:
    """Replace what XML 1.0 cannot hold."""
    return re.sub("[\x00-\x08\x0b\x0c\x0e-\x1f\ud800-\udfff\ufffe\uffff]", "?", text)
