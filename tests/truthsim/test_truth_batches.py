"""Suites and condition tables: the same whatever works on them, inside their ranges, and resumable."""

import hashlib
import json
import operator
import shlex
import tomllib
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from other_readers import read_with_other_libraries

from pdhef_logtool.car.toml_files import read_vehicle_file
from pdhef_logtool.records.errors import UsageError
from studies.defaults import fit_nominal_tyres
from tests.command_line import pdhef
from truthsim.batch import DriveSpec, Job, make_drive, run_jobs
from truthsim.conditions import ROW_NAMES, plan_conditions, write_conditions
from truthsim.drive import START_NS, simulate_drive, write_drive
from truthsim.samples import SAMPLES, write_sample
from truthsim.suite import SHARES, is_held_out, plan_suite, write_suite

pytestmark = pytest.mark.slow


def digests(folder: Path) -> dict[str, str]:
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.rglob("*.mcap"))
    }


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    folder = tmp_path_factory.mktemp("suite")
    options = ("--count", 4, "--seed", 3, "--duration", 5, "--vehicles", "randomised", "--jobs", 2)
    pdhef("simulate", "suite", "-o", folder, *options)
    return folder, json.loads((folder / "manifest.json").read_text())


def test_a_suite_does_not_depend_on_the_processes(suite, tmp_path):
    folder, manifest = suite
    alone = write_suite(tmp_path, count=4, seed=3, duration_s=5.0, processes=1, vehicles="randomised")
    assert alone == manifest
    assert digests(folder) == digests(tmp_path)
    assert (folder / "manifest.json").read_bytes() == (tmp_path / "manifest.json").read_bytes()
    assert not [p for p in folder.iterdir() if p.suffix not in (".mcap", ".json")]


def test_a_suite_s_manifest_tells_what_is_there(suite, tmp_path):
    folder, manifest = suite
    assert manifest["complete"] and manifest["written"] == len(manifest["drives"]) == 4
    assert sum(manifest["splits"].values()) == 4
    for entry in manifest["drives"]:
        data = (folder / entry["file"]).read_bytes()
        assert hashlib.sha256(data).hexdigest() == entry["sha256"] and len(data) == entry["size_bytes"]
        assert entry["command"].startswith(f"pdhef simulate {entry['manoeuvre']} --speed ")
        assert entry["peak_share"] == pytest.approx(entry["peak_ay_m_s2"] / (entry["friction"] * 9.80665))
        assert not entry["spun"] and not entry["lifted"]
    assert len({entry["vehicle"] for entry in manifest["drives"]}) == 4
    pdhef(*shlex.split(manifest["drives"][1]["command"])[1:], "-o", tmp_path / "x.mcap")
    assert hashlib.sha256((tmp_path / "x.mcap").read_bytes()).hexdigest() == manifest["drives"][1]["sha256"]


def test_draws_fill_the_range_and_the_splits():
    jobs = plan_suite(750, 1)
    specs = [job.candidates[0] for job in jobs]
    speeds, frictions = np.array([s.speed_km_h for s in specs]), np.array([s.friction for s in specs])
    assert 40.0 <= speeds.min() < 44.0 and 116.0 < speeds.max() <= 120.0
    assert 0.3 <= frictions.min() < 0.32 and 0.98 < frictions.max() <= 1.0
    drawn = Counter(s.manoeuvre for s in specs)
    total = sum(SHARES.values())
    for name, share in SHARES.items():
        assert drawn[name] / 750 == pytest.approx(share / total, abs=0.04), name
    assert "fishhook" not in drawn
    assert len({s.seed for s in specs}) == 750
    splits = Counter(dict(job.facts)["split"] for job in jobs)
    held_out = splits.pop("extrapolation")
    assert 0.05 < held_out / 750 < 0.25
    inside = sum(splits.values())
    for name, share in (("train", 0.70), ("validation", 0.15), ("test", 0.15)):
        assert splits[name] / inside == pytest.approx(share, abs=0.04)


def test_held_out_cells_are_never_trained_on_not_even_in_place_of_a_spun_drive():
    for job in plan_suite(300, 2):
        apart = dict(job.facts)["split"] == "extrapolation"
        for spec in job.candidates:
            assert is_held_out(spec.manoeuvre, spec.speed_km_h, spec.friction) == apart
    # Every manoeuvre has two of sixteen cells held out, at the edge of the range.
    grid = [(s, f) for s in (50.0, 70.0, 90.0, 110.0) for f in (0.4, 0.6, 0.8, 0.9)]
    for name in SHARES:
        cells = [(s, f) for s, f in grid if is_held_out(name, s, f)]
        assert len(cells) == 2 and all(s in (50.0, 110.0) or f in (0.4, 0.9) for s, f in cells)


