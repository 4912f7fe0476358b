"""The vehicle file: accepted entries and error messages."""

import json
import os
import re
import tomllib
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from pdhef_logtool.car.assumed_values import assumed_car
from pdhef_logtool.car.car import SHIPPED_CARS, Car
from pdhef_logtool.car.parts import FilterNoise, Fit, FittedPhysics, LearntOn
from pdhef_logtool.car.toml_files import VehicleEntries, part_toml, read_vehicle_file, vehicle_of_entries
from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.evaluation.validation_plan import PlanTable
from pdhef_logtool.model import priors
from pdhef_logtool.records.errors import VehicleError
from pdhef_logtool.results.parquet_sink import load_schema

FILES = Path(__file__).parents[1] / "reference" / "vehicles"
SAMPLES = Path(__file__).parents[2] / "sample_logs"
#: The example of the documentation.
EXAMPLE = re.search(
    r"## vehicle\.toml\n```toml\n(.*?)```", (SAMPLES.parent / "docs/formats.md").read_text("utf-8"), re.DOTALL
)[1]


def as_plain(value):
    """Tuples as lists, as TOML has them."""
    if isinstance(value, dict):
        return {k: as_plain(v) for k, v in value.items()}
    return [as_plain(v) for v in value] if isinstance(value, list | tuple) else value


def write(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "car.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def problem(path: Path) -> str:
    with pytest.raises(VehicleError) as caught:
        read_vehicle_file(path)
    assert str(path) in str(caught.value)
    return str(caught.value)


def test_every_entry_of_the_example_is_read(tmp_path):
    network = "[network]\ngain = 0.3\n"
    file = read_vehicle_file(write(tmp_path, EXAMPLE + network))
    vehicle = file.vehicle
    assert file.network_gain == 0.3
    assert "network.gain" in problem(write(tmp_path, EXAMPLE + network.replace("0.3", "1.3")))
    raw = tomllib.loads(EXAMPLE)
    given = {k: v for k, v in vehicle.model_dump(exclude_unset=True).items() if k in raw}
    assert as_plain(given) == raw
    assert vehicle_of_entries(as_plain(vehicle.model_dump(exclude_none=True)), where="again").vehicle == vehicle


def test_defaults_of_what_the_file_leaves_out(tmp_path):

    lines = "mass_kg = 1000\nyaw_inertia_kg_m2 = 1200\ncg_to_front_axle_m = 1.2\ncg_to_rear_axle_m = 1.3\n"
    tyres = "".join(f"[tyres.{a}]\ncornering_stiffness_n_per_rad = 8e4\n" for a in ("front", "rear"))
    vehicle = read_vehicle_file(write(tmp_path, lines + tyres)).vehicle
    assert vehicle.friction is None
    assert vehicle.assumed_friction == 1.0
    assert vehicle.imu_position_m == (0.0, 0.0, 0.0)
    assert Car.load(tmp_path / "car.toml", network="none").residual_gain == 0.0
    assert vehicle.sensors.ay_std_m_s2 == 0.12


def test_the_default_vehicle_is_the_published_one(tmp_path):
    published = EXAMPLE.replace("cornering_stiffness_n_per_rad = 108000.0", "B = 15.4\nC = 1.17\nD_n = 6110.0\nE = 0.2")
    vehicle = read_vehicle_file(write(tmp_path, published)).vehicle
    same = {"imu_position_m", "truth_position_m", "sensors"}
    assert default_vehicle().model_dump(exclude=same) == vehicle.model_dump(exclude=same)


def test_all_problems_are_reported_together(tmp_path):
    text = EXAMPLE.replace("mass_kg = 1440.0", "mass_kg = -5").replace("friction = 0.85", 'friction = "wet"')
    text = text.replace("track_m = 1.57", "trak_m = 1.57").replace("yaw_inertia_kg_m2 = 1523.0", "")
    said = problem(write(tmp_path, text))
    for entry in ("mass_kg", "friction", "trak_m"):
        assert entry in said
    assert "yaw_inertia_kg_m2" not in said  # it may be left out once the mass is right
    assert "docs/formats.md" in said


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("E = 0.30", "E = 0.30\ncornering_stiffness_n_per_rad = 9e4", "tyres.front"),
        ("E = 0.30\n", "", "tyres.front"),
        ("E = 0.30", "E = 1.5", "tyres.front.E"),
        ("mass_kg = 1440.0", "mass_kg = nan", "mass_kg"),
        ("friction = 0.85", "friction = 0.0", "friction"),
        ("imu_position_m = [0.0, 0.0, 0.0]", "imu_position_m = [0.1, 0.0]", "imu_position_m"),
        ("ay_std_m_s2 = 0.12", "yaw_rate_std_rad_s = 0", "sensors.yaw_rate_std_rad_s"),
        ("ay_std_m_s2 = 0.12", "yaw_rate_std_deg_s = 0.2", "sensors.yaw_rate_std_deg_s"),
        ("[tyres.rear]", "[tyres.back]", "tyres.back"),
        ("mass_kg = 1440.0", 'mass_kg = "1440"', "mass_kg: should be a valid number, got '1440'"),
        ("imu_position_m = [0.0, 0.0, 0.0]", 'imu_position_m = "100"', "imu_position_m: should be a list, got '100'"),
        ("imu_position_m = [0.0, 0.0, 0.0]", "imu_position_m = [100.0, 0.0, 200.0]", "imu_position_m.0"),
        ("friction = 0.85", "friction = 85.0", "friction"),
        ("roll_gradient_rad_per_m_s2 = 0.0105", "roll_gradient_rad_per_m_s2 = 0.6", "roll_gradient_rad_per_m_s2"),
        ("ay_std_m_s2 = 0.12", "ay_std_m_s2 = 120.0", "sensors.ay_std_m_s2"),
    ],
)
def test_a_wrong_entry_is_named(tmp_path, old, new, named):
    assert EXAMPLE.count(old) >= 1
    assert named in problem(write(tmp_path, EXAMPLE.replace(old, new, 1)))


