"""Full copies: every message, attachment and metadata record of the source."""

from __future__ import annotations

from collections import Counter
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType
from recorded import messages_of, raw_channel, summary_of

from pdhef_logtool.logs.columnar_log import ColumnarLog
from pdhef_logtool.logs.container import RawMessage, block_of
from pdhef_logtool.logs.mcap_log import McapContainer
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.source_copy import iterate_copy, register_channels, source_profile
from pdhef_logtool.logs.writer import McapLogWriter, TopicBatch
from tests.mcap_files import mcap_writer

pytestmark = pytest.mark.slow

T0 = 1_700_000_000_000_000_000
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


def _annotate(source: Path | ColumnarLog, target: Path, leave_out=lambda _: False, batches: bool = True, window=()):
    """Copy with a topic of ours beside it, which begins before and ends behind the source."""
    with closing(open_log(source) if isinstance(source, Path) else source) as log:
        with McapLogWriter(target, profile=source_profile(log)) as writer:
            channels = register_channels(writer, log, leave_out=leave_out)
            writer.add_topic("/ours", "std_msgs/msg/Float64")
            stamps = T0 - 50_000_000 + np.arange(7000) * 100_000
            ours = [TopicBatch("/ours", stamps, stamps, {"data": np.arange(7000.0)})] if batches else []
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
def test_a_damaged_chunk_is_dropped_and_said(tmp_path: Path, compression: CompressionType) -> None:
    source, target = tmp_path / "source.mcap", tmp_path / "copy.mcap"
    _write(source, compression=compression)
    intact = _messages(source)
    start, end = _damage_chunk(source, 2)
    lost = _annotate(source, target)
    assert [(x.kind, x.start_ns, x.end_ns) for x in lost] == [("bad-chunk", start, end)]
    assert _messages(target) == [m for m in intact if not start <= m[0] < end]  # type: ignore[operator]
    assert _messages(target) != intact


def test_a_copy_has_no_topic_that_is_left_out(tmp_path: Path) -> None:
    source, target = tmp_path / "source.mcap", tmp_path / "copy.mcap"
    _write(source, extra=("/old",))
    lost = _annotate(source, target, leave_out=lambda topic: topic == "/old")
    assert lost == ()
    assert _messages(target) == [m for m in _messages(source) if m[1] != "/old"]


def test_a_copy_of_a_window(tmp_path: Path) -> None:
    source, target = tmp_path / "source.mcap", tmp_path / "copy.mcap"
    _write(source)
    window = (T0 + 100_500_000, T0 + 400_500_000)
    _annotate(source, target, window=window)
    assert _messages(target) == [m for m in _messages(source) if window[0] <= m[0] < window[1]]  # type: ignore[operator]


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
        containers.append(McapContainer(path))
    return ColumnarLog(tmp_path, "rosbag2-mcap", containers)


@pytest.mark.parametrize("swap", [False, True])
def test_split_files_become_one_whatever_their_ids(tmp_path: Path, swap: bool) -> None:
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
def test_copies_of_recordings_equal_their_sources(shared_dir: Path, tmp_path: Path, name: str) -> None:
    _copy_all(shared_dir / name, tmp_path / "copy.mcap")
    copied, original = messages_of(tmp_path / "copy.mcap"), messages_of(shared_dir / name)
    assert len(copied) == len(original)
    assert [m[0] for m in copied] == [m[0] for m in original]
    # The other reader leaves the order of equal log times open.
    assert Counter(copied) == Counter(original)


@pytest.mark.parametrize("name", ["data/drives/lunda_v40", "reader_corpus/foxglove_rosbag1/example-bz2.bag"])
def test_a_copy_of_another_container_keeps_bytes_and_definitions(shared_dir: Path, tmp_path: Path, name: str) -> None:
    from rosbags.highlevel import AnyReader

    source, target = shared_dir / name, tmp_path / "copy.mcap"
    _copy_all(source, target)
    with AnyReader([source]) as reader:
        expected = [(stamp, c.topic, bytes(data)) for c, stamp, data in reader.messages()]
    assert sorted((m[0], m[1], m[2]) for m in messages_of(target)) == sorted(expected)
    with closing(open_log(source)) as log, closing(open_log(target)) as copy:
        assert copy.topics == log.topics
        assert [copy.fields(t.name) for t in copy.topics] == [log.fields(t.name) for t in log.topics]