def test_what_is_there_is_kept_and_what_is_spoilt_is_made_again(suite):
    folder, manifest = suite
    before = digests(folder)
    names = [entry["file"] for entry in manifest["drives"]]
    (folder / names[1]).write_bytes(b"spoilt")
    (folder / names[2]).unlink()
    stamps = {name: (folder / name).stat().st_mtime_ns for name in names if (folder / name).exists()}
    assert write_suite(folder, count=4, seed=3, duration_s=5.0, vehicles="randomised") == manifest
    assert digests(folder) == before
    kept = [n for n in names if n in stamps and (folder / n).stat().st_mtime_ns == stamps[n]]
    assert kept == [names[0], *names[3:]]


def test_an_interrupted_batch_goes_on(tmp_path):
    jobs = plan_suite(3, 3, duration_s=4.0)

    def stop(_text: str, share: float) -> None:
        if share > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_jobs(jobs, tmp_path, {}, processes=1, progress=stop)
    partial = json.loads((tmp_path / "manifest.json").read_text())
    assert not partial["complete"] and len(partial["drives"]) == 2
    done: list[str] = []
    whole = run_jobs(jobs, tmp_path, {}, processes=1, progress=lambda text, _share: done.append(text))
    assert done == ["3 of 3 drives"] and whole["complete"] and len(whole["drives"]) == 3


def test_a_drive_that_spins_gives_way_to_the_next_and_is_reported(tmp_path):
    # Swapped tyres with soft rears spin in the severe lane change.
    spun = DriveSpec("dlc-3888-2", 70.0, 0.2, 1, 8.0, vehicle="sedan,cg=0.45")
    calm = DriveSpec("step-steer", 60.0, 0.8, 1, 4.0)
    entry = make_drive(Job("x.mcap", (spun, calm)), tmp_path)
    assert entry["manoeuvre"] == "step-steer" and (tmp_path / "x.mcap").is_file()
    assert len(entry["dropped"]) == 1 and "spun" in entry["dropped"][0]["reason"]
    assert entry["dropped"][0]["spec"]["manoeuvre"] == "dlc-3888-2"
    lost = make_drive(Job("y.mcap", (spun,)), tmp_path)
    assert "sha256" not in lost and len(lost["dropped"]) == 1 and not (tmp_path / "y.mcap").exists()


def test_every_row_of_the_table_has_its_drives_in_every_bin(tmp_path):
    rows = ("in-domain", "paper-b", "low-friction", "friction-plus-20")
    manifest = write_conditions(tmp_path, drives=1, seed=1, rows=rows)
    assert [row["name"] for row in manifest["rows"]] == [*rows]
    for row in manifest["rows"]:
        assert len(row["files"]) == 1 and row["description"], row["name"]
        assert (tmp_path / row["files"][0]).is_file()
        assert min(row["drives_in_bin"].values()) == 1, row["name"]
        assert (row["files"][0].startswith("in-domain/")) is (row["name"] in (rows[0], rows[-1]))
    (paper_b,) = (d for d in manifest["drives"] if d["row"] == "paper-b")
    assert paper_b["peak_share"] > 0.89


def test_rows_are_the_same_drives_with_one_thing_wrong():
    jobs, rows = plan_conditions(1, 1)
    assert tuple(row.name for row in rows) == ROW_NAMES
    assert {row.name: row.assume for row in rows if row.assume} == {
        "friction-plus-20": {"friction_factor": 1.2},
        "friction-minus-20": {"friction_factor": 0.8},
        "friction-unknown": {"friction": "unknown"},
        "no-wheel-speed": {"sensors": "esp"},
    }
    drives = {dict(job.facts)["row"]: job.candidates[0] for job in jobs}
    base = drives["in-domain"]
    same = operator.attrgetter("manoeuvre", "speed_km_h", "friction", "seed", "duration_s")
    for row in ("mass-plus-20", "burst-20", "gyro-stuck", "delay-30", "other-tyres", "randomised-vehicle", "bias"):
        assert same(drives[row]) == same(base), row
        assert (drives[row].vehicle != base.vehicle) is not (drives[row].faults != base.faults), row
    assert 0.15 <= drives["low-friction"].friction <= 0.25


WRONG = ({"count": 0}, {"seed": -1}, {"processes": 0}, {"vehicles": "all"}, {"duration_s": 1.0})


@pytest.mark.parametrize("wrong", [*WRONG, {"rows": ["hail"]}, {"rows": []}, {"drives": 0}], ids=str)
def test_bad_requests_are_refused(wrong, tmp_path):
    with pytest.raises(UsageError):
        if wrong in WRONG:
            write_suite(tmp_path / "x", **{"count": 1, "seed": 1, **wrong})
        else:
            write_conditions(tmp_path / "x", **wrong)


# ---- The written log, read back by other libraries; and the sample logs of the repository ----

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
