"""Files that a run writes for the pages: planted faults, the verdict of a plan, and reasons without ground truth."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from tests.run_report import follows

pytestmark = pytest.mark.slow


def run(log: str, sample_logs_dir: Path, out: Path, **changes: Any) -> dict[str, Any]:
    config = RunConfig(car=Path("saloon"), keep="estimates", **changes)
    run_logs([str(sample_logs_dir / f"{log}.mcap")], out, config, report=False)
    report = json.loads((out / "logs" / log / "report.json").read_text())
    follows(report)
    return report


def test_a_drive_with_truth_has_all_of_it(sample_logs_dir: Path, tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text('[[requirement]]\nid = "a"\nsignal = "sideslip_rad"\nlimit_deg = 90.0\n')
    report = run("road", sample_logs_dir, tmp_path / "out", plan=plan, start="+60", end="+130")
    of_run = json.loads((tmp_path / "out" / "run.json").read_text())
    figure = {(m["estimator"], m["signal"], m["metric"], m["segment"]): m["value"] for m in report["metrics"]}
    low, high = report["answer"]["sideslip_rmse_ci_rad"]
    assert low < figure["pd-hef", "sideslip_rad", "rmse", "all"] < high
    assert f"(95 % CI {math.degrees(low):.3f}° to {math.degrees(high):.3f}°; " in report["answer"]["texts"]["result"]
    assert report["plan"]["requirements"][0]["outcome"] == "PASS"
    (judged,) = of_run["plan"]["requirements"]
    assert (judged["outcome"], judged["basis"], judged["units"]) == ("PASS", "blocks", 7)
    assert judged["exposure"]["minutes"] == pytest.approx(62.5 / 60.0, rel=0.02)  # of 70 s
    largest = report["largest_errors"][0]
    assert abs(largest["error_rad"]) <= figure["pd-hef", "sideslip_rad", "max_abs", "all"] * 1.001
    assert all(place["stamp_ns"] >= report["log"]["start_ns"] + 2e9 for place in report["largest_errors"])
    seconds = sum(c["seconds"] for c in report["operating_space"]["cells"])
    assert seconds == pytest.approx(report["log"]["duration_s"], rel=0.05)
    assert report["metadata"]
