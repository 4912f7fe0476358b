"""Recorded drives in other formats: the same signals give the same sideslip scores as in MCAP."""

import math
from pathlib import Path

import pytest

from pdhef_logtool import Car, ReadOptions, estimate, read_drive, score
from pdhef_logtool.mapping.mapping_file import mapping_from_dict

DEG, KMH, G = math.pi / 180.0, 1.0 / 3.6, 9.81
V40 = """
mass_kg = 1355.0
yaw_inertia_kg_m2 = 2380.0
cg_to_front_axle_m = 1.0455
cg_to_rear_axle_m = 1.5045
track_m = 1.565
steering_ratio = 17.0
friction = 0.95
[tyres.front]
cornering_stiffness_n_per_rad = 70000.0
[tyres.rear]
cornering_stiffness_n_per_rad = 70000.0
"""
#: Fields, with scales and latencies.
_Table = dict[str, tuple[str, str | list[str], float, float]]
_WHEEL = "steering_wheel_rad"
#: Speed, a_x, a_y, yaw rate, steering, and v_x and v_y of the ground truth.
_NAMES = ("speed_m_s", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", _WHEEL, "truth.vx_m_s", "truth.vy_m_s")


def _table(*rows: tuple[str, str, float, float]) -> _Table:
    return dict(zip(_NAMES, rows, strict=True))


V40_MCAP = _table(
    ("/reference/slip", "lng_vel_kmh", KMH, 0.0),
    ("/imu/data", "linear_acceleration.x", 1.0, 0.0),
    ("/imu/data", "linear_acceleration.y", 1.0, 0.0),
    ("/imu/data", "angular_velocity.z", 1.0, 0.0),
    ("/can/steering", "steering_wheel_angle_deg", DEG, 0.0),
    ("/reference/slip", "lng_vel_kmh", KMH, 0.0),
    ("/reference/slip", "lat_vel_kmh", KMH, 0.0),
)
_OF_VBO = ("Lng_Vel", "X_Accel", "Y_Accel", "YawRate", "SteerAng", "Lng_Vel", "Lat_Vel")
V40_VBO = _table(*(("vbox", n, f, 0.0) for n, f in zip(_OF_VBO, (KMH, G, G, -DEG, DEG, KMH, KMH), strict=True)))
V40_MF4 = _table(
    ("GNSS_10_Hz", "GNSS_Speed", KMH, 0.06),
    ("IMU_100_Hz", "IMU_AccX", G, 0.0),
    ("IMU_100_Hz", "IMU_AccY", G, 0.0),
    ("IMU_100_Hz", "IMU_YawRate", -DEG, 0.0),
    ("CAN", "CAN_SteeringWheelAngle", DEG, 0.006),
    ("reference", "REF_VelLong", KMH, 0.0),
    ("reference", "REF_VelLat", KMH, 0.0),
)
_GNSS: _Table = {"speed_m_s": ("/gnss/velocity", ["twist.linear.x", "twist.linear.y"], 1.0, 0.0)}


def _scores(log: Path, table: _Table, car: Path) -> dict[str, float]:
    raw: dict[str, dict[str, dict[str, object]]] = {"signals": {}, "truth": {}}
    for name, (topic, field, scale, latency_s) in table.items():
        entry: dict[str, object] = {"topic": topic, "field": field, "scale": scale, "latency_s": latency_s}
        if isinstance(field, list):
            entry |= {"combine": "norm", "scale": [scale] * len(field)}
        if name == _WHEEL:
            entry |= {"valid_min": -10.0, "valid_max": 10.0}
        raw["truth" if name.startswith("truth.") else "signals"][name.removeprefix("truth.")] = entry
    with read_drive(log, Car.load(car), mapping_from_dict(raw, where="test"), ReadOptions(end="+23.9s")) as drive:
        assert not [loss for loss in drive.losses if loss.severity == "lost"]
        figures = score(estimate(drive, ["phy-ukf", "physics"]))
    rows = figures.filter(signal="sideslip_rad", segment="all", metric="rmse")
    return dict(zip(rows["estimator"], rows["value"], strict=True))


@pytest.mark.parametrize(("file", "table", "more"), [("v40_swd.vbo", V40_VBO, {}), ("v40_swd.mf4", V40_MF4, _GNSS)])
def test_scores_are_those_of_the_same_drive_in_mcap(file, table, more, shared_dir, tmp_path):
    car = tmp_path / "vehicle.toml"
    car.write_text(f'name = "test"\n{V40}')
    drive = shared_dir / "data" / "drives" / "v40_swd_gnss.mcap"
    expected = _scores(drive, V40_MCAP | more, car)
    got = _scores(shared_dir / "data" / "formats" / file, table, car)
    assert set(got) >= {"phy-ukf", "physics"}
    for estimator, value in got.items():
        # Only the MCAP file has arrival times, and with them latencies.
        assert value == pytest.approx(expected[estimator], rel=0.05), estimator
