"""Each error is planted once and taken off once, however often the drive is inspected."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.drive.plan import plan_drive, with_gyro_delay
from pdhef_logtool.drive.survey import Survey, mapping_proposals, survey_log
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import Mapping, auto_map, fit_clocks, load_mapping
from pdhef_logtool.runs.inspection.report import inspect_drive_log, write_mapping
from tests.turned_log import TurnedLog, rotation

DELAY_S, LEVER_M, GAIN = 0.040, -1.45, 1.06
AY_DELAY_S = 0.024
CAR = default_vehicle().model_copy(update={"name": "other"})


class WrongLog(TurnedLog):
    """An IMU on its side and off the CG, late, its gyro with a gain, and a steering of the wrong sign."""

    def read(self, requests: dict[str, list[str]], start_ns: int, end_ns: int, **options: bool) -> dict[str, Any]:
        found = super().read(requests, start_ns, end_ns, **options)
        if "/imu/data" in found:
            columns = found["/imu/data"]
            fields = dict(columns.fields)
            time_s = (columns.log_time_ns - columns.log_time_ns[0]) * 1e-9
            rates = np.stack([fields[f"angular_velocity.{a}"] for a in "xyz"], axis=1)
            smooth = np.convolve(rates @ self._turn[2], np.ones(11) / 11.0, mode="same")
            turning = np.gradient(smooth, time_s)
            for i, axis in enumerate("xyz"):
                name = f"angular_velocity.{axis}"
                fields[name] = GAIN * np.interp(time_s - DELAY_S, time_s, fields[name])
                # The lever acts along the car's left.
                felt = fields[f"linear_acceleration.{axis}"] + LEVER_M * turning * self._turn[1, i]
                fields[f"linear_acceleration.{axis}"] = np.interp(time_s - AY_DELAY_S, time_s, felt)
            found["/imu/data"] = replace(columns, fields=fields)
        for columns in found.values():
            if "steering_tire_angle" in columns.fields:
                columns.fields["steering_tire_angle"] = -columns.fields["steering_tire_angle"]
        return found


@pytest.fixture(scope="module")
def log(sample_logs_dir: Path):
    opened = open_log(sample_logs_dir / "sweep.mcap")
    yield WrongLog(opened, rotation(90, 0, 0))
    opened.close()


def surveyed(log, mapping: Mapping, vehicle: VehicleParameters) -> Survey:
    mapping = with_gyro_delay(mapping, vehicle)
    clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
    return survey_log(log, mapping, clocks, (log.start_ns, log.end_ns))


def inspected(log, mapping: Mapping, path: Path) -> Mapping:
    write_mapping(inspect_drive_log(log, mapping if mapping.origin == "file" else None), path)
    return load_mapping(path)


@pytest.mark.parametrize("times", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_each_error_is_taken_off_once_however_often(log, tmp_path: Path, times: int) -> None:
    mapping = auto_map(log).mapping
    for number in range(times):
        mapping = inspected(log, mapping, tmp_path / f"{number}.toml")
    plan = plan_drive(log, mapping, CAR, log.start_ns, log.end_ns)
    assert plan.mapping.signals["steer_rad"].scale == -1.0
    assert plan.mapping.signals["ay_m_s2"].field == "linear_acceleration.z"
    assert plan.mapping.signals["yaw_rate_rad_s"].field == "angular_velocity.y"
    assert plan.mapping.signals["yaw_rate_rad_s"].latency_s == pytest.approx(DELAY_S, abs=0.003)
    assert plan.mapping.signals["ay_m_s2"].latency_s == pytest.approx(AY_DELAY_S, abs=0.008)
    # Place of the accelerometer and gain of the gyro belong to the vehicle file: a check names the values.
    assert {c.name for c in plan.checks if c.verdict == "failed"} == {"ay_m_s2.place", "yaw_rate_rad_s.gain"}
    assert abs(plan.truth_latency_s) < 0.003
    assert mapping_proposals(surveyed(log, mapping, CAR)) == ()


def test_proposals_say_where_they_belong_and_why(log) -> None:
    found = inspect_drive_log(log)
    assert {p.subject for p in found.proposals} == {"yaw_rate_rad_s", "ay_m_s2"}, (
        "a sign is corrected in a recognised mapping itself"
    )
    file = inspect_drive_log(log, replace(auto_map(log).mapping, origin="file"))
    assert {p.subject for p in file.proposals} >= {"ay_m_s2", "yaw_rate_rad_s"}
    assert all(p.evidence for p in found.proposals)
    assert [p["subject"] for p in found.to_dict()["proposals"]] == [p.subject for p in found.proposals]


class TurnedTruth(TurnedLog):
    """A log with the body velocity of its ground truth rotated by 0.4 degrees."""

    def read(self, requests: dict[str, list[str]], start_ns: int, end_ns: int, **options: bool) -> dict[str, Any]:
        found = dict(self._log.read(requests, start_ns, end_ns, **options))
        c, s = np.cos(np.radians(0.4)), np.sin(np.radians(0.4))
        for topic, columns in found.items():
            vx, vy = (columns.fields.get(f"twist.twist.linear.{a}") for a in "xy")
            if vx is not None and vy is not None:
                turned = {"twist.twist.linear.x": c * vx - s * vy, "twist.twist.linear.y": s * vx + c * vy}
                found[topic] = replace(columns, fields={**columns.fields, **turned})
        return found


@pytest.mark.slow
def test_a_turned_truth_is_turned_back_once(sample_logs_dir: Path, tmp_path: Path) -> None:
    opened = open_log(sample_logs_dir / "road.mcap")
    log = TurnedTruth(opened, np.eye(3))
    found = inspect_drive_log(log)
    assert {p.subject for p in found.proposals} == {"truth.vx_m_s", "truth.vy_m_s"}
    write_mapping(found, tmp_path / "mapping.toml")
    mapping = load_mapping(tmp_path / "mapping.toml")
    again = inspect_drive_log(log, mapping)
    opened.close()
    assert again.proposals == ()
    assert not [c for c in again.checks if c.verdict == "failed"]
    assert mapping.truth["vy_m_s"].scale[0] == pytest.approx(-np.radians(0.4), abs=np.radians(0.06))
