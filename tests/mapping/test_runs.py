"""A file of several runs: signals and ground truth must be of one of them."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.table_file import TableSettings
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
        with pytest.raises(MappingError, match=r"2 runs: run_1, run_2.*--set group=run_1"):
            choose_mapping(log, None, prefer_truth="perfect")
        auto = auto_map(log)
    assert {s.topic for s in auto.mapping.sources()} == {"run_1_imu", "run_1_car"}
    assert [(a.subject, a.candidates) for a in auto.ambiguities] == [("run", ("run_1", "run_2"))]


def test_a_single_run_is_read(tmp_path: Path) -> None:
    with closing(open_log(write(tmp_path / "run.mat", "run_1"))) as log:
        assert "ay_m_s2" in choose_mapping(log, None, prefer_truth="perfect").mapping.signals


def test_the_answer_to_the_question_is_a_group(tmp_path: Path) -> None:
    path = write(tmp_path / "runs.mat", "run_1", "run_2")
    with closing(open_log(path, settings=TableSettings(group="run_2"))) as log:
        assert {s.topic for s in choose_mapping(log, None, prefer_truth="perfect").mapping.sources()} == {
            "run_2_imu", "run_2_car",
        }  # fmt: skip


@pytest.mark.parametrize("start_s", [0.0, 100.0])
def test_repeated_channel_groups_of_an_mdf_are_runs_if_one_follows_the_other(start_s: float, tmp_path: Path) -> None:
    asammdf = pytest.importorskip("asammdf")
    mdf = asammdf.MDF(version="4.10")
    rate = 0.2 * np.sin(S)
    columns = {
        "ax": np.cos(S),
        "ay": 15.0 * rate,
        "yaw_rate": rate,
        "steering_angle": 0.1 * np.sin(S),
        "speed": 15.0 + S,
    }
    for start in (0.0, start_s):
        mdf.append([asammdf.Signal(v, S + start, name=n) for n, v in columns.items()], acq_name="Fast", comment="Fast")
    path = mdf.save(tmp_path / "a.mf4")
    mdf.close()
    with closing(open_log(path)) as log:
        assert [t.name for t in log.topics] == ["Fast", "Fast_2"]
        runs = [a.candidates for a in auto_map(log).ambiguities if a.subject == "run"]
    assert runs == ([("1", "2")] if start_s else [])
    for group, name in (("1", "Fast"), ("2", "Fast_2")):
        with closing(open_log(path, settings=TableSettings(group=group))) as log:
            assert [t.name for t in log.topics] == [name]