@pytest.mark.parametrize(
    ("entry", "factor", "named"),
    [
        ("yaw_inertia_kg_m2", 20.0, "I_z / (m l_f l_r) is 10.7"),
        ("yaw_inertia_kg_m2", 0.1, "I_z / (m l_f l_r) is 0.05"),
        ("D_n", 10.0, "peak force over static load of the front axle is 9.0"),
        ("D_n", 0.1, "peak force over static load of the front axle is 0.09"),
        ("B", 10.0, "cornering stiffness over static load of the front axle in 1/rad is"),
        ("cornering_stiffness_n_per_rad", 10.0, "cornering stiffness over static load of the rear axle in 1/rad is 18"),
        # N per degree instead of N per radian
        ("cornering_stiffness_n_per_rad", 0.0175, "cornering stiffness over static load of the rear axle in 1/rad"),
        # As soft as those of a model car.
        ("cornering_stiffness_n_per_rad", 0.08, "cornering stiffness over static load of the rear axle in 1/rad"),
        ("cg_to_front_axle_m", 10.0, "I_z / (m l_f l_r)"),
        ("track_m", 0.1, "track over wheelbase"),
        ("cg_height_m", 6.0, "height of the CG over wheelbase"),
        ("relaxation_length_m", 20.0, "relaxation length over wheelbase"),
        ("low_speed_blend_m_s", 6.0, "low-speed limit over sqrt(g wheelbase)"),
    ],
)
def test_relations_find_a_slip_that_the_ranges_let_pass(entry, factor, named):
    raw = tomllib.loads(EXAMPLE)
    raw["relaxation_length_m"] = 0.5
    place = next(t for t in (raw, raw["tyres"]["front"], raw["tyres"]["rear"]) if entry in t)
    place[entry] *= factor
    with pytest.raises(VehicleError) as caught:
        vehicle_of_entries(raw, where="car.toml")
    assert named in str(caught.value)
    assert entry in str(caught.value) or f"tyres.{'rear' if entry.startswith('corn') else 'front'}" in str(caught.value)


