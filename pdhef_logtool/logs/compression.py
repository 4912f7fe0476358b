"""Decompression of chunks, messages and files, up to the declared size and the resource limits."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from threading import local
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from pdhef_logtool.logs.container import Block, SpanDamageError
from pdhef_logtool.logs.resource_limits import MIB, LimitError, Meter, ResourceLimits

if TYPE_CHECKING:
    import zstandard

_Bytes: TypeAlias = bytes | memoryview
_OF_THREAD = local()
_BLOCK_BYTES = MIB
_FRAME_HEAD_BYTES = 18
#: Free disk space that a decompressed copy leaves.
_DISK_RESERVE_BYTES = 256 * MIB


def decompress(compression: str, stored: _Bytes, size: int, limits: ResourceLimits) -> bytes:
    """Decompress a chunk that claims ``size`` bytes.

    Parameters
    ----------
    compression : ``zstd``, ``lz4`` (frames), ``bz2``; empty or ``none`` for none.

    Raises
    ------
    SpanDamageError : unknown, damaged, or of another size. LimitError : the declared size is above a limit.
    """
    length = memoryview(stored).nbytes
    if compression in ("", "none"):
        limits.check("chunk_bytes", length, "a chunk")
        content = bytes(stored)
    else:
        unpack = _UNPACK.get(compression)
        if unpack is None:
            raise SpanDamageError(f"unknown compression {compression!r}")
        limits.check_unpacked(size, length, "a compressed chunk")
        try:
            content = unpack(stored, size)
        except (OSError, RuntimeError, EOFError, ValueError, OverflowError, MemoryError) as error:
            raise SpanDamageError(str(error)) from error
    if len(content) != size:
        more = "more" if len(content) > size else f"{len(content)}"
        raise SpanDamageError(f"decompressed to {more} bytes instead of {size}")
    return content


def decompress_messages(block: Block, limits: ResourceLimits) -> Block:
    """Decompress the messages of a block, each a zstd frame; errors as of :func:`decompress`."""
    payloads: list[bytes] = []
    size = 0
    for start, n in zip(block.offset.tolist(), block.length.tolist(), strict=True):
        payloads.append(decompress_message(block.buffer[start : start + n], limits))
        size += len(payloads[-1])
        limits.check("chunk_bytes", size, "compressed messages")
    length = np.array([len(p) for p in payloads], dtype=np.int64)
    return replace(block, buffer=b"".join(payloads), offset=np.cumsum(length) - length, length=length)


def decompress_message(stored: _Bytes, limits: ResourceLimits) -> bytes:
    """Decompress a message that is a zstd frame; errors as of :func:`decompress`."""
    import zstandard

    try:
        size = zstandard.frame_content_size(stored)
        if size >= 0:
            return decompress("zstd", stored, size, limits)
        return _zstd_decompressor().decompress(stored, max_output_size=limits.chunk_bytes)
    except (zstandard.ZstdError, SpanDamageError, OverflowError, MemoryError) as error:
        raise SpanDamageError(f"a compressed message is damaged: {error}") from error


def decompress_file(source: Path, target: Path, meter: Meter) -> str:
    """Decompress a zstd file into another; returns why it stopped early, empty at the end of a sound file."""
    import shutil

    import zstandard

    allowed = max(_BLOCK_BYTES, meter.limits.chunk_ratio * source.stat().st_size)
    free = shutil.disk_usage(target.parent).free - _DISK_RESERVE_BYTES
    written = 0
    with source.open("rb") as packed, target.open("wb") as unpacked:
        claimed = zstandard.frame_content_size(packed.read(_FRAME_HEAD_BYTES))
        packed.seek(0)
        reader = zstandard.ZstdDecompressor().stream_reader(packed, read_across_frames=True)
        while True:
            try:
                meter.check()
                block = reader.read(_BLOCK_BYTES)
            except LimitError as error:
                return error.got
            except zstandard.ZstdError as error:
                return f"the compressed file is damaged: {error}"
            if not block:
                return "the compressed file ends early" if written < claimed else ""
            written += len(block)
            if written > allowed:
                return f"the file decompresses to more than {allowed} bytes, above the limit (--set budget=FACTOR)"
            if written > free:
                return "the disk has no room for the decompressed file (set TMPDIR to another)"
            unpacked.write(block)


def _zstd(stored: _Bytes, size: int) -> bytes:
    import zstandard

    try:
        if zstandard.frame_content_size(stored) not in (-1, size):
            raise SpanDamageError("its compressed content has another size")
        return _zstd_decompressor().decompress(stored, max_output_size=size)
    except zstandard.ZstdError as error:
        raise SpanDamageError(str(error)) from error


def _zstd_decompressor() -> "zstandard.ZstdDecompressor":
    """Return the decompressor of this thread: it is slow to make and not thread-safe."""
    import zstandard

    if not hasattr(_OF_THREAD, "zstd"):
        _OF_THREAD.zstd = zstandard.ZstdDecompressor()
    decompressor: zstandard.ZstdDecompressor = _OF_THREAD.zstd
    return decompressor


def _stream(codec: str, stored: _Bytes, size: int) -> bytes:
    """Decompress concatenated frames to at most ``size`` + 1 bytes; pyarrow is three times as fast as ``lz4.frame``."""
    from pyarrow import BufferReader, CompressedInputStream

    content: bytes = CompressedInputStream(BufferReader(stored), codec).read(size + 1)
    return content


_UNPACK: dict[str, Callable[[_Bytes, int], bytes]] = {
    "zstd": _zstd,
    "lz4": partial(_stream, "lz4"),
    "bz2": partial(_stream, "bz2"),
}
