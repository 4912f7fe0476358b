"""Hostile and corrupt files: declared sizes beyond memory, files of another format, files that shrink while open."""

import bz2
import os
import struct
import threading
import zlib
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType, IndexType
from recorded import T0, counts_of

from pdhef_logtool.logs.compression import decompress, decompress_message
from pdhef_logtool.logs.container import SpanDamageError
from pdhef_logtool.logs.discovery import hash_log
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, LimitError, ResourceLimits
from pdhef_logtool.records.errors import EXIT_PARTIAL, LogError
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.runs.inspection.report import inspect_log
from tests.mcap_files import mcap_writer

N = 300
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
        for i in range(N):
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
    assert 0 < read == claimed < 2 * N
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
        assert b == N or log.lost
        assert log.end_ns <= T0 + N
    read, lost, claimed = _outcome(path)
    assert read == claimed
    assert (read == 2 * N) != (place == "kind of a chunk")
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
        assert sum(topic.messages for topic in log.topics) == 2 * N


@pytest.mark.parametrize("chunked", [True, False])
def test_a_file_that_is_cut_while_it_is_open_is_a_loss(tmp_path, chunked):
    padding = np.random.default_rng(0).bytes(8000).hex()
    path = _write(tmp_path / "a.mcap", chunked=chunked, chunk_size=70_000, padding=padding)
    with closing(open_log(path)) as log:
        os.truncate(path, 40_000)
        assert sum(counts_of(log).values()) < N
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
