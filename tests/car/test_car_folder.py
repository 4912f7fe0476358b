"""A car is a folder of parts, read one by one and written whole; the residual gain is that of file, name or network."""

import json
import os
import re
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, strategies as st
from made_models import random_network
from reference_car import drive, slalom, with_noise

from pdhef_logtool.car import store, vehicle
from pdhef_logtool.car.car import FIT_FILE, NETWORK_FOLDER, SHIPPED_CARS, VEHICLE_FILE, Car
from pdhef_logtool.car.names import MODEL_FILE
from pdhef_logtool.car.parts import FilterNoise, Fit, FittedPhysics, LearntOn, Record, car_folder, physics_sha256
from pdhef_logtool.car.store import check_output, update_car
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.car.vehicle import PhysicsParts, default_vehicle
from pdhef_logtool.drive.sensor_faults import without_faults
from pdhef_logtool.estimators.kinematic import Kinematic
from pdhef_logtool.estimators.pass_through import PassThrough
from pdhef_logtool.estimators.speed_slip import believable
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.estimators.vehicle_ukf import nominal_filter, of_car
from pdhef_logtool.records import reasons
from pdhef_logtool.records.errors import OutputError, UsageError, VehicleError
from pdhef_logtool.records.signals import SIGNAL_COLUMNS, Signals
from pdhef_logtool.residual_model.bundle import SHIPPED_FOLDERS
from pdhef_logtool.runs.config import RunConfig, load_config
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.storage import outputs

#: A vehicle file written by hand: with comments, entries in any order, and a blank line.
PERSONS = """# My car, weighed on 3 May.
mass_kg = 1440.0            # with driver
name = "mine"

yaw_inertia_kg_m2 = 1523.0
cg_to_front_axle_m = 1.16
cg_to_rear_axle_m = 1.71    # tank full
friction = 0.85
truth_position_m = [-0.4, 0.0, 0.0]

[tyres.front]  # guessed
cornering_stiffness_n_per_rad = 110000.0
[tyres.rear]
cornering_stiffness_n_per_rad = 108000.0
# end
"""
DRIVES = (LearntOn(name="lap", sha256="cd" * 32, start_s=0.0, end_s=80.0),)
TUNED = "phy-ukf:tuned"


@pytest.fixture
def folder(tmp_path):
    path = tmp_path / "car"
    path.mkdir()
    (path / VEHICLE_FILE).write_text(PERSONS)
    return path


def load(path: Path, network: str = "none") -> Car:
    return Car.load(path, network=network)


def write_part(path: Path, part: Record) -> None:
    path.write_text(part_toml(part, "Written by a test."))


def add_fit(folder: Path) -> Fit:
    noise = {TUNED: FilterNoise(q_std=(0.1, 0.2, 0.3), r_std={"ay_m_s2": 0.5})}
    fit = Fit(physics_sha256=physics_sha256(load(folder).vehicle), filter=noise, drives=DRIVES)
    write_part(folder / FIT_FILE, fit)
    return fit


def edit(folder: Path, old: str, new: str) -> None:
    text = (folder / VEHICLE_FILE).read_text()
    assert text.count(old) == 1
    (folder / VEHICLE_FILE).write_text(text.replace(old, new))


# --- reading -------------------------------------------------------------------------------------------------------


def test_the_shipped_car_is_found_by_name_and_none_is_the_default_sedan():
    saloon = Car.load("saloon")
    assert (saloon.vehicle.name, saloon.source) == ("truthsim saloon", SHIPPED_CARS["saloon"])
    assert saloon.network is not None
    assert Car.load(SHIPPED_CARS["saloon"]).physics_sha256 == saloon.physics_sha256
    default = Car.load()
    assert (default.vehicle, default.source) == (default_vehicle(), None)
    assert default.residual_gain == 0.0


def test_a_car_without_network_has_no_residual_network_and_one_for_physics_is_it():
    assert Car(default_vehicle()).residual_network is None
    saloon = Car.load("saloon")
    assert saloon.network is not None
    assert saloon.residual_network is saloon.network


