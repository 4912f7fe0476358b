"""Vehicle files: shipped cars are plausible, an invalid file gives a one-line error, and randomised cars drive."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.records.errors import VehicleError
from truthsim.linear_theory import steady_roll, understeer_gradient_rad_per_m_s2
from truthsim.manoeuvres import Plan
from truthsim.motion import simulate_motion
from truthsim.randomisation import randomise
from truthsim.vehicle import Vehicle
from truthsim.vehicle_files import VEHICLES, load_vehicle

SHIPPED = Path(__file__).resolve().parents[2] / "truthsim" / "vehicles"
SEDAN = (SHIPPED / "sedan.toml").read_text()
DEG_PER_G = np.degrees(1.0) * 9.80665


def test_the_default_is_the_sedan_s_file() -> None:
    assert load_vehicle("sedan") == Vehicle()
    assert {p.stem for p in SHIPPED.glob("*.toml")} == set(VEHICLES)


@pytest.mark.parametrize("name", VEHICLES)
def test_shipped_vehicles_handle_like_cars_of_their_kind(name: str) -> None:
    car = load_vehicle(name)
    assert 1.5 < understeer_gradient_rad_per_m_s2(car, 0.85) * DEG_PER_G < 4.0
    angle, (front, rear) = steady_roll(car)
    assert 3.0 < angle * DEG_PER_G < 6.0
    assert 0.5 < front / (front + rear) < 0.65
    motion = simulate_motion(Plan(25.0, 4.0, steer_rad=np.linspace(0.0, 0.10, 4001)), 0.85, vehicle=car)
    assert np.isfinite(motion.observed).all()
    assert 0.6 < motion.column("ay_m_s2").max() / 9.80665 < 0.88


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("mass_kg = 1440.0\n", "", ("mass_kg: is missing",)),
        ("mass_kg = 1440.0", "mass_kg = nan", ("mass_kg", "nan", "finite")),
        ("track_m = ", "trakc_m = ", ("track_m: is missing", "trakc_m: unknown, did you mean track_m?")),
        ("ackermann = 0.5", "ackermann = 1.5", ("ackermann", "1.5")),
        ("front_unsprung_mass_kg = 35.0", "front_unsprung_mass_kg = 400.0", ("unsprung",)),
        ("front_unsprung_mass_kg = 35.0", "front_unsprung_mass_kg = 1.0", ("300 rad/s",)),
        ("cg_height_m = 0.64", "cg_height_m = 6.4", ("upright",)),
        ("front_roll_centre_height_m = 0.1", "front_roll_centre_height_m = 0.9", ("roll and pitch centres",)),
        ("lateral_relaxation_min_m = 0.3", "lateral_relaxation_min_m = 0.9", ("front_tyre", "lateral_relaxation")),
    ],
)
def test_a_wrong_file_is_one_clear_line(tmp_path: Path, old: str, new: str, words: tuple[str, ...]) -> None:
    assert old in SEDAN
    path = tmp_path / "car.toml"
    path.write_text(SEDAN.replace(old, new, 1))
    with pytest.raises(VehicleError) as caught:
        load_vehicle(path)
    assert "\n" not in str(caught.value) and "car.toml" in str(caught.value)
    assert all(word in str(caught.value) for word in words)


def test_an_own_file_is_read_and_a_missing_one_named(tmp_path: Path) -> None:
    path = tmp_path / "car.toml"
    path.write_text(SEDAN.replace("mass_kg = 1440.0", "mass_kg = 1500"))
    assert load_vehicle(path) == Vehicle()._replace(mass_kg=1500.0)
    with pytest.raises(VehicleError, match="sedan, suv, hatchback"):
        load_vehicle("lorry")


@pytest.mark.slow
@pytest.mark.parametrize("name", VEHICLES)
def test_randomised_cars_drive(name: str) -> None:
    steer = 0.03 * np.sin(2.0 * np.pi * 0.7 * np.arange(0.0, 4.0, 1e-3))
    for seed in range(8):
        motion = simulate_motion(Plan(22.0, 3.9, steer_rad=steer), 0.7, vehicle=randomise(load_vehicle(name), seed))
        assert np.isfinite(motion.observed).all()
        assert 0.25 < np.abs(motion.column("ay_m_s2")).max() / 9.80665 < 0.72
