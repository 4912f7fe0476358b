"""The written log, read back by other libraries; and the sample logs of the repository."""

import hashlib
import json
import operator
import tomllib
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from other_readers import read_with_other_libraries

from pdhef_logtool.car.toml_files import read_vehicle_file
from studies.defaults import fit_nominal_tyres
from truthsim.drive import START_NS, simulate_drive, write_drive
from truthsim.samples import SAMPLES, write_sample

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
TYPES = {
    "/imu/data": "sensor_msgs/msg/Imu",
    "/vehicle/status/steering_status": "autoware_vehicle_msgs/msg/SteeringReport",
    "/vehicle/wheel_speeds": "truthsim_msgs/msg/WheelSpeeds",
    "/rtk/odometry": "nav_msgs/msg/Odometry",
    "/rtk/fix": "sensor_msgs/msg/NavSatFix",
    "/rtk/quality": "truthsim_msgs/msg/RtkQuality",
    "/truth/perfect/odometry": "nav_msgs/msg/Odometry",
    "/truth/perfect/state": "truthsim_msgs/msg/VehicleTruth",
}


def nanoseconds(stamp) -> int:
    return stamp.sec * 1_000_000_000 + stamp.nanosec


@pytest.fixture(scope="module")
def drive():
    return simulate_drive("step-steer", seed=2)


@pytest.fixture(scope="module")
def read_back(drive, tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "step.mcap"
    write_drive(drive, path)
    return read_with_other_libraries(path)


def test_other_libraries_find_every_topic_with_its_type(read_back, drive):
    messages, types, _ = read_back
    assert types == TYPES
    n = drive.times_s.shape[0]
    assert {t: len(m) for t, m in messages.items()} == {
        t: (61 if t in ("/rtk/fix", "/rtk/quality") else n) for t in TYPES
    }


def test_stamps_are_measurement_times_and_log_times_arrivals(read_back):
    messages, _, _ = read_back
    for topic in TYPES:
        delay_ns = 0 if "truth" in topic else 20_000_000 if "rtk" in topic else 10_000_000
        for log_time, publish_time, message in messages[topic]:
            stamp = nanoseconds(message.stamp if topic.endswith("steering_status") else message.header.stamp)
            assert stamp == publish_time and log_time - publish_time == delay_ns
    assert nanoseconds(messages["/imu/data"][0][2].header.stamp) == START_NS == 1_767_225_600 * 10**9
    steering = [p for _, p, _ in messages["/vehicle/status/steering_status"]]
    assert steering[0] - START_NS == 3_000_000 and set(np.diff(steering)) == {10_000_000}


#: Topic and field of a message, channel and field of the sensor.
FIELDS = [
    ("/imu/data", "linear_acceleration.x", "imu", "ax_m_s2"),
    ("/imu/data", "linear_acceleration.y", "imu", "ay_m_s2"),
    ("/imu/data", "angular_velocity.z", "imu", "yaw_rate_rad_s"),
    ("/vehicle/status/steering_status", "steering_tire_angle", "steering", "steer_rad"),
    *(("/vehicle/wheel_speeds", f"{w}_m_s", "wheels", f"{w}_m_s") for w in ("fl", "fr", "rl", "rr")),
    ("/rtk/odometry", "twist.twist.linear.y", "rtk", "vy_m_s"),
    ("/rtk/odometry", "pose.pose.position.x", "rtk", "x_m"),
    ("/rtk/fix", "latitude", "fix", "lat_deg"),
]


def test_values_survive(read_back, drive):
    messages, _, _ = read_back
    for topic, path, channel, name in FIELDS:
        found = [operator.attrgetter(path)(m) for _, _, m in messages[topic]]
        assert found == pytest.approx(drive.channels[channel].fields[name], abs=1e-5, rel=1e-7), path
    imu, odometry, fix = (messages[topic][-1][2] for topic in ("/imu/data", "/rtk/odometry", "/rtk/fix"))
    assert imu.orientation_covariance[0] == -1.0
    assert imu.linear_acceleration_covariance[4] == pytest.approx(0.12**2)
    assert odometry.pose.covariance[0] == pytest.approx(1e-4) and odometry.twist.covariance[7] > 0.0
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "base_link")
    assert fix.status.status == 2 and fix.position_covariance_type == 2
    assert fix.position_covariance[[0, 4, 8]] == pytest.approx([1e-4, 1e-4, 4e-4])
    assert messages["/rtk/quality"][-1][2].quality == 4


