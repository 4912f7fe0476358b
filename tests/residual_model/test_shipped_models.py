"""The models that come with the package: found by name, small, and complete."""

from __future__ import annotations

from pathlib import Path

import pytest

from pdhef_logtool.car.vehicle import load_vehicle
from pdhef_logtool.records.errors import ModelError
from pdhef_logtool.residual_model.bundle import SHIPPED_FOLDERS, model_folder, open_model
from pdhef_logtool.residual_model.features import FEATURES, ONE_CAR_FEATURES
from pdhef_logtool.watches.intervals import find_calibration


def test_models_are_found_by_name() -> None:
    default, many = open_model(None), open_model(Path("many-cars"))
    assert default is not None
    assert many is not None
    assert (default.feature_names, many.feature_names) == (ONE_CAR_FEATURES, FEATURES)
    assert None not in (default.pure_lstm, default.linear_regression, default.paper_network)
    assert open_model(Path("none")) is None
    assert model_folder(Path("elsewhere")) == Path("elsewhere")
    with pytest.raises(ModelError):
        open_model(Path("elsewhere"))


def test_all_of_it_is_below_three_megabytes() -> None:
    folder = SHIPPED_FOLDERS["default"].parent
    assert sum(f.stat().st_size for f in folder.rglob("*") if f.is_file()) < 3_000_000


def test_noise_evidence_and_calibration_are_of_the_shipped_network() -> None:
    model, folder = open_model(None), SHIPPED_FOLDERS["default"]
    assert model is not None
    vehicle = load_vehicle(folder / "vehicle.toml")
    assert vehicle.network.model_sha256 == model.sha256
    assert vehicle.network.trust_cap == 1.0
    assert {"phy-ukf-tuned", "physics-plus", "pd-hef"} <= set(vehicle.filter)
    for chosen in (None, Path("unsure")):
        calibration = find_calibration(chosen, None)
        assert calibration is not None
        assert calibration.model_sha256 == model.sha256
        assert "pd-hef" in calibration.inflations
