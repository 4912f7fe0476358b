"""Damaged files: a log opens with a loss or one clear error; what only a checksum shows is a loss, too."""

import bz2
import os
import struct
import threading
import zlib
from collections.abc import Callable
from contextlib import closing, suppress
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings, strategies as st
from mcap.writer import CompressionType, IndexType
from recorded import T0, counts_of, numeric_paths, summary_of, write_imu, write_vectors

from pdhef_logtool.logs import recording_span as span
from pdhef_logtool.logs.compression import decompress, decompress_message
from pdhef_logtool.logs.container import SpanDamageError
from pdhef_logtool.logs.discovery import hash_log
from pdhef_logtool.logs.drive_log import Columns, windows
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, LimitError, ResourceLimits
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL, LogError, PdhefError
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.runs.inspection.report import inspect_log
from tests.command_line import called
from tests.mcap_files import mcap_writer

N = 400


def _json_log(folder: Path, **options: Any) -> Path:
    path = folder / "log.mcap"
    with mcap_writer(path, chunk_size=2000, **options) as writer:
        channel = writer.register_channel("/t", "json", writer.register_schema("T", "jsonschema", b"{}"))
        for i in range(N):
            writer.add_message(channel, T0 + i, b'{"a": %03d}' % (100 + i), T0 + i, i)
    return path


_SOURCES: dict[str, Callable[[Path], Path]] = {
    "mcap": lambda folder: write_imu(folder / "good.mcap", np.arange(N) * 0.5, chunk=100),
    "mcap-lz4": partial(_json_log, compression=CompressionType.LZ4),
    "mcap-no-index": partial(_json_log, compression=CompressionType.ZSTD, index_types=IndexType.NONE),
    "bag": lambda folder: write_vectors(folder / "good.bag", "/v", N, "bag", "LZ4"),
    "sqlite3": lambda folder: write_vectors(folder / "bag", "/v", N) / "bag.db3",
}


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    return {kind: make(tmp_path_factory.mktemp(kind)).read_bytes() for kind, make in _SOURCES.items()}


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


# ---- hostile and corrupt files: declared sizes beyond memory, other formats, files that shrink while open ----

EACH = 300
_MAGIC = b"\x89MCAP0\r\n"


def _write(path: Path, *, chunk_size: int = 4000, chunked: bool = True, index: bool = True, padding: str = "") -> Path:
    with mcap_writer(
        path,
        chunk_size=chunk_size,
        use_chunking=chunked,
        compression=CompressionType.ZSTD,
        index_types=IndexType.ALL if index else IndexType.NONE,
        use_statistics=index,
    ) as writer:
        schema = writer.register_schema("T", "jsonschema", b'{"type": "object"}')
        channels = [writer.register_channel(topic, "json", schema) for topic in ("/a", "/b")]
        for i in range(EACH):
            for channel in channels:
                writer.add_message(channel, T0 + i, f'{{"x": {i}, "p": "{padding}"}}'.encode(), T0 + i, i)
    return path


def _records(data: bytes) -> list[tuple[int, int, int]]:
    """Opcode and extent of the top-level records."""
    found, at = [], len(_MAGIC)
    while at < len(data) - len(_MAGIC):
        opcode, length = struct.unpack_from("<BQ", data, at)
        found.append((opcode, at, at + 9 + length))
        at = found[-1][2]
    return found


def _outcome(path: Path, budget: ResourceLimits = DEFAULT_LIMITS) -> tuple[int, tuple[Loss, ...], int]:
    """Return the number of messages read, the losses, and the number of messages that the topics then declare."""
    with closing(open_log(path, budget)) as log:
        return sum(counts_of(log).values()), log.lost, sum(t.messages for t in log.topics)


def test_a_flipped_bit_in_a_chunk_without_indexes_is_a_loss_that_names_it(tmp_path):
    path = _write(tmp_path / "a.mcap", index=False)
    data = bytearray(path.read_bytes())
    chunks = [(at, end) for op, at, end in _records(data) if op == 6]
    at, end = chunks[1]
    first, last = struct.unpack_from("<QQ", data, at + 9)
    data[end - 30] ^= 4
    path.write_bytes(data)
    read, (loss,), claimed = _outcome(path)
    assert len(chunks) > 4
    assert 0 < read == claimed < 2 * EACH
    assert (loss.kind, loss.start_ns, loss.end_ns, loss.count) == ("bad-chunk", first, last + 1, None)
    assert f"at byte {at}:" in loss.what
    assert inspect_log(path).exit_code == EXIT_PARTIAL


