"""``pdhef learn`` without ground truth: a model is made from a pool of logs, and insufficient pools are rejected."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.learning import learn as learning
from pdhef_logtool.learning.drives import LearnSettings
from pdhef_logtool.learning.learn import LearnResult, learn
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.runs.config import RunConfig

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def config(bare_vehicle: str, tmp_path_factory: pytest.TempPathFactory) -> RunConfig:
    """Return the sample logs' car with a front axle that is half as stiff."""
    path = tmp_path_factory.mktemp("car") / "vehicle.toml"
    path.write_text(bare_vehicle.replace("B = 11.146", "B = 5.6"))
    return RunConfig(car=path)


@pytest.fixture(scope="module")
def pool(sample_logs_dir: Path, config: RunConfig, tmp_path_factory: pytest.TempPathFactory) -> LearnResult:
    logs = [str(sample_logs_dir / f"{name}.mcap") for name in ("dlc", "step", "fishhook")]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            learning, "read_drive", partial(read_drive, adjust=lambda _log, mapping, _tell: replace(mapping, truth={}))
        )
        return learn(logs, tmp_path_factory.mktemp("out") / "car", LearnSettings(config=config))


def test_a_pool_of_logs_mends_the_file_without_ground_truth(pool: LearnResult, sample_logs_dir: Path) -> None:
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