@pytest.mark.parametrize("path", [*sorted(FILES.glob("*.toml")), *sorted(SAMPLES.glob("vehicle*.toml"))], ids=str)
def test_the_files_of_the_project_are_taken(path):
    read_vehicle_file(path)


def test_a_mass_in_tonnes_contradicts_the_other_entries(tmp_path):
    said = problem(write(tmp_path, EXAMPLE.replace("mass_kg = 1440.0", "mass_kg = 1.44")))
    assert "mass_kg, yaw_inertia_kg_m2, cg_to_front_axle_m, cg_to_rear_axle_m contradict one another" in said
    assert "I_z / (m l_f l_r) is 533, plausible is 0.15 to 8" in said
    assert "tyres.front.D_n, mass_kg, cg_to_front_axle_m, cg_to_rear_axle_m contradict one another" in said


FOLDER = Path(__file__).parents[2] / "schemas"
#: By the name of the schema.
MODELS: dict[str, Any] = {"car-vehicle": VehicleEntries, "car-fit": Fit, "plan": PlanTable}
FIT = Fit(
    physics_sha256="ab" * 32,
    physics=FittedPhysics(values=default_vehicle(), noise=FilterNoise()),
    filter={"phy-ukf:tuned": FilterNoise(q_std=(0.1, 0.1, 0.1), r_std={"ay_m_s2": 1.0})},
    drives=(LearntOn(name="lap", sha256="cd", end_s=9.0),),
)


def said_by_the_model(name: str) -> str:
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "$id": f"{name}.schema.json"}
    return json.dumps({**head, **MODELS[name].model_json_schema()}, indent=2, ensure_ascii=False) + "\n"


def document(part: str) -> dict[str, Any]:
    """Return one that pdhef wrote."""
    if part == "fit":
        return tomllib.loads(part_toml(FIT, "Written by a test."))
    path = next(SHIPPED_CARS["saloon"].glob(f"{part}.[tj]*"))
    return json.loads(path.read_text()) if path.suffix == ".json" else tomllib.loads(path.read_text())


def valid(part: str, value: dict[str, Any]) -> bool:
    return bool(jsonschema.Draft202012Validator(load_schema(f"car-{part}.schema.json")).is_valid(value))


@pytest.mark.parametrize("name", MODELS)
def test_a_schema_is_what_its_model_says(name):
    path = FOLDER / f"{name}.schema.json"
    if os.environ.get("PDHEF_UPDATE_SCHEMAS") == "1":
        path.write_text(said_by_the_model(name), encoding="utf-8")
    assert path.read_text(encoding="utf-8") == said_by_the_model(name), "PDHEF_UPDATE_SCHEMAS=1 writes it again"
    jsonschema.Draft202012Validator.check_schema(load_schema(path.name))


@pytest.mark.parametrize("part", ["vehicle", "fit"])
def test_what_pdhef_wrote_is_valid_and_what_it_refuses_is_not(part):
    written = document(part)
    assert valid(part, written)
    assert not valid(part, written | {"no_such_entry": 1})
    for name in MODELS[f"car-{part}"].model_json_schema().get("required", []):
        assert not valid(part, {k: v for k, v in written.items() if k != name}), name
    if part != "vehicle":
        assert not valid(part, written | {"version": 99})
        assert not valid(part, written | {"format": "pdhef-else"})


#: Mass, wheelbase and front share of a 1:10 car, a 1:5 car, a small car, a saloon, a van, a 40 t truck.
VEHICLES = [(3.5, 0.32, 0.5), (21.0, 0.57, 0.42), (900.0, 2.3, 0.6)]
VEHICLES += [(1440.0, 2.87, 0.6), (3500.0, 4.3, 0.45), (4e4, 6, 0.3)]


def rough(mass: float, wheelbase: float, share: float) -> dict[str, float]:
    return {"mass_kg": mass, "wheelbase_m": wheelbase, "front_weight_share": share}


def write_entries(folder: Path, entries: dict[str, float]) -> Path:
    path = folder / "car.toml"
    path.write_text("".join(f"{name} = {value}\n" for name, value in entries.items()))
    return path