def test_manifest_lists_the_sample_logs_with_their_hashes():
    folder = ROOT / "sample_logs"
    manifest = tomllib.loads((folder / "manifest.toml").read_text(encoding="utf-8"))["log"]
    assert [entry["file"] for entry in manifest] == [s.file for s in SAMPLES]
    assert {"dlc.mcap", "sweep.mcap", "road.mcap", "fishhook.mcap", "faults.mcap"} <= {e["file"] for e in manifest}
    for entry in manifest:
        path = folder / entry["file"]
        parts = sorted(path.iterdir()) if path.is_dir() else [path]
        data = b"".join(p.read_bytes() for p in parts)
        assert hashlib.sha256(data).hexdigest() == entry["sha256"] and len(data) == entry["size_bytes"]
        assert (folder / entry["vehicle"]).is_file()
        assert f"--seed {entry['seed']}" in entry["command"] and f"-o {entry['file']}" in entry["command"]
    assert sum(p.stat().st_size for p in folder.rglob("*") if p.is_file()) < 15_000_000


def message_counts(path: Path) -> dict[str, int]:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    return {summary.channels[i].topic: n for i, n in summary.statistics.channel_message_counts.items()}


#: The longest log and the rosbag2 take too long to read; the others are made in the same way.
@pytest.mark.parametrize("sample", [s for s in SAMPLES if s.file in ("dlc.mcap", "faults.mcap")], ids=lambda s: s.file)
def test_a_sample_log_is_what_the_code_makes(sample, tmp_path):
    paths = {
        "/imu/data": "linear_acceleration.y",
        "/vehicle/status/steering_status": "steering_tire_angle",
        "/vehicle/wheel_speeds": "fl_m_s",
        "/rtk/odometry": "twist.twist.linear.y",
        "/truth/perfect/state": "sideslip_rad",
    }
    write_sample(sample, tmp_path)
    files = (tmp_path / sample.file, ROOT / "sample_logs" / sample.file)
    (new, _, new_metadata), (old, _, old_metadata) = (read_with_other_libraries(file, *paths) for file in files)
    assert message_counts(files[0]) == message_counts(files[1])
    assert new_metadata["command"] == old_metadata["command"]
    for topic, path in paths.items():
        columns = [
            np.array([operator.attrgetter(path)(m) for _, _, m in messages[topic]], dtype=np.float64)
            for messages in (new, old)
        ]
        # Sensors are quantised: a last-place difference of another processor may flip one step of a few samples.
        difference = np.abs(columns[0] - columns[1])
        assert np.mean(difference > 1e-6) < 1e-3 and difference.max() < 5e-3, topic


def test_the_samples_are_what_they_are_for():
    folder = ROOT / "sample_logs"
    for name, low, high in (("dlc.mcap", 0.65, 0.75), ("sweep.mcap", 0.9 * 0.3, 0.3)):
        messages, _, metadata = read_with_other_libraries(folder / name, "/truth/perfect/state")
        peak = max(abs(m.ay_m_s2) for _, _, m in messages["/truth/perfect/state"]) / 9.80665
        assert low <= peak <= high and float(metadata["peak_ay_m_s2"]) == pytest.approx(peak * 9.80665, rel=1e-6)
    assert not [topic for topic in message_counts(folder / "no_truth.mcap") if "truth" in topic or "rtk" in topic]
    faulty, _, metadata = read_with_other_libraries(folder / "faults.mcap", "/truthsim/events")
    assert len(faulty["/truthsim/events"]) == 2 * len(json.loads(metadata["faults"])) == 16


@pytest.mark.parametrize(("name", "friction"), [("vehicle.toml", 0.85), ("vehicle_mu03.toml", 0.3)])
def test_vehicle_file_gives_the_truth_s_axle_forces_and_understeer(name, friction):
    vehicle = read_vehicle_file(ROOT / "sample_logs" / name).vehicle
    columns = map(fit_nominal_tyres.ramp(friction).column, fit_nominal_tyres.MOTION)
    for axle, (alpha, force) in fit_nominal_tyres.axle_curves(columns).items():
        b, c, d, e = vehicle.magic_formula(axle == "front", friction)
        x = b * alpha
        model = d * np.sin(c * np.arctan(x - e * (x - np.arctan(x))))
        # One curve an axle serves both roads, which costs accuracy on each.
        assert np.sqrt(np.mean((model - force) ** 2)) < 0.04 * force.max(), axle
    assert np.degrees(vehicle.understeer_gradient_rad_per_m_s2(friction)) * 9.80665 == pytest.approx(1.93, abs=0.35)
