"""``pdhef learn``: prior and residual from drives with ground truth, and the car that they make."""

import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from pdhef_logtool import Car, ExtractSettings, ReadOptions, RunConfig, extract, read_drive
from pdhef_logtool.car.model import ESTIMATED, read_model
from pdhef_logtool.car.names import MODEL_FILE
from pdhef_logtool.car.parts import Fit, LearntOn
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.learning import learn as learning
from pdhef_logtool.learning.drives import DriveRecord, LearnSettings, exit_code, tell_drive
from pdhef_logtool.learning.learn import OpenedDrive, learn, learn_from, open_drive
from pdhef_logtool.learning.truth import weight_of
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.model.fit import fit_car
from pdhef_logtool.model.priors import REAR_STIFFNESS, TYRES, prior_of
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.records.signals import Loss
from tests.command_line import printed
from tests.runs.test_inspection_report import write_log

SPAN = {"start": "60", "end": "130"}


@pytest.fixture(scope="module")
def bare(bare_vehicle, tmp_path_factory):
    """Return the vehicle file of the sample logs with a front axle that is too soft, and without a network."""
    path = tmp_path_factory.mktemp("car") / "vehicle.toml"
    path.write_text(bare_vehicle.replace("B = 11.146", "B = 7.0"))
    return path


def opened(log: Path, bare: Path, **span: str) -> OpenedDrive:
    with read_drive(log, Car.load(bare, network="none"), None, RunConfig(**span).read_options) as drive:
        found = open_drive(drive, RunConfig(**span))[1]
    assert found is not None
    return found


@pytest.fixture(scope="module")
def drive(sample_logs_dir, bare):
    return opened(sample_logs_dir / "road.mcap", bare, **SPAN)


@pytest.fixture(scope="module")
def result(sample_logs_dir, bare, tmp_path_factory):
    settings = LearnSettings(config=RunConfig(car=bare, **SPAN))
    return learn([str(sample_logs_dir / "road.mcap")], tmp_path_factory.mktemp("out") / "car", settings)


def test_a_drive_teaches_a_prior_that_later_drives_start_from(result, drive, sample_logs_dir):
    car = Car.load(result.car, network="none")
    assert car.model is not None and not car.has_evidence and car.notes == ()
    by_name = {p.name: p for p in car.taught_prior}
    before = {p.name: p for p in prior_of(car.vehicle).parameters}
    assert by_name.keys() == set(TYRES)
    assert all(p.std <= 1.05 * before[p.name].std and p.ay_m_s2 > 0.0 for p in by_name.values())
    right = Car.load(sample_logs_dir / "vehicle.toml").vehicle
    true = right.cornering_stiffness_n_per_rad(False, right.assumed_friction)
    assert abs(np.log(by_name[REAR_STIFFNESS].value / true)) < 0.2
    alone, taught = (
        next(p for p in fit_car(replace(drive.driving, slopes=None), car.vehicle, earlier).parameters if p.name == name)
        for name, earlier in ((REAR_STIFFNESS, ()), (REAR_STIFFNESS, car.taught_prior))
    )
    assert abs(np.log(taught.prior / true)) < abs(np.log(alone.prior / true)) and taught.prior_sd < alone.prior_sd


def test_the_figures_say_which_rung_is_used(result):
    figures = result.figures
    assert [t["rung"] for t in figures["rungs"]][:2] == ["none", "linear"]
    assert figures["rung"] in ("none", "linear", "random") and figures["evidence"] in result.text
    text = printed("learning", result, 150)
    assert "held-out" in text and "1 drive;" in text
    model = read_model(result.car / MODEL_FILE)
    assert [d.name for d in model.drives] == ["road"] and model.evidence == figures["evidence"]


def test_an_offset_of_the_ground_truth_changes_neither_prior_nor_residual(drive):
    truth, offset = drive.truth, 0.01
    moved = replace(truth, sideslip_rad=truth.sideslip_rad + offset, vy_m_s=truth.vy_m_s + offset * truth.vx_m_s)
    assert drive.driving.slopes is not None
    driving = replace(drive.driving, slopes=drive.driving.slopes + offset)
    shifted = replace(drive, whole=replace(drive.whole, truth=moved), driving=driving)
    (first, of_first), (second, of_second) = (learn_from([d]) for d in (drive, shifted))
    assert [p.value for p in second.parameters] == pytest.approx([p.value for p in first.parameters], rel=1e-6)
    assert of_second["rung"] == of_first["rung"]
    if first.residual is not None and second.residual is not None:
        assert np.allclose(second.residual.weights, first.residual.weights, rtol=1e-4, atol=1e-9)


