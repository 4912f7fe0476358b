"""A sensor profile replaces the sensors of a car. Each entry affects its signals, and a run records the profile."""

import json
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from reference_car import drive, slalom, with_noise

from pdhef_logtool.car import vehicle
from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.sensor_faults import without_faults
from pdhef_logtool.estimators.kinematic import Kinematic
from pdhef_logtool.estimators.pass_through import PassThrough
from pdhef_logtool.estimators.speed_slip import believable
from pdhef_logtool.estimators.vehicle_ukf import nominal_filter
from pdhef_logtool.records import reasons
from pdhef_logtool.records.errors import VehicleError
from pdhef_logtool.records.signals import SIGNAL_COLUMNS, Signals
from pdhef_logtool.runs.config import RunConfig, load_config
from pdhef_logtool.runs.fleet import run_logs

SAMPLES = Path(__file__).parents[2] / "sample_logs"


def car_with(**sensors: float) -> vehicle.VehicleParameters:
    return vehicle.default_vehicle().model_copy(update={"sensors": vehicle.Sensors(**sensors)})


@pytest.fixture(scope="module")
def clean():
    return with_noise(drive(slalom(), 8.0, speed=15.0).signals, seed=1)


def seconds(signals: Signals) -> np.ndarray:
    return (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9


def reasons_of(signals: Signals, **sensors: float) -> int:
    return int(np.bitwise_or.reduce(without_faults(signals, car_with(**sensors)).faults.astype(int)))


def masked(signals: Signals, column: str, gone: np.ndarray, value: float = np.nan) -> Signals:
    return replace(signals, **{column: np.where(gone, value, getattr(signals, column))})


def test_a_profile_replaces_the_sensors_and_makes_what_belongs_to_others_stale(tmp_path):
    file = tmp_path / "imu.toml"
    file.write_text("[sensors]\nay_std_m_s2 = 0.3\nimu_rate_hz = 200.0\n")
    car = Car.load("saloon", sensors=file)
    assert car.vehicle.sensors == vehicle.Sensors(ay_std_m_s2=0.3, imu_rate_hz=200.0)
    assert car.vehicle.mass_kg == Car.load("saloon").vehicle.mass_kg
    assert car.notes and car.physics_sha256 != Car.load("saloon").physics_sha256
    named = Car.load(None, sensors="production")
    assert named.vehicle.sensors == vehicle.SENSOR_PROFILES["production"]
    assert named.physics_sha256 == Car.load().physics_sha256


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("[sensors]\nimu_rate = 200.0\n", r"imu\.toml: sensors.*imu_rate_hz"),
        ("[sensors]\nimu_rate_hz = 0.0\n", r"imu\.toml: sensors.*imu_rate_hz"),
        ("imu_rate_hz = 200.0\n", r"a table \[sensors\].*got none.*production"),
    ],
)
def test_a_wrong_profile_is_refused_in_one_line(text, match, tmp_path):
    (tmp_path / "imu.toml").write_text(text)
    with pytest.raises(VehicleError, match=match):
        Car.load(None, sensors=tmp_path / "imu.toml")
    with pytest.raises(VehicleError, match=r"absent\.toml"):
        Car.load(None, sensors=tmp_path / "absent.toml")


def test_rates_and_held_samples_decide_what_is_a_fault(clean):
    t = seconds(clean)
    gone = (t > 4.0) & (t < 4.3)
    assert reasons_of(masked(clean, "ay_m_s2", gone)) & reasons.MISSING_AY
    assert not reasons_of(masked(clean, "ay_m_s2", gone), imu_hold_s=0.5) & reasons.MISSING_AY
    stuck = masked(clean, "ay_m_s2", (t > 4.0) & (t < 4.3), 1.0)
    assert reasons_of(stuck) & reasons.STUCK_AY
    assert not reasons_of(stuck, stuck_samples=60) & reasons.STUCK_AY
    noise = np.where((t > 4.0) & (t < 7.0), np.random.default_rng(0).normal(0.0, 2.0, len(t)), 0.0)
    burst = replace(clean, ay_m_s2=clean.ay_m_s2 + noise)
    assert reasons_of(burst) & reasons.BURST_AY
    assert not reasons_of(burst, imu_span_s=0.02) & reasons.BURST_AY  # 100 Hz is too slow for such a profile
    assert not reasons_of(burst, imu_rate_hz=1.0) & reasons.BURST_AY  # 100 samples count as one


def test_speed_and_steering_are_kept_for_the_times_of_the_profile(clean):
    t = seconds(clean)
    dark = masked(clean, "speed_m_s", t > 4.0)

    def lost_s(**sensors: float) -> float:
        values = PassThrough(car_with(**sensors), "zero").run(dark, None)[0].values[:, 0]
        return float(t[np.isfinite(values)].max())

    assert lost_s() == pytest.approx(4.5, abs=0.02)
    assert lost_s(speed_hold_s=1.5) == pytest.approx(5.5, abs=0.02)
    kinematic = Kinematic(car_with(speed_hold_s=1.5)).run(dark, None)[0].valid
    assert float(t[kinematic].max()) == pytest.approx(5.5, abs=0.02)
    lost = masked(clean, "steer_rad", t > 4.0)

    def steered_s(**sensors: float) -> float:
        steps, _ = nominal_filter(car_with(**sensors)).run(lost, None)
        return float(t[steps.valid].max())

    assert steered_s() == pytest.approx(4.2, abs=0.02)
    assert steered_s(steer_hold_s=1.0) == pytest.approx(5.0, abs=0.02)