def test_parts_come_one_by_one(folder):
    own = load(folder).vehicle
    fit = add_fit(folder)
    car = load(folder)
    assert car.vehicle == own
    assert dict(car.noise) == fit.filter
    assert car.learnt_on == DRIVES
    assert car.notes == ()


def test_a_cars_network_may_be_its_own_or_named_by_the_cars_folder(folder, tmp_path):
    shutil.copytree(SHIPPED_FOLDERS["default"], folder / NETWORK_FOLDER)
    car = Car.load(folder)
    assert car.network_name == NETWORK_FOLDER
    (tmp_path / "bare.toml").write_text(PERSONS)
    other = Car.load(tmp_path / "bare.toml", network=folder)
    assert other.network.sha256 == car.network.sha256


# --- parameters identified with physics -----------------------------------------------------------------------------

VALUES = {"yaw_inertia_kg_m2": 1700.0, "steering_ratio": 15.0, "physics": PhysicsParts(lag=True, roll=True)}
FOUND_NOISE = FilterNoise(q_std=(0.1, 0.2, 0.3, 0.4, 0.5, 0.6), r_std={"ay_m_s2": 0.5})
FOUND = FittedPhysics(values=default_vehicle().model_copy(update=VALUES), noise=FOUND_NOISE)


def add_physics(folder: Path) -> Fit:
    fit = add_fit(folder).model_copy(update={"physics": FOUND})
    write_part(folder / FIT_FILE, fit)
    return fit


def test_what_was_found_through_physics_is_its_own(folder):
    """Other filters do not see it."""
    add_physics(folder)
    car = load(folder)
    assert car.fitted_physics == FOUND
    assert dict(car.noise) == {TUNED: car.noise[TUNED], "physics": FOUND.noise}
    assert car.vehicle.physics == PhysicsParts()
    assert car.physics_vehicle == FOUND.values
    assert car.physics_vehicle.physics.names == ("lag", "roll")
    assert of_car(car).vehicle == car.physics_vehicle
    assert make_estimator(TUNED, car).vehicle == car.vehicle


# --- staleness -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("mass_kg = 1440.0 ", "mass_kg = 1450.0 "),
        ("110000.0", "111000.0"),
        ("friction = 0.85\n", ""),
        ("[tyres.front]", "[sensors]\nay_bias_m_s2 = 0.1\n[tyres.front]"),
    ],
)
def test_other_physics_leave_the_fit_out_and_say_so(folder, old, new):
    add_fit(folder)
    edit(folder, old, new)
    car = load(folder, "default")
    assert dict(car.noise) == {}
    assert car.learnt_on == ()
    assert car.notes == ("fit.toml is not used: vehicle.toml has changed since",)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('name = "mine"', 'name = "ours"'),
        ("# with driver", "# without"),
        ("# My car, weighed on 3 May.\n", ""),
        ("truth_position_m = [-0.4, 0.0, 0.0]", "truth_position_m = [-0.5, 0.0, 0.0]"),
        ("mass_kg = 1440.0 ", "mass_kg = 1440 "),
        ("[tyres.front]", "[sensors]\nax_bias_m_s2 = 0.0\n[tyres.front]"),  # its default
    ],
)
def test_what_is_no_physics_makes_nothing_stale(folder, old, new):
    add_fit(folder)
    before = load(folder, "default")
    edit(folder, old, new)
    car = load(folder, "default")
    assert car.notes == before.notes == ()
    assert dict(car.noise) == dict(before.noise)
    assert car.physics_sha256 == before.physics_sha256


# --- rejected inputs -------------------------------------------------------------------------------------------------


def test_a_network_is_no_car(tmp_path):
    with pytest.raises(VehicleError, match=r"a folder with vehicle\.toml, or such a file, got a network's folder"):
        Car.load(SHIPPED_FOLDERS["default"])
    with pytest.raises(VehicleError, match="got another folder"):
        Car.load(tmp_path)


