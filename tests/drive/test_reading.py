"""The one way to read a drive: once, with the source of its friction, and a hash that other recordings of it share."""

from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool import Car, ReadOptions, RunConfig
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.drive import reading, recorded
from pdhef_logtool.drive.friction import FrictionFrom, friction_source, parse_friction
from pdhef_logtool.drive.reading import Drive, Tell, friction_of, one_log, read_drive
from pdhef_logtool.evaluation.segments import segment_masks
from pdhef_logtool.logs.discovery import hash_log
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.resource_limits import ResourceLimits
from pdhef_logtool.mapping import Mapping, SignalSource, read_signals
from pdhef_logtool.records.errors import MappingError, UsageError
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from studies.strangers.containers import Topic, write


@pytest.fixture
def car(sample_logs_dir):
    return Car.load(sample_logs_dir / "vehicle.toml")


def _assert_equal(a: Signals | StateTrack, b: Signals | StateTrack) -> None:
    for f in fields(a):
        x, y = getattr(a, f.name), getattr(b, f.name)
        if isinstance(x, np.ndarray):
            assert x.tobytes() == y.tobytes(), f.name


def test_a_drive_is_read_once_and_says_the_same_again(sample_logs_dir, car, monkeypatch):
    reads: list[object] = []
    monkeypatch.setattr(recorded, "read_signals", lambda *a: reads.append(a) or read_signals(*a))
    with read_drive(sample_logs_dir / "dlc.mcap", car, options=ReadOptions()) as drive:
        first = drive.whole()
        said = drive.recorded(), drive.losses
        second = drive.whole()
        assert said[0] is drive.recorded() and said[1] == drive.losses
        assert drive.sha256 == hash_log(drive.path)
        assert drive.losses == ()
        used = {s.source: s.used for s in drive.recorded().ledger}
        assert used["/imu/data.angular_velocity.z"] > len(first.signals) - 3
    assert len(reads) == 1
    _assert_equal(first.signals, second.signals)
    assert first.seconds == pytest.approx(9.5, abs=0.1)


def test_what_is_told_is_noted_and_named(sample_logs_dir, car):
    told: list[str] = []
    without = Car(car.vehicle.model_copy(update={"friction": None}))
    with read_drive(sample_logs_dir / "dlc.mcap", without, tell=told.append) as drive:
        drive.tell("one more")
        notes, remarks = list(drive.notes), list(drive.remarks)
    assert told == [f"dlc: {note}" for note in notes]
    # Remarks are no warnings: they are stored, not printed.
    assert any("/rtk/odometry not used" in remark for remark in remarks)
    assert any("friction" in remark for remark in remarks)
    assert notes[-1] == "one more"


def test_the_mapping_can_be_adjusted_and_is_checked(sample_logs_dir, car):
    def with_friction(field: str) -> reading.Adjust:
        def adjust(_log: DriveLog, mapping: Mapping, tell: Tell) -> Mapping:
            tell("adjusted")
            source = SignalSource("friction", "/truth/perfect/state", field)
            return replace(mapping, signals={**mapping.signals, "friction": source})

        return adjust

    log, options = sample_logs_dir / "dlc.mcap", ReadOptions(friction=None)
    with read_drive(log, car, options=options, adjust=with_friction("friction")) as drive:
        assert drive.friction.label == "topic /truth/perfect/state.friction"
        assert "adjusted" in drive.notes
        np.testing.assert_allclose(drive.whole().signals.friction, 0.85, rtol=1e-6)
    with read_drive(log, car, options=options) as drive:
        assert drive.friction.label == "none"
        assert not np.isfinite(drive.whole().signals.friction).any()
    with pytest.raises(MappingError):
        read_drive(log, car, options=options, adjust=with_friction("nothing"))


def test_bounds_and_ends(sample_logs_dir, car, monkeypatch):
    closed: list[str] = []
    open_log = reading.open_log

    def watched_log(path: Path, budget: ResourceLimits, *_: object) -> DriveLog:
        log = open_log(path, budget)
        close = log.close
        monkeypatch.setattr(type(log), "close", lambda _self: closed.append(path.name) or close())
        return log

    log = sample_logs_dir / "dlc.mcap"
    monkeypatch.setattr(reading, "open_log", watched_log)
    with pytest.raises(UsageError, match="a slice inside"):
        read_drive(log, car, options=ReadOptions(start="99"))
    assert closed == ["dlc.mcap"]
    with pytest.raises(UsageError, match="one log"):
        one_log(str(sample_logs_dir))


@pytest.mark.parametrize("size", [250, 3000])
def test_a_log_that_is_cut_before_its_messages_names_the_cut_and_the_remedy(sample_logs_dir, tmp_path, car, size):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((sample_logs_dir / "dlc.mcap").read_bytes()[:size])
    with pytest.raises(MappingError, match=f"the file ends inside a record at byte .* of {size}") as error:
        read_drive(cut, car)
    assert "the file is cut: copy the recording again" in error.value.remedy


NO_FRICTION = default_vehicle().model_copy(update={"friction": None})


def test_a_file_without_friction_is_refused():
    with pytest.raises(UsageError, match="friction"):
        friction_source("file", NO_FRICTION, frozenset({"friction"}))


@pytest.mark.parametrize("text", ["wet", "", "nan", "-0.3", "0", "6", "inf", "estimate"])
def test_other_texts_are_refused(text):
    with pytest.raises(UsageError, match="--friction"):
        parse_friction(text)


def _read(logs: Path, **options: object) -> Drive:
    """Open a drive on a road with friction 0.3; the vehicle file states 0.85."""
    return read_drive(logs / "sweep.mcap", logs / "vehicle.toml", options=RunConfig(end="4", **options).read_options)


