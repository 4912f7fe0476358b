"""Recorded drives in other formats: the same signals give the same sideslip scores as in MCAP."""

import math
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool import Car, ReadOptions, estimate, read_drive, score
from pdhef_logtool.mapping.mapping_file import mapping_from_dict
from studies.peers.drives import mapping_table, peer_drive, vehicle_of

DEG, KMH, G = math.pi / 180.0, 1.0 / 3.6, 9.81
DRIVE = peer_drive("v40_swd_gnss.mcap")
NAMES = ("speed_m_s", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "steering_wheel_rad", "truth.vx_m_s", "truth.vy_m_s")
SCALES = (KMH, G, G, -DEG, DEG, KMH, KMH)
#: Topic and field of each signal, and latencies, by the end of the file's name.
FIELDS = {
    ".vbo": "vbox Lng_Vel vbox X_Accel vbox Y_Accel vbox YawRate vbox SteerAng vbox Lng_Vel vbox Lat_Vel",
    ".mf4": "GNSS_10_Hz GNSS_Speed IMU_100_Hz IMU_AccX IMU_100_Hz IMU_AccY IMU_100_Hz IMU_YawRate "
    "CAN CAN_SteeringWheelAngle reference REF_VelLong reference REF_VelLat",
}
LATE_S = {".vbo": {}, ".mf4": {"speed_m_s": 0.06, "steering_wheel_rad": 0.006}}


def mapping_of(suffix: str) -> dict[str, Any]:
    """Return the mapping file of a format."""
    tables: dict[str, dict[str, Any]] = {"signals": {}, "truth": {}}
    words = FIELDS[suffix].split()
    for name, topic, field, scale in zip(NAMES, words[::2], words[1::2], SCALES, strict=True):
        entry = {"topic": topic, "field": field, "scale": scale, "latency_s": LATE_S[suffix].get(name, 0.0)}
        limits = {"valid_min": -10.0, "valid_max": 10.0} if name == "steering_wheel_rad" else {}
        tables["truth" if name.startswith("truth.") else "signals"][name.removeprefix("truth.")] = entry | limits
    return tables


def scores(log: Path, tables: dict[str, Any]) -> dict[str, float]:
    """Return the RMSE of the sideslip by estimator."""
    mapping, options = mapping_from_dict(tables, where="test"), ReadOptions(end="+23.9s")
    with read_drive(log, Car(vehicle_of(DRIVE)), mapping, options) as drive:
        assert not [loss for loss in drive.losses if loss.severity == "lost"]
        figures = score(estimate(drive, ["phy-ukf", "physics"]))
    rows = figures.filter(signal="sideslip_rad", segment="all", metric="rmse")
    return dict(zip(rows["estimator"], rows["value"], strict=True))


@pytest.mark.parametrize("suffix", FIELDS)
def test_scores_are_those_of_the_same_drive_in_mcap(suffix, shared_dir):
    tables = mapping_table(DRIVE)
    del tables["truth"]["yaw_rate_rad_s"]
    if suffix == ".vbo":  # it has no receiver: its speed is that of the ground truth
        tables["signals"]["speed_m_s"] = tables["truth"]["vx_m_s"]
    expected = scores(shared_dir / "data" / "drives" / DRIVE.log, tables)
    got = scores(shared_dir / "data" / "formats" / f"v40_swd{suffix}", mapping_of(suffix))
    # Only the MCAP file has arrival times, and with them latencies.
    assert got.keys() >= {"phy-ukf", "physics"} and got == pytest.approx(expected, rel=0.05)
