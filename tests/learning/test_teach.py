"""``pdhef learn``: prior and residual from drives with ground truth, and the car that they make."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.model import read_model
from pdhef_logtool.car.names import MODEL_FILE
from pdhef_logtool.car.parts import Fit, LearntOn
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.cli.learning import render_learning
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.learning.drives import LearnSettings
from pdhef_logtool.learning.learn import LearnResult, OpenedDrive, learn, learn_from, open_drive
from pdhef_logtool.model.fit import fit_car
from pdhef_logtool.model.priors import REAR_STIFFNESS, TYRES, prior_of
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.runs.config import RunConfig
from tests.command_line import rendered

SPAN = {"start": "60", "end": "130"}


@pytest.fixture(scope="module")
def bare(bare_vehicle: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
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
def drive(sample_logs_dir: Path, bare: Path) -> OpenedDrive:
    return opened(sample_logs_dir / "road.mcap", bare, **SPAN)


@pytest.fixture(scope="module")
def result(sample_logs_dir: Path, bare: Path, tmp_path_factory: pytest.TempPathFactory) -> LearnResult:
    settings = LearnSettings(config=RunConfig(car=bare, **SPAN))
    return learn([str(sample_logs_dir / "road.mcap")], tmp_path_factory.mktemp("out") / "car", settings)


def test_a_drive_teaches_a_prior_that_later_drives_start_from(
    result: LearnResult, drive: OpenedDrive, sample_logs_dir: Path
) -> None:
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


def test_the_figures_say_which_rung_is_used(result: LearnResult) -> None:
    figures = result.figures
    assert [t["rung"] for t in figures["rungs"]][:2] == ["none", "linear"]
    assert figures["rung"] in ("none", "linear", "random") and figures["evidence"] in result.text
    text = rendered(render_learning, result, 150)
    assert "held-out" in text and "1 drive;" in text
    model = read_model(result.car / MODEL_FILE)
    assert [d.name for d in model.drives] == ["road"] and model.evidence == figures["evidence"]


def test_an_offset_of_the_ground_truth_changes_neither_prior_nor_residual(drive: OpenedDrive) -> None:
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


def test_a_model_takes_the_place_of_a_fit_unless_the_vehicle_file_has_changed(
    result: LearnResult, tmp_path: Path
) -> None:
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


def test_what_cannot_be_taught_is_refused(sample_logs_dir: Path, bare: Path, tmp_path: Path) -> None:
    road = [str(sample_logs_dir / "road.mcap")]
    short = LearnSettings(config=RunConfig(car=bare, start="60", end="70"))
    with pytest.raises(EstimatorError, match="at least 20 s"):
        learn(road, tmp_path / "car", short)
    alone = LearnSettings(config=RunConfig(car=bare, reference="on"))
    with pytest.raises(EstimatorError, match="at least one drive"):
        learn([str(sample_logs_dir / "no_truth.mcap")], tmp_path / "car", alone)
    assert not (tmp_path / "car").exists()