def test_a_dataset_takes_the_friction_of_the_ground_truth(sample_logs_dir):
    with _read(sample_logs_dir) as drive:
        frictions = []
        for of_truth in (True, False):
            drive.friction = friction_of(drive.plan, drive.car.vehicle, drive.options, of_truth=of_truth)
            frictions.append(drive.whole().signals.friction)
        known = np.isfinite(frictions[0])
        np.testing.assert_allclose(frictions[0][known], 0.3, atol=1e-6)
        assert known.mean() > 0.9
        assert not np.isfinite(frictions[1]).any()  # friction of the vehicle file
        assert drive.friction.label == "vehicle file, 0.85"


@pytest.mark.parametrize("options", [{"friction": 0.5}, {"prefer_truth": "rtk"}])
def test_a_friction_of_the_options_and_another_ground_truth_go_before(sample_logs_dir, options):
    with _read(sample_logs_dir, **options) as drive:
        source = friction_of(drive.plan, drive.car.vehicle, drive.options, of_truth=True)
        assert source.source is not FrictionFrom.TRUTH


def test_segments_take_the_friction_of_the_ground_truth_and_estimators_do_not(sample_logs_dir):
    with _read(sample_logs_dir) as drive:
        whole, vehicle = drive.whole(), drive.car.vehicle
    assert whole.truth is not None and "friction" not in whole.signals.available
    assert not np.isfinite(whole.signals.friction).any()
    nonlinear = segment_masks(whole.signals, whole.truth, vehicle)["nonlinear"]
    assert nonlinear.any()
    assert np.abs(whole.truth.ay_m_s2[nonlinear]).max() < 0.5 * 0.85 * 9.81


START_NS = 1_700_000_000_000_000_123
SECONDS = np.arange(600) * 0.01
ALL = ("/imu", "/speed", "/ins", "/other")
MAPPED = ALL[:3]

IMU = {"linear_acceleration.z": np.full(600, 9.81)}


def _write(path: Path, topics: tuple[str, ...], container: str, factor: float = 1.0, ay_offset: float = 0.0) -> Path:
    """Write a drive; ``factor`` scales the true lateral velocity."""
    rate, speed = 0.2 * np.sin(SECONDS), np.full(600, 15.0)
    imu = IMU | {"angular_velocity.z": rate, "linear_acceleration.y": 15.0 * rate + ay_offset}
    velocity = {"twist.twist.linear.x": speed, "twist.twist.linear.y": factor * rate, "twist.twist.angular.z": rate}
    ins = velocity | {"pose.pose.position.x": 15.0 * SECONDS}
    of_topics: dict[str, tuple[str, dict[str, np.ndarray], int, int]] = {
        "/imu": ("sensor_msgs/msg/Imu", imu, 1, 1),
        "/speed": ("geometry_msgs/msg/TwistStamped", {"twist.linear.x": speed}, 5, 2),
        "/ins": ("nav_msgs/msg/Odometry", ins, 5, 3),
        "/other": ("sensor_msgs/msg/Imu", imu, 10, 4),
    }
    found = []
    for topic in topics:
        kind, fields, step, late_ms = of_topics[topic]
        stamps_ns = START_NS + np.arange(0, 600, step, dtype=np.int64) * 10_000_000
        columns = {"header.stamp": stamps_ns} | {n: v[::step] for n, v in fields.items()}
        found.append(Topic(topic, kind, stamps_ns, stamps_ns + late_ms * 1_000_000, columns))
    return write(found, path, container)


def _hashes(path: Path, **changed: object) -> tuple[str | None, str | None]:
    sources = (
        SignalSource("ay_m_s2", "/imu", ("linear_acceleration.y",), **changed),
        SignalSource("yaw_rate_rad_s", "/imu", ("angular_velocity.z",), **changed),
        SignalSource("speed_m_s", "/speed", ("twist.linear.x",)),
        SignalSource("vx_m_s", "/ins", ("twist.twist.linear.x",)),
        SignalSource("vy_m_s", "/ins", ("twist.twist.linear.y",)),
    )
    mapping = Mapping({s.name: s for s in sources[:3]}, {s.name: s for s in sources[3:]})
    with read_drive(str(path), Car.load(), mapping) as drive:
        assert len(drive.whole().signals) > 580
        return drive.recorded().signals_sha256, drive.recorded().truth_sha256


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    path = _write(tmp_path_factory.mktemp("full") / "drive", ALL, "rosbag2-mcap")
    return path, _hashes(path)


@pytest.mark.slow
def test_a_slim_copy_and_other_containers_have_one_hash(tmp_path, full):
    _, expected = full
    assert None not in expected
    assert expected[0] != expected[1]
    assert _hashes(_write(tmp_path / "slim", MAPPED, "rosbag2-mcap")) == expected
    assert _hashes(_write(tmp_path / "database", ALL, "rosbag2")) == expected
    assert _hashes(_write(tmp_path / "drive", MAPPED, "rosbag1")) == expected


def test_a_latency_that_becomes_known_leaves_the_drive_the_same(full):
    assert _hashes(full[0], latency_s=0.02) == full[1]


def test_another_truth_is_another_truth_of_the_same_drive(tmp_path, full):
    signals, truth = _hashes(_write(tmp_path / "truth", MAPPED, "rosbag2-mcap", factor=1.0 + 1e-12))
    assert signals == full[1][0]
    assert truth != full[1][1]


def test_other_values_and_another_scale_are_another_drive(tmp_path, full):
    signals, truth = _hashes(_write(tmp_path / "other", MAPPED, "rosbag2-mcap", ay_offset=1e-9))
    assert signals != full[1][0]
    assert truth == full[1][1]
    assert _hashes(full[0], scale=1.01)[0] != full[1][0]
