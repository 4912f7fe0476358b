"""Two runs held against each other."""

import json
import math
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.requirement_blocks import RequirementBlocks
from pdhef_logtool.evaluation.requirement_verdicts import (
    DriveValue,
    JudgedDrive,
    RequirementVerdict,
    judge as judge_values,
)
from pdhef_logtool.evaluation.validation_plan import ExposureNeed, Requirement, ValidationPlan, default_plan
from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.results.comparing import Comparison, compare, compare_runs, figure, notes_of, sentence
from pdhef_logtool.results.junit import junit_bytes
from pdhef_logtool.results.opened_run import open_run
from pdhef_logtool.results.plan_verdicts import PlanVerdicts, figures_of_file, figures_of_rows, plan_verdicts
from pdhef_logtool.results.run_report import LogOutcome
from pdhef_logtool.results.tables import write_metrics
from pdhef_logtool.runs.judging import judge, read_validation_plan
from pdhef_logtool.runs.run_result import LogResult
from pdhef_logtool.storage.documents import jsonable
from tests.results.made_run import digest, entry, row, write_run

ASKED = (figure(),)
GATE = (figure(limit=0.05),)
TEN = {f"d{i}": 0.01 * (1 + i) for i in range(10)}


def _compare(a: Path, b: Path, gate: tuple[Requirement, ...] = ASKED, **options: Any) -> Comparison:
    return compare_runs(open_run(a), open_run(b), gate, **options)


def _scaled(factor: float, **changed: float) -> dict[str, float]:
    return {label: changed.get(label, value * factor * (1 + 0.001 * i)) for i, (label, value) in enumerate(TEN.items())}


def test_the_same_run_is_equal_and_nothing_else_is_looked_at(tmp_path):
    run = write_run(tmp_path / "a", TEN)
    for gate in (ASKED, GATE):
        found = _compare(run, run, gate, strict=True)
        assert (found.verdict, found.exit_code, found.changed) == ("equal", 0, 0)
        assert found.pairs == {"signals": 10}
        assert found.others == found.differences == ()


def test_drives_pair_by_signals_then_content_then_name(tmp_path):
    a = [entry("slim"), entry("moved"), entry("same"), entry("gone"), entry("twin1"), entry("twin2")]
    b = [entry("full", signals_sha256=digest("signals slim")), entry("same", signals_sha256=None, sha256=None)]
    b.append(entry("renamed", signals_sha256=None, sha256=digest("file moved")))
    b += [entry("new"), entry("twin1"), entry("twin2")]
    for twins in (a, b):
        for twin in twins[4:]:
            twin.update(signals_sha256=digest("twin"))
    rmse = {"slim": 0.1, "moved": 0.1, "same": 0.1, "twin1": 0.1, "twin2": 0.2}
    other = {"full": 0.1, "renamed": 0.1, "same": 0.1, "twin1": 0.1, "twin2": 0.2}
    found = _compare(write_run(tmp_path / "a", rmse, entries=a), write_run(tmp_path / "b", other, entries=b))
    assert found.pairs == {"signals": 1, "content": 3, "name": 1}
    assert (found.only_a, found.only_b, found.changed) == (("gone",), ("new",), 0)
    assert (found.verdict, found.exit_code) == ("equal", 3)
    assert any(line.startswith("drives: only their names") for line in found.differences)


@pytest.mark.slow
def test_the_gate_closes_on_a_regression_and_not_on_an_improvement(tmp_path):
    a = write_run(tmp_path / "a", TEN)
    worse = _compare(a, write_run(tmp_path / "b", _scaled(1.2)), GATE)
    assert (worse.verdict, worse.exit_code) == ("worse", 4)
    assert worse.figures[0].drives[0]["drive"] == "d9"
    assert worse.figures[0].drives[0]["change"] == pytest.approx(0.2 * 1.009 + 0.009)
    assert _compare(a, tmp_path / "b").exit_code == 0  # no gate
    assert _compare(a, write_run(tmp_path / "c", _scaled(1.02)), GATE).verdict == "not worse"
    assert _compare(a, write_run(tmp_path / "d", _scaled(0.9)), GATE).verdict == "better"
    json.dumps(jsonable(worse.to_dict()), allow_nan=False)


