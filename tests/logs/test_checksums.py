"""Checksums of a file: their coverage is reported, and damage that only a checksum detects is a loss."""

from __future__ import annotations

import struct
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType
from recorded import summary_of

from pdhef_logtool.cli.app import app
from pdhef_logtool.logs.container import Wanted
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL
from tests.mcap_files import mcap_writer

T0 = 1_700_000_000_000_000_000
N = 400


def _log(path: Path, *, chunk_crcs: bool, data_crc: bool, chunked: bool = True) -> Path:
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


def _exit_code(path: Path) -> int:
    with pytest.raises(SystemExit) as ended:
        app(["inspect", str(path)], prog_name="pdhef")
    return int(ended.value.code or 0)


@pytest.mark.parametrize("message", range(0, N, N // 12))
def test_a_flipped_bit_that_only_the_crc_of_the_data_shows_is_a_loss(tmp_path: Path, message: int) -> None:
    path = _log(tmp_path / "log.mcap", chunk_crcs=False, data_crc=True)
    content = bytearray(path.read_bytes())
    content[_first_numbers(path)[message] + 3] ^= 1 << message % 8
    path.write_bytes(content)
    with closing(open_log(path)) as log:
        values = log.read({"/t": ["a", "b", "c"]})["/t"].fields
        assert [(loss.kind, loss.severity) for loss in log.lost] == [("bad-data-crc", "lost")]
        assert "it is unknown which" in log.lost[0].what
        np.testing.assert_array_equal(values["b"], 0.5 * np.arange(N))  # readable values are returned
    assert _exit_code(path) == EXIT_PARTIAL


@pytest.mark.parametrize("chunked", [True, False])
def test_a_sound_log_whose_data_has_a_crc_is_covered_by_it(tmp_path: Path, chunked: bool) -> None:
    path = _log(tmp_path / "log.mcap", chunk_crcs=False, data_crc=True, chunked=chunked)
    with closing(open_log(path)) as log:
        assert log.lost == ()
    assert _exit_code(path) == EXIT_OK


def test_a_log_that_is_read_in_part_from_a_server_says_what_was_not_verified(tmp_path: Path) -> None:
    pytest.importorskip("aiohttp", reason="reads http://: pip install 'pdhef-logtool[http]'")
    from tests.counting_server import serving

    path = tmp_path / "log.mcap"
    with mcap_writer(path, chunk_size=4000, enable_crcs=False, enable_data_crcs=True) as writer:
        schema = writer.register_schema(
            "T", "jsonschema", b'{"type": "object", "properties": {"a": {"type": "number"}}}'
        )
        channels = [writer.register_channel(topic, "json", schema) for topic in ("/a", "/b")]
        for i in range(2 * N):  # each chunk has one topic
            writer.add_message(channels[i // N], T0 + i * 10_000_000, b'{"a": %d}' % i, T0 + i * 10_000_000)
    with serving(**{"log.mcap": path.read_bytes()}) as server:
        place = RemotePlace(server.place("log.mcap"))
        with closing(open_log(place, wanted=Wanted(frozenset({"/a"})))) as log:
            assert [(loss.kind, loss.severity) for loss in log.lost] == [("unverified", "note")]
            assert log.index is not None
            assert len(log.read({"/a": ["a"]})["/a"]) == N
        with closing(open_log(place)) as log:  # all of it
            log.read({"/a": ["a"], "/b": ["a"]})
            assert log.lost == ()


def test_damage_of_a_summary_is_a_note(tmp_path: Path) -> None:
    path = _log(tmp_path / "log.mcap", chunk_crcs=True, data_crc=False)
    content = bytearray(path.read_bytes())
    last = struct.pack("<Q", summary_of(path).chunk_indexes[-1].chunk_start_offset)
    content[content.rindex(last)] ^= 4  # where the last chunk begins, which a near log does not ask the index
    path.write_bytes(content)
    with closing(open_log(path)) as log:
        assert len(log.read({"/t": ["a"]})["/t"]) == N
        assert [(loss.kind, loss.severity) for loss in log.lost] == [("bad-summary-crc", "note")]
    assert _exit_code(path) == EXIT_OK
