from __future__ import annotations

import importlib.metadata
import json
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.operating_space import AY_EDGES_M_S2, SPEED_EDGES_M_S
from pdhef_logtool.evaluation.reasons import Interval, sensor_fault
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.results.plotted import colour_rgb
from pdhef_logtool.results.run_report import LogOutcome, build_run, lines_of, report_markdown, tool_versions, write_json
from pdhef_logtool.results.sink import Event
from tests.run_report import SHA, VELOCITY, follows, ran, report, truth

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
    run = build_run(
        {"estimators": ["phy-ukf"], "start": None},
        None,
        [
            LogOutcome("a", "logs/a.mcap", SHA),
            LogOutcome("b", "logs/b.mcap", None, failed="no log"),
            LogOutcome("c", "logs/c.mcap", SHA, lost=["the last 3 s", "a chunk"]),
        ],
    )
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


def test_json_is_sorted_and_the_same_each_time_and_versions_are_installed(tmp_path):
    write_json(tmp_path / "a.json", {"b": [float("nan")], "a": float("inf"), "c": {"z": 1, "y": "β"}})
    assert (tmp_path / "a.json").read_bytes() == (
        '{\n "a": null,\n "b": [\n  null\n ],\n "c": {\n  "y": "β",\n  "z": 1\n }\n}\n'.encode()
    )
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]
    versions = tool_versions()
    assert versions["numpy"] == importlib.metadata.version("numpy") and "python" in versions


def test_colours_are_red_green_blue_and_a_names_own() -> None:
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


def test_the_report_for_people_is_this() -> None:
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
