"""Slim logs: whatever the container and the damage, what is read of one is what is read of its source, bit for bit."""

from __future__ import annotations

import json
import shutil
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer
from odd_clocks import S, rewrite
from rosbags.convert.converter import convert
from rosbags.typesys import Stores, get_typestore

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.drive.slim import slim_log
from pdhef_logtool.logs.discovery import LogInput, hash_log
from pdhef_logtool.logs.open_log import log_metadata, open_log
from pdhef_logtool.logs.reduced_copy import write_record
from pdhef_logtool.logs.reduced_log import ReducedLog
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.mapping import Mapping, load_mapping
from pdhef_logtool.records.errors import LogError, MappingError
from pdhef_logtool.runs.inspection import inspect_log

AS_IT_IS = ReadOptions()
CAR = Car.load(None)
SAMPLES = Path(__file__).resolve().parents[2] / "sample_logs"
MAPPINGS = Path(__file__).resolve().parents[1] / "reference/mappings"
DLC, STEP = SAMPLES / "dlc.mcap", SAMPLES / "step.mcap"


def _facts(path: Path, mapping: Mapping | None, options: ReadOptions) -> dict[str, Any]:
    """Return everything that figures and report of a run are made of, as it can be compared."""
    with read_drive(path, CAR, mapping, options) as drive:
        columns = []
        for window in drive.windows(fill_friction=False):
            for part in filter(None, (window.signals, window.truth)):
                for name in (f.name for f in fields(part)):
                    value = getattr(part, name)
                    columns.append((name, value.tobytes() if isinstance(value, np.ndarray) else value))
        plan, log = drive.plan, drive.log
        return {
            "columns": columns,
            "hashes": (drive.signals_sha256, drive.truth_sha256, drive.sha256, drive.mapping.sha256),
            "told": (drive.checks, drive.notes, drive.missing),
            "remarks": [r for r in drive.remarks if not r.startswith("a reduced log replaces")],
            "losses": drive.losses,
            "samples": (drive.samples, drive.sample_ledger, drive.log.size),
            "log": (drive.file, log.kind, log.topics, log.start_ns, log.end_ns),
            "plan": repr((plan.clocks, plan.alignment, plan.latency, plan.dependent, plan.derivation)),
        }


def _same(source: Path, tmp_path: Path, mapping: Mapping | None = None, options: ReadOptions = AS_IT_IS) -> ReducedLog:
    """Make a slim log, hold all that is read of it against the source, and return it closed."""
    target = tmp_path / "slim" / "drive.mcap"
    expected = _facts(source, mapping, options)
    slim_log(LogInput(source, "drive"), target, mapping, options)
    moved = target.rename(tmp_path / "elsewhere.mcap")
    got = _facts(moved, None, ReadOptions())
    for key, value in expected.items():
        assert repr(got[key]) == repr(value), key
    with closing(open_log(moved)) as log:
        assert isinstance(log, ReducedLog)
        return log


# ------------------------------------------------------------------------------------------ logs of all kinds


def _bag(path: Path) -> Path:
    topics = ["/imu/data", "/vehicle/wheel_speeds", "/vehicle/status/steering_status", "/truth/perfect/odometry"]
    store = get_typestore(Stores.ROS1_NOETIC)
    bag = path / "step.bag"
    convert([SAMPLES / "step_rosbag2"], bag, "sqlite3", 8, "lz4", "file", None, store, [], topics, [], [])
    return bag


def _compressed(path: Path) -> Path:
    folder = path / "compressed"
    convert([SAMPLES / "step_rosbag2"], folder, "mcap", 9, "zstd", "message", None, None, [], [], [], [])
    return folder


