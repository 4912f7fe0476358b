"""The condition table from simulation to page on a tiny row."""

from __future__ import annotations

import math
from pathlib import Path

import polars as pl
import pytest

from pdhef_logtool import Car
from studies import conditions
from studies.drawn_cars import fit_vehicle
from truthsim.vehicle_choice import choose_vehicle

ROWS = ("in-domain", "friction-plus-20")


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    work = tmp_path_factory.mktemp("conditions")
    arguments = ["--drives", "2", "--rows", ",".join(ROWS), "--jobs", "1", "--estimators", "zero,phy-ukf"]
    arguments += ["--work", str(work / "work"), "--out", str(work / "docs"), "--results", str(work / "results")]
    assert conditions.main(arguments) == 0
    return work


@pytest.mark.fleet
@pytest.mark.slow
def test_the_page_has_every_row_and_its_pooled_figure_is_that_of_the_samples(made: Path) -> None:
    page = (made / "docs" / "conditions.md").read_text(encoding="utf-8")
    assert all(f"| {row} |" in page for row in ROWS)
    assert "nan" not in page
    rmse = _rmse(made, "in-domain", "zero")
    pooled = math.sqrt(float((rmse["value"] ** 2 * rmse["n"]).sum() / rmse["n"].sum()))
    tables = (made / "results" / "tables.md").read_text(encoding="utf-8")
    tables = tables[tables.index("pooled over all samples") :]
    line = next(text for text in tables.splitlines() if text.startswith("| in-domain |"))
    assert line.split("|")[2].strip() == f"{math.degrees(pooled):.3f}"


@pytest.mark.fleet
@pytest.mark.slow
def test_wrong_friction_reaches_the_model_and_nothing_else(made: Path) -> None:
    for estimator, is_equal in (("zero", True), ("phy-ukf", False)):
        right, wrong = (_rmse(made, row, estimator)["value"] for row in ROWS)
        assert (right == wrong).all() == is_equal


def _rmse(made: Path, row: str, estimator: str) -> pl.DataFrame:
    metrics = pl.read_parquet(made / "results" / "metrics.parquet")
    chosen = {"row": row, "estimator": estimator, "signal": "sideslip_rad", "segment": "all", "metric": "rmse"}
    return metrics.filter(**chosen).sort("drive")


def test_a_fitted_file_has_the_mass_and_the_stiffness_of_the_car(sample_logs_dir: Path) -> None:
    vehicle = Car.load(sample_logs_dir / "vehicle.toml").vehicle
    fitted = fit_vehicle(choose_vehicle("sedan,mass=1.2,stiffness=0.85"), 0.3, vehicle)
    assert fitted.mass_kg == pytest.approx(1.2 * 1440.0)
    soft = fitted.cornering_stiffness_n_per_rad(True, 0.3)
    stiff = fit_vehicle(choose_vehicle("sedan,mass=1.2"), 0.3, vehicle).cornering_stiffness_n_per_rad(True, 0.3)
    assert soft / stiff == pytest.approx(0.85, rel=0.08)


def test_the_stored_page_is_that_of_the_stored_results(tmp_path: Path) -> None:
    results = conditions.RESULTS / "conditions"
    for name in ("facts.json", "metrics.parquet"):
        (tmp_path / name).write_bytes((results / name).read_bytes())
    assert conditions.main(["--render", "--results", str(tmp_path), "--out", str(tmp_path)]) == 0
    for name, stored in (("conditions.md", conditions.DOCS), ("tables.md", results)):
        assert (tmp_path / name).read_bytes() == (stored / name).read_bytes()
