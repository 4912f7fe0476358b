"""The models that come with the package: found by name, small, and complete."""

from __future__ import annotations

from pathlib import Path

import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import physics_sha256
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
    assert (car.residual_gain, model.physics_sha256) == (0.75, physics_sha256(car.physics_vehicle))
    assert car.notes == ()
    assert {"phy-ukf:tuned", "physics"} == set(car.noise)
