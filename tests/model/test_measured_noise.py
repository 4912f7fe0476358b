"""The measurement noise that a drive shows: raised for noisy sensors, not for sound ones or a wrong model."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.vehicle_ukf import of_car
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.model.measured_noise import measured_noise
from truthsim.drive import simulate_drive, write_drive
from truthsim.sensors import SensorNoise

NOISY = SensorNoise(acceleration_m_s2=1.0, yaw_rate_rad_s=0.05, wheel_speed_m_s=0.5)


def slalom(folder: Path, noise: SensorNoise) -> Path:
    log = folder / "drive.mcap"
    write_drive(simulate_drive("slalom", seed=3, noise=noise), log)
    return log


def test_noisy_sensors_are_taken_as_noisy(tmp_path: Path) -> None:
    with read_drive(slalom(tmp_path, NOISY), Car.load(None), None, ReadOptions()) as drive:
        posterior = DriveModel.fit(drive).posterior
    assert posterior is not None
    assert posterior.r_std["yaw_rate_rad_s"] == pytest.approx(NOISY.yaw_rate_rad_s, rel=0.4)
    assert "yaw_rate_rad_s 0.0" in posterior.text


def test_sound_sensors_keep_their_noise(tmp_path: Path) -> None:
    with read_drive(slalom(tmp_path, SensorNoise()), Car.load(None), None, ReadOptions()) as drive:
        posterior = DriveModel.fit(drive).posterior
    assert posterior is not None
    assert posterior.r_std == {}
    assert "noise" not in posterior.text


def test_a_model_that_explains_the_yaw_rate_worse_with_more_noise_keeps_its_noise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with read_drive(slalom(tmp_path, SensorNoise()), Car.load(None), None, ReadOptions()) as drive:
        model = DriveModel.fit(drive)
        calibrated = model.calibrated(drive.whole().signals)
    vehicle = model.car.calibrated_car.physics_vehicle
    # A car that is far too quick to turn: the innovations are large, the sensors are sound.
    wrong = vehicle.model_copy(update={"cg_to_front_axle_m": 0.3})
    physics = replace(of_car(model.car.calibrated_car), vehicle=wrong, r_std=(0.02, 0.0003, 0.02))
    assert measured_noise(calibrated, physics) == {}
    monkeypatch.setattr("pdhef_logtool.model.measured_noise.EXPLAINED", 2.0)
    assert measured_noise(calibrated, physics)["yaw_rate_rad_s"] > 0.0003
