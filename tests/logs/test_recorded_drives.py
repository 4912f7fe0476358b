"""Recorded drives and their damaged copies: counts, intervals of loss, and values against an independent reader."""

import contextlib
import json
from collections import Counter
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType
from recorded import T0, attribute, counts_of, decoded_by_rosbags, messages_of, numeric_paths, raw_channel, summary_of

from pdhef_logtool.logs.columnar_log import ColumnarLog
from pdhef_logtool.logs.container import RawMessage, block_of
from pdhef_logtool.logs.drive_log import Columns, DriveLog
from pdhef_logtool.logs.mcap_log import McapContainer
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.resource_limits import Meter
from pdhef_logtool.logs.source_copy import iterate_copy, register_channels, source_profile
from pdhef_logtool.logs.table_file import LogFile
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.records.errors import LogError, MappingError
from tests.mcap_files import mcap_writer

pytestmark = pytest.mark.slow

REVS = "data/drives/revs_250lm_a.mcap"
FAULTY = "data/drives/faulty"

_COMPARED = {
    "data/drives/revs_250lm_a.mcap": {
        "/imu/data": ["linear_acceleration.y", "angular_velocity.z"],
        "/vehicle/status/steering_status": ["steering_tire_angle"],
        "/ins/odometry": ["twist.twist.linear.x", "twist.twist.angular.z"],
    },
    "data/drives/f1tenth_hoons_run2.bag": {
        "/imu": ["header.stamp", "linear_acceleration", "orientation", "angular_velocity_covariance"],
        "/sensors/wheel_speed": ["data"],
        "/drive": ["drive.steering_angle"],
        "/optitrack/twist": ["twist.linear.y"],
    },
    "data/drives/lunda_v40": {"/vbox/sample": ["steer_ang_deg", "y_accel_g"], "/vbox/slip": ["lat_vel_kmh"]},
}


def _as_column(value: object) -> object:
    """Return a time in ns, and a vector as a list, as columns have them."""
    if hasattr(value, "nanosec"):
        return value.sec * 10**9 + value.nanosec
    axes = [axis for axis in "wxyz" if hasattr(value, axis)]
    return [getattr(value, axis) for axis in axes] or value


@pytest.mark.parametrize("name", sorted(_COMPARED))
def test_values_equal_those_of_an_independent_reader(shared_dir, name):
    path = shared_dir / name
    expected = decoded_by_rosbags([path], _COMPARED[name])
    with closing(open_log(path)) as log:
        read = log.read(_COMPARED[name])
    for topic, paths in _COMPARED[name].items():
        np.testing.assert_array_equal(read[topic].log_time_ns, [stamp for stamp, _ in expected[topic]])
        for field in paths:
            values = np.array([_as_column(attribute(m, field)) for _, m in expected[topic]])
            np.testing.assert_array_equal(read[topic].fields[field], values)
            assert read[topic].fields[field].dtype == (np.int64 if field.endswith("stamp") else np.float64)


def test_a_split_folder_is_one_log(shared_dir):
    split, whole = open_log(shared_dir / FAULTY / "revs_250lm_a_split"), open_log(shared_dir / REVS)
    assert split.kind == "rosbag2-mcap"
    assert [(t.name, t.messages) for t in split.topics] == [(t.name, t.messages) for t in whole.topics]
    fields = {"/ins/odometry": ["twist.twist.linear.y", "header.stamp"]}
    a, b = split.read(fields)["/ins/odometry"], whole.read(fields)["/ins/odometry"]
    np.testing.assert_array_equal(a.log_time_ns, b.log_time_ns)
    for path in fields["/ins/odometry"]:
        np.testing.assert_array_equal(a.fields[path], b.fields[path])
    assert (split.start_ns, split.end_ns, split.lost) == (whole.start_ns, whole.end_ns, ())
    split.close()
    whole.close()


# Their test fixtures carry a definition that is not the one the payloads were written with, or align a double to 4.
_WRONG_DEFINITIONS = {
    ("ros2_rosbag2/rosbag2_py/test/resources/sqlite3/talker/talker.db3", "/rosout"),
    ("plotjuggler_pj-mcap-server/test_embedded_timestamp.mcap", "/stamped/value"),
}
# A schema that is no definition, and protobuf messages with the text of a .proto file in the place of descriptors.
_UNDECODABLE = {"/bad/data", "/proto/data"}


