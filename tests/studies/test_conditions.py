"""The fitted files of the cars of the condition table, and the stored page."""

from __future__ import annotations

from pathlib import Path

import pytest

from pdhef_logtool import Car
from studies import conditions
from studies.drawn_cars import fit_vehicle
from studies.pages import DOCS, RESULTS
from truthsim.vehicle_choice import choose_vehicle


def test_a_fitted_file_has_the_mass_and_the_stiffness_of_the_car(sample_logs_dir: Path) -> None:
    vehicle = Car.load(sample_logs_dir / "vehicle.toml").vehicle
    fitted = fit_vehicle(choose_vehicle("sedan,mass=1.2,stiffness=0.85"), 0.3, vehicle)
    assert fitted.mass_kg == pytest.approx(1.2 * 1440.0)
    soft = fitted.cornering_stiffness_n_per_rad(True, 0.3)
    stiff = fit_vehicle(choose_vehicle("sedan,mass=1.2"), 0.3, vehicle).cornering_stiffness_n_per_rad(True, 0.3)
    assert soft / stiff == pytest.approx(0.85, rel=0.08)


def test_the_stored_page_is_that_of_the_stored_results(tmp_path: Path) -> None:
    results = RESULTS / "conditions"
    for name in ("facts.json", "metrics.parquet"):
        (tmp_path / name).write_bytes((results / name).read_bytes())
    assert conditions.main(["--stored", "--results", str(tmp_path), "--out", str(tmp_path)]) == 0
    assert (tmp_path / "conditions.md").read_bytes() == (DOCS / "conditions.md").read_bytes()
