import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.operating_space import AY_EDGES_M_S2, SPEED_EDGES_M_S
from pdhef_logtool.evaluation.reasons import Interval, sensor_fault
from pdhef_logtool.evaluation.requirement_blocks import RequirementBlocks
from pdhef_logtool.evaluation.validation_plan import SIDESLIP
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.results.plotted import colour_rgb
from pdhef_logtool.results.run_report import LogOutcome, build_run, lines_of, report_markdown, write_json
from pdhef_logtool.results.selected_estimate import MainFacts
from pdhef_logtool.results.sink import Event
from tests.run_report import GNSS, MAIN, MODEL, SHA, TRUTH, VELOCITY, errors_deg, figures, follows, ran, report, truth

SECOND = 10**9
SKIPPED = ran("pd-hef", algorithm=None, outcome="skipped", reason="no model", notes=["needs --model"])
CONTENT = {
    "main": None,
    "estimators": [ran("phy-ukf", algorithm=None), SKIPPED],
    "truth": truth(*VELOCITY, latency_s=0.012, not_independent=["yaw_rate_rad_s"]),
    "metrics": [
        MetricRow("drive", "phy-ukf", "sideslip_rad", "all", "rmse", np.deg2rad(0.5), "rad", 990),
        MetricRow("drive", "phy-ukf", "sideslip_rad", "nonlinear", "rmse", float("nan"), "rad", 0),
    ],
    "segments": [Event("nonlinear", 1, 2, "|ay| above 0.5 g")],
    "losses": [Loss(kind="gap", what="0.4 s without samples", where="/imu", start_ns=5, end_ns=6, count=1)],
    "warnings": ["steering contradicts the yaw rate"],
}


def read(path: Path):
    def no_constant(text):
        raise AssertionError(f"{text} is no JSON")

    return json.loads(path.read_text(encoding="utf-8"), parse_constant=no_constant)


def test_report_follows_its_schema(tmp_path):
    path = tmp_path / "report.json"
    write_json(path, report(**CONTENT))
    document = read(path)
    follows(document)
    assert [(e["name"], e["outcome"], e["reason"]) for e in document["estimators"]] == [
        ("phy-ukf", "ran", None),
        ("pd-hef", "skipped", "no model"),
    ]
    assert [m["value"] for m in document["metrics"]] == [np.deg2rad(0.5), None]
    assert document["segments"] == [{"name": "nonlinear", "start_ns": 1, "end_ns": 2, "text": "|ay| above 0.5 g"}]
    assert document["losses"][0]["severity"] == "lost"
    cell = {"speed": 3, "ay": 2, "seconds": 1.5, "scored": 0, "sideslip_mse_rad2": float("nan")}
    space = {"cells": [cell], "speed_max_m_s": 12.3, "ay_max_m_s2": 2.5, "friction_median": 0.9}
    space |= {"speed_edges_m_s": SPEED_EDGES_M_S, "ay_edges_m_s2": AY_EDGES_M_S2}
    more = report(metadata={"vehicle": "a"}, operating_space=space, faults=None)
    follows({**more, "estimators": []})
    assert more["operating_space"]["cells"][0]["sideslip_mse_rad2"] is None and more["faults"] is None


def test_faults_are_in_words():
    spans = [Interval(int(a * 1e9), int(b * 1e9)) for a, b in ((1.2, 1.21), (3.45, 3.46), (7, 8), (9, 9.01))]
    stuck, spike = sensor_fault("yaw_rate_rad_s", "stuck", spans[2:3]), sensor_fault("ay_m_s2", "spike", spans)
    document = report(None, faults=[stuck, {**spike, "count": 60}], estimators=[ran("phy-ukf", algorithm=None)])
    follows(document)
    words = "yaw rate stuck 7.0-8.0 s; a_y spike 1.20 s, 3.45 s, 7.0-8.0 s and 57 more"
    assert f"- {words}" in report_markdown(document).splitlines()


def test_run_says_how_each_log_ended(tmp_path):
    outcomes = [LogOutcome("a", "logs/a.mcap", SHA), LogOutcome("b", "logs/b.mcap", None, failed="no log")]
    outcomes.append(LogOutcome("c", "logs/c.mcap", SHA, lost=["the last 3 s", "a chunk"]))
    run = build_run({"estimators": ["phy-ukf"], "start": None}, None, outcomes)
    path = tmp_path / "run.json"
    write_json(path, run)
    run = read(path)
    follows(run, "run.schema.json")
    assert [o["outcome"] for o in run["logs"]] == ["ok", "failed: no log", "lost: the last 3 s; a chunk"]
    assert [o["file"] for o in run["logs"]] == ["a.mcap", "b.mcap", "c.mcap"]
    run["logs"][0]["outcome"] = "fine"
    with pytest.raises(jsonschema.ValidationError):
        follows(run, "run.schema.json")
    follows(build_run({}, ("st-resnet", SHA), []), "run.schema.json")


