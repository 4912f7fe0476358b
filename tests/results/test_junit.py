"""JUnit XML as CI systems count it."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.evaluation.thresholds import Threshold, Verdict
from pdhef_logtool.results.junit import junit_bytes, write_junit

LIMIT = Threshold("sideslip_rad", "rmse", maximum=0.5, unit="deg")
VERDICTS = {
    "a.mcap": [
        Verdict("a.mcap", "phy-ukf", LIMIT, "pass", 0.4, 0.1, 10),
        Verdict("a.mcap", "zero", LIMIT, "fail", 2.0, -1.5, 10, True, "2 deg is beyond the limit by 1.5"),
        Verdict("a.mcap", "none", LIMIT, "not evaluated", reason="no such figure in this log"),
    ],
    "b": [Verdict("b", "none", LIMIT, "skipped", reason="no such figure in this log")],
    "empty": [],
}


def test_counts_agree_with_the_cases() -> None:
    assert junit_bytes(VERDICTS).startswith(b"<?xml version=")
    root = ET.fromstring(junit_bytes(VERDICTS))
    assert root.tag == "testsuites"
    suites = root.findall("testsuite")
    assert [s.get("name") for s in suites] == ["a.mcap", "b", "empty"]
    for suite in [root, *suites]:
        assert int(suite.attrib["tests"]) == len(suite.findall(".//testcase"))
        assert int(suite.attrib["failures"]) == len(suite.findall(".//failure"))
        assert int(suite.attrib["skipped"]) == len(suite.findall(".//skipped"))
    assert [suite.attrib["failures"] for suite in suites] == ["2", "0", "0"]


def test_cases_name_threshold_and_estimator_and_say_why() -> None:
    cases = ET.fromstring(junit_bytes(VERDICTS)).findall(".//testcase")
    assert cases[0].attrib["name"] == "sideslip_rad rmse (all) <= 0.5 deg"
    assert cases[0].attrib["classname"] == "pdhef.a_mcap.phy-ukf"
    assert cases[0].find("failure") is None
    failure = cases[1].find("failure")
    assert failure is not None
    assert failure.attrib["message"] == "2 deg is beyond the limit by 1.5"
    not_evaluated = cases[2].find("failure")
    assert not_evaluated is not None
    assert not_evaluated.attrib["type"] == "not evaluated"


@settings(derandomize=True, max_examples=50)
@given(name=st.text(min_size=1))
def test_any_name_gives_xml_that_parsers_read(name: str) -> None:
    verdict = Verdict(name, name, LIMIT, "fail", 1.0, -1.0, reason=name)
    root = ET.fromstring(junit_bytes({name: [verdict]}))
    assert len(root.findall(".//failure")) == 1


def test_file_appears_under_its_name_alone(tmp_path: Path) -> None:
    write_junit(tmp_path / "deep" / "gate.xml", VERDICTS)
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["gate.xml"]
    assert (tmp_path / "deep" / "gate.xml").read_bytes() == junit_bytes(VERDICTS)


def test_the_figure_is_there_with_its_remark_and_a_failure_s_reason_is_not_said_twice() -> None:
    remarked = Verdict("c", "ekf", LIMIT, "pass", 0.25, 0.25, 7, reason="few samples")
    cases = ET.fromstring(junit_bytes({**VERDICTS, "c": [remarked]})).findall(".//testcase")
    said = [case.findtext("system-out") for case in cases]
    assert said == [
        "value 0.4 deg, margin 0.1, n=10",
        "value 2 deg, margin -1.5, n=10",
        None,
        None,
        "value 0.25 deg, margin 0.25, n=7, few samples",
    ]
