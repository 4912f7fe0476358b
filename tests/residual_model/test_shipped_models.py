"""The models that come with the package: found by name, small, and complete."""

from __future__ import annotations

from pathlib import Path

import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import physics_sha256
from pdhef_logtool.records.errors import ModelError
from pdhef_logtool.residual_model.bundle import SHIPPED_FOLDERS, load_bundle, network_folder
from pdhef_logtool.residual_model.features import FEATURES


def test_models_are_found_by_name() -> None:
    default = load_bundle(SHIPPED_FOLDERS["default"])
    assert default.feature_names == FEATURES
    assert None not in (default.pure_lstm, default.linear_regression, default.paper_network)
    folders = [network_folder(Path(name)) for name in ("default", "none", "elsewhere")]
    assert folders == [SHIPPED_FOLDERS["default"], None, Path("elsewhere")]
    with pytest.raises(ModelError):
        load_bundle(Path("elsewhere"))


def test_all_of_it_is_below_three_megabytes() -> None:
    folder = SHIPPED_FOLDERS["default"].parents[1]
    assert sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) < 3_000_000


def test_noise_evidence_and_calibration_are_of_the_shipped_network() -> None:
    model, car = load_bundle(SHIPPED_FOLDERS["default"]), Car.load("saloon")
    assert car.network is not None and car.network.sha256 == model.sha256
    assert (car.residual_gain, model.physics_sha256) == (0.75, physics_sha256(car.physics_vehicle))
    assert car.notes == ()
    assert {"phy-ukf:tuned", "physics"} == set(car.noise)
