"""The residual gain of pd-hef: 1 with a network for the physics of the car, unless file or name state another."""

from dataclasses import replace

import polars as pl
import pytest
from made_models import random_network

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.toml_files import part_toml, read_vehicle_file
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.table import make_estimator
from tests.command_line import called

SEDAN = Car(default_vehicle())
OWN, FOREIGN = replace(random_network(), physics_sha256=SEDAN.physics_sha256), random_network()


def _gain(car: Car, name: str = "pd-hef") -> tuple[float, str]:
    """Return gain and note of an estimator."""
    estimator = make_estimator(name, car)
    return estimator.trust, " ".join(estimator.notes)


def test_a_network_acts_on_the_physics_that_it_was_trained_with():
    own, foreign = replace(SEDAN, network=OWN), replace(SEDAN, network=FOREIGN)
    assert _gain(own) == (1.0, "residual gain 1: within its region of validity")
    assert _gain(foreign) == (
        0.0,
        "residual gain 0: the network was not trained with the physics of this car",
    )
    assert (own.has_evidence, foreign.has_evidence, SEDAN.has_evidence) == (True, False, False)
    assert "no network" in _gain(SEDAN)[1]
    assert _gain(own.with_noise("physics", FilterNoise(q_std=(1.0, 1.0, 1.0))))[0] == 1.0


def test_the_file_decides_before_the_network_and_the_name_before_both(tmp_path):
    for gain in (0.0, 0.25):
        (tmp_path / "car.toml").write_text(f"{part_toml(SEDAN.vehicle)}\n[network]\ngain = {gain}\n")
        loaded = Car.load(tmp_path / "car.toml")
        for network in (OWN, FOREIGN):
            car = replace(loaded, network=network)
            assert _gain(car)[0] == gain
            for option, named in (("gain=1", 1.0), ("gain=0.5", 0.5), ("fixed-r", 1.0)):
                assert _gain(car, f"pd-hef:{option}") == (named, "")


@pytest.mark.slow
def test_a_run_says_the_gain_and_uses_it(sample_logs_dir, tmp_path):
    vehicle = read_vehicle_file(sample_logs_dir / "vehicle.toml").vehicle
    car = tmp_path / "car"
    car.mkdir()
    (car / "vehicle.toml").write_text(part_toml(vehicle))
    replace(random_network(), physics_sha256=Car(vehicle).physics_sha256).save(car / "network")
    random_network(1).save(tmp_path / "foreign")
    for out, network, gain, text in (
        ("own", (), 1.0, "residual gain 1 within the region of validity"),
        ("other", ("--network", tmp_path / "foreign"), 0.0, "no network was trained with the physics of this car"),
    ):
        given = ("--car", car, *network, "-e", "pd-hef", "--model", "off", "-o", tmp_path / out)
        shown = called("run", sample_logs_dir / "dlc.mcap", *given, env={"COLUMNS": "400"})
        assert text in shown.stdout, shown.stdout + shown.stderr
        rows = pl.read_parquet(tmp_path / out / "logs" / "dlc" / "estimates.parquet")
        found = rows.filter((pl.col("estimator") == "pd-hef") & pl.col("valid"))["network_trust"]
        assert found.unique().to_list() == [gain]
