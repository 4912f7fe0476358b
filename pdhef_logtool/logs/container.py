"""What every container format reduces to: channels, spans of messages, and blocks of undecoded messages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np

from pdhef_logtool.records.signals import IntArray, Loss

#: Log times above this (unsigned in the file) cannot be held in int64 and are set to it.
MAX_TIME_NS = int(np.iinfo(np.int64).max) - 1


@dataclass(frozen=True, slots=True)
class ChannelRecord:
    """One channel of a file. Several channels may carry the same topic.

    ``type_name`` is in ROS 2 form for ROS messages; ``schema_name`` is as the file has it.
    """

    id: int
    topic: str
    type_name: str
    encoding: str  # "cdr" | "ros1" | "json" | "protobuf" | ...
    schema_name: str
    schema_encoding: str  # "ros2msg" | "ros2idl" | "ros1msg" | "jsonschema" | "protobuf" | ""
    schema_data: bytes
    metadata: Mapping[str, str] = field(default_factory=dict)
    schema_id: int = 0  # in an MCAP file; 0: no schema


@dataclass(frozen=True, slots=True)
class Span:
    """A run of messages that is read as a whole: an MCAP or bag chunk, a run of unchunked records, a page of rows.

    ``start_ns`` and ``end_ns`` bound the log times as [start, end). ``counts`` gives messages by channel id.
    """

    index: int
    start_ns: int
    end_ns: int
    counts: Mapping[int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """The messages of one span in file order, undecoded.

    Attributes
    ----------
    buffer : bytes that hold all payloads.
    channel, log_time_ns, publish_time_ns, sequence, offset, length : int64 [N]; message i is
        ``buffer[offset[i]:offset[i] + length[i]]``.
    """

    buffer: bytes | memoryview
    channel: IntArray
    log_time_ns: IntArray
    publish_time_ns: IntArray
    sequence: IntArray
    offset: IntArray
    length: IntArray

    def __len__(self) -> int:
        """Return the number of messages."""
        return int(self.channel.shape[0])


@dataclass(frozen=True, slots=True, eq=False)
class RawChunk:
    """A chunk that another file holds, to be written as it is.

    Whoever makes one has decompressed it and checked its CRC, and knows that the channels it holds or declares have
    the same ids and the same definitions in the file that is written.

    Attributes
    ----------
    compression, stored : compression and compressed bytes, as in the other file.
    size, crc : bytes and CRC-32 of the decompressed records.
    channel, log_time_ns, offset : int64 [N] of its messages; offset of the record in the decompressed bytes.
    """

    compression: str
    stored: bytes
    size: int
    crc: int
    channel: IntArray
    log_time_ns: IntArray
    offset: IntArray

    @property
    def start_ns(self) -> int:
        """First log time."""
        return int(self.log_time_ns.min())


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file inside a log."""

    name: str
    media_type: str
    data: bytes
    log_time_ns: int
    create_time_ns: int


@dataclass(frozen=True, slots=True)
class MetadataRecord:
    """A named record of key-value pairs inside a log."""

    name: str
    values: Mapping[str, str]


class SpanDamageError(Exception):
    """A span cannot be decoded; caught inside this package and turned into a loss."""


class Container(Protocol):
    """One open file of a log."""

    @property
    def path(self) -> Path:
        """The file as the user named it."""
        ...

    @property
    def channels(self) -> Mapping[int, ChannelRecord]:
        """Channels by their id in this file."""
        ...

    @property
    def spans(self) -> Sequence[Span]:
        """All spans in file order."""
        ...

    @property
    def lost(self) -> Sequence[Loss]:
        """Damage found while the file was opened."""
        ...

    @property
    def selective(self) -> bool:
        """Whether a load can leave out the payloads of unwanted channels."""
        ...

    def load(self, span: Span, want: frozenset[int] | None = None) -> Block:
        """Read a span's messages (of the channels in ``want`` at least); raises :class:`SpanDamageError`."""
        ...

    def attachments(self) -> Iterator[Attachment]:
        """Read the attachments."""
        ...

    def metadata_records(self) -> Iterator[MetadataRecord]:
        """Read the metadata records."""
        ...

    def close(self) -> None:
        """Release the file."""
        ...


def block_from_lists(
    buffer: bytes | memoryview,
    channel: Sequence[int],
    log_time_ns: Sequence[int],
    publish_time_ns: Sequence[int],
    sequence: Sequence[int],
    offset: Sequence[int],
    length: Sequence[int],
) -> Block:
    """Build a block from Python lists."""
    return Block(
        buffer,
        np.array(channel, dtype=np.int64),
        np.array(log_time_ns, dtype=np.int64),
        np.array(publish_time_ns, dtype=np.int64),
        np.array(sequence, dtype=np.int64),
        np.array(offset, dtype=np.int64),
        np.array(length, dtype=np.int64),
    )