def _field_problems(log: DriveLog, file: str) -> list[str]:
    problems = []
    for topic in log.topics:
        if topic.encoding not in ("cdr", "ros1", "json", "protobuf") or topic.name in _UNDECODABLE:
            continue
        paths = numeric_paths(log, topic.name)
        columns = log.read({topic.name: paths})[topic.name]
        if len(columns) != topic.messages:
            problems.append(f"{file} {topic.name}: {len(columns)} of {topic.messages}")
    problems += [
        f"{file}: {loss.where}: {loss.what}"
        for loss in log.lost
        if loss.kind == "undecodable" and (file, loss.where) not in _WRONG_DEFINITIONS
    ]
    return problems


def test_every_recording_ends_as_catalogued_and_every_field_decodes(shared_dir):
    root = shared_dir / "reader_corpus"
    catalogue = json.loads((root / "CATALOG.json").read_text())
    problems: list[str] = []
    for entry in catalogue:
        outcome, counts = "must-be-rejected", entry["messages"]
        with contextlib.suppress(LogError), closing(open_log(root / entry["file"])) as log:
            counts = counts_of(log)
            assert counts == {t.name: t.messages for t in log.topics}
            outcome = "truncated" if any(loss.severity == "lost" for loss in log.lost) else "ok"
            problems += _field_problems(log, entry["file"])
        if (outcome, counts) != (entry["expected"], entry["messages"]):
            problems.append(f"{entry['file']}: expected {entry['expected']}, got {outcome} with {counts}")
    assert len(catalogue) > 700
    assert not problems, "\n".join(problems)


def test_a_database_that_its_folder_declares_in_another_format_is_not_decoded_as_cdr(shared_dir):
    folder = shared_dir / "reader_corpus" / "ros2_rosbag2/rosbag2_tests/resources/sqlite3/wrong_rmw_test"
    with closing(open_log(folder)) as log:
        assert {t.encoding for t in log.topics} == {"wrong_format"}
        with pytest.raises(MappingError, match="wrong_format"):
            log.read({"/test_topic": ["bool_value"]})


def test_definitions_behind_a_short_separator_are_read(shared_dir):
    with closing(
        open_log(shared_dir / "reader_corpus" / "plotjuggler_pj-mcap-server/test_embedded_timestamp.mcap")
    ) as log:
        assert {"header.sec", "header.nanosec", "value"} <= {f.path for f in log.fields("/stamped/value")}


TEXT = b"float64 x\n"


def _write(path: Path, n: int = 600, *, compression=CompressionType.ZSTD, chunk_size=20_000, extra=(), **options):
    """Write three channels with the mcap library, which declares them inside the first chunk; ids as it gives them."""
    rng = np.random.default_rng(4)
    with mcap_writer(
        path, profile="ros2", library="recorder", compression=compression, chunk_size=chunk_size, **options
    ) as writer:
        a = writer.register_schema("own/msg/A", "ros2msg", TEXT)
        b = writer.register_schema("own/msg/B", "ros2msg", TEXT + b"float64 y\n")
        channels = [
            writer.register_channel("/a", "cdr", a, {"qos": "1"}),
            writer.register_channel("/b", "cdr", b),
            writer.register_channel("/c", "octets", 0),
            *(writer.register_channel(topic, "cdr", a) for topic in extra),
        ]
        for i in range(n):
            time = T0 + 1_000_000 * i
            writer.add_message(channels[i % len(channels)], time, rng.bytes(200), time - i, sequence=5 * i)


def _annotate(source: Path | ColumnarLog, target: Path, leave_out=lambda _: False, window=()):
    """Copy with a topic of ours beside it, which begins before and ends behind the source."""
    with closing(open_log(source) if isinstance(source, Path) else source) as log:
        with McapLogWriter(target, profile=source_profile(log)) as writer:
            channels = register_channels(writer, log, leave_out=leave_out)
            writer.add_topic("/ours", "std_msgs/msg/Float64")
            stamps = T0 - 50_000_000 + np.arange(7000) * 100_000
            ours = [Columns("/ours", stamps, stamps, {"data": np.arange(7000.0)})]
            writer.write(ours, iterate_copy(log, channels, *window))
        return log.lost


def _messages(path: Path) -> list[tuple[object, ...]]:
    return messages_of(path, without="/ours")