def test_colours_are_red_green_blue_and_a_names_own():
    assert colour_rgb("phy-ukf", {"phy-ukf": 0x12_34_56}) == (0x12, 0x34, 0x56)
    assert colour_rgb("truth", {}) == (0x8A, 0x8A, 0x8A)
    palette = "d55e00 0072b2 e69f00 009e73 cc79a7 56b4e9"
    found = [colour_rgb(f"recorded {i}", {"phy-ukf": 0}) for i in range(40)]
    assert set(found) == {tuple(bytes.fromhex(colour)) for colour in palette.split()}
    assert colour_rgb("recorded 7", {}) == found[7]


def _report(**changes: Any) -> dict[str, Any]:
    estimators = [ran("ukf", notes=["a", "b"]), ran("smooth", causal=False)]
    content = {"estimators": estimators, "warnings": ["careful"], "losses": [Loss("gap", "a gap", "/imu")], **changes}
    return report(None, **content)


def test_the_report_for_people_is_this():
    spans = [
        Event("ukf diverged", 5 * SECOND, 6 * SECOND, ""),
        Event("ukf diverged", 2 * SECOND, 2 * SECOND + 250_000_000, ""),
    ]
    assert report_markdown(_report(segments=spans)).splitlines() == [
        "# drive", "", "drive.mcap (mcap), 10.0 s", "",
        "## Warnings", "", "- careful", "",
        "## Losses", "", "- a gap (/imu)", "",
        "## Estimators", "",
        "- **ukf** (causal): a; b; diverged for 1.25 s in 2 intervals, first at 2.00 s",
        "- **smooth** (not causal)",
    ]  # fmt: skip
    assert lines_of("diverged", _report(segments=spans[:1]), "ukf") == ["diverged for 1.00 s, first at 5.00 s"]
    assert lines_of("diverged", _report(segments=spans), "smooth") == []
    assert "Warnings" not in report_markdown(_report(warnings=[], losses=[]))
    verdict = {"id": "S", "label": "sideslip RMSE ≤ 1°", "reason": "1.2° (95 % CI 1.1° to 1.3°)", "next": ""}
    verdict["outcome"] = "FAIL"
    text = report_markdown(_report(plan={"file": "p.toml", "requirements": [verdict]}))
    assert "- **FAIL** sideslip RMSE ≤ 1°: 1.2° (95 % CI 1.1° to 1.3°)" in text


UNKNOWN = {"file": None, "proven": False}


def texts(main: MainFacts = MAIN, **changes: Any) -> dict[str, str]:
    found: dict[str, str] = report(main, **changes)["answer"]["texts"]
    return found


def test_the_result_says_how_good_against_which_truth_and_against_whom():
    said = texts(metrics=errors_deg(pd_hef=0.1, physics=0.12, zero=1.0))["result"]
    assert said == (
        "Sideslip RMSE of pd-hef: 0.100° (ground truth: /ins), 17 % lower than physics (0.120°), "
        "1/10 of zero sideslip (1.00°)"
    )


def test_the_interval_of_the_error_needs_six_blocks_of_time():
    def said(count: int) -> str:
        value = np.deg2rad(np.linspace(0.08, 0.12, count)).tolist()
        blocks = RequirementBlocks(SIDESLIP.measured, 10.0, range(count), [9] * count, (), (), value)
        return texts(metrics=errors_deg(pd_hef=0.1), requirement_blocks=[blocks])["result"]

    assert "0.100° (95 % CI 0.085° to 0.119°; ground truth: /ins)" in said(6)
    assert "CI" not in said(5)


@pytest.mark.parametrize(
    ("own", "said"),
    [
        (1.0, "equal to zero sideslip"),
        (0.99, "equal within 3 % to zero sideslip"),
        (1.5, "50 % higher than zero sideslip"),
        (3.0, "3.0 times zero sideslip"),
    ],
)
def test_an_estimate_that_is_worse_than_none_is_said_to_be_of_no_use(own, said):
    result = texts(metrics=errors_deg(pd_hef=own, zero=1.0))["result"]
    assert said in result
    assert ("worse than a constant" in result) == (own > 1.1)


