"""Damaged files: a log opens with a loss or one clear error; what only a checksum shows is a loss, too."""

import struct
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, IndexType
from recorded import T0, counts_of, numeric_paths, summary_of, write_imu, write_vectors

from pdhef_logtool.logs.drive_log import Columns
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL, PdhefError
from tests.command_line import called
from tests.mcap_files import mcap_writer

N = 400


def _mcap(folder: Path) -> bytes:
    return write_imu(folder / "good.mcap", np.arange(N) * 0.5, chunk=100).read_bytes()


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
    return write_vectors(folder / "good.bag", "/v", N, "bag", "LZ4").read_bytes()


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
def good(tmp_path_factory):
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
def test_every_byte_ends_somewhere_and_no_message_is_missing_in_silence(good, tmp_path, kind, data):
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
def test_a_cut_file_never_gives_more_nor_passes_as_whole(good, tmp_path, kind):
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
def test_a_damaged_record_length_costs_at_most_what_the_summary_does_not_describe(good, tmp_path, is_summary_sound):
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


def test_a_byte_that_only_the_crc_shows_costs_its_chunk(tmp_path):
    path = _json_log(tmp_path, compression=CompressionType.NONE)
    content = path.read_bytes()
    path.write_bytes(content.replace(b'{"a": 350}', b'{"a": 950}'))
    with closing(open_log(path)) as log:
        values = log.read({"/t": ["a"]})["/t"].fields["a"]
        (loss,) = log.lost
        assert loss.kind == "bad-chunk"
        assert len(values) == N - (loss.count or 0) < N
        assert not np.isin([350.0, 950.0], values).any()


def test_a_chunk_whose_index_is_cut_gives_all_its_topics(tmp_path):
    path = tmp_path / "log.mcap"
    stamps = T0 + np.arange(N) * 10_000_000
    with McapLogWriter(path) as writer:
        for topic in ("/a", "/b"):
            writer.add_topic(topic, "sensor_msgs/msg/Imu")
        writer.write([Columns(topic, stamps, stamps, {}) for topic in ("/a", "/b")])
    (chunk,) = summary_of(path).chunk_indexes
    second_index = sorted(chunk.message_index_offsets.values())[1]
    path.write_bytes(path.read_bytes()[: second_index + 20])
    with closing(open_log(path)) as log:
        assert counts_of(log) == {"/a": N, "/b": N}
        assert [loss.kind for loss in log.lost] == ["truncated"]


def _plain_numbers(path: Path, *, chunk_crcs: bool, data_crc: bool, chunked: bool = True) -> Path:
    """Write an MCAP file with plain numbers, so that a damaged value is still a valid number."""
    text = b"float64 a\nfloat64 b\nfloat64 c\n"
    with mcap_writer(
        path,
        chunk_size=4000,
        compression=CompressionType.NONE,
        enable_crcs=chunk_crcs,
        enable_data_crcs=data_crc,
        use_chunking=chunked,
    ) as writer:
        channel = writer.register_channel("/t", "cdr", writer.register_schema("x/msg/T", "ros2msg", text))
        for i in range(N):
            data = b"\x00\x01\x00\x00" + struct.pack("<3d", i, 0.5 * i, -i)
            writer.add_message(channel, T0 + i * 10_000_000, data, T0 + i * 10_000_000, i)
    return path


def _first_numbers(path: Path) -> list[int]:
    """Return where the first number of each message lies."""
    content, found, at = path.read_bytes(), [], 0
    for i in range(N):
        at = content.index(b"\x00\x01\x00\x00" + struct.pack("<3d", i, 0.5 * i, -i), at)
        found.append(at + 4)
    return found


@pytest.mark.parametrize("message", range(0, N, N // 12))
def test_a_flipped_bit_that_only_the_crc_of_the_data_shows_is_a_loss(tmp_path, message):
    path = _plain_numbers(tmp_path / "log.mcap", chunk_crcs=False, data_crc=True)
    content = bytearray(path.read_bytes())
    content[_first_numbers(path)[message] + 3] ^= 1 << message % 8
    path.write_bytes(content)
    with closing(open_log(path)) as log:
        values = log.read({"/t": ["a", "b", "c"]})["/t"].fields
        assert [(loss.kind, loss.severity) for loss in log.lost] == [("bad-data-crc", "lost")]
        assert "it is unknown which" in log.lost[0].what
        np.testing.assert_array_equal(values["b"], 0.5 * np.arange(N))  # readable values are returned
    assert called("inspect", path).returncode == EXIT_PARTIAL


@pytest.mark.parametrize("chunked", [True, False])
def test_a_sound_log_whose_data_has_a_crc_is_covered_by_it(tmp_path, chunked):
    path = _plain_numbers(tmp_path / "log.mcap", chunk_crcs=False, data_crc=True, chunked=chunked)
    with closing(open_log(path)) as log:
        assert log.lost == ()
    assert called("inspect", path).returncode == EXIT_OK


def test_a_log_on_a_server_says_what_was_not_verified(tmp_path, monkeypatch):
    pytest.importorskip("aiohttp", reason="reads http://: pip install 'pdhef-logtool[http]'")
    from tests.counting_server import serving

    path = tmp_path / "log.mcap"
    kind = CompressionType.NONE
    with mcap_writer(path, chunk_size=4000, compression=kind, enable_crcs=False, enable_data_crcs=True) as writer:
        schema = writer.register_schema(
            "T", "jsonschema", b'{"type": "object", "properties": {"a": {"type": "number"}}}'
        )
        channels = [writer.register_channel(topic, "json", schema) for topic in ("/a", "/b")]
        for i in range(2 * N):  # each chunk has one topic
            writer.add_message(channels[i // N], T0 + i * 10_000_000, b'{"a": %d}' % i, T0 + i * 10_000_000)
    damaged = path.read_bytes().replace(b'{"a": 7}', b'{"a": 8}')
    with serving(**{"log.mcap": path.read_bytes(), "damaged.mcap": damaged}) as server:
        place = RemotePlace(server.place("log.mcap"))
        with closing(open_log(place)) as log, closing(open_log(RemotePlace(server.place("damaged.mcap")))) as other:
            assert log.lost == ()
            assert [loss.kind for loss in other.lost] == ["bad-data-crc"]
        monkeypatch.setattr("pdhef_logtool.logs.mcap_log.WHOLE_BYTES", 1000)
        with closing(open_log(place)) as log:
            assert [(loss.kind, loss.severity) for loss in log.lost] == [("unverified", "note")]
            assert log.messages is not None
            assert log.messages.is_indexed
            assert len(log.read({"/a": ["a"]})["/a"]) == N


def test_damage_of_a_summary_is_a_note(tmp_path):
    path = _plain_numbers(tmp_path / "log.mcap", chunk_crcs=True, data_crc=False)
    content = bytearray(path.read_bytes())
    last = struct.pack("<Q", summary_of(path).chunk_indexes[-1].chunk_start_offset)
    content[content.rindex(last)] ^= 4  # where the last chunk begins, which a near log does not ask the index
    path.write_bytes(content)
    with closing(open_log(path)) as log:
        assert len(log.read({"/t": ["a"]})["/t"]) == N
        assert [(loss.kind, loss.severity) for loss in log.lost] == [("bad-summary-crc", "note")]
    assert called("inspect", path).returncode == EXIT_OK