def test_the_lowest_speed_of_wheels_with_few_pulses_is_no_slip():
    rolling = drive(lambda _: 0.0, 6.0, speed=1.6).signals
    t = seconds(rolling)
    gone = (t > 3.0) & (t < 4.0)
    silent = masked(rolling, "speed_m_s", gone, 0.0)
    assert believable(silent, vehicle.Sensors(), None)[0] is not silent
    assert believable(silent, vehicle.Sensors(speed_least_m_s=2.0), None)[0] is silent


def test_a_standstill_has_the_speed_and_the_yaw_rate_of_the_profile():
    parked = drive(lambda _: 0.0, 6.0, speed=0.2).signals
    offset = replace(parked, yaw_rate_rad_s=parked.yaw_rate_rad_s + 0.08)

    def still(signals: Signals, **sensors: float) -> bool:
        steps, _ = nominal_filter(car_with(**sensors)).run(signals, None)
        return bool((steps.x[-100:, 0] == 0.0).any())

    assert not still(parked)
    assert still(parked, speed_zero_m_s=0.5)
    assert not still(offset, speed_zero_m_s=0.5)
    assert still(offset, speed_zero_m_s=0.5, still_yaw_rate_rad_s=0.1)


def test_a_run_records_the_profile(tmp_path):
    file = tmp_path / "imu.toml"
    file.write_text("[sensors]\nspeed_hold_s = 0.7\n")
    config = load_config(None, {"sensor_profile": file, "estimators": ("zero",), "keep": "metrics"})
    run_logs([str(SAMPLES / "step.mcap")], tmp_path / "out", config)
    document = json.loads((tmp_path / "out" / "run.json").read_text())
    assert document["config"]["sensor_profile"] == "imu.toml"
    assert document["logs"][0]["car"]["sensors"] == {"speed_hold_s": 0.7}
    assert RunConfig().sensor_profile is None


#: Sensor bias per signal; all values differ, so that a swapped bias is detected.
TOO_MUCH = {"steer_rad": 0.011, "ax_m_s2": 0.21, "ay_m_s2": -0.37, "yaw_rate_rad_s": 0.0053}


def biased(offset: float, ratio: float, *biases: float) -> vehicle.VehicleParameters:
    names = ("ax_bias_m_s2", "ay_bias_m_s2", "yaw_rate_bias_rad_s")
    sensors = vehicle.Sensors(**dict(zip(names, biases, strict=True)))
    changes = {"steer_offset_rad": offset, "steering_ratio": ratio, "sensors": sensors}
    return vehicle.default_vehicle().model_copy(update=changes)


OFFSET, *BIASES = TOO_MUCH.values()
CAR = biased(OFFSET, vehicle.default_vehicle().steering_ratio, *BIASES)


def test_what_the_sensors_read_too_much_is_taken_off_and_nothing_else():
    true = drive(slalom(0.03, 0.5), speed=20.0, step_s=np.full(299, 0.01)).signals
    read = replace(true, **{name: getattr(true, name) + bias for name, bias in TOO_MUCH.items()})
    corrected = vehicle.correct_signals(read, CAR)
    for f in fields(Signals):
        if f.name in TOO_MUCH:
            np.testing.assert_allclose(getattr(corrected, f.name), getattr(true, f.name), atol=1e-12, err_msg=f.name)
        elif f.name in SIGNAL_COLUMNS:
            np.testing.assert_array_equal(getattr(corrected, f.name), getattr(true, f.name), err_msg=f.name)
    assert corrected.available == true.available


vehicles = st.builds(
    biased, st.floats(-0.1, 0.1), st.floats(1.0, 30.0), st.floats(-2.0, 2.0), st.floats(-2.0, 2.0), st.floats(-0.1, 0.1)
)


@given(vehicles, vehicles)
def test_correction_anew_is_that_of_what_the_sensors_read(was, other):
    """``raw`` has the steering wheel's angle by the first one's ratio, as reading makes it."""
    raw = drive(slalom(0.03, 0.5), speed=20.0, step_s=np.full(9, 0.01)).signals
    raw.ay_m_s2[3] = np.nan
    by_other = replace(raw, steer_rad=raw.steer_rad * was.steering_ratio / other.steering_ratio)
    before, wanted = vehicle.correct_signals(raw, was), vehicle.correct_signals(by_other, other)
    found = vehicle.corrected_anew(before, was, other)
    back = vehicle.corrected_anew(found, other, was)
    for f in fields(Signals):
        if f.name in SIGNAL_COLUMNS:
            for one, two in ((found, wanted), (back, before)):
                np.testing.assert_allclose(getattr(one, f.name), getattr(two, f.name), rtol=1e-9, atol=1e-11)
    assert found.available == raw.available


def test_signals_that_need_no_other_correction_are_left_as_they_are():
    signals = vehicle.correct_signals(drive(slalom(0.03, 0.5), step_s=np.full(9, 0.01)).signals, CAR)
    heavier = CAR.model_copy(update={"mass_kg": 1500.0, "roll_gradient_rad_per_m_s2": 0.01})
    assert vehicle.corrected_anew(signals, CAR, heavier) is signals
    assert vehicle.corrected_anew(signals, CAR, CAR.model_copy(update={"steering_ratio": 15.0})) is not signals