def test_a_truth_that_is_an_input_is_no_independent_check():
    metrics = errors_deg(pd_hef=0.1)
    dependent = TRUTH | {"not_independent": ["sideslip_rad"]}
    assert "not an independent check" in texts(metrics=metrics, truth=dependent)["result"]
    assert "not an independent check" not in texts(metrics=metrics)["result"]


@pytest.mark.parametrize(
    ("share", "said"),
    [
        (1.0, "(nominal 95 %), wider than necessary"),
        (0.95, "(nominal 95 %) ("),
        (0.91, "(nominal 95 %), slightly too narrow"),
        (0.7, "(nominal 95 %), too narrow"),
    ],
)
def test_whether_the_band_holds(share, said):
    band = texts(metrics=[*errors_deg(pd_hef=0.1), *figures(("pd-hef", "sideslip_rad", "coverage95", share))])["band"]
    assert band.startswith(f"coverage {100 * share:.0f} % {said}")
    assert band.endswith("(intervals: own, parameters and sensors)")


def test_a_truth_of_gnss_alone_says_why_there_is_no_figure():
    said = texts(truth=GNSS, metrics=figures(("pd-hef", "vx_m_s", "rmse", 0.05)))
    assert "not the heading" in said["result"]
    assert "v_x 0.05 m/s" in said["result"]
    assert said["band"].startswith("coverage unknown")


@pytest.mark.parametrize(("d2", "proof"), [(0.1, "not a proof"), (0.95, "inconclusive")])
def test_without_truth_the_consistency_is_put_in_words(d2, proof):
    metrics = figures(
        ("pd-hef", "vy_m_s", "d2", d2), ("zero", "vy_m_s", "d2", 1.0),
        ("pd-hef", "state", "nis", 6.0), ("pd-hef", "state", "nis_dof", 2.0),
    )  # fmt: skip
    said = texts(truth=truth(), metrics=metrics)
    assert "is unknown" in said["result"]
    assert proof in said["consistency"]
    assert "NIS per degree of freedom 3.00 (expected value 1): model or noise are wrong" in said["consistency"]
    assert texts(metrics=metrics)["consistency"] == ""


def test_what_was_assumed_of_car_friction_and_network():
    assert texts()["assumed"] == (
        "car golf, validated on drives with ground truth; friction given (option, 0.9); "
        "residual gain 0.5 within the region of validity"
    )
    unknown = texts(vehicle=UNKNOWN)
    assert unknown["assumed"].startswith("default sedan (no car given)")
    assert unknown["next"].startswith("give your car")
    assumed = texts(friction={"source": "no value given", "value": 1.0, "topic": None, "given": False})
    assert "friction assumed (no value given, 1);" in assumed["assumed"]
    assert "--friction" in assumed["next"]
    assert texts(replace(MAIN, name="zero"))["assumed"] == "no vehicle model (zero needs none)"
    without = {**MODEL, "algorithm": "adaptive-physics", "options": {}}
    unused = {n: texts(replace(MAIN, name=n), estimators=[ran(n, algorithm=without)]) for n in ("pd-hef", "physics")}
    assert {n: "no network was trained" in said["assumed"] for n, said in unused.items()} == {
        "pd-hef": True, "physics": False,
    }  # fmt: skip


def test_the_next_steps_are_few_and_the_most_important_first():
    lacking = [
        ran("physics", outcome="skipped", reason="the log has no steer_rad", algorithm=None),
        ran("zero", algorithm=None),
    ]
    said = texts(replace(MAIN, name="zero"), estimators=lacking, vehicle=UNKNOWN)["next"]
    assert said.startswith("map the missing signals (the log has no steer_rad)")
    assert said.count("; ") == 1
    distrusted = replace(MAIN, name="open-loop", why="pd-hef contradicts", distrusted=True)
    estimators = [ran("open-loop")]
    said = texts(distrusted, estimators=estimators)
    assert "pd-hef contradicts" in said["assumed"]
    assert said["next"].startswith("check the vehicle file")
    assert texts()["next"] == ""


@pytest.mark.parametrize(("own", "zero"), [(0.3, 0.0), (0.0, 0.3), (0.0, 0.0)])
def test_an_error_of_nothing_is_no_division(own, zero):
    result = texts(metrics=errors_deg(pd_hef=own, zero=zero))["result"]
    assert ("the sideslip of the ground truth is 0 throughout" in result) == (zero == 0.0)
