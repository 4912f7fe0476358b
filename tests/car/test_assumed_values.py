"""Values that a vehicle file leaves out: rules that hold from a 1:10 car to a laden truck."""

from __future__ import annotations

from pathlib import Path

import pytest

from pdhef_logtool.car.assumed_values import assumed_car
from pdhef_logtool.car.toml_files import read_vehicle_file
from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.model import priors
from pdhef_logtool.records.errors import VehicleError

#: Mass, wheelbase and front share of a 1:10 car, a 1:5 car, a small car, a saloon, a van, a 40 t truck.
VEHICLES = [
    (3.5, 0.32, 0.5),
    (21.0, 0.57, 0.42),
    (900.0, 2.3, 0.6),
    (1440.0, 2.87, 0.6),
    (3500.0, 4.3, 0.45),
    (4e4, 6, 0.3),
]


def rough(mass: float, wheelbase: float, share: float) -> dict[str, float]:
    return {"mass_kg": mass, "wheelbase_m": wheelbase, "front_weight_share": share}


def write(folder: Path, entries: dict[str, float]) -> Path:
    path = folder / "car.toml"
    path.write_text("".join(f"{name} = {value}\n" for name, value in entries.items()))
    return path


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_mass_wheelbase_and_weight_split_suffice(tmp_path: Path, vehicle: tuple[float, float, float]) -> None:
    file = read_vehicle_file(write(tmp_path, rough(*vehicle)))
    mass, wheelbase, share = vehicle
    assert file.vehicle.mass_kg == mass and file.vehicle.wheelbase_m == pytest.approx(wheelbase)
    assert file.vehicle.axle_load_n(True) == pytest.approx(share * mass * 9.80665)
    assert {a.entry for a in file.assumed} >= {"yaw_inertia_kg_m2", "tyres.rear.cornering_stiffness_n_per_rad"}
    assert all(a.spread > 0 and a.rule for a in file.assumed)
    assert file.vehicle.understeer_gradient_rad_per_m_s2() > 0  # the default vehicle understeers


def test_what_is_given_is_kept_and_what_builds_on_it_follows(tmp_path: Path) -> None:
    given_entries = rough(1500.0, 2.6, 0.6) | {"wheel_radius_m": 0.4, "track_m": 1.7, "cg_height_m": 0.7}
    file = read_vehicle_file(write(tmp_path, given_entries))
    assert (file.vehicle.wheel_radius_m, file.vehicle.track_m) == (0.4, 1.7)
    assert file.vehicle.relaxation_length_m == pytest.approx(0.4 / 0.6, abs=1e-4)
    assert file.vehicle.cg_over_roll_axis_m == pytest.approx(0.4375)
    assert {"track_m", "wheel_radius_m", "cg_height_m"}.isdisjoint(a.entry for a in file.assumed)


def test_one_axle_distance_and_the_wheelbase_give_the_other(tmp_path: Path) -> None:
    vehicle = read_vehicle_file(
        write(tmp_path, {"mass_kg": 1500, "wheelbase_m": 2.6, "cg_to_front_axle_m": 1.1})
    ).vehicle
    assert vehicle.cg_to_rear_axle_m == pytest.approx(1.5)


def test_without_a_weight_split_that_of_a_passenger_car_is_assumed_and_named(tmp_path: Path) -> None:
    file = read_vehicle_file(write(tmp_path, {"mass_kg": 1500, "wheelbase_m": 2.6}))
    assert file.vehicle.cg_to_front_axle_m == pytest.approx(2.6 * 0.44)
    assert "front_weight_share" in {a.entry for a in file.assumed}


@pytest.mark.parametrize(
    ("entries", "named"),
    [
        ({"wheelbase_m": 2.6, "front_weight_share": 0.6}, "mass_kg"),
        (
            {"mass_kg": 1500, "wheelbase_m": 2.6, "front_weight_share": 60},
            r"got front_weight_share: should be less than 1, got 60;",
        ),
        (
            {"mass_kg": 1500, "wheelbase_m": 2600, "front_weight_share": 0.6},
            r"got wheelbase_m: should [^;]*30, got 2600;",
        ),
        ({"mass_kg": 1500, "wheelbase_m": 2.6, "cg_height_m": 550}, r"got cg_height_m: should [^;]*, got 550;"),
        (
            {"mass_kg": 1500, "cg_to_front_axle_m": 1.1, "cg_to_rear_axle_m": 1500, "mas": 1},
            r"got cg_to_rear_axle_m: should [^;]*, got 1500; mas: unknown[^;]*;",
        ),
        ({"mass_kg": 1500, "wheelbase_m": 2.6, "cg_to_front_axle_m": 1.1, "cg_to_rear_axle_m": 1.5}, "wheelbase_m"),
    ],
)
def test_wrong_entries_are_named(tmp_path: Path, entries: dict[str, float], named: str) -> None:
    with pytest.raises(VehicleError, match=named):
        read_vehicle_file(write(tmp_path, entries))


def test_without_a_file_only_a_wheelbase_below_that_of_road_cars_replaces_the_sedan() -> None:
    model = assumed_car(0.4)
    assert model.wheelbase_m == pytest.approx(0.4) and 4.0 < model.mass_kg < 20.0
    assert model.low_speed_blend_m_s == pytest.approx(1.12, abs=0.01)
    for unknown_or_usual in (float("nan"), 0.05, 1.3, 2.6):
        assert assumed_car(unknown_or_usual) is default_vehicle()


def test_the_softest_tyres_that_a_fit_of_a_model_car_can_have_are_a_vehicle() -> None:
    car = assumed_car(0.3)
    values = {
        p.name: p.low if p.name in (priors.RATIO, priors.REAR_STIFFNESS) else p.mean for p in priors.parameters_of(car)
    }
    VehicleParameters.model_validate(priors.vehicle_with(car, values).model_dump())
