"""Frozen accuracy of the baselines: a weakened baseline fails this test, and no flag updates the values."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.reading import WholeDrive, read_drive
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.evaluation.track_errors import signal_error
from pdhef_logtool.runs.config import RunConfig

SAMPLES = Path(__file__).parents[2] / "sample_logs"
#: Sideslip RMSE in degrees on sample logs with the shipped car: friction from the file, or from the user (sweep).
STRENGTH = {
    ("dlc", None): {"kinematic": 0.7728, "open-loop": 0.2991, "phy-ukf": 0.3721, "physics": 0.0609},
    ("road", None): {"kinematic": 1.8236, "open-loop": 0.1216, "phy-ukf": 0.1218, "physics": 0.0690},
    ("sweep", 0.3): {"kinematic": 0.5005, "open-loop": 0.4858, "phy-ukf": 0.6236, "physics": 0.0634},
}


@pytest.fixture(scope="module")
def car() -> Car:
    return Car.load("saloon", network="none")


@pytest.fixture(scope="module", params=STRENGTH, ids=lambda key: key[0])
def drive(car: Car, request: pytest.FixtureRequest) -> tuple[WholeDrive, dict[str, float]]:
    name, friction = request.param
    options = RunConfig().read_options
    with read_drive(SAMPLES / f"{name}.mcap", car, None, replace(options, friction=friction or options.friction)) as d:
        return d.whole(), STRENGTH[request.param]


@pytest.mark.slow
def test_no_baseline_is_weaker_than_it_was(car: Car, drive: tuple[WholeDrive, dict[str, float]]) -> None:
    whole, strength = drive
    assert whole.truth is not None
    for name, rmse_deg in strength.items():
        track = run_estimator(make_estimator(name, car), whole.signals)
        error = signal_error(track, whole.truth, "sideslip_rad", 3.0)
        found = math.degrees(math.sqrt(float(np.nanmean(error**2))))
        assert found <= 1.005 * rmse_deg, f"{name}: {found:.4f}"