FIT = f'format = "pdhef-fit"\nversion = 1\nphysics_sha256 = "{"ab" * 32}"\n'
NOISE = f'{FIT}[filter."{TUNED}"]\n'
MODEL = FIT.replace("fit", "model")


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        (VEHICLE_FILE, PERSONS.replace("friction", "frictoin"), "frictoin: unknown, did you mean friction?"),
        (VEHICLE_FILE, PERSONS.replace("[tyres.rear]", "[tyres.reer]"), "did you mean tyres.rear?"),
        (VEHICLE_FILE, PERSONS + "[network]\ngian = 1.0\n", "network.gian: unknown, did you mean network.gain?"),
        (FIT_FILE, FIT + "drive = []\n", "drive: unknown, did you mean drives?"),
        (FIT_FILE, FIT + "[physics.values]\nsteering_ration = 3.0\n", "did you mean physics.values.steering_ratio?"),
        (FIT_FILE, FIT.replace("version = 1", "version = 2"), "version: should be 1"),
        (FIT_FILE, NOISE + "q_sdt = []\n", f"did you mean filter.{TUNED}.q_std?"),
        (FIT_FILE, NOISE + "r_std = {ay = 1.0}\n", f"did you mean filter.{TUNED}.r_std.ay_m_s2?"),
        (FIT_FILE, NOISE.replace("tuned", "tunde") + "q_std = []\n", f"did you mean filter.{TUNED}?"),
        (FIT_FILE, NOISE + "q_std = [0.02, -0.006, 0.002]\n", "greater than or equal to 0"),
        (FIT_FILE, MODEL, "format: should be 'pdhef-fit'"),
        (MODEL_FILE, MODEL + "parameters = [{name = 'x', value = 1.0, std = -1.0}]\n", "std: should be greater than 0"),
        (MODEL_FILE, MODEL + "parameter = []\n", "parameter: unknown, did you mean parameters?"),
    ],
)
def test_wrong_entries_of_every_part_are_told_in_one_line(folder, name, text, said):
    (folder / name).write_text(text)
    with pytest.raises(VehicleError, match=re.escape(said)) as caught:
        Car.load(folder, network="none")
    assert str(folder / name) in str(caught.value)


# --- writing ---------------------------------------------------------------------------------------------------------


NEW = {MODEL_FILE: f'format = "pdhef-model"\nphysics_sha256 = "{"ab" * 32}"\n'.encode()}


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_a_new_folder_gets_the_persons_file_byte_for_byte_and_the_parts(folder, tmp_path):
    add_fit(folder)
    written = tmp_path / "deep" / "new"
    update_car(load(folder), written, NEW)
    files = {name: (folder / name).read_bytes() for name in (VEHICLE_FILE, FIT_FILE)}
    assert files_of(written) == {**files, **NEW}
    assert {p.name for p in folder.iterdir()} == {VEHICLE_FILE, FIT_FILE}
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["new"]


def test_a_bare_file_and_the_default_car_become_folders(tmp_path):
    (tmp_path / "mine.toml").write_text(PERSONS)
    update_car(load(tmp_path / "mine.toml"), tmp_path / "mine", NEW)
    assert (tmp_path / "mine" / VEHICLE_FILE).read_text() == PERSONS
    mask = os.umask(0)
    os.umask(mask)
    assert (tmp_path / "mine").stat().st_mode & 0o777 == 0o777 & ~mask
    update_car(Car.load(None, network="none"), tmp_path / "sedan", NEW)
    assert load(tmp_path / "sedan").vehicle == default_vehicle()


def test_the_same_folder_is_updated(folder):
    (folder / "notes.txt").write_text("mine too")
    vehicle = (folder / VEHICLE_FILE).read_bytes()
    update_car(load(folder), folder, {MODEL_FILE: b"x"})
    update_car(load(folder / VEHICLE_FILE), folder, NEW)
    assert files_of(folder) == {VEHICLE_FILE: vehicle, "notes.txt": b"mine too", **NEW}
    assert [p.name for p in folder.parent.iterdir()] == [folder.name]


def _raise(error: BaseException) -> Callable[..., Any]:
    def fail(*_: object) -> None:
        raise error

    return fail