@pytest.mark.parametrize(
    "place",
    ["channel", "channel, no summary", "kind of an index", "size", "huge size", "times of a chunk", "kind of a chunk"],
)
def test_messages_that_an_index_or_a_header_hides_are_read_or_lost(tmp_path, place):
    path = _write(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    index = [at for op, at, _ in _records(data) if op == 7][2]
    chunk = [at for op, at, _ in _records(data) if op == 6][1]
    if place.startswith("channel"):
        struct.pack_into("<H", data, index + 9, 1 + data[index + 9] % 2)
        data[-9] ^= "no summary" in place
    elif place == "kind of an index":
        data[index] = 0x87
    elif "size" in place:
        struct.pack_into("<I", data, index + 11, 0xFFFFFFF0 if "huge" in place else 16 * 10_000)
    elif place == "times of a chunk":
        struct.pack_into("<QQ", data, chunk + 9, T0 + 2**50, T0 + 2**50 + 1)
    else:
        data[chunk] ^= 0x80
        data[-9] ^= 1  # the CRC of the summary, by which the chunk would be found
    path.write_bytes(data)
    with closing(open_log(path)) as log:
        b = len(log.read({"/b": ["x"]})["/b"])
        assert b == EACH or log.lost
        assert log.end_ns <= T0 + EACH
    read, lost, claimed = _outcome(path)
    assert read == claimed
    assert (read == 2 * EACH) != (place == "kind of a chunk")
    assert bool(lost) == (place != "times of a chunk")


def _mcap_of_chunk(path: Path, size: int, compression: bytes, stored: bytes, crc: int = 0) -> Path:
    head = struct.pack("<QQQI", T0, T0 + 1, size, crc) + struct.pack("<I", len(compression)) + compression
    chunk = head + struct.pack("<Q", len(stored)) + stored
    records = [(1, b"\0" * 8), (6, chunk), (15, b"\0" * 4), (2, b"\0" * 20)]
    path.write_bytes(_MAGIC + b"".join(struct.pack("<BQ", op, len(d)) + d for op, d in records) + _MAGIC)
    return path


@pytest.mark.parametrize("claim", [1000, 100 << 30])
def test_a_chunk_that_would_fill_memory_is_refused_by_name(tmp_path, claim):
    stored = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(400 << 20))
    read, (loss,), _ = _outcome(_mcap_of_chunk(tmp_path / "a.mcap", claim, b"zstd", stored))
    assert read == 0
    assert "chunk at byte 25" in loss.what
    assert loss.kind == ("bad-chunk" if claim == 1000 else "over-budget")


@pytest.mark.parametrize("compression", ["zstd", "lz4", "bz2"])
def test_decompression_stops_where_the_claim_ends(compression, monkeypatch):
    import lz4.frame

    content = np.random.default_rng(1).bytes(5000)
    pack: dict[str, Callable[[bytes], bytes]] = {
        "zstd": zstandard.ZstdCompressor(write_content_size=False).compress,
        "lz4": lz4.frame.compress,
        "bz2": bz2.compress,
    }
    stored = pack[compression](content)
    assert decompress(compression, stored, 5000, DEFAULT_LIMITS) == content
    for size in (4999, 5001, 0):
        with pytest.raises(SpanDamageError):
            decompress(compression, stored, size, DEFAULT_LIMITS)
    with pytest.raises(SpanDamageError):
        decompress(compression, stored[:-10], 5000, DEFAULT_LIMITS)
    with pytest.raises(LimitError, match="--set budget"):
        decompress(compression, stored, 5000, ResourceLimits(chunk_bytes=4999))
    # Limit on the ratio: 100 kB of zeros must not expand to gigabytes, for any declared size.
    with pytest.raises(LimitError, match="chunk ratio"):
        decompress(compression, stored, 200 << 20, DEFAULT_LIMITS)
    with pytest.raises(LimitError):
        decompress_message(zstandard.ZstdCompressor().compress(bytes(8 << 20)), ResourceLimits(chunk_bytes=1 << 20))


def test_a_sparse_length_near_the_largest_integer_is_a_loss(tmp_path):
    message = struct.pack("<BQHIQQ", 5, 2**63 - 8, 1, 0, T0, T0) + bytes(100)
    read, lost, _ = _outcome(_mcap_of_chunk(tmp_path / "a.mcap", len(message), b"", message, zlib.crc32(message)))
    assert (read, len(lost)) == (0, 1)


