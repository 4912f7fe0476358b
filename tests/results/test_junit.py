"""JUnit XML of a plan as CI systems count it."""

import xml.etree.ElementTree as ET
from dataclasses import replace

from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.evaluation.requirement_verdicts import DriveValue, JudgedDrive, judge
from pdhef_logtool.evaluation.validation_plan import Requirement, ValidationPlan
from pdhef_logtool.results.junit import junit_bytes
from pdhef_logtool.results.plan_verdicts import PlanVerdicts

WORST = Requirement("R1", "No bad drive", "sideslip_rad", limit=0.02, statistic="worst drive")


def verdicts(*errors: float | None, strict: bool = False, title: str = "") -> PlanVerdicts:
    """Return one verdict per error of the only drive, in rad; None: the drive has no figure."""
    requirements = tuple(replace(WORST, id=f"R{i}") for i in range(len(errors)))
    judged = [
        judge(
            r,
            [] if e is None else [DriveValue(JudgedDrive("a.mcap", None), "pd-hef", e, 100, seconds=60.0, metres=1e3)],
        )
        for r, e in zip(requirements, errors, strict=True)
    ]
    return PlanVerdicts(ValidationPlan(requirements, title, "plan.toml"), tuple(judged), strict)


def test_counts_agree_with_the_cases():
    data = junit_bytes(verdicts(0.01, 0.03, None))
    assert data.startswith(b"<?xml version=")
    root = ET.fromstring(data)
    (suite,) = root.findall("testsuite")
    assert (root.tag, suite.get("name")) == ("testsuites", "plan.toml")
    for element in (root, suite):
        counts = {k: element.attrib[k] for k in ("tests", "failures", "skipped")}
        assert counts == {"tests": "3", "failures": "1", "skipped": "1"}
    strict = ET.fromstring(junit_bytes(verdicts(0.01, 0.03, None, strict=True)))
    assert (strict.attrib["failures"], strict.attrib["skipped"]) == ("2", "0")


def test_a_case_names_requirement_limit_value_margin_and_exposure():
    passed, failed, skipped = ET.fromstring(junit_bytes(verdicts(0.01, 0.03, None))).iter("testcase")
    assert (passed.attrib["name"], passed.attrib["classname"]) == ("No bad drive", "pdhef.plan_toml.R0")
    assert passed.findtext("system-out") == (
        "sideslip RMSE ≤ 1.15° (worst drive): PASS, worst of 1 drives: 0.573°; margin 0.573°; "
        "1 drives, 1.0 minutes scored"
    )
    failure = failed.find("failure")
    assert failure is not None and failure.attrib["message"].startswith("FAIL: worst of 1 drives: 1.72°")
    skip = skipped.find("skipped")
    assert skip is not None and "record drives with ground truth" in skip.attrib["message"]


def test_checks_that_did_not_pass_are_properties():
    checks = {"a": [{"name": "speed", "verdict": "failed", "waived": False, "evidence": "too fast"}]}
    root = ET.fromstring(junit_bytes(verdicts(0.01), checks))
    assert [p.attrib for p in root.iter("property")] == [{"name": "check speed", "value": "failed: too fast"}]
    root = ET.fromstring(junit_bytes(verdicts(0.01), checks | {"b": []}))
    assert [p.attrib["name"] for p in root.iter("property")] == ["a: check speed"]


@settings(derandomize=True, max_examples=15)
@given(name=st.text(min_size=1))
def test_any_name_gives_xml_that_parsers_read(name):
    root = ET.fromstring(junit_bytes(verdicts(0.03, title=name)))
    assert len(root.findall(".//failure")) == 1
