"""Recorded frames are evidence of how an IMU lies and where: held against the drive, believed only with gravity."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.drive.mounting import Survey, survey_log
from pdhef_logtool.logs.drive_log import TopicInfo
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import auto_map, fit_clocks
from pdhef_logtool.mapping.frames import placement_of
from tests.turned_log import TurnedLog, rotation

SECOND = 1_000_000_000


def quaternion(turn: np.ndarray) -> dict[str, float]:
    w = 0.5 * np.sqrt(max(0.0, 1.0 + np.trace(turn)))
    if w > 1e-6:
        x, y, z = ((turn[i, j] - turn[j, i]) / (4 * w) for i, j in ((2, 1), (0, 2), (1, 0)))
    else:
        values, vectors = np.linalg.eigh(turn)
        x, y, z = vectors[:, int(np.argmax(values))]
    return {"w": float(w), "x": float(x), "y": float(y), "z": float(z)}


def transform(parent: str, child: str, turn: np.ndarray, at: tuple[float, float, float]) -> dict[str, Any]:
    place = {"translation": dict(zip("xyz", at, strict=True)), "rotation": quaternion(turn)}
    return {"header": {"frame_id": parent}, "child_frame_id": child, "transform": place}


class FramedLog(TurnedLog):
    """A turned IMU, and frames that say how: ``box`` in ``base_link``, ``imu_link`` in ``box``."""

    def __init__(self, log: Any, turn: np.ndarray, said: np.ndarray) -> None:
        super().__init__(log, turn)
        box = rotation(0, 0, 90)
        self.messages = [
            {"transforms": [transform("/box", "imu_link", box.T @ said, (0.0, -1.2, 0.0))]},
            {"transforms": [transform("base_link", "box", box, (0.0, 0.1, 0.5))]},
        ]

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        return (*self._log.topics, TopicInfo("/tf_static", "tf2_msgs/msg/TFMessage", "cdr", 2))

    def fields(self, topic: str, **options: bool) -> Any:
        return () if topic == "/tf_static" else self._log.fields(topic, **options)

    def first_messages(self, topic: str, most: int) -> list[object]:
        if topic == "/tf_static":
            return list(self.messages)
        return [{"header": {"frame_id": "imu_link"}}] if topic == self._topic else []


@pytest.fixture(scope="module")
def drives(sample_logs_dir: Path):
    logs = {name: open_log(sample_logs_dir / f"{name}.mcap") for name in ("faults", "fishhook")}
    yield logs
    for log in logs.values():
        log.close()


def surveyed(log: Any, seconds: float = 60.0, origin: str = "auto") -> Survey:
    from dataclasses import replace

    mapping = replace(auto_map(log).mapping, origin=origin)
    clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
    return survey_log(log, mapping, clocks, (log.start_ns, log.start_ns + round(seconds * SECOND)))


def verdicts(survey: Survey) -> list[str]:
    return [c.verdict for c in survey.checks if c.name == "imu.frames"]


def test_frames_are_joined_from_the_sensor_to_the_car(drives) -> None:
    placed = placement_of(FramedLog(drives["faults"], np.eye(3), rotation(180, 0, 30)), "/imu/data")
    assert placed is not None
    assert (placed.frame, placed.base) == ("imu_link", "base_link")
    np.testing.assert_allclose(placed.rotation, rotation(180, 0, 30), atol=1e-12)
    assert placement_of(FramedLog(drives["faults"], np.eye(3), np.eye(3)), "/other") is None


def test_a_frame_that_moves_is_none(drives) -> None:
    log = FramedLog(drives["faults"], np.eye(3), np.eye(3))
    log.messages.append({"transforms": [transform("base_link", "box", np.eye(3), (3.0, 0.1, 0.5))]})
    assert placement_of(log, "/imu/data") is None


def test_the_drive_agrees_with_frames_that_are_right(drives) -> None:
    turn = rotation(180, 0, 90)
    assert verdicts(surveyed(FramedLog(drives["faults"], turn, turn))) == ["passed"]


def test_frames_that_contradict_the_drive_are_a_failed_check_and_not_taken(drives) -> None:
    turn = rotation(0, 0, 90)
    survey = surveyed(FramedLog(drives["faults"], turn, np.eye(3)))
    (check,) = (c for c in survey.checks if c.name == "imu.frames")
    assert check.verdict == "failed"
    assert "yaw 90 deg" in check.evidence
    assert survey.mapping.signals["ay_m_s2"].field == "linear_acceleration.x"


def test_frames_alone_turn_an_imu_where_gravity_agrees_and_this_is_said(drives) -> None:
    turn = rotation(180, 0, 90)
    survey = surveyed(FramedLog(drives["fishhook"], turn, turn), 2.0)
    assert survey.mapping.signals["ay_m_s2"].field == "linear_acceleration.x"
    assert verdicts(survey) == ["undecided"]
    assert "the recorded frames give it" in survey.mapping.notes[-1]
    file = surveyed(FramedLog(drives["fishhook"], turn, turn), 2.0, origin="file")
    assert file.mapping.signals["ay_m_s2"].field == "linear_acceleration.y"
    assert {c.verdict for c in file.mounted} == {"undecided"}


def test_frames_that_contradict_gravity_are_not_taken(drives) -> None:
    survey = surveyed(FramedLog(drives["fishhook"], rotation(0, 0, 90), rotation(90, 0, 0)), 2.0)
    assert verdicts(survey) == ["failed"]
    assert survey.mapping.signals["ay_m_s2"].field == "linear_acceleration.y"