@pytest.mark.parametrize("vehicle", VEHICLES)
def test_mass_wheelbase_and_weight_split_suffice(tmp_path, vehicle):
    file = read_vehicle_file(write_entries(tmp_path, rough(*vehicle)))
    mass, wheelbase, share = vehicle
    assert file.vehicle.mass_kg == mass and file.vehicle.wheelbase_m == pytest.approx(wheelbase)
    assert file.vehicle.axle_load_n(True) == pytest.approx(share * mass * 9.80665)
    assert {a.entry for a in file.assumed} >= {"yaw_inertia_kg_m2", "tyres.rear.cornering_stiffness_n_per_rad"}
    assert all(a.spread > 0 and a.rule for a in file.assumed)
    assert file.vehicle.understeer_gradient_rad_per_m_s2() > 0  # the default vehicle understeers


def test_what_is_given_is_kept_and_what_builds_on_it_follows(tmp_path):
    given_entries = rough(1500.0, 2.6, 0.6) | {"wheel_radius_m": 0.4, "track_m": 1.7, "cg_height_m": 0.7}
    file = read_vehicle_file(write_entries(tmp_path, given_entries))
    assert (file.vehicle.wheel_radius_m, file.vehicle.track_m) == (0.4, 1.7)
    assert file.vehicle.relaxation_length_m == pytest.approx(0.4 / 0.6, abs=1e-4)
    assert file.vehicle.cg_over_roll_axis_m == pytest.approx(0.4375)
    assert {"track_m", "wheel_radius_m", "cg_height_m"}.isdisjoint(a.entry for a in file.assumed)


@pytest.mark.parametrize(("front", "rear_m"), [({"cg_to_front_axle_m": 1.1}, 1.5), ({}, 2.6 * 0.56)])
def test_a_wheelbase_needs_one_axle_distance_or_has_the_weight_split_of_a_passenger_car(tmp_path, front, rear_m):
    file = read_vehicle_file(write_entries(tmp_path, {"mass_kg": 1500, "wheelbase_m": 2.6, **front}))
    assert file.vehicle.cg_to_rear_axle_m == pytest.approx(rear_m)
    assert ("front_weight_share" in {a.entry for a in file.assumed}) is (not front)


@pytest.mark.parametrize(
    ("entries", "named"),
    [
        ({"mass_kg": None}, "mass_kg"),
        ({"front_weight_share": 60}, "got front_weight_share: should be less than 1, got 60;"),
        ({"wheelbase_m": 2600}, r"got wheelbase_m: should [^;]*30, got 2600;"),
        ({"cg_height_m": 550}, r"got cg_height_m: should [^;]*, got 550;"),
        ({"cg_to_rear_axle_m": 1500, "mas": 1}, "got cg_to_rear_axle_m: should [^;]*, got 1500; .*mas: unknown"),
        ({"cg_to_front_axle_m": 1.1, "cg_to_rear_axle_m": 1.5}, "wheelbase_m"),
    ],
)
def test_wrong_entries_are_named(tmp_path, entries, named):
    with pytest.raises(VehicleError, match=named):
        given = rough(1500, 2.6, 0.6) | entries
        read_vehicle_file(write_entries(tmp_path, {name: value for name, value in given.items() if value is not None}))


def test_without_a_file_only_a_wheelbase_below_that_of_road_cars_replaces_the_sedan():
    model = assumed_car(0.4)
    assert model.wheelbase_m == pytest.approx(0.4) and 4.0 < model.mass_kg < 20.0
    assert model.low_speed_blend_m_s == pytest.approx(1.12, abs=0.01)
    for unknown_or_usual in (float("nan"), 0.05, 1.3, 2.6):
        assert assumed_car(unknown_or_usual) is default_vehicle()


def test_the_softest_tyres_that_a_fit_of_a_model_car_can_have_are_a_vehicle():
    car = assumed_car(0.3)
    values = {
        p.name: p.low if p.name in (priors.RATIO, priors.REAR_STIFFNESS) else p.mean for p in priors.parameters_of(car)
    }
    VehicleParameters.model_validate(priors.vehicle_with(car, values).model_dump())