def test_a_model_takes_the_place_of_a_fit_unless_the_vehicle_file_has_changed(result, tmp_path):
    car = tmp_path / "car"
    car.mkdir()
    for name in ("vehicle.toml", MODEL_FILE):
        (car / name).write_bytes((result.car / name).read_bytes())
    fit = Fit(physics_sha256=Car.load(result.car).physics_sha256, drives=(LearntOn(name="road"),))
    (car / "fit.toml").write_text(part_toml(fit, "a fit"))
    loaded = Car.load(car, network="none")
    assert loaded.model is not None and not loaded.has_evidence and "fit.toml" in loaded.notes[0]
    text = (car / "vehicle.toml").read_text()
    (car / "vehicle.toml").write_text(text.replace("B = 7.0", "B = 7.1"))
    loaded = Car.load(car, network="none")
    assert loaded.model is None and MODEL_FILE in loaded.notes[0]


def test_what_cannot_be_taught_is_refused(sample_logs_dir, bare, tmp_path):
    road = [str(sample_logs_dir / "road.mcap")]
    short = LearnSettings(config=RunConfig(car=bare, start="60", end="70"))
    with pytest.raises(EstimatorError, match="at least 20 s"):
        learn(road, tmp_path / "car", short)
    alone = LearnSettings(config=RunConfig(car=bare, reference="on"))
    with pytest.raises(EstimatorError, match="at least one drive"):
        learn([str(sample_logs_dir / "no_truth.mcap")], tmp_path / "car", alone)
    assert not (tmp_path / "car").exists()


def record(name: str, **changes: Any) -> DriveRecord:
    return replace(DriveRecord(name, f"{name}.mcap", sha256=name * 64, seconds=6.0, span_s=(1.5, 7.5)), **changes)


def test_what_a_user_must_know_of_a_drive_is_told_in_order_and_decides_the_exit_code():
    lost = Loss("gap", "2 s are gone", "/imu")
    note = Loss("late", "late", "/imu", severity="note")
    told: list[str] = []
    tell_drive(record("a", notes=("perfect ground truth",), losses=(lost, note), left_out="it is short"), told.append)
    assert told == ["a: perfect ground truth", "a: 2 s are gone (/imu)", "a is left out: it is short"]
    good, bad = record("a", losses=(note,)), record("b", left_out="x")
    assert [exit_code(r) for r in ([good], [good, bad], [good, record("c", losses=(lost,))], [bad])] == [0, 3, 3, 1]


@pytest.mark.slow
def test_a_pool_of_logs_mends_the_file_without_ground_truth(bare, sample_logs_dir, tmp_path, monkeypatch):
    logs = [str(sample_logs_dir / f"{name}.mcap") for name in ("dlc", "step", "fishhook")]
    without_truth = partial(read_drive, adjust=lambda _log, mapping, _tell: replace(mapping, truth={}))
    monkeypatch.setattr(learning, "read_drive", without_truth)
    pool = learn(logs, tmp_path / "car", LearnSettings(config=RunConfig(car=bare)))
    right, car = Car.load(sample_logs_dir / "vehicle.toml").vehicle, Car.load(pool.car)
    text = (pool.car / "model.toml").read_text()
    assert "calibrated without ground truth on" in text and car.model is not None and car.model.truth == ""
    values = {p["name"]: p["value"] for p in tomllib.loads(text)["parameters"]}
    front, rear = (right.cornering_stiffness_n_per_rad(axle, 0.85) for axle in (True, False))
    assert values["rear cornering stiffness"] == pytest.approx(rear, rel=0.3)
    assert len(pool.figures["self_calibration"]) == len(pool.records) == 3
    options = ReadOptions(model=pool.car / "model.toml")
    with read_drive(sample_logs_dir / "fishhook.mcap", car, options=options) as drive:
        model = DriveModel.fit(drive)
    assert make_estimator("physics", model.car).causal
    used = model.car.calibrated_car.vehicle
    assert used.cornering_stiffness_n_per_rad(True, 0.85) == pytest.approx(front, rel=0.25)
    assert used.cornering_stiffness_n_per_rad(False, 0.85) == pytest.approx(rear, rel=0.25)


SIGNALS = ("steer_rad", "yaw_rate_rad_s", "ax_m_s2", "ay_m_s2", "speed_m_s")
GNSS = ("gnss_velocity_east_m_s", "gnss_velocity_north_m_s")
MAPPING = "".join(
    f'[signals.{name}]\ntopic = "/{name}"\nfield = "value"\nstamp = "log_time"\n' for name in (*SIGNALS, *GNSS)
)


