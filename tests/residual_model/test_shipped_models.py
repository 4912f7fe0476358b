"""The models that come with the package: found by name, small, and complete."""

from __future__ import annotations

from pathlib import Path

import pytest

from pdhef_logtool.car.car import NO_INTERVALS, Car
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.table import all_names, make_estimator
from pdhef_logtool.records.errors import ModelError
from pdhef_logtool.residual_model.bundle import SHIPPED_FOLDERS, model_folder, open_model
from pdhef_logtool.residual_model.features import FEATURES


def test_models_are_found_by_name() -> None:
    default = open_model(None)
    assert default is not None
    assert default.feature_names == FEATURES
    assert None not in (default.pure_lstm, default.linear_regression, default.paper_network)
    assert open_model(Path("none")) is None
    assert model_folder(Path("elsewhere")) == Path("elsewhere")
    with pytest.raises(ModelError):
        open_model(Path("elsewhere"))


def test_all_of_it_is_below_three_megabytes() -> None:
    folder = SHIPPED_FOLDERS["default"].parents[1]
    assert sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) < 3_000_000


def test_noise_evidence_and_calibration_are_of_the_shipped_network() -> None:
    model, car = open_model(None), Car.load("saloon")
    assert model is not None
    assert car.network is not None and car.network.sha256 == model.sha256
    assert (car.residual_gain, model.physics_sha256) == (0.75, car.physics_of("physics"))
    assert car.notes == ()
    assert {"phy-ukf:tuned", "physics"} == set(car.noise)
    assert car.intervals is not None
    by_name = {e.estimator: e.algorithm for e in car.intervals.entries}
    assert by_name["pd-hef"].network_sha256 == model.sha256
    assert by_name["pd-hef"].physics_sha256 == car.physics_of("physics")
    assert car.intervals.physics_sha256 == car.physics_sha256
    assert Car.load("saloon", intervals=NO_INTERVALS).intervals is None


def test_every_shipped_interval_is_of_what_runs_on_the_shipped_car() -> None:
    car = Car.load("saloon")
    assert car.intervals is not None
    ran = {name: resolve(make_estimator(name, car)) for name in all_names(car)}
    for entry in car.intervals.entries:
        assert entry.algorithm == ran[entry.estimator], entry.estimator
