"""A file of several runs: signals and ground truth must be of one of them."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import auto_map
from pdhef_logtool.mapping.choosing import choose_mapping
from pdhef_logtool.records.errors import MappingError

S = np.arange(0.0, 30.0, 0.01)


def write(path: Path, *runs: str) -> Path:
    scipy_io = pytest.importorskip("scipy.io")
    rate = 0.2 * np.sin(S)
    imu = {"time": S, "ax": np.cos(S), "ay": 15.0 * rate, "yaw_rate": rate}
    car = {"time": S, "steering_angle": 0.1 * np.sin(S), "vehicle_speed": 15.0 + 0.0 * S}
    scipy_io.savemat(path, {run: {"imu": imu, "car": car} for run in runs})
    return path


def test_a_choice_between_runs_is_asked_for(tmp_path: Path) -> None:
    with closing(open_log(write(tmp_path / "runs.mat", "run_1", "run_2"))) as log:
        with pytest.raises(MappingError, match="2 runs: run_1, run_2"):
            choose_mapping(log, None, prefer_truth="perfect")
        auto = auto_map(log)
    assert {s.topic for s in auto.mapping.sources()} == {"run_1_imu", "run_1_car"}
    assert [(a.subject, a.candidates) for a in auto.ambiguities] == [("run", ("run_1", "run_2"))]


def test_a_single_run_is_read(tmp_path: Path) -> None:
    with closing(open_log(write(tmp_path / "run.mat", "run_1"))) as log:
        assert "ay_m_s2" in choose_mapping(log, None, prefer_truth="perfect").mapping.signals