@pytest.fixture(scope="module")
def recorded(sample_logs_dir, tmp_path_factory):
    """Return a fishhook with a GNSS velocity at 10 Hz in place of its ground truth, and the true sideslip at stamps."""
    car = Car.load(sample_logs_dir / "vehicle.toml", network="none")
    with read_drive(sample_logs_dir / "fishhook.mcap", car) as drive:
        whole = drive.whole()
    stamps, truth = whole.signals.stamps_ns, whole.truth
    heading = np.cumsum(np.nan_to_num(truth.yaw_rate_rad_s)) * 0.01
    velocity = (truth.vx_m_s + 1j * truth.vy_m_s) * np.exp(1j * (heading + 0.7))
    received = velocity + 0.02 * (np.random.default_rng(1).standard_normal((2, len(stamps))).T @ [1.0, 1j])
    received[np.arange(len(stamps)) % 10 != 0] = np.nan
    columns = {name: getattr(whole.signals, name) for name in SIGNALS}
    columns |= dict(zip(GNSS, (received.real, received.imag), strict=True))
    known = {f"/{name}": np.isfinite(values) for name, values in columns.items()}
    topics = {f"/{name}": {"value": values[np.isfinite(values)]} for name, values in columns.items()}
    times = {name: stamps[at] for name, at in known.items()}
    log = write_log(tmp_path_factory.mktemp("log") / "drive.mcap", topics, times)
    return str(log), stamps, truth.sideslip_rad


@pytest.fixture
def reference_config(bare_vehicle, tmp_path):
    (tmp_path / "m.toml").write_text(MAPPING)
    (tmp_path / "vehicle.toml").write_text(bare_vehicle)
    return RunConfig(car=tmp_path / "vehicle.toml", mapping=tmp_path / "m.toml", reference="on")


def test_the_weight_is_one_over_the_variance_of_sideslip_and_model():
    std = np.radians([0.0, 0.3, 0.6])
    assert weight_of(std) == pytest.approx([1.0, 0.5, 0.2])


def test_extract_takes_it_where_it_is_independent_and_says_so(reference_config, recorded, tmp_path):
    log = [recorded[0]]
    with pytest.raises(EstimatorError, match="expected ground truth"):
        extract(log, tmp_path / "off", ExtractSettings(replace(reference_config, reference="auto")))
    result = extract(log, tmp_path / "on", ExtractSettings(reference_config, split="train"))
    (entry,) = result.manifest["drives"]
    assert entry["truth"]["kind"] == ESTIMATED and result.manifest["settings"]["reference"] == "on"
    rows = pl.read_parquet(tmp_path / "on" / entry["file"])
    assert rows["truth_source"].unique().to_list() == [ESTIMATED]
    used = rows.filter(pl.col("weight") > 0.0)
    assert 0.3 < len(used) / len(rows) < 0.8  # straight before the manoeuvre the axle law prevails
    assert used["weight"].to_numpy() == pytest.approx(weight_of(used["truth_std_rad"].to_numpy()), rel=1e-5)
    sideslip = np.arctan2(used["truth_vy_m_s"].to_numpy(), used["truth_vx_m_s"].to_numpy())
    error = sideslip - np.interp(used["stamp_ns"].to_numpy(), recorded[1], recorded[2])
    assert np.degrees(np.sqrt(np.mean(error**2))) < 0.3
    assert np.mean(np.abs(error) < 1.96 * used["truth_std_rad"].to_numpy()) > 0.8


def test_learn_is_taught_by_it_on_request_alone(reference_config, recorded, tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "LEAST_S", 3.0)
    log = [recorded[0]]
    off = learn(log, tmp_path / "off", LearnSettings(config=replace(reference_config, reference="auto")))
    assert off.records[0].truth == () and read_model(off.car / MODEL_FILE).truth == ""
    result = learn(log, tmp_path / "car", LearnSettings(config=reference_config))
    assert result.records[0].truth == (ESTIMATED,) and f"taught by {ESTIMATED}" in result.text
    assert read_model(tmp_path / "car" / MODEL_FILE).truth == ESTIMATED == result.figures["truth"]
    assert any(f"taught by {ESTIMATED}" in note for note in Car.load(tmp_path / "car").notes)


def test_ground_truth_has_priority(reference_config, sample_logs_dir):
    car = Car.load(reference_config.car, network="none")
    with read_drive(sample_logs_dir / "step.mcap", car) as drive:
        record, opened = learning.open_drive(drive, reference_config)
    assert opened is not None and opened.truth.name != "reference" and record.truth != (ESTIMATED,)
