"""``pdhef learn --stages calibrate``: a car is made from a pool of logs, and insufficient pools are rejected."""

from __future__ import annotations

from pathlib import Path

import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.learning.engine import LearnResult
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


def test_a_pool_of_logs_mends_the_file(pool: LearnResult, sample_logs_dir: Path) -> None:
    right = Car.load(sample_logs_dir / "vehicle.toml").vehicle
    car = Car.load(pool.car)
    for front in (True, False):
        found = car.vehicle.cornering_stiffness_n_per_rad(front, 0.85)
        assert found == pytest.approx(right.cornering_stiffness_n_per_rad(front, 0.85), rel=0.25)
    assert car.datasheet.cornering_stiffness_n_per_rad(True, 0.85) < 0.6 * right.cornering_stiffness_n_per_rad(
        True, 0.85
    )


def test_the_car_says_what_it_rests_on_and_that_no_truth_was_looked_at(pool: LearnResult) -> None:
    text = (pool.car / "fit.toml").read_text()
    assert "without_truth = true" in text
    assert "no ground truth was used" in text
    car = Car.load(pool.car)
    assert [d.name for d in car.learnt_on] == ["dlc", "step", "fishhook"]
    assert all(d.end_s >= 5.0 for d in car.learnt_on)
    assert car.vehicle.name.endswith("(calibrated without ground truth)")
    assert car.has_evidence  # it is not calibrated once more in a run
    assert make_estimator("physics", car).causal
    assert pool.figures["self_calibration"]["logs"] == 3


def test_one_log_is_no_pool(sample_logs_dir: Path, config: RunConfig, tmp_path: Path) -> None:
    with pytest.raises(EstimatorError, match="need not apply to another"):
        run_stage("calibrate", [str(sample_logs_dir / "dlc.mcap")], tmp_path / "car", config)
    assert not (tmp_path / "car").exists()


def test_logs_that_do_not_know_the_stiffness_are_refused(
    sample_logs_dir: Path, config: RunConfig, tmp_path: Path
) -> None:
    logs = [str(sample_logs_dir / f"{name}.mcap") for name in ("no_truth", "faults")]
    with pytest.raises(EstimatorError, match=r"cornering stiffness|are needed"):
        run_stage("calibrate", logs, tmp_path / "car", config)
    assert not (tmp_path / "car").exists()