@pytest.mark.parametrize("error", [OSError(28, "no space left"), KeyboardInterrupt()])
@pytest.mark.parametrize("place", ["file", "exchange"])
@pytest.mark.parametrize("new", [False, True])
def test_a_failure_in_the_middle_leaves_the_old_car_and_nothing_else(folder, monkeypatch, error, place, new):
    car, before = load(folder), files_of(folder)
    places = {"file": (store, "write_bytes"), "exchange": (outputs, "_exchanged")}
    monkeypatch.setattr(*places[place], _raise(error))
    output = folder.with_name("new") if new else folder
    with pytest.raises(OutputError if isinstance(error, OSError) else type(error)):
        update_car(car, output, NEW)
    assert files_of(folder) == before
    assert [p.name for p in folder.parent.iterdir()] == [folder.name]


def test_what_is_no_place_for_a_car_is_refused_and_untouched(folder, tmp_path):
    car = load(folder)
    another, full, file = tmp_path / "another", tmp_path / "full", tmp_path / "file"
    for path, text in ((another / VEHICLE_FILE, PERSONS.replace("0.85", "0.75")), (full / "x.txt", "x")):
        path.parent.mkdir()
        path.write_text(text)
    file.write_text("x")
    before = files_of(tmp_path)
    for output, said in (
        (another, r"got another, which contains a different vehicle\.toml; name another folder, or give --car"),
        (full, "a new folder or a car's folder"),
        (file, "a new folder or a car's folder"),
        (tmp_path / "new.toml", r"a new folder or a car's folder, got new\.toml"),
    ):
        for act in (lambda o=output: check_output(car, o), lambda o=output: update_car(car, o, NEW)):
            with pytest.raises(UsageError, match=said):
                act()
    assert files_of(tmp_path) == before
    (tmp_path / "empty").mkdir()
    for output in (folder, tmp_path / "empty", tmp_path / "none"):
        check_output(car, output)


@pytest.mark.slow
@pytest.mark.parametrize("new", [False, True])
def test_changes_by_several_commands_at_once_are_all_there(folder, new):
    car = load(folder)
    output = folder.with_name("new") if new else folder
    changes = [{f"part-{i}.toml": b"x = 1\n"} for i in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda change: update_car(car, output, change), changes))
    assert {f"part-{i}.toml" for i in range(8)} <= set(files_of(output))
    assert not [p for p in folder.parent.iterdir() if p.name.startswith(".")]


def test_the_folder_of_a_cars_drives_is_short_and_portable():
    assert car_folder("Saloon/2: my first – a_b.c", "0123456789abcdef") == "car=Saloon-2-my-first-a_b.c-01234567"
    assert car_folder("n" * 99, "f" * 64) == f"car={'n' * 24}-ffffffff"


SEDAN = Car(default_vehicle())
OWN, FOREIGN = replace(random_network(), physics_sha256=SEDAN.physics_sha256), random_network()


def _gain(car: Car, name: str = "pd-hef") -> tuple[float, str]:
    """Return gain and note of an estimator."""
    estimator = make_estimator(name, car)
    return estimator.trust, " ".join(estimator.notes)


def test_a_network_acts_on_the_physics_that_it_was_trained_with():
    own, foreign = replace(SEDAN, network=OWN), replace(SEDAN, network=FOREIGN)
    assert _gain(own) == (1.0, "residual gain 1: within its region of validity")
    assert _gain(foreign) == (0.0, "residual gain 0: the network was not trained with the physics of this car")
    assert (own.has_evidence, foreign.has_evidence, SEDAN.has_evidence) == (True, False, False)
    assert "no network" in _gain(SEDAN)[1]
    assert _gain(own.with_noise("physics", FilterNoise(q_std=(1.0, 1.0, 1.0))))[0] == 1.0


def test_the_file_decides_before_the_network_and_the_name_before_both(tmp_path):
    for gain in (0.0, 0.25):
        (tmp_path / "car.toml").write_text(f"{part_toml(SEDAN.vehicle)}\n[network]\ngain = {gain}\n")
        loaded = Car.load(tmp_path / "car.toml")
        for network in (OWN, FOREIGN):
            car = replace(loaded, network=network)
            assert _gain(car)[0] == gain
            for option, named in (("gain=1", 1.0), ("gain=0.5", 0.5), ("fixed-r", 1.0)):
                assert _gain(car, f"pd-hef:{option}") == (named, "")


# ---- a sensor profile replaces the sensors of a car; each entry affects its signals, and a run records it ----

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