def test_cannot_tell_is_an_answer_and_strict_refuses_it(tmp_path):
    a = write_run(tmp_path / "a", TEN)
    b = write_run(tmp_path / "b", {k: v * (1.5 if i % 2 else 0.7) for i, (k, v) in enumerate(TEN.items())})
    for gate in (ASKED, GATE):
        found = _compare(a, b, gate)
        assert (found.verdict, found.exit_code) == ("inconclusive", 0)
        assert found.figures[0].detectable > 0.3
        assert replace(found, strict=True).exit_code == 4


def test_drives_of_six_days_that_change_together_are_no_evidence_unless_the_user_says_so(tmp_path):
    rmse = {f"d{i}": 0.01 for i in range(60)}
    changed = {label: 0.01 * (1.1 if i // 10 < 4 else 0.95) * (1 + 1e-4 * i) for i, label in enumerate(rmse)}
    of_days = [entry(label, day=f"2026-01-0{1 + i // 10}") for i, label in enumerate(rmse)]
    reports = {label: {"metadata": {"x.road": "north"}} for label in rmse}
    a = write_run(tmp_path / "a", rmse, entries=of_days, reports=reports)
    b = write_run(tmp_path / "b", changed)
    found = _compare(a, b, GATE)
    (days,) = found.figures
    assert (found.verdict, days.change.dependence.by) == ("inconclusive", ("day",))
    assert days.change.dependence.levels == (("day", 6),)
    assert days.change.dependence.design_effect == pytest.approx(10.0)
    assert "60 drives of 6 days have the evidence of 6 independent drives" in "".join(notes_of(found))
    assert found.to_dict()["figures"][0]["dependence"] == ("day",)
    alone = _compare(a, b, GATE, cluster="none")
    assert (alone.verdict, alone.figures[0].change.dependence.design_effect) == ("worse", 1.0)
    assert "--cluster none" in "".join(notes_of(alone))


def test_the_others_are_corrected_for_being_several(tmp_path):
    def rows(factor: float) -> list[Any]:
        signals = ("vx_m_s", "ay_m_s2", "yaw_rate_rad_s")
        return [row(k, factor, signal=s) for k in TEN for s in signals] + [row(k, 1, signal="vy_m_s") for k in TEN]

    a, b = write_run(tmp_path / "a", TEN, rows=rows(1.0)), write_run(tmp_path / "b", _scaled(1.1), rows=rows(1.1))
    by_signal = {f.requirement.signal: f for f in _compare(a, b).others}
    assert by_signal["vx_m_s"].change.sign_p == pytest.approx(2 * 0.5**10)
    assert by_signal["vx_m_s"].corrected_p == pytest.approx(4 * 2 * 0.5**10)
    assert (by_signal["vy_m_s"].corrected_p, by_signal["vy_m_s"].verdict) == (1.0, "equal")


def test_what_else_differs_is_said(tmp_path):
    changed = {
        "d0": {"car": {"name": "golf", "sha256": digest("tuned"), "network_sha256": digest("net")}},
        "d1": {"truth_sha256": digest("rtk")},
        "d3": {"main": "physics"},
        "d4": {"outcome": "lost: a chunk"},
        "d2": {"mapping_sha256": digest("scaled"), "signals_sha256": digest("scaled signals")},
        "d5": {"signals_sha256": digest("other signals"), "sha256": digest("another file")},
    }
    b = [entry(label, **changed.get(label, {})) for label in TEN]
    other = write_run(tmp_path / "b", TEN, entries=b, config={"friction": 0.3}, versions={"numpy": "2.1"})
    found = _compare(write_run(tmp_path / "a", TEN), other)
    text = "\n".join(found.differences)
    assert f"car: golf {digest('golf')[:8]} → golf {digest('tuned')[:8]}, 1 of 10 drives" in text
    assert f"network: none → {digest('net')[:8]}, 1 of 10 drives" in text
    assert "truth: another one (what it held), 1 of 10 drives: d1" in text
    assert "mapping: another one" in text
    assert (
        "signals: they held something else, 2 of 10 drives: d2, d5; 1 of them are one drive by their name alone" in text
    )
    assert "selected estimate: pd-hef → physics, 1 of 10 drives" in text
    assert "configuration: friction auto → 0.3" in text
    assert "versions: numpy 2.0 → 2.1" in text
    assert "outcome of d4: ok → lost: a chunk" in text


def test_no_pair_and_unknown_names_are_errors(tmp_path):
    a = write_run(tmp_path / "a", TEN)
    b = write_run(tmp_path / "b", {"other": 0.1})
    with pytest.raises(OutputError, match="none of 10 and 1 by signals, content or name") as error:
        _compare(a, b)
    assert error.value.exit_code == 1
    c = write_run(tmp_path / "c", _scaled(1.1))
    with pytest.raises(UsageError, match="an estimator of these runs: pd-hef, got pd-hof"):
        _compare(a, c, (figure(estimator="pd-hof", limit=0.1),))
    scored = write_run(tmp_path / "scored", _scaled(1.1), entries=[entry(label, main=None) for label in TEN])
    with pytest.raises(UsageError, match="an estimator of these runs: pd-hef, got none named"):
        _compare(scored, a)
    assert _compare(scored, a, (figure(estimator="pd-hef"),)).figures[0].change.drives == 10


def test_a_history_has_a_row_per_run_and_reads_only_tables(tmp_path):
    versions = [{"versions": {"pdhef-logtool": version}} for version in ("1", "2", "3", "4")]
    rmse = [TEN, TEN, _scaled(1.2), {**_scaled(1.0), "new": 0.1}]
    runs = [
        write_run(tmp_path / of["versions"]["pdhef-logtool"], x, **of) for x, of in zip(rmse, versions, strict=True)
    ]
    assert not list(tmp_path.rglob("report.json"))
    found = compare(*runs, max_regression="5%", allow_unpaired=True)
    assert (found.a, found.b, found.verdict, found.exit_code) == (str(runs[2]), str(runs[3]), "better", 0)
    rows = jsonable(found.to_dict())["history"]
    assert [(r["version"], r["drives"], r["verdict"]) for r in rows] == [
        ("1", 10, ""), ("2", 10, "equal"), ("3", 10, "worse"), ("4", 11, "better"),
    ]  # fmt: skip
    assert rows[0]["value"] == pytest.approx(math.sqrt(sum(x**2 for x in TEN.values()) / 10))
    assert rows[0]["low"] < rows[0]["value"] < rows[0]["high"] and rows[0]["change"] == [None] * 3
    assert rows[1]["change"][0] == 0.0 and rows[2]["change"][0] == pytest.approx(0.2, abs=0.01)
    assert compare(*runs[:3], max_regression="5%").exit_code == 4
    assert compare(*runs[:2]).history == ()


@settings(max_examples=8, deadline=None)
@given(changed=st.sets(st.sampled_from(["asked", "other signal", "other estimator", "stamps"])), gated=st.booleans())
def test_verdict_and_number_of_changed_drives_never_contradict(changed, gated):
    def rows(of: set[str]) -> list[Any]:
        more = [row(k, 1.0 + ("other signal" in of), signal="vx_m_s") for k in TEN]
        more += [row(k, 1.0 + ("other estimator" in of), estimator="zero") for k in TEN]
        return [*more, *(row(k, v * (1.3 if "asked" in of else 1.0), n=99 + ("stamps" in of)) for k, v in TEN.items())]

    with TemporaryDirectory() as folder:
        runs = [
            write_run(Path(folder) / str(len(of)), dict.fromkeys(TEN, math.nan), rows=rows(of))
            for of in (set(), changed)
        ]
        found = _compare(runs[0], runs[-1], GATE if gated else ASKED)
    assert found.equal == (not changed) == (found.changed == 0)
    assert (found.verdict == "equal") == (not changed & {"asked", "stamps"})
    text = sentence("changes", found)
    assert ("No figure of the drives" in text) == found.equal
    assert ("none of the compared ones" in text) == (found.verdict == "equal" and not found.equal)
    assert sentence("verdict", found).startswith("equal: all figures") == found.equal
    assert "all figures" in sentence("verdict", found) or "10 of 10 drives" in text


# ---- A plan on the figures of a run: which drives count, against what, with how much driving; and its JUnit XML ----

BETA = Requirement("A", "", "sideslip_rad", limit=0.02)
SIX = tuple("abcdef")
EARLIER = '[[requirement]]\nid = "A"\nsignal = "sideslip_rad"\nbaseline = "{}"\nmax_ratio = 1.0\n'


def metric_row(log: str, metric: str, value: float, n: int = 1000, **changes: str) -> MetricRow:
    of = {"estimator": "pd-hef", "signal": "sideslip_rad", "segment": "all", "unit": "rad", **changes}
    return MetricRow(log, of["estimator"], of["signal"], of["segment"], metric, value, of["unit"], n)


def scored(logs: Sequence[str] = SIX, value: float = 0.01, **changes: str) -> list[MetricRow]:
    exposed = [metric_row(log, m, v, 2000, estimator="sensors", signal="state")
               for log in logs for m, v in (("exposure_s", 120.0), ("exposure_m", 3000.0))]  # fmt: skip
    return [*(metric_row(log, "rmse", value * (1.0 + 0.01 * i), **changes) for i, log in enumerate(logs)), *exposed]


def judged(rows: list[MetricRow], requirement: Requirement = BETA, **options: Any) -> RequirementVerdict:
    logs = list(dict.fromkeys(r.log for r in rows))
    drives = options.pop("drives", None) or [JudgedDrive(log, options.get("main", "pd-hef")) for log in logs]
    options.pop("main", None)
    (verdict,) = plan_verdicts(ValidationPlan((requirement,)), figures_of_rows(rows), drives, **options).verdicts
    return verdict


def test_drives_are_pooled_with_the_exposure_of_their_scored_stamps():
    verdict = judged(scored())
    assert (verdict.outcome, verdict.basis, verdict.units, verdict.worst) == ("PASS", "drives", 6, "f")
    assert (verdict.exposure.minutes, verdict.exposure.km) == (6.0, 9.0)  # half of the stamps are scored
    assert verdict.estimators == ("pd-hef",)


def test_a_file_gives_the_same_verdict_as_the_rows(tmp_path):
    rows = scored() + scored(value=0.5, estimator="zero")
    plan = ValidationPlan((BETA,))
    write_metrics(tmp_path / "metrics.parquet", rows)
    drives = [JudgedDrive(log, "pd-hef") for log in SIX]
    of_file = plan_verdicts(plan, figures_of_file(tmp_path / "metrics.parquet", plan, ["pd-hef"] * 6), drives)
    assert of_file == plan_verdicts(plan, figures_of_rows(rows), drives)


def test_the_estimated_reference_counts_only_without_ground_truth():
    reference = [
        r for log in SIX for r in (metric_row(log, "reference_rms", 0.001), metric_row(log, "reference_std", 0.0005))
    ]
    alone = judged(reference)
    assert (alone.against, alone.outcome) == ("estimated reference", "PASS")
    both = judged(scored() + reference)
    assert both.against == "ground truth" and both.value == pytest.approx(0.01, rel=0.1)


@pytest.mark.parametrize(
    ("requirement", "reason"),
    [
        (Requirement("A", "", "vx_m_s", limit=1.0), "no ground truth of v_x"),
        (Requirement("A", "", "sideslip_rad", segment="slalom", limit=1.0), "no scored driving in slalom"),
        (Requirement("A", "", "sideslip_rad", estimator="ekf", limit=1.0), "ekf did not run"),
        (Requirement("A", "", "sideslip_rad", baseline="ekf", max_ratio=1.0), "ekf has no such value"),
        (Requirement("A", "", "sideslip_rad", baseline="run", max_ratio=1.0), "pdhef compare A B --plan PLAN"),
    ],
)
def test_the_reason_for_no_value_is_given(requirement, reason):
    verdict = judged(scored(), requirement)
    assert (verdict.outcome, verdict.exposure.drives) == ("INCONCLUSIVE", 0)
    assert reason in verdict.reason and verdict.next


def test_run_a_is_the_baseline_of_a_comparison_with_its_own_selected_estimate():
    requirement = Requirement("A", "", "sideslip_rad", baseline="run", max_ratio=1.05)
    a = figures_of_rows(scored(value=0.02, estimator="physics"))
    partners = {log: JudgedDrive(log, "physics") for log in SIX}
    verdict = judged(scored(), requirement, against={"run": (a, partners)})
    assert (verdict.outcome, verdict.value) == ("PASS", pytest.approx(0.5))
    del partners["a"]
    assert judged(scored(), requirement, against={"run": (a, partners)}).exposure.drives == 5


def test_blocks_are_read_only_where_fewer_than_five_drives_are_scored():
    read: list[str] = []

    def blocks(log: str) -> list[RequirementBlocks]:
        read.append(log)
        k = 8
        return [RequirementBlocks(BETA.measured, 10.0, range(k), [99] * k, [10.0] * k, [9.0] * k, [0.01] * k)]

    def drives(logs: Sequence[str]) -> list[JudgedDrive]:
        return [
            JudgedDrive(log, "pd-hef", lambda log=log: {"requirement_blocks": jsonable(blocks(log))}) for log in logs
        ]

    assert judged(scored(), drives=drives(SIX)).basis == "drives" and read == []
    few = judged(scored("ab"), drives=drives("ab"))
    assert (few.basis, few.units, read) == ("blocks", 16, ["a", "b"])
    assert few.exposure.minutes == pytest.approx(160.0 / 60.0)


def test_only_a_users_plan_closes_the_gate():
    rows = scored(value=0.5)
    for file, strict, closed in (("", True, False), ("plan.toml", False, True)):
        plan = ValidationPlan((BETA,), file=file)
        verdicts = plan_verdicts(plan, figures_of_rows(rows), [JudgedDrive(x, "pd-hef") for x in SIX], strict=strict)
        assert bool(verdicts.closing) is closed
    nothing = plan_verdicts(ValidationPlan((BETA,), file="plan.toml"), figures_of_rows([]), [], strict=True)
    assert nothing.closing and not plan_verdicts(nothing.plan, figures_of_rows([]), []).closing
    assert nothing.to_dict()["requirements"][0]["value"] is None


@pytest.mark.parametrize(("factor", "outcome"), [(1.0, "PASS"), (1.02, "PASS"), (1.08, "FAIL"), (0.9, "PASS")])
def test_a_plan_and_the_gate_of_compare_decide_alike(factor, outcome, tmp_path):
    """Of drives of six days, each is compared with itself: days that are harder in both runs cancel."""
    rng = np.random.default_rng(11)
    level = {f"d{i:02d}": 0.01 * math.exp(0.5 * (i % 6) + 0.3 * rng.normal()) for i in range(60)}
    changed = {log: v * factor * math.exp(0.02 * rng.normal()) for log, v in level.items()}
    days = [entry(log, day=f"2026-01-0{1 + i % 6}") for i, log in enumerate(level)]
    a, b = (write_run(tmp_path / str(i), x, entries=days) for i, x in enumerate((level, changed)))
    plan = tmp_path / "plan.toml"
    for baseline in ("run", "0/"):
        plan.write_text(EARLIER.format(baseline).replace("1.0", "1.05\nconfidence = 0.9"))
        found = compare(a, b, plan=plan)
        (verdict,) = found.requirements.verdicts
        assert (verdict.outcome, found.exit_code) == (outcome, 4 * (outcome == "FAIL"))
        assert any("6 days" in note for note in verdict.notes)
    gated = compare(a, b, max_regression="5%")
    assert (gated.exit_code, gated.verdict == "worse") == (found.exit_code, outcome == "FAIL")
    assert verdict.value == pytest.approx(math.exp(gated.figures[0].change.median))


def test_a_missing_earlier_run_ends_the_command_before_the_work(tmp_path):
    (tmp_path / "plan.toml").write_text(EARLIER.format("gone/run"))
    with pytest.raises(OutputError, match="no such folder") as raised:
        read_validation_plan(tmp_path / "plan.toml", None)
    assert raised.value.exit_code == 2 and "gone/run" in str(raised.value)


@pytest.mark.parametrize(
    ("need", "outcome", "words"),
    [
        ({"speed_m_s": [20.0, 30.0], "minutes": 1.0}, "PASS", ""),
        ({"speed_m_s": [20.0, 30.0], "minutes": 5.0}, "INCONCLUSIVE", "2.0 of 5 minutes at 20 to 30 m/s"),
        ({"ay_m_s2": [4.0, 13.0], "drives": 1}, "INCONCLUSIVE", "0 of 1 drives at |a_y| 4 to 13 m/s²"),
        ({"friction": [0.0, 0.5], "drives": 3}, "PASS", ""),
        (
            {"friction": [0.5, 1.2], "car": "golf", "drives": 4},
            "INCONCLUSIVE",
            "3 of 4 drives at μ 0.5 to 1.2, car golf",
        ),
        ({"car": "polo", "minutes": 1.0}, "INCONCLUSIVE", "0.0 of 1 minutes at car polo"),
    ],
)
def test_exposure_in_conditions(need, outcome, words):
    space = {(20.0, 0.0): 20.0, (5.0, 2.0): 20.0}
    drives = [JudgedDrive(x, "pd-hef", dict, {"car": "golf"}, space, 0.3 if x < "d" else 0.9) for x in SIX]
    verdict = judged(scored(), replace(BETA, exposure=(ExposureNeed(**need),)), drives=drives)
    assert verdict.outcome == outcome and words in verdict.reason


@pytest.mark.parametrize(("logs", "judged_logs"), [(4, None), (5, 5)])
def test_the_default_plan_judges_only_as_many_drives_as_a_bootstrap_needs(logs, judged_logs):
    outcomes = [LogOutcome(str(i), f"{i}.mcap", "0" * 64, main="pd-hef") for i in range(logs)]
    results = [LogResult(o, None, {}, tuple(scored([o.log]))) for o in outcomes]
    verdicts = judge(default_plan(), results, strict=False)
    assert (None if verdicts is None else verdicts.verdicts[0].exposure.drives) == judged_logs


WORST = Requirement("R1", "No bad drive", "sideslip_rad", limit=0.02, statistic="worst drive")


def judged_alone(*errors: float | None, strict: bool = False, title: str = "") -> PlanVerdicts:
    """Return one verdict per error of the only drive, in rad; None: the drive has no figure."""
    requirements = tuple(replace(WORST, id=f"R{i}") for i in range(len(errors)))
    drive = JudgedDrive("a.mcap", None)
    known = [e if e is None else DriveValue(drive, "pd-hef", e, 100, seconds=60.0, metres=1e3) for e in errors]
    judged = [judge_values(r, [v] if v else []) for r, v in zip(requirements, known, strict=True)]
    return PlanVerdicts(ValidationPlan(requirements, title, "plan.toml"), tuple(judged), strict)


def test_counts_agree_with_the_cases():
    data = junit_bytes(judged_alone(0.01, 0.03, None))
    assert data.startswith(b"<?xml version=")
    root = ET.fromstring(data)
    (suite,) = root.findall("testsuite")
    assert (root.tag, suite.get("name")) == ("testsuites", "plan.toml")
    for element in (root, suite):
        counts = {k: element.attrib[k] for k in ("tests", "failures", "skipped")}
        assert counts == {"tests": "3", "failures": "1", "skipped": "1"}
    strict = ET.fromstring(junit_bytes(judged_alone(0.01, 0.03, None, strict=True)))
    assert (strict.attrib["failures"], strict.attrib["skipped"]) == ("2", "0")


def test_a_case_names_requirement_limit_value_margin_and_exposure():
    passed, failed, skipped = ET.fromstring(junit_bytes(judged_alone(0.01, 0.03, None))).iter("testcase")
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
    root = ET.fromstring(junit_bytes(judged_alone(0.01), checks))
    assert [p.attrib for p in root.iter("property")] == [{"name": "check speed", "value": "failed: too fast"}]
    root = ET.fromstring(junit_bytes(judged_alone(0.01), checks | {"b": []}))
    assert [p.attrib["name"] for p in root.iter("property")] == ["a: check speed"]


@settings(derandomize=True, max_examples=15)
@given(name=st.text(min_size=1))
def test_any_name_gives_xml_that_parsers_read(name):
    root = ET.fromstring(junit_bytes(judged_alone(0.03, title=name)))
    assert len(root.findall(".//failure")) == 1