def _split(path: Path) -> Path:
    """Cut a log into a rosbag2 folder of two files."""
    folder = path / "split"
    folder.mkdir()
    far = -20 * 365 * 86_400 * S
    for number in (0, 1):  # of the other file's messages the times are far off: they are left out as another epoch's
        rewrite(STEP, folder / f"s_{number}.mcap", lambda _n, s, _t, of=number: far if (s > 3.0) != bool(of) else 0)
    names = "".join(f"    - s_{n}.mcap\n" for n in (0, 1))
    (folder / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information:\n  relative_file_paths:\n{names}  custom_data: {{vin: WVW}}\n"
    )
    return folder


def _flipped(path: Path) -> Path:
    data = bytearray((SAMPLES / "fishhook.mcap").read_bytes())
    for at in (len(data) // 3, len(data) // 2):
        data[at] ^= 0x40
    (path / "flipped.mcap").write_bytes(data)
    return path / "flipped.mcap"


def _cut(path: Path) -> Path:
    data = DLC.read_bytes()
    (path / "cut.mcap").write_bytes(data[: 2 * len(data) // 3])
    return path / "cut.mcap"


def _set_back(path: Path) -> Path:
    """Write a log whose clock was set back for good, and that begins before it was set at all."""

    def shift(number: int, seconds: float, _topic: str) -> int:
        return -40 * 365 * 86_400 * S if number < 8 else -2 * S if seconds > 4.0 else 0

    rewrite(STEP, path / "odd.mcap", shift, chunk=1 << 14)
    return path / "odd.mcap"


def _two_publishers(path: Path) -> Path:
    """Write a log whose IMU topic has two channels, with the same times and other bytes."""
    target = path / "two.mcap"
    with STEP.open("rb") as old, target.open("wb") as new:
        reader, writer = make_reader(old), Writer(new, chunk_size=1 << 15)
        writer.start(profile="ros2")
        ids: dict[tuple[int, int], int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=True):
            assert schema is not None
            copies = 2 if channel.topic == "/imu/data" else 1
            for copy in range(copies):
                if (channel.id, copy) not in ids:
                    known = writer.register_schema(schema.name, schema.encoding, schema.data)
                    ids[channel.id, copy] = writer.register_channel(channel.topic, channel.message_encoding, known)
                data = bytearray(message.data)
                if copy:
                    data[-80:-72] = np.float64(9.0 + message.sequence % 3).tobytes()
                writer.add_message(ids[channel.id, copy], message.log_time, bytes(data), message.publish_time)
        writer.finish()
    return target


@pytest.mark.slow
@pytest.mark.parametrize(
    "make",
    [
        _bag,
        _flipped,
        _cut,
        *(pytest.param(f, marks=pytest.mark.slow) for f in (_compressed, _split, _set_back, _two_publishers)),
    ],
    ids=lambda f: f.__name__,
)
def test_a_slim_log_reads_like_its_source(make: Callable[[Path], Path], tmp_path: Path) -> None:
    source = make(tmp_path)
    assert _same(source, tmp_path).record.metadata == log_metadata(source)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["faults.mcap", "no_truth.mcap", "step_rosbag2"])
def test_a_slim_sample_log_reads_like_its_source(name: str, tmp_path: Path) -> None:
    log = _same(SAMPLES / name, tmp_path)
    if name == "faults.mcap":
        _holds_a_topic_a_chunk(log)
        assert inspect_log(tmp_path / "elsewhere.mcap").mapping.sha256 == inspect_log(SAMPLES / name).mapping.sha256
    assert log.record.identity == hash_log(SAMPLES / name)
    assert log.record.metadata == log_metadata(SAMPLES / name) == log_metadata(tmp_path / "elsewhere.mcap")
    with read_drive(SAMPLES / name, CAR) as drive:
        list(drive.windows())
        assert (log.record.signals_sha256, log.record.truth_sha256) == (drive.signals_sha256, drive.truth_sha256)


def _holds_a_topic_a_chunk(slim: ReducedLog) -> None:
    """Hold a slim log of faults.mcap against what is to be kept of it: mapped topics, apart from each other."""
    container = slim.containers[0]
    assert all(len(span.counts) == 1 for span in container.spans)
    kept = {channel.topic for channel in container.channels.values()}
    truth = {"/truth/perfect/odometry", "/truth/perfect/state"}  # the second one for its friction
    assert kept == {"/imu/data", *truth, "/vehicle/wheel_speeds", "/vehicle/status/steering_status"}
    assert {"/rtk/fix", "/rtk/odometry"} < {t.name for t in slim.topics} - kept


def test_the_truth_that_was_asked_for_is_kept(tmp_path: Path) -> None:
    slim_log(LogInput(DLC, "drive"), tmp_path / "s.mcap", None, replace(AS_IT_IS, prefer_truth="rtk"))
    rtk = replace(AS_IT_IS, prefer_truth="rtk")
    assert repr(_facts(DLC, None, rtk)["columns"]) == repr(_facts(tmp_path / "s.mcap", None, rtk)["columns"])
    with pytest.raises(MappingError, match="prefer_truth = rtk"):
        _facts(tmp_path / "s.mcap", None, AS_IT_IS)


def test_windows_and_slices_of_a_slim_log_are_those_of_its_source(tmp_path: Path) -> None:
    slim_log(LogInput(DLC, "drive", (2.0, 3.0)), tmp_path / "s.mcap", None, replace(AS_IT_IS, start="1", end="2"))
    part = replace(AS_IT_IS, start="2.5", end="7", window_s=1.5)
    assert repr(_facts(DLC, None, part)) == repr(_facts(tmp_path / "s.mcap", None, part))


def test_a_slim_log_of_a_slim_log_stands_for_the_same_source(tmp_path: Path) -> None:
    slim_log(LogInput(DLC, "a"), tmp_path / "a.mcap", None, AS_IT_IS)
    assert _same(tmp_path / "a.mcap", tmp_path).record.identity == hash_log(DLC)


@pytest.mark.slow
@pytest.mark.fleet
@pytest.mark.parametrize(
    ("name", "mapping"),
    [
        ("comma2k19_segment.mcap", "comma2k19.toml"),
        ("comma2k19_segment.mcap", None),
        ("f1tenth_hoons_run2.bag", "f1tenth.toml"),
        ("lunda_v40", "lunda_v40.toml"),
        ("tts_kk.mcap", "tts_kk.toml"),
        ("faulty/revs_250lm_a_flipped_byte.mcap", "revs_250lm.toml"),
        ("faulty/revs_250lm_a_truncated60.mcap", "revs_250lm.toml"),
        ("faulty/revs_250lm_a_disorder.mcap", None),
        ("faulty/revs_250lm_a_split", "revs_250lm.toml"),
    ],
)
def test_a_slim_recorded_log_reads_like_its_source(
    shared_dir: Path, tmp_path: Path, name: str, mapping: str | None
) -> None:
    sources = None if mapping is None else load_mapping(MAPPINGS / mapping)
    _same(shared_dir / "data/drives" / name, tmp_path, sources)


# ------------------------------------------------------------------------------------------ what goes with it


DBC = """VERSION ""
NS_ :
BS_:
BU_: A
BO_ 256 Motion: 8 A
 SG_ YawRate : 0|16@1- (0.001,0) [0|0] "rad/s" A
 SG_ Ay : 16|16@1- (0.01,0) [0|0] "m/s2" A
 SG_ Speed : 32|16@1+ (0.01,0) [0|0] "m/s" A
"""


def test_a_slim_log_of_can_frames_holds_its_dbc(tmp_path: Path) -> None:
    (tmp_path / "car.dbc").write_text(DBC)
    names = {"yaw_rate_rad_s": "YawRate", "ay_m_s2": "Ay", "speed_m_s": "Speed"}
    tables = [f'[signals.{n}]\ntopic = "/can"\nfield = "can:Motion.{f}"\n' for n, f in names.items()]
    (tmp_path / "mapping.toml").write_text('[can]\ndbc = "car.dbc"\ndata_encoding = "hex"\n' + "\n".join(tables))
    with (tmp_path / "can.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=1 << 12)
        writer.start()
        channels = [writer.register_channel(topic, "json", 0) for topic in ("/can", "/other")]
        for i in range(500):
            rate = round(200 * np.sin(0.05 * i))
            data = b"".join(x.to_bytes(2, "little", signed=True) for x in (rate, 2 * rate, 1500, 0)).hex()
            payload = json.dumps({"id": 256 + i % 2, "data": data[: 16 if i % 50 else 6]}).encode()
            for channel in channels:
                writer.add_message(channel, S + i * 10_000_000, payload, S + i * 10_000_000)
        writer.finish()
    mapping = load_mapping(tmp_path / "mapping.toml")
    slim = _same(tmp_path / "can.mcap", tmp_path, mapping)
    assert {c.topic for c in slim.containers[0].channels.values()} == {"/can"}
    (tmp_path / "car.dbc").unlink()
    assert _facts(tmp_path / "elsewhere.mcap", None, AS_IT_IS)["losses"]


@pytest.mark.slow
def test_definitions_of_the_user_go_into_the_slim_log(tmp_path: Path) -> None:
    bare, msgs = tmp_path / "bare", tmp_path / "msgs" / "own_msgs" / "msg"
    shutil.copytree(SAMPLES / "step_rosbag2", bare)
    (database,) = bare.glob("*.db3")
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("drop table message_definitions")
        connection.execute("update topics set type = 'own_msgs/msg/Steer' where type like '%SteeringReport'")
        connection.commit()
    msgs.mkdir(parents=True)
    (msgs / "Steer.msg").write_text("builtin_interfaces/Time stamp\nfloat32 steering_tire_angle\n")
    assert "steer_rad" not in _same(bare, tmp_path).record.mapped["mapping"]["signals"]
    given = replace(AS_IT_IS, msgs=tmp_path / "msgs")
    assert "steer_rad" in _same(bare, tmp_path, None, given).record.mapped["mapping"]["signals"]


def test_a_damaged_slim_log_tells_its_own_losses_besides(tmp_path: Path) -> None:
    slim_log(LogInput(DLC, "drive"), tmp_path / "s.mcap", None, AS_IT_IS)
    with closing(open_log(tmp_path / "s.mcap")) as log:
        assert isinstance(log, ReducedLog)
        start, end = log.containers[0].extent(log.containers[0].spans[-1])  # the first one holds all of the IMU
    data = bytearray((tmp_path / "s.mcap").read_bytes())
    data[(start + end) // 2] ^= 0x40
    (tmp_path / "s.mcap").write_bytes(data)
    losses = _facts(tmp_path / "s.mcap", None, AS_IT_IS)["losses"]
    assert [x.where for x in losses if x.kind == "bad-chunk"] == ["s.mcap"]


@pytest.fixture(scope="module")
def slim_dlc(tmp_path_factory: pytest.TempPathFactory) -> ReducedLog:
    target = tmp_path_factory.mktemp("slim") / "dlc.mcap"
    slim_log(LogInput(DLC, "drive"), target, None, AS_IT_IS)
    with closing(open_log(target)) as log:
        assert isinstance(log, ReducedLog)
        return log


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"format": 2}, "format 2 of version"),
        ({"intervals": ((0, 1 << 62),)}, "times that no log has"),
        ({"intervals": ((5, 3),)}, "times that no log has"),
        ({"mapped": {"mapping": {"signals": 3}}}, "mapping.signals"),
    ],
)
def test_a_record_that_cannot_be_is_one_clear_line(
    tmp_path: Path, slim_dlc: ReducedLog, changed: dict[str, Any], said: str
) -> None:
    record = replace(slim_dlc.record, **changed)
    with McapLogWriter(tmp_path / "bad.mcap") as writer:
        write_record(writer, record)
    with pytest.raises(LogError, match=said) as error:
        read_drive(tmp_path / "bad.mcap", CAR)
    assert "--cache" in error.value.remedy
