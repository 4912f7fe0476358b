"""The vehicle file: what it accepts, and how it says what is wrong."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from pdhef_logtool.car.vehicle import default_vehicle, load_vehicle, vehicle_from_dict
from pdhef_logtool.records.errors import VehicleError

#: The example of the file format's documentation, entry for entry.
EXAMPLE = """
name = "sedan"
mass_kg = 1440.0
yaw_inertia_kg_m2 = 1523.0
cg_to_front_axle_m = 1.16
cg_to_rear_axle_m = 1.71
track_m = 1.57
cg_height_m = 0.64
wheel_radius_m = 0.30
steering_ratio = 16.0
roll_gradient_rad_per_m_s2 = 0.0105
friction = 0.85
imu_position_m = [0.1, 0.0, 0.2]
truth_position_m = [-0.4, 0.0, 0.0]
low_speed_blend_m_s = 3.0
[sensors]
ay_std_m_s2 = 0.12
yaw_rate_std_rad_s = 0.004
[tyres.front]
B = 12.3
C = 1.41
D_n = 7600.0
E = 0.30
[tyres.rear]
cornering_stiffness_n_per_rad = 108000.0
[filter.phy-ukf-tuned]
q_std = [0.02, 0.006, 0.002]
r_std = { ay_m_s2 = 1.0, yaw_rate_rad_s = 0.003, speed_m_s = 0.1 }
[network]
trust_cap = 0.3
evidence = "none"
"""


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
        load_vehicle(path)
    text = str(caught.value)
    assert "\n" not in text
    assert str(path) in text
    assert caught.value.exit_code == 1
    return text


def test_every_entry_of_the_example_is_read(tmp_path):
    vehicle = load_vehicle(write(tmp_path, EXAMPLE))
    raw = tomllib.loads(EXAMPLE)
    assert as_plain(vehicle.model_dump(exclude_unset=True)) == raw
    assert vehicle_from_dict(as_plain(vehicle.model_dump(exclude_none=True)), where="again") == vehicle


def test_defaults_of_what_the_file_leaves_out(tmp_path):
    lines = "mass_kg = 1000\nyaw_inertia_kg_m2 = 1200\ncg_to_front_axle_m = 1.2\ncg_to_rear_axle_m = 1.3\n"
    tyres = "".join(f"[tyres.{a}]\ncornering_stiffness_n_per_rad = 8e4\n" for a in ("front", "rear"))
    vehicle = load_vehicle(write(tmp_path, lines + tyres))
    assert vehicle.friction is None
    assert vehicle.assumed_friction == 1.0
    assert vehicle.imu_position_m == (0.0, 0.0, 0.0)
    assert vehicle.network.trust_cap == 0.0
    assert not vehicle.network.has_evidence
    assert vehicle.filter == {}
    assert vehicle.sensors.ay_std_m_s2 == 0.12


def test_the_default_vehicle_is_the_published_one(tmp_path):
    published = EXAMPLE.replace("cornering_stiffness_n_per_rad = 108000.0", "B = 15.4\nC = 1.17\nD_n = 6110.0\nE = 0.2")
    vehicle = load_vehicle(write(tmp_path, published))
    same = {"imu_position_m", "truth_position_m", "filter", "network", "sensors"}
    assert default_vehicle().model_dump(exclude=same) == vehicle.model_dump(exclude=same)


def test_all_problems_are_reported_together(tmp_path):
    text = EXAMPLE.replace("mass_kg = 1440.0", "mass_kg = -5").replace("friction = 0.85", 'friction = "wet"')
    text = text.replace("track_m = 1.57", "trak_m = 1.57").replace("yaw_inertia_kg_m2 = 1523.0", "")
    said = problem(write(tmp_path, text))
    for entry in ("mass_kg", "friction", "trak_m", "yaw_inertia_kg_m2"):
        assert entry in said
    assert "docs/formats.md" in said


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("E = 0.30", "E = 0.30\ncornering_stiffness_n_per_rad = 9e4", "tyres.front"),
        ("E = 0.30\n", "", "tyres.front"),
        ("cornering_stiffness_n_per_rad = 108000.0", "", "tyres.rear"),
        ("E = 0.30", "E = 1.5", "tyres.front.E"),
        ("mass_kg = 1440.0", "mass_kg = nan", "mass_kg"),
        ("mass_kg = 1440.0", "mass_kg = inf", "mass_kg"),
        ("mass_kg = 1440.0", "mass_kg = 0", "mass_kg"),
        ("friction = 0.85", "friction = 0.0", "friction"),
        ("imu_position_m = [0.1, 0.0, 0.2]", "imu_position_m = [0.1, 0.0]", "imu_position_m"),
        ("imu_position_m = [0.1, 0.0, 0.2]", "imu_position_m = [0.1, nan, 0.2]", "imu_position_m.1"),
        ("yaw_rate_std_rad_s = 0.004", "yaw_rate_std_rad_s = 0", "sensors.yaw_rate_std_rad_s"),
        ("yaw_rate_std_rad_s = 0.004", "yaw_rate_std_deg_s = 0.2", "sensors.yaw_rate_std_deg_s"),
        ("q_std = [0.02, 0.006, 0.002]", "q_std = [0.02, -0.006]", "filter.phy-ukf-tuned.q_std.1"),
        ("trust_cap = 0.3", "trust_cap = 1.3", "network.trust_cap"),
        ("[tyres.rear]", "[tyres.back]", "tyres.back"),
    ],
)
def test_a_wrong_entry_is_named(tmp_path, old, new, named):
    assert EXAMPLE.count(old) >= 1
    assert named in problem(write(tmp_path, EXAMPLE.replace(old, new, 1)))


def test_a_missing_file_is_said_to_be_missing(tmp_path):
    assert "no such file" in problem(tmp_path / "nowhere.toml")


@pytest.mark.parametrize("content", ["mass_kg = ", "just words\n", b"\xff\xfe\x00", b"\x89MCAP0\r\n"])
def test_what_is_no_toml_is_one_line(tmp_path, content):
    problem(write(tmp_path, content))


def test_a_folder_is_no_vehicle_file(tmp_path):
    problem(tmp_path)


@settings(derandomize=True, deadline=None, max_examples=50)
@given(st.floats(0.05, 2.0))
def test_axle_quantities(friction):
    vehicle = vehicle_from_dict(tomllib.loads(EXAMPLE), where="example")
    assert vehicle.wheelbase_m == pytest.approx(2.87)
    weight = 1440.0 * 9.80665
    assert vehicle.axle_load_n(True) + vehicle.axle_load_n(False) == pytest.approx(weight)
    assert vehicle.axle_load_n(True) * 1.16 == pytest.approx(vehicle.axle_load_n(False) * 1.71)  # moments about the CG
    assert vehicle.cornering_stiffness_n_per_rad(True, friction) == pytest.approx(12.3 * 1.41 * 7600.0 * friction)
    assert vehicle.cornering_stiffness_n_per_rad(False, friction) == pytest.approx(108_000.0)
    assert vehicle.magic_formula(False, friction)[2] == pytest.approx(friction * vehicle.axle_load_n(False))


def test_records_are_frozen():
    with pytest.raises(ValidationError):
        default_vehicle().mass_kg = 1.0
