"""Damaged files: with any bytes changed, a log opens with a loss or raises one clear error of this package."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType
from recorded import counts_of, numeric_paths, summary_of, write_vectors

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.writer import McapLogWriter, TopicBatch
from pdhef_logtool.records.errors import PdhefError
from tests.mcap_files import mcap_writer

T0 = 1_700_000_000_000_000_000
N = 400


def _mcap(folder: Path) -> bytes:
    path = folder / "good.mcap"
    stamps = T0 + np.arange(N) * 10_000_000
    with McapLogWriter(path) as writer:
        writer.add_topic("/imu", "sensor_msgs/msg/Imu", constants={"header.frame_id": "imu"})
        for at in range(0, N, 100):  # a chunk a call
            cut = slice(at, at + 100)
            writer.write(
                [TopicBatch("/imu", stamps[cut], stamps[cut], {"angular_velocity.z": np.arange(N)[cut] * 0.5})]
            )
    return path.read_bytes()


def _json_log(folder: Path, **options: Any) -> Path:
    path = folder / "log.mcap"
    with mcap_writer(path, chunk_size=2000, **options) as writer:
        channel = writer.register_channel("/t", "json", writer.register_schema("T", "jsonschema", b"{}"))
        for i in range(N):
            writer.add_message(channel, T0 + i, b'{"a": %03d}' % (100 + i), T0 + i, i)
    return path


def _mcap_of_another_writer(folder: Path) -> bytes:
    return _json_log(folder, compression=CompressionType.LZ4).read_bytes()


def _mcap_of_a_killed_recorder(folder: Path) -> bytes:
    return _json_log(folder, compression=CompressionType.ZSTD, index_types=IndexType.NONE).read_bytes()


def _bag(folder: Path) -> bytes:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    name = "geometry_msgs/msg/Vector3"
    path = folder / "good.bag"
    writer = Writer(path)
    writer.set_compression(writer.CompressionFormat.LZ4)
    with writer:
        connection = writer.add_connection("/v", name, typestore=store)
        for i in range(N):
            message = store.types[name](x=float(i), y=0.0, z=0.0)
            writer.write(connection, T0 + i, store.serialize_ros1(message, name))
    return path.read_bytes()


def _database(folder: Path) -> bytes:
    return (write_vectors(folder / "bag", "/v", N) / "bag.db3").read_bytes()


_SOURCES: dict[str, Callable[[Path], bytes]] = {
    "mcap": _mcap,
    "mcap-lz4": _mcap_of_another_writer,
    "mcap-no-index": _mcap_of_a_killed_recorder,
    "bag": _bag,
    "sqlite3": _database,
}


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    return {kind: make(tmp_path_factory.mktemp(kind)) for kind, make in _SOURCES.items()}


def _read_everything(path: Path) -> tuple[int, bool]:
    with closing(open_log(path)) as log:
        count = sum(counts_of(log).values())
        for topic in log.topics:
            log.read({topic.name: numeric_paths(log, topic.name)})
        return count, bool(log.lost)


@pytest.mark.slow
@pytest.mark.parametrize("kind", sorted(_SOURCES))
@settings(max_examples=30, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_every_byte_ends_somewhere_and_no_message_is_missing_in_silence(
    good: dict[str, bytes], tmp_path: Path, kind: str, data: st.DataObject
) -> None:
    content = bytearray(good[kind])
    places = st.one_of(st.integers(0, len(content) - 1), st.integers(0, 300), st.integers(1, 300).map(lambda n: -n))
    for at, mask in data.draw(st.lists(st.tuples(places, st.integers(1, 255)), max_size=3)):
        content[at] ^= mask
    cut = data.draw(st.one_of(st.none(), st.integers(1, len(content))))
    path = tmp_path / "damaged"
    path.write_bytes(content[:cut])
    try:
        log = open_log(path)
    except PdhefError as error:
        assert "\n" not in str(error)
        return
    with closing(log):
        # Messages whose damaged times are far from all others are left out, with a note.
        left_out = sum(sum(reasons.values()) for reasons in log.recording_span.left_out.values())
        count = sum(counts_of(log).values()) + left_out
        assert sum(t.messages for t in log.topics) == count
        assert count >= N or any(loss.severity == "lost" for loss in log.lost)
        for topic in log.topics:
            with suppress(PdhefError):
                log.read({topic.name: numeric_paths(log, topic.name)})


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["mcap", "mcap-lz4", "bag"])
def test_a_cut_file_never_gives_more_nor_passes_as_whole(good: dict[str, bytes], tmp_path: Path, kind: str) -> None:
    content, counts = good[kind], []
    path = tmp_path / "cut"
    for cut in np.linspace(len(content) * 0.2, len(content) - 1, 60).astype(int):
        path.write_bytes(content[:cut])
        try:
            count, lost = _read_everything(path)
        except PdhefError:
            continue
        assert lost
        counts.append(count)
    assert counts == sorted(counts)
    assert counts[-1] == N


@pytest.mark.parametrize("is_summary_sound", [True, False])
def test_a_damaged_record_length_costs_at_most_what_the_summary_does_not_describe(
    good: dict[str, bytes], tmp_path: Path, is_summary_sound: bool
) -> None:
    (tmp_path / "good").write_bytes(good["mcap"])
    summary = summary_of(tmp_path / "good")
    content = bytearray(good["mcap"])
    content[summary.chunk_indexes[1].chunk_start_offset + 7] = 0xFF  # the length now points past the end
    content[-9] ^= not is_summary_sound
    (tmp_path / "bad").write_bytes(content)
    with closing(open_log(tmp_path / "bad")) as log:
        values = log.read({"/imu": ["angular_velocity.z"]})["/imu"].fields["angular_velocity.z"]
        lost = np.arange(0) if is_summary_sound else np.arange(100, 200)
        np.testing.assert_array_equal(values, np.setdiff1d(np.arange(N), lost) * 0.5)
        assert [loss.kind for loss in log.lost] == ["bad-record"] * (not is_summary_sound)


def test_a_byte_that_only_the_crc_shows_costs_its_chunk(tmp_path: Path) -> None:
    path = _json_log(tmp_path, compression=CompressionType.NONE)
    content = path.read_bytes()
    path.write_bytes(content.replace(b'{"a": 350}', b'{"a": 950}'))
    with closing(open_log(path)) as log:
        values = log.read({"/t": ["a"]})["/t"].fields["a"]
        (loss,) = log.lost
        assert loss.kind == "bad-chunk"
        assert len(values) == N - (loss.count or 0) < N
        assert not np.isin([350.0, 950.0], values).any()


def test_a_chunk_whose_index_is_cut_gives_all_its_topics(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    stamps = T0 + np.arange(N) * 10_000_000
    with McapLogWriter(path) as writer:
        for topic in ("/a", "/b"):
            writer.add_topic(topic, "sensor_msgs/msg/Imu")
        writer.write([TopicBatch(topic, stamps, stamps, {}) for topic in ("/a", "/b")])
    (chunk,) = summary_of(path).chunk_indexes
    second_index = sorted(chunk.message_index_offsets.values())[1]
    path.write_bytes(path.read_bytes()[: second_index + 20])
    with closing(open_log(path)) as log:
        assert counts_of(log) == {"/a": N, "/b": N}
        assert [loss.kind for loss in log.lost] == ["truncated"]
