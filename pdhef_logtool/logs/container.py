"""What every container format reduces to: channels, spans of messages, and blocks of undecoded messages."""

from __future__ import annotations

import mmap
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import IntArray, Loss

# What the files of each format begin with.
MCAP_MAGIC = b"\x89MCAP0\r\n"
ROSBAG1_MAGIC = b"#ROSBAG V2.0\n"
SQLITE_MAGIC = b"SQLite format 3\0"
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
    ``ordered``: the log times of each channel are known not to step back in file order; False: nobody looked.
    """

    index: int
    start_ns: int
    end_ns: int
    counts: Mapping[int, int]
    ordered: bool = False


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

    @property
    def counts(self) -> dict[int, int]:
        """Messages by channel."""
        channels, counts = np.unique(self.channel, return_counts=True)
        return dict(zip(channels.tolist(), counts.tolist(), strict=True))


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


class Container(ABC):
    """One open file of a log. Opening it fills what stands below.

    Attributes
    ----------
    path : the file as the user named it.
    channels : by their id in this file. spans : in file order. lost : damage found while the file was opened.
    form : ``mcap``, ``rosbag1`` or ``sqlite3``.
    selective : whether a load can leave out the payloads of unwanted channels.
    profile : MCAP profile that a copy should carry. distro : ROS distribution that the file names; empty if none.
    remedy : what to do about a file that is none of this format.
    """

    form = ""
    selective = False
    profile = "ros2"
    distro = ""
    remedy = ""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.channels: dict[int, ChannelRecord] = {}
        self.spans: list[Span] = []
        self.lost: list[Loss] = []

    @abstractmethod
    def load(self, span: Span, want: frozenset[int] | None = None) -> Block:
        """Read a span's messages (of the channels in ``want`` at least); raises :class:`SpanDamageError`."""

    def times(self, span: Span) -> tuple[IntArray, IntArray]:
        """Return channels and log times of a span's messages [N], a channel's in file order, as cheaply as it goes.

        Raises
        ------
        SpanDamageError : they cannot be read.
        """
        block = self.load(span)
        return block.channel, block.log_time_ns

    def attachments(self) -> Iterator[Attachment]:
        """Read the attachments; a damaged one is among the losses and left out."""
        yield from ()

    def metadata_records(self) -> Iterator[MetadataRecord]:
        """Read the metadata records."""
        yield from ()

    @abstractmethod
    def close(self) -> None:
        """Release the file."""

    def no_log(self, expected: str, got: str) -> LogError:
        """Return the error for a file that cannot be opened."""
        return LogError(expected=expected, got=got, where=str(self.path), remedy=self.remedy)

    def lose(
        self, kind: str, what: str, start_ns: int | None = None, end_ns: int | None = None, count: int | None = None
    ) -> None:
        """Note damage of this file."""
        self.lost.append(Loss(kind, what, str(self.path), start_ns, end_ns, count))

    def drop_undeclared(self, called: str) -> None:
        """Take the messages of channels that the file does not declare out of the spans' counts, with a loss each."""
        for i, span in enumerate(self.spans):
            unknown = {c: n for c, n in span.counts.items() if c not in self.channels}
            if unknown:
                count = sum(unknown.values())
                what = f"{count} messages on {called.format(sorted(unknown))} that no readable record declares"
                self.lose("unknown-channel", what, span.start_ns, span.end_ns, count)
                known = {c: n for c, n in span.counts.items() if c not in unknown}
                self.spans[i] = Span(span.index, span.start_ns, span.end_ns, known, span.ordered)


class MappedContainer(Container):
    """A file that begins with ``magic`` (``magic_text`` in words), mapped into memory and walked once.

    Parameters
    ----------
    path : file to read.
    shown_path : what to call it in messages (a decompressed copy has another name than its source).

    Raises
    ------
    LogError : the file is none of this format.
    """

    magic = b""
    magic_text = ""

    def __init__(self, path: Path, shown_path: Path | None = None) -> None:
        super().__init__(shown_path or path)
        with path.open("rb") as file:
            if file.read(len(self.magic)) != self.magic:
                raise self.no_log(self.magic_text, "other content")
            self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        try:
            self._walk()
        except BaseException:
            self._data.close()
            raise

    @abstractmethod
    def _walk(self) -> None:
        """Fill channels, spans and losses."""

    def close(self) -> None:
        """Release the file."""
        self._data.close()


def block_from_lists(buffer: bytes | memoryview, *columns: Sequence[int]) -> Block:
    """Build a block from Python lists, in the order of its columns."""
    return Block(buffer, *(np.array(column, dtype=np.int64) for column in columns))
