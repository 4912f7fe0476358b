"""The recipe of docs/retrain.md: extract, train, run with the network, compare."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from tests.command_line import called, pdhef

pytestmark = pytest.mark.slow

#: A vehicle file with wrong tyres: the network has something to learn.
CAR = """name = "mycar"
mass_kg = 1440.0
yaw_inertia_kg_m2 = 1523.0
cg_to_front_axle_m = 1.16
cg_to_rear_axle_m = 1.71
cg_height_m = 0.6
wheel_radius_m = 0.3
steering_ratio = 16.0
friction = 0.85

[tyres.front]
cornering_stiffness_n_per_rad = 60000.0

[tyres.rear]
cornering_stiffness_n_per_rad = 110000.0
"""


def test_a_retrained_network_changes_the_estimates_of_pd_hef(tmp_path: Path) -> None:
    car = tmp_path / "car.toml"
    car.write_text(CAR)
    for name, manoeuvre in (("training/a", "slalom"), ("validation/b", "dlc"), ("held_out/e", "dlc")):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        pdhef("simulate", manoeuvre, "--seed", ord(name[-1]), "-o", tmp_path / f"{name}.mcap")
    for folder, split in (("training", "train"), ("validation", "validation")):
        pdhef("extract", tmp_path / folder, "-o", tmp_path / "residuals", "--car", car, "--split", split)
    pdhef("train", tmp_path / "residuals", "-o", tmp_path / "candidate", "--epochs", "4")
    estimates = {}
    for name, network in (("before", "default"), ("after", tmp_path / "candidate")):
        given = ("--car", car, "--network", network, "-e", "physics,pd-hef", "--no-report")
        pdhef("run", tmp_path / "held_out", "-o", tmp_path / name, *given)
        rows = pl.read_parquet(tmp_path / name / "logs" / "e" / "estimates.parquet")
        estimates[name] = [
            rows.filter(pl.col("estimator") == e)["sideslip_rad"].to_numpy() for e in ("physics", "pd-hef")
        ]
    np.testing.assert_array_equal(*estimates["before"])
    physics, pd_hef = estimates["after"]
    assert np.nanmax(np.abs(physics - pd_hef)) > 1e-3
    compared = called("compare", tmp_path / "before", tmp_path / "after", "--max-regression", "5%")
    assert compared.returncode in (0, 4) and "verdict" in compared.stdout