def _damage_chunk(path: Path, number: int) -> tuple[int, int]:
    """Flip a byte inside the compressed records of a chunk; returns the log times it held as [start, end)."""
    index = sorted(summary_of(path).chunk_indexes, key=lambda c: c.chunk_start_offset)[number]
    data = bytearray(path.read_bytes())
    data[index.chunk_start_offset + index.chunk_length - 100] ^= 0x40
    path.write_bytes(data)
    return index.message_start_time, index.message_end_time + 1


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_damaged_chunk_is_dropped_and_said(tmp_path, compression):
    source, target = tmp_path / "source.mcap", tmp_path / "copy.mcap"
    _write(source, compression=compression)
    intact = _messages(source)
    start, end = _damage_chunk(source, 2)
    lost = _annotate(source, target)
    assert [(x.kind, x.start_ns, x.end_ns) for x in lost] == [("bad-chunk", start, end)]
    assert _messages(target) == [m for m in intact if not start <= m[0] < end]
    assert _messages(target) != intact


def test_a_copy_of_a_window_without_a_topic(tmp_path):
    source, target = tmp_path / "source.mcap", tmp_path / "copy.mcap"
    _write(source, extra=("/old",))
    start, end = T0 + 100_500_000, T0 + 400_500_000
    assert _annotate(source, target, lambda topic: topic == "/old", (start, end)) == ()
    kept = [m for m in _messages(source) if m[1] != "/old" and start <= m[0] < end]
    assert _messages(target) == kept


def _split(tmp_path: Path, swap: bool) -> ColumnarLog:
    """Two files of one recording; in the second the ids of the topics are swapped, or the same."""
    containers = []
    for k in range(2):
        path = tmp_path / f"{k}.mcap"
        with McapLogWriter(path) as writer:
            names = ["/b", "/a"] if swap and k else ["/a", "/b"]
            ids = {name: raw_channel(writer, name, f"own/msg/{name[1].upper()}", TEXT) for name in names}
            times = T0 + 10**9 * k + np.arange(100)
            messages = (RawMessage(ids["/b" if i % 2 else "/a"], int(t), 0, i, b"x") for i, t in enumerate(times))
            writer.write([], [block_of(messages)])
        containers.append(McapContainer(LogFile(path, path, Meter())))
    return ColumnarLog(tmp_path, "rosbag2-mcap", containers)


@pytest.mark.parametrize("swap", [False, True])
def test_split_files_become_one_whatever_their_ids(tmp_path, swap):
    target = tmp_path / "copy.mcap"
    _annotate(_split(tmp_path, swap), target)
    expected = _messages(tmp_path / "0.mcap") + _messages(tmp_path / "1.mcap")
    assert _messages(target) == expected
    assert len(summary_of(target).channels) == 3


# ---- full copies of recordings ----


def _copy_all(source: Path, target: Path) -> None:
    with closing(open_log(source)) as log, McapLogWriter(target, profile=source_profile(log)) as writer:
        channels = register_channels(writer, log)
        writer.write([], iterate_copy(log, channels))
        for a in log.attachments():
            writer.attachment(a)
        for m in log.metadata_records():
            writer.metadata(m.name, m.metadata)


@pytest.mark.parametrize(
    "name",
    [
        "data/drives/comma2k19_segment.mcap",
        "data/drives/faulty/revs_250lm_a_disorder.mcap",
        "reader_corpus/plotjuggler_pj-mcap-server/test_unsupported_encoding.mcap",
        "reader_corpus/rerun/foxglove_log.mcap",
    ],
)
def test_copies_of_recordings_equal_their_sources(shared_dir, tmp_path, name):
    _copy_all(shared_dir / name, tmp_path / "copy.mcap")
    copied, original = messages_of(tmp_path / "copy.mcap"), messages_of(shared_dir / name)
    assert len(copied) == len(original)
    assert [m[0] for m in copied] == [m[0] for m in original]
    # The other reader leaves the order of equal log times open.
    assert Counter(copied) == Counter(original)


@pytest.mark.parametrize("name", ["data/drives/lunda_v40", "reader_corpus/foxglove_rosbag1/example-bz2.bag"])
def test_a_copy_of_another_container_keeps_bytes_and_definitions(shared_dir, tmp_path, name):
    from rosbags.highlevel import AnyReader

    source, target = shared_dir / name, tmp_path / "copy.mcap"
    _copy_all(source, target)
    with AnyReader([source]) as reader:
        expected = [(stamp, c.topic, bytes(data)) for c, stamp, data in reader.messages()]
    assert sorted((m[0], m[1], m[2]) for m in messages_of(target)) == sorted(expected)
    with closing(open_log(source)) as log, closing(open_log(target)) as copy:
        assert copy.topics == log.topics
        assert [copy.fields(t.name) for t in copy.topics] == [log.fields(t.name) for t in log.topics]
