"""A model file determines sensors and car before the drive: later data do not change them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool import Car, estimate, load_mapping, read_drive
from pdhef_logtool.car.model import CarModel, TaughtParameter, read_model
from pdhef_logtool.drive import reading
from pdhef_logtool.drive.options import OFF, ReadOptions
from pdhef_logtool.drive.plan import with_earlier_drive
from pdhef_logtool.estimators.table import spec_of
from pdhef_logtool.estimators.vehicle_ukf import of_car
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.model.measured_noise import measured_noise
from pdhef_logtool.records.errors import MappingError, VehicleError
from pdhef_logtool.records.signals import Signals
from truthsim.drive import simulate_drive, write_drive
from truthsim.sensors import SensorNoise

CHANGE_S = 30.0


#: Fields that change their sign when the IMU is turned by half a turn about the vertical.
TURNED = tuple(f"{vector}.{axis}" for vector in ("linear_acceleration", "angular_velocity") for axis in "xy")


class ChangedLater:
    """A log with a change: from a given time on, its IMU is rotated by 180° and its messages arrive 70 ms later."""

    def __init__(self, log: Any, change_ns: int) -> None:
        self._log, self._change_ns = log, change_ns

    def __getattr__(self, name: str) -> Any:
        return getattr(self._log, name)

    def read(self, requests: Any, start_ns: Any = None, end_ns: Any = None, **options: Any) -> dict[str, Any]:
        columns = dict(self._log.read(requests, start_ns, end_ns, **options))
        for topic, read in columns.items():
            later = read.log_time_ns >= self._change_ns
            changed = {
                path: np.where(later, -values, values) if path in TURNED else values
                for path, values in read.fields.items()
            }
            columns[topic] = replace(read, fields=changed, log_time_ns=read.log_time_ns + later * 70_000_000)
        return columns


def signals(log: Path, options: ReadOptions) -> tuple[Signals, CarModel]:
    with read_drive(log, Car.load("saloon"), options=options) as drive:
        return drive.whole().signals, DriveModel.of(drive).file


@pytest.fixture
def file(road, tmp_path):
    """Return the model of the drive before the change."""
    _, model = signals(road, ReadOptions(end=str(CHANGE_S - 5.0)))
    path = tmp_path / "model.toml"
    path.write_text(model.toml("Of a test.\nTwo lines."))
    return path


@pytest.fixture(scope="module")
def road(sample_logs_dir):
    return sample_logs_dir / "road.mcap"


@pytest.mark.slow
def test_no_causal_estimate_depends_on_the_future(road, file, monkeypatch):
    """Of every estimator, with a model file."""
    options = ReadOptions(model=file, end="60")

    def estimates() -> dict[str, Any]:
        with read_drive(road, Car.load("saloon"), options=options) as drive:
            tracks = estimate(drive, ["all"]).tracks
        return {name: track for name, track in tracks.items() if name != "truth"}

    as_recorded = estimates()
    really_open = reading.open_log

    def opened(*args: Any, **more: Any) -> Any:
        log = really_open(*args, **more)
        return ChangedLater(log, log.start_ns + round(CHANGE_S * 1e9))

    monkeypatch.setattr(reading, "open_log", opened)
    changed = estimates()
    assert len(changed) > 8
    for name, track in as_recorded.items():
        rows = track.stamps_ns < track.stamps_ns[0] + (CHANGE_S - 3.0) * 1e9
        same = np.array_equal(track.sideslip_rad[rows], changed[name].sideslip_rad[rows], equal_nan=True)
        assert same == spec_of(name).causal, name


def test_a_model_is_read_back_as_it_was_written_and_gives_the_same_signals(road, tmp_path):
    whole, model = signals(road, ReadOptions())
    model = model.model_copy(update={"parameters": (TaughtParameter(name="yaw inertia", value=1510.0, std=0.02),)})
    path = tmp_path / "model.toml"
    path.write_text(model.toml("Of a test.\nTwo lines."))
    assert path.read_text().startswith("# Of a test.\n# Two lines.\n")
    read, written = (json.dumps(m.model_dump(), sort_keys=True) for m in (read_model(path), model))
    assert read == written
    saloon = Car.load("saloon")
    car, _ = with_earlier_drive(saloon, path)
    assert car.taught_prior == model.parameters
    own = CarModel(physics_sha256=saloon.physics_sha256, truth="ground truth", parameters=model.parameters[:0])
    car, _ = with_earlier_drive(replace(saloon, model=own), path)
    assert car.model is not None and (car.model.truth, car.taught_prior) == ("ground truth", model.parameters)
    again, _ = signals(road, ReadOptions(model=path))
    np.testing.assert_array_equal(whole.ay_m_s2, again.ay_m_s2)
    np.testing.assert_array_equal(whole.ready_ns, again.ready_ns)
    with pytest.raises(VehicleError, match=r"expected a model of the car .*, got one of the vehicle file"):
        with_earlier_drive(Car.load(), path)


def test_a_model_that_does_not_fit_is_refused_in_one_line(road, file):
    text = file.read_text().replace("/imu/data", "/imu/other")
    file.write_text(text)
    with pytest.raises(MappingError, match="/imu/other"):
        signals(road, ReadOptions(model=file))
    file.write_text(text.replace("decided_s", "decided"))
    with pytest.raises(VehicleError, match="decided_s"):
        signals(road, ReadOptions(model=file))
    with pytest.raises(VehicleError, match=r"auto, off or a model\.toml"):
        signals(road, ReadOptions(model="of"))


def test_sensors_show_a_model_car_without_a_vehicle_file_and_its_model_belongs_to_later_drives(tmp_path):
    time = np.arange(0.0, 40.0, 0.01)
    speed, angle = 2.0 + 0.5 * np.sin(0.3 * time), 0.15 * np.sin(1.5 * time) + 0.05 * np.sin(0.4 * time)
    rate = speed * np.tan(angle) / 0.4
    log, mapping = tmp_path / "small.csv", tmp_path / "mapping.toml"
    columns = {"speed_m_s": speed, "steer_rad": angle, "yaw_rate_rad_s": rate, "ay_m_s2": speed * rate}
    rows = np.column_stack([time, *columns.values()])
    np.savetxt(log, rows, delimiter=",", header=",".join(["time", *columns]), comments="")
    table = '[signals.{0}]\ntopic = "csv"\nfield = "{0}"\nstamp = "log_time"\n'
    mapping.write_text("".join(map(table.format, columns)))
    with read_drive(log, Car.load(), load_mapping(mapping)) as drive:
        assert drive.car.vehicle.wheelbase_m == pytest.approx(0.4, abs=0.01)
        assert drive.car.vehicle.name == "model car of 0.4 m"
        assert any("the default car is scaled" in note for note in drive.notes)
        model = DriveModel.of(drive).file
    with read_drive(log, Car.load(), load_mapping(mapping), ReadOptions(model=OFF)) as drive:
        assert drive.car.vehicle == Car.load().vehicle
    path = tmp_path / "model.toml"
    taught = TaughtParameter(name="yaw inertia", value=0.3, std=0.02)
    path.write_text(model.model_copy(update={"parameters": (taught,)}).toml("Of a test."))
    later, _ = with_earlier_drive(Car.load(), path)
    assert later.vehicle.wheelbase_m == model.wheelbase_m and later.taught_prior == (taught,)


NOISY = SensorNoise(acceleration_m_s2=1.0, yaw_rate_rad_s=0.05, wheel_speed_m_s=0.5)


def slalom(folder: Path, noise: SensorNoise) -> Path:
    log = folder / "drive.mcap"
    write_drive(simulate_drive("slalom", seed=3, noise=noise), log)
    return log


@pytest.mark.parametrize("noise", [NOISY, SensorNoise()], ids=["noisy", "sound"])
def test_noisy_sensors_are_taken_as_noisy_and_sound_ones_keep_their_noise(tmp_path, noise):
    with read_drive(slalom(tmp_path, noise), Car.load(None), None, ReadOptions()) as drive:
        posterior = DriveModel.fit(drive).posterior
    if noise is NOISY:
        assert posterior.r_std["yaw_rate_rad_s"] == pytest.approx(NOISY.yaw_rate_rad_s, rel=0.4)
        assert "yaw_rate_rad_s 0.0" in posterior.text
    else:
        assert (posterior.r_std, "noise" in posterior.text) == ({}, False)


def test_a_model_that_explains_the_yaw_rate_worse_with_more_noise_keeps_its_noise(tmp_path, monkeypatch):
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
