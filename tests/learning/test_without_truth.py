"""``pdhef learn --stages calibrate``: a model is made from a pool of logs, and insufficient pools are rejected."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.learning.engine import LearnResult
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.runs.config import RunConfig
from tests.learning.stage_run import run_stage

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def config(sample_logs_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> RunConfig:
    """Return the sample logs' car with a front axle that is half as stiff."""
    text = (sample_logs_dir / "vehicle.toml").read_text()
    head, _, rest = text.partition("[network]")
    path = tmp_path_factory.mktemp("car") / "vehicle.toml"
    path.write_text(head + rest[rest.index("[sensors]") :].replace("B = 11.146", "B = 5.6"))
    return RunConfig(car=path)


@pytest.fixture(scope="module")
def pool(sample_logs_dir: Path, config: RunConfig, tmp_path_factory: pytest.TempPathFactory) -> LearnResult:
    logs = [str(sample_logs_dir / f"{name}.mcap") for name in ("dlc", "step", "fishhook")]
    return run_stage("calibrate", logs, tmp_path_factory.mktemp("out") / "car", config)


def test_a_pool_of_logs_mends_the_file_without_ground_truth(pool: LearnResult, sample_logs_dir: Path) -> None:
    right, car = Car.load(sample_logs_dir / "vehicle.toml").vehicle, Car.load(pool.car)
    text = (pool.car / "model.toml").read_text()
    assert "no ground truth was used" in text
    values = {p["name"]: p["value"] for p in tomllib.loads(text)["parameters"]}
    for front, axle in ((True, "front"), (False, "rear")):
        expected = right.cornering_stiffness_n_per_rad(front, 0.85)
        assert values[f"{axle} cornering stiffness"] == pytest.approx(expected, rel=0.25)
    assert pool.figures["self_calibration"]["logs"] == 3
    options = ReadOptions(model=pool.car / "model.toml")
    with read_drive(sample_logs_dir / "fishhook.mcap", car, options=options) as drive:
        model = DriveModel.fit(drive)
    assert make_estimator("physics", model.car).causal
    assert model.car.calibrated_car.vehicle.cornering_stiffness_n_per_rad(True, 0.85) == pytest.approx(
        values["front cornering stiffness"], rel=1e-4
    )


def test_logs_that_do_not_know_the_stiffness_are_refused(
    sample_logs_dir: Path, config: RunConfig, tmp_path: Path
) -> None:
    logs = [str(sample_logs_dir / f"{name}.mcap") for name in ("no_truth", "faults")]
    with pytest.raises(EstimatorError, match=r"cornering stiffness|are needed"):
        run_stage("calibrate", logs, tmp_path / "car", config)
    assert not (tmp_path / "car").exists()
