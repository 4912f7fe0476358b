from __future__ import annotations

import json
from pathlib import Path

import jsonschema
import numpy as np
import pytest

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.operating_space import Cell, OperatingSpace
from pdhef_logtool.evaluation.reasons import Interval, SensorFault
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.results.run_report import LogOutcome, build_run, report_markdown, write_json
from pdhef_logtool.results.sink import Event
from tests.run_report import SHA, VELOCITY, follows, ran, report, truth

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


def test_faults_are_in_words():
    spans = [Interval(int(a * 1e9), int(b * 1e9)) for a, b in ((1.2, 1.21), (3.45, 3.46), (7, 8), (9, 9.01))]
    stuck, spike = (
        SensorFault("yaw_rate_rad_s", "stuck", 1, 1.0, (spans[2],)),
        SensorFault("ay_m_s2", "spike", 60, 1.0, tuple(spans)),
    )
    document = report(None, faults=[stuck, spike], estimators=[ran("phy-ukf", algorithm=None)])
    follows(document)
    words = "yaw rate stuck 7.0-8.0 s; a_y spike 1.20 s, 3.45 s, 7.0-8.0 s and 57 more"
    assert f"- {words}" in report_markdown(document).splitlines()


@pytest.mark.slow
def test_schema_misses_every_part():
    parts = "log mapping vehicle estimators truth metrics segments losses warnings remarks answer versions"
    for part in parts.split():
        document = report(**CONTENT)
        del document[part]
        with pytest.raises(jsonschema.ValidationError, match=part):
            follows(document)


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


def test_json_is_sorted_and_the_same_each_time(tmp_path):
    write_json(tmp_path / "a.json", {"b": 1, "a": float("inf"), "c": {"z": 1, "y": "β"}})
    assert (tmp_path / "a.json").read_bytes() == (
        '{\n "a": null,\n "b": 1,\n "c": {\n  "y": "β",\n  "z": 1\n }\n}\n'.encode()
    )
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]


def test_records_of_a_drive_follow_the_schema() -> None:
    fault = SensorFault("ay_m_s2", "spike", 70, 1.0, (Interval(1, 2),))
    space = OperatingSpace([Cell(3, 2, 1.5, 0, float("nan"))], 12.3, 2.5, 0.9)
    document = report(faults=[fault], metadata={"vehicle": "a"}, operating_space=space)
    follows({**document, "estimators": []})
    assert document["operating_space"]["cells"][0]["sideslip_mse_rad2"] is None
    assert report(faults=None)["faults"] is None
