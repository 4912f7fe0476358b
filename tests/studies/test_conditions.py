"""The condition table from simulation to page on a tiny row."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
import torch

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.residual_model.bundle import ModelBundle, Normalisation
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.residual_model.network import Architecture, ResidualNetwork
from studies import conditions
from studies.condition_drives import bin_masks, read_drive, told
from studies.drawn_cars import fit_vehicle
from truthsim.vehicle_choice import choose_vehicle

pytestmark = pytest.mark.slow

NAMES = "zero,phy-ukf,pd-hef:fixed-r"
ROWS = ("in-domain", "friction-plus-20", "gyro-dropped")


@pytest.fixture(scope="module")
def car(sample_logs_dir: Path) -> Car:
    return replace(Car.load(sample_logs_dir / "vehicle.toml", network="none"), network=_bundle())


@pytest.fixture(scope="module")
def vehicle(car: Car) -> VehicleParameters:
    return car.vehicle


def _bundle() -> ModelBundle:
    """Return a network that knows nothing but says something."""
    torch.manual_seed(0)
    network = ResidualNetwork(Architecture(len(FEATURES), 8, 1, (4,)))
    weights = {k: v.numpy().copy() for k, v in network.state_dict().items()}
    scale = Normalisation((0.0,) * len(FEATURES), (10.0,) * len(FEATURES), (1.0, 1.0))
    return ModelBundle(FEATURES, 8, 1, (4,), 0.01, scale, weights)


def _make(work: Path) -> int:
    arguments = ["--drives", "2", "--rows", ",".join(ROWS), "--jobs", "1"]
    arguments += ["--estimators", NAMES, "--car", "sample_logs/vehicle.toml"]
    arguments += ["--network", str(work / "network")]
    return conditions.main(
        [*arguments, "--work", str(work / "work"), "--out", str(work / "docs"), "--results", str(work / "results")]
    )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    work = tmp_path_factory.mktemp("conditions")
    _bundle().save(work / "network")
    assert _make(work) == 0
    return work


def _drives(folder: Path) -> tuple[Path, dict[str, Any]]:
    found = next((folder / "work").glob("drives-1-2*"))
    return found, json.loads((found / "manifest.json").read_text(encoding="utf-8"))


def test_the_page_has_every_row_and_its_pooled_figure_is_that_of_the_samples(made, car, vehicle):
    page = (made / "docs" / "conditions.md").read_text(encoding="utf-8")
    assert all(f"| {row} |" in page for row in ROWS)
    assert "nan" not in page
    folder, manifest = _drives(made)
    squares, count = 0.0, 0
    for entry in manifest["drives"]:
        if entry["row"] == "in-domain":
            drive = read_drive(folder / entry["file"], car)
            track, _ = run_window(make_estimator("zero", car), drive.signals)
            truth = drive.truth
            scored = track.valid & (np.hypot(truth.vx_m_s, truth.vy_m_s) > vehicle.low_speed_blend_m_s)
            squares += float(np.sum(truth.sideslip_rad[scored] ** 2))  # the error of sideslip 0
            count += int(scored.sum())
    tables = (made / "results" / "tables.md").read_text(encoding="utf-8")
    pooled = tables[tables.index("pooled over all samples") :]
    line = next(text for text in pooled.splitlines() if text.startswith("| in-domain |"))
    assert line.split("|")[2].strip() == f"{math.degrees(math.sqrt(squares / count)):.3f}"


def test_wrong_friction_reaches_the_model_and_nothing_else(made):
    metrics = pl.read_parquet(made / "results" / "metrics.parquet").filter(
        (pl.col("metric") == "rmse") & (pl.col("signal") == "sideslip_rad") & (pl.col("segment") == "low")
    )

    def of(row: str, estimator: str) -> list[float]:
        chosen = metrics.filter((pl.col("row") == row) & (pl.col("estimator") == estimator)).sort("drive")
        return chosen["value"].to_list()

    # The bins are those of the true friction, so that what ignores friction scores the same in each of them.
    assert of("in-domain", "zero") == of("friction-plus-20", "zero")
    assert of("in-domain", "phy-ukf") != of("friction-plus-20", "phy-ukf")


def test_a_second_call_computes_nothing_and_writes_the_same(made, monkeypatch):
    page = (made / "docs" / "conditions.md").read_bytes()
    monkeypatch.setattr("studies.condition_runs._run", lambda *_: pytest.fail("a kept row was computed again"))
    assert _make(made) == 0
    assert (made / "docs" / "conditions.md").read_bytes() == page


def test_a_fitted_file_has_the_mass_and_the_stiffness_of_the_car(made, vehicle):
    car = choose_vehicle("sedan,mass=1.2,stiffness=0.85")
    fitted = fit_vehicle(car, 0.3, vehicle)
    assert fitted.mass_kg == pytest.approx(1.2 * 1440.0)
    soft = fitted.cornering_stiffness_n_per_rad(True, 0.3)
    stiff = fit_vehicle(choose_vehicle("sedan,mass=1.2"), 0.3, vehicle).cornering_stiffness_n_per_rad(True, 0.3)
    assert soft / stiff == pytest.approx(0.85, rel=0.08)


def test_told_and_bins(made, car):
    folder, manifest = _drives(made)
    drive = read_drive(folder / manifest["drives"][0]["file"], car)
    assert np.isnan(told(drive, {"friction": "unknown"}).friction).all()
    np.testing.assert_allclose(told(drive, {"friction_factor": 0.8}).friction, 0.8 * drive.signals.friction)
    with pytest.raises(ValueError, match="expected"):
        told(drive, {"weather": "rain"})
    masks = bin_masks(drive)
    assert (sum(masks[b].astype(int) for b in ("low", "middle", "high")) == 1).all()


def test_the_stored_page_is_that_of_the_stored_results(tmp_path: Path):
    results = tmp_path / "results"
    shutil.copytree(conditions.RESULTS / "conditions", results)
    assert conditions.main(["--render", "--results", str(results), "--out", str(tmp_path)]) == 0
    for made, stored in (("conditions.md", conditions.DOCS), ("results/tables.md", conditions.RESULTS / "conditions")):
        assert (tmp_path / made).read_bytes() == (stored / Path(made).name).read_bytes()