def test_too_many_channels_cost_the_surplus_and_end(tmp_path):
    path = tmp_path / "a.mcap"
    with mcap_writer(path, chunk_size=20_000) as writer:
        for i in range(400):
            channel = writer.register_channel(f"/t{i}", "json", 0)
            writer.add_message(channel, T0 + i, b"{}", T0 + i)
    read, lost, claimed = _outcome(path, ResourceLimits(channels=300))
    assert read == claimed == 300
    assert {"over-budget", "unknown-channel"} <= {loss.kind for loss in lost}
    assert len(lost) < 60  # and not one for each of them
    assert all(len(loss.what) < 500 for loss in lost)
    assert _outcome(path)[:2] == (400, ())


def test_a_channel_that_nothing_declares_in_a_log_whose_clock_is_set_back(tmp_path):
    path = tmp_path / "a.mcap"
    with mcap_writer(path, use_chunking=False) as writer:
        channel = writer.register_channel("/a", "json", 0)
        for i in range(2000):
            at = T0 + (i - 500 * (i // 1000)) * 10_000_000
            for id_ in (channel, 9):
                writer.add_message(id_, at, b"{}", at)
    read, lost, _ = _outcome(path)
    assert 0 < read < 2000
    assert {loss.kind for loss in lost} == {"unknown-channel", "time-jump"}


def test_a_log_that_takes_too_long_loses_its_rest(tmp_path, monkeypatch):
    path = _write(tmp_path / "a.mcap")
    now = [0.0]
    monkeypatch.setattr("pdhef_logtool.logs.resource_limits.time.thread_time", lambda: now[0])
    with closing(open_log(path, ResourceLimits(seconds=10.0, seconds_per_mib=0.0))) as log:
        container = log.containers[0]
        load = container.load

        def slow(span: object, want: object = None) -> object:
            now[0] += 4.0
            return load(span, want)

        monkeypatch.setattr(container, "load", slow)
        log.read({t.name: () for t in log.topics})
        assert {loss.kind for loss in log.lost} == {"over-budget"}
        assert sum(loss.count or 0 for loss in log.lost) == sum(sum(s.counts.values()) for s in container.spans[3:])
        assert all("--set budget" in loss.what for loss in log.lost)
        assert sum(topic.messages for topic in log.topics) == 2 * EACH


@pytest.mark.parametrize("chunked", [True, False])
def test_a_file_that_is_cut_while_it_is_open_is_a_loss(tmp_path, chunked):
    padding = np.random.default_rng(0).bytes(8000).hex()
    path = _write(tmp_path / "a.mcap", chunked=chunked, chunk_size=70_000, padding=padding)
    with closing(open_log(path)) as log:
        os.truncate(path, 40_000)
        assert sum(counts_of(log).values()) < EACH
        assert all(loss.kind == "bad-chunk" and loss.severity == "lost" for loss in log.lost)
        assert log.lost


def _within(action: Callable[[], object]) -> BaseException | None:
    """Return the exception that an action raises; fail if the action does not end."""
    caught: list[BaseException | None] = []

    def run() -> None:
        try:
            action()
            caught.append(None)
        except BaseException as error:  # noqa: BLE001
            caught.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(300.0)
    assert caught, "it waits for ever"
    return caught[0]


@pytest.mark.parametrize("name", ["x.mcap", "x.mcap.zstd"])
def test_a_fifo_is_refused_at_once(tmp_path, name):
    path = tmp_path / name
    os.mkfifo(path)
    for action in (lambda: open_log(path), lambda: hash_log(path)):
        error = _within(action)
        assert isinstance(error, LogError)
        assert "a FIFO" in str(error)
    assert isinstance(_within(lambda: open_log("/dev/null")), LogError)
    (tmp_path / "metadata.yaml").write_text(f"rosbag2_bagfile_information:\n  relative_file_paths: [{name}]\n")
    assert isinstance(_within(lambda: open_log(tmp_path)), LogError)


def test_more_messages_than_their_bytes_can_hold_are_refused(tmp_path):
    record = struct.pack("<BQHIQQ", 5, 22, 1, 0, T0, T0)
    for count, kinds in ((60_000, {"unknown-channel"}), (70_000, {"over-budget"})):
        content = record * count
        stored = zstandard.ZstdCompressor().compress(content)
        path = _mcap_of_chunk(tmp_path / "a.mcap", len(content), b"zstd", stored)
        assert {loss.kind for loss in _outcome(path, ResourceLimits(chunk_ratio=100_000))[1]} == kinds
    assert _outcome(path, ResourceLimits(chunk_ratio=100_000).times(100))[1][0].kind == "unknown-channel"


# ---- outlier stamps, clock resets and backward clock steps: found before windows are cut; other times do not move ----

S = 1_000_000_000
EPOCH_NS = 1_767_225_600 * S
LATEST = 2**63 - 2


@pytest.mark.parametrize("stray", [0, 1, LATEST, EPOCH_NS - 900 * S, EPOCH_NS + 5000 * S])
def test_one_message_far_from_all_others_is_stray(stray):
    times = np.append(EPOCH_NS + np.arange(1000) * S // 100, stray)
    intervals, kept, strays = span.find_epochs(times, times + 1, np.ones(len(times), dtype=np.int64))
    assert intervals == [(EPOCH_NS, EPOCH_NS + 999 * S // 100 + 1)]
    assert np.flatnonzero(strays).tolist() == [1000]
    assert kept.sum() == 1000


@pytest.mark.slow
@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    pieces=st.lists(
        st.tuples(st.integers(0, LATEST), st.integers(1, 10_000 * S), st.integers(1, 50)), min_size=1, max_size=12
    )
)
def test_every_piece_is_kept_stray_or_of_another_epoch(pieces):
    start = np.array([p[0] for p in pieces], dtype=np.int64)
    end = np.array([min(p[0] + p[1], LATEST + 1) for p in pieces], dtype=np.int64)
    intervals, kept, stray = span.find_epochs(start, end, np.array([p[2] for p in pieces], dtype=np.int64))
    assert kept.any()
    assert not (kept & stray).any()
    for i in np.flatnonzero(kept):
        assert any(a <= start[i] and end[i] <= b for a, b in intervals)
    for i in np.flatnonzero(~kept):
        assert all(end[i] <= a or start[i] >= b for a, b in intervals)
    for (_, b), (a, _) in pairwise(intervals):
        assert span.SILENCE_NS - 1000 < a - b < span.EPOCH_NS + 1000


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    steps=st.lists(st.tuples(st.integers(1, 199), st.integers(-8 * S, 8 * S)), max_size=4), seed=st.integers(0, 1000)
)
def test_what_is_left_never_interleaves_two_passes(steps, seed):
    rng = np.random.default_rng(seed)
    times = EPOCH_NS + np.cumsum(rng.integers(S // 20, S // 5, 200))
    for at, by in steps:
        times[at:] += by
    left = np.ones(200, dtype=np.bool_)
    for place, low, high in span.recorded_twice(times):
        left[place:] &= ~((times[place:] >= low) & (times[place:] <= high))
    passes = np.concatenate([[0], np.cumsum(np.diff(times) < -S)])
    for p in range(passes[-1]):
        of_this, later = times[passes == p], times[left & (passes > p)]
        assert not ((later > of_this.min()) & (later < of_this.max())).any()
    if not (np.diff(times) < -S).any():
        assert left.all()


def test_windows_keep_their_borders_and_leave_silences_out():
    occupied = span.RecordingSpan(((100, 130), (1000, 1011), (1015, 1030)))
    whole = list(windows(100, 1030, 20))
    some = list(windows(100, 1030, 20, occupied))
    assert some == [w for w in whole if any(w[0] < b and a < w[1] for a, b in occupied.intervals)]
    assert list(windows(100, 1030, 20, span.RecordingSpan(((100, 1030),)))) == whole
    assert list(windows(200, 900, 20, occupied)) == []
    assert list(windows(110, 120, 20, occupied)) == [(110, 120)]


def test_any_time_can_be_shown():
    assert span.shown_time(0) == "1970-01-01 00:00:00 UTC"
    assert span.shown_time(-1) == "1969-12-31 23:59:59 UTC"
    assert span.shown_time(LATEST).startswith("2262-04-11")


@pytest.mark.parametrize("back_s", [0, 3])
def test_the_times_in_an_index_show_a_step_within_a_chunk(back_s, tmp_path):
    """In a chunk of 20 s the clock steps back midway; the first and last time do not show it."""
    path = tmp_path / "log.mcap"
    with mcap_writer(path, chunk_size=1 << 30) as writer:
        ids = [writer.register_channel(topic, "json", 0) for topic in ("/fast", "/slow")]
        for i in range(2000):
            ns = EPOCH_NS + i * S // 100 - (back_s * S if i >= 1000 else 0)
            for id_ in ids if i % 10 == 0 else ids[:1]:
                writer.add_message(id_, ns, b"{}", ns)
    with closing(open_log(path)) as log:
        (container,) = log.containers
        (only,) = container.spans
        assert all((np.diff(times) >= 0).all() == (back_s == 0) for times in only.times.values())
        assert [loss.kind for loss in log.lost] == ([] if back_s == 0 else ["time-jump"])
