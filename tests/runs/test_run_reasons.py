"""An a_y that sticks and a gyro with bursts in a sample log: report, tables and terminal name them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.cli.run_tables import render_run
from pdhef_logtool.records.reasons import STUCK_AY
from pdhef_logtool.results.parquet_sink import read_track
from pdhef_logtool.results.run_report import report_markdown
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.runs.run_result import RunResult
from tests.command_line import rendered
from tests.run_report import follows

pytestmark = pytest.mark.slow

#: Planted faults, s from the start.
FAULTS = {("yaw_rate_rad_s", "burst"): (5.0, 8.0), ("ay_m_s2", "stuck"): (12.0, 14.0)}
START_S, END_S = FAULTS["ay_m_s2", "stuck"]


@pytest.fixture(scope="module")
def result(sample_logs_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> RunResult:
    config = RunConfig(car=Path("saloon"), estimators=("phy-ukf", "pd-hef"), keep="estimates", end="20")
    return run_logs([str(sample_logs_dir / "faults.mcap")], tmp_path_factory.mktemp("out"), config, report=False)


@pytest.fixture(scope="module")
def report(result: RunResult) -> dict[str, Any]:
    document = json.loads((Path(str(result.place)) / "logs/faults/report.json").read_text())
    follows(document)
    return dict(document)


def told(text: str) -> tuple[float, float]:
    found = re.search(r"a_y stuck (\d+\.\d)-(\d+\.\d) s", text)
    assert found, text
    return float(found[1]), float(found[2])


def test_the_report_names_the_faults_with_their_times(report: dict[str, Any]) -> None:
    assert report["plan"] is None  # nobody gave one, and one drive decides little
    start_ns = report["log"]["start_ns"]
    found = {
        (f["sensor"], f["kind"]): ((i["start_ns"] - start_ns) * 1e-9, (i["end_ns"] - start_ns) * 1e-9)
        for f in report["faults"]
        for i in f["intervals"]
    }
    assert found == {fault: pytest.approx(times, abs=0.7) for fault, times in FAULTS.items()}
    # It is reported after it has lasted for 0.05 s.
    assert told(report_markdown(report)) == pytest.approx((START_S, END_S), abs=0.11)


def test_the_track_has_the_bit_where_the_sensor_stuck_and_nowhere_else(
    result: RunResult, report: dict[str, Any]
) -> None:
    track = read_track(Path(str(result.place)) / "logs/faults/estimates.parquet", "pd-hef")
    times = (track.stamps_ns - report["log"]["start_ns"]) * 1e-9
    stuck = track.reason & STUCK_AY > 0
    assert stuck[(times > START_S + 0.1) & (times < END_S - 0.05)].all()
    assert not stuck[(times < START_S) | (times > END_S + 0.1)].any()
    assert np.isfinite(track.mixture_weight[track.valid]).all()


def test_the_terminal_says_it_in_one_line(result: RunResult) -> None:
    (line,) = [one for one in rendered(render_run, result, 200).splitlines() if "a_y stuck" in one]
    assert line.strip().startswith("faults of the sensors: ")
    assert told(line) == pytest.approx((START_S, END_S), abs=0.11)
