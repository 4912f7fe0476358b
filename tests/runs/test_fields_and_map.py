"""Every number of a log, the way to a mapping by question and answer, and the estimators that can run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pdhef_logtool.mapping import SignalSource, load_mapping
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.runs.inspection import (
    ask_mapping,
    fields_of_log,
    inspect_log,
    render_fields,
    render_inspection,
    write_mapping,
)
from pdhef_logtool.storage.documents import jsonable
from tests.command_line import rendered


def test_covariances_do_not_hide_the_gyro(sample_logs_dir: Path) -> None:
    found = fields_of_log(sample_logs_dir / "dlc.mcap", "/imu/data")
    (topic,) = found["topics"]
    paths = [f["path"] for f in topic["fields"]]
    assert "angular_velocity.z" in paths
    assert sum("covariance" in p for p in paths) == 3
    gravity = next(f for f in topic["fields"] if f["path"] == "linear_acceleration.z")
    assert gravity["type"] == "float64"
    assert gravity["minimum"] <= gravity["mean"] <= gravity["maximum"]
    assert found["whole"]
    text = rendered(render_fields, found)
    assert max(map(len, text.splitlines()[1:])) <= 80
    json.dumps(jsonable(found), allow_nan=False)


def test_all_topics_are_listed_and_a_wrong_one_is_refused(sample_logs_dir: Path) -> None:
    found = fields_of_log(sample_logs_dir / "dlc.mcap")
    assert len(found["topics"]) > 5
    with pytest.raises(UsageError, match="topics: "):
        fields_of_log(sample_logs_dir / "dlc.mcap", "/imu")


@pytest.mark.slow
def test_missing_signals_are_named_and_doubtful_candidates_stand_in_the_file_as_comments(
    shared_dir: Path, tmp_path: Path
) -> None:
    found = inspect_log(shared_dir / "reader_corpus" / "dart_ros1" / "4_sept_random_driving_fast.bag")
    text = rendered(render_inspection, found, 200)
    assert "speed_m_s" in next(line for line in text.splitlines() if line.startswith("missing"))
    assert "pdhef map LOG" in text
    write_mapping(found, tmp_path / "m.toml")
    text = (tmp_path / "m.toml").read_text()
    assert "undecided: /steering_angle_1.data is taken" in text
    assert '# topic = "/steering_1"' in text
    assert "score 0." in text
    assert set(load_mapping(tmp_path / "m.toml").signals) == {"steer_rad"}


def test_a_mapping_by_question_and_answer(shared_dir: Path) -> None:
    found = inspect_log(shared_dir / "data" / "drives" / "lunda_v40")
    said: list[str] = []
    answers = iter(
        ["", "1", "nonsense", "/vbox y_accel_g", "/vbox/sample y_accel_g -9.81", "-", "", "", "", "", "", ""]
    )
    mapping = ask_mapping(found, lambda _: next(answers), said.append)
    assert mapping.signals["steering_wheel_rad"] == found.mapping.signals["steering_wheel_rad"]
    assert mapping.signals["yaw_rate_rad_s"].field == "yaw_rate_gnss_deg_s"
    assert mapping.signals["ay_m_s2"] == SignalSource("ay_m_s2", "/vbox/sample", "y_accel_g", scale=-9.81)
    assert "ax_m_s2" not in mapping.signals
    assert said[-1] == "missing: ax_m_s2"
    assert any("*" in line and "steer_ang_deg" in line for line in said)
