"""A gyro that sticks in a simulated drive: the report, the recording's tables and the terminal say so."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from pdhef_logtool.cli.run_tables import render_run
from pdhef_logtool.records.reasons import STUCK_YAW_RATE
from pdhef_logtool.residual_model.bundle import ModelBundle, Normalisation
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.residual_model.network import ResidualNetwork
from pdhef_logtool.results.parquet_sink import read_track
from pdhef_logtool.results.run_report import report_markdown
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.runs.run_result import RunResult
from tests.run_report import follows
from truthsim.drive import simulate_drive, write_drive
from truthsim.faults import parse_fault

pytestmark = pytest.mark.slow

START_S, END_S = 2.0, 4.0


@pytest.fixture(scope="module")
def stuck_run(sample_logs_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[RunResult, Path]:
    folder = tmp_path_factory.mktemp("stuck")
    fault = parse_fault(f"stuck:yaw_rate:{START_S:g}:{END_S:g}")
    write_drive(simulate_drive("sine-sweep", seed=5, duration_s=8.0, faults=[fault]), folder / "stuck.mcap")
    torch.manual_seed(0)
    n = len(FEATURES)
    network = ResidualNetwork(n, 8, 1, (4,))
    weights = {k: v.numpy().copy() for k, v in network.state_dict().items()}
    scale = Normalisation((0.0,) * n, (10.0,) * n, (1.0, 1.0))
    ModelBundle(FEATURES, 8, 1, (4,), 0.01, scale, weights).save(folder / "model")
    config = RunConfig(
        car=sample_logs_dir / "vehicle.toml",
        network=folder / "model",
        estimators=("phy-ukf", "pd-hef"),
        keep="estimates",
    )
    return run_logs(
        [str(folder / "stuck.mcap")], folder / "out", config, report=False
    ), folder / "out" / "logs" / "stuck"


def told(text: str) -> tuple[float, float]:
    found = re.search(r"gyro stuck (\d+\.\d)-(\d+\.\d) s", text)
    assert found, text
    return float(found[1]), float(found[2])


def test_the_report_says_when_the_gyro_stuck(stuck_run: tuple[RunResult, Path]) -> None:
    _, folder = stuck_run
    report = json.loads((folder / "report.json").read_text())
    follows(report)
    filters = {e["name"]: e["reasons"] for e in report["estimators"]}
    assert filters["phy-ukf"] is None
    (stuck,) = [r for r in filters["pd-hef"] if r["name"] == "stuck_yaw_rate"]
    assert stuck["intervals"] == 1 and stuck["longest"] == [{"start_ns": stuck["first_ns"], "end_ns": stuck["end_ns"]}]
    # It is reported after it has lasted for 0.05 s.
    assert told(report_markdown(report)) == (pytest.approx(START_S, abs=0.11), pytest.approx(END_S, abs=0.11))


def test_the_track_has_the_bit_where_the_gyro_stuck_and_nowhere_else(stuck_run: tuple[RunResult, Path]) -> None:
    track = read_track(stuck_run[1] / "estimates.parquet", "pd-hef")
    times = (track.stamps_ns - track.stamps_ns[0]) * 1e-9
    stuck = track.reason & STUCK_YAW_RATE > 0
    assert stuck[(times > START_S + 0.1) & (times < END_S - 0.05)].all()
    assert not stuck[(times < START_S) | (times > END_S + 0.1)].any()
    assert np.isfinite(track.mixture_weight[track.valid]).all()


def test_the_terminal_says_it_in_one_line(stuck_run: tuple[RunResult, Path]) -> None:
    out = io.StringIO()
    render_run(stuck_run[0], Console(file=out, width=200))
    (line,) = [one for one in out.getvalue().splitlines() if "gyro stuck" in one]
    assert line.strip().startswith("pd-hef: ")
    assert told(line) == (pytest.approx(START_S, abs=0.11), pytest.approx(END_S, abs=0.11))
