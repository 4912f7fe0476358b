"""Common interface of container formats: channels, spans of messages, and blocks of undecoded messages."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate
from typing import Any, NamedTuple, TypeVar

import numpy as np
from mcap.records import Attachment, Metadata
from numpy.typing import NDArray

from pdhef_logtool.logs.byte_source import ByteSource, CutError, LocalFile, raise_source_error
from pdhef_logtool.logs.resource_limits import LimitError
from pdhef_logtool.logs.table_file import LogFile
from pdhef_logtool.records.errors import LogError, PdhefError
from pdhef_logtool.records.signals import BoolArray, IntArray, Loss

#: First and last bytes of an MCAP.
MCAP_MAGIC = b"\x89MCAP0\r\n"
#: Log times above this (unsigned in the file) do not fit int64 and are set to it.
MAX_TIME_NS = int(np.iinfo(np.int64).max) - 1
#: Kind of the note that a checksum of a file was not verified, as that would need all of a remote file.
UNVERIFIED = "unverified"
RecordT = TypeVar("RecordT", Attachment, Metadata)
#: Losses of one file; further ones become one loss.
LOSSES_OF_A_KIND = 20
_IDS_TOLD = 5
_TOLD_CHARACTERS = 300
_RECORDS_A_CHECK = 256  # of the time that a walk takes
_NONE = np.empty(0, np.int64)


@dataclass(frozen=True, slots=True)
class ChannelRecord:
    """One channel of a file. Several channels may carry the same topic."""

    id: int
    topic: str
    encoding: str  # "cdr" | "ros1" | "json" | "protobuf" | ...
    schema_name: str  # as the file has it
    schema_encoding: str  # "ros2msg" | "ros2idl" | "ros1msg" | "jsonschema" | "protobuf" | ""
    schema_data: bytes
    metadata: Mapping[str, str] = field(default_factory=dict)

    @property
    def type_name(self) -> str:
        """Name of the type; of ROS messages in ROS 2 form, ``pkg/msg/Type``, also for ``pkg/Type``."""
        parts = self.schema_name.replace("::", "/").split("/")
        if self.encoding not in ("cdr", "ros1"):
            return self.schema_name
        return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 and all(parts) else "/".join(parts)


@dataclass(frozen=True, slots=True, eq=False)
class Span:
    """A run of messages that is read as a whole: an MCAP or bag chunk, a run of unchunked records, a page of rows.

    ``start_ns`` and ``end_ns`` bound the log times as [start, end). ``counts`` gives messages by channel id.
    ``times``: log times [N] by channel id in file order; None if only the bounds were read, as in a sound remote file.
    """

    index: int
    start_ns: int
    end_ns: int
    counts: Mapping[int, int]
    times: Mapping[int, IntArray] | None = None

    @classmethod
    def of(cls, channels: Iterable[tuple[int, IntArray]]) -> "Span":
        """Return the span of messages with these channels and log times [N] in file order; a channel may repeat."""
        times: dict[int, IntArray] = {}
        for id_, its in channels:
            if len(its):
                times[id_] = np.concatenate((times[id_], its)) if id_ in times else its
        every = np.concatenate([_NONE, *times.values()])
        first, last = (int(every.min()), int(every.max())) if len(every) else (0, -1)
        return cls(0, first, last + 1, {id_: len(its) for id_, its in times.items()}, times)

    def overlaps(self, start_ns: int | None, end_ns: int | None) -> bool:
        """Return whether some of its time is in [start, end); None: without limit."""
        return (start_ns is None or self.end_ns > start_ns) and (end_ns is None or self.start_ns < end_ns)


@dataclass(frozen=True, eq=False)
class Block:
    """The messages of one span in file order, undecoded.

    Attributes
    ----------
    buffer : bytes that contain all payloads.
    channel, log_time_ns, publish_time_ns, sequence, offset, length : int64 [N]; message i is
        ``buffer[offset[i]:offset[i] + length[i]]``.
    dropped : channels that lack payloads.
    """

    buffer: bytes | memoryview
    channel: IntArray
    log_time_ns: IntArray
    publish_time_ns: IntArray
    sequence: IntArray
    offset: IntArray
    length: IntArray
    dropped: frozenset[int] = field(default=frozenset(), kw_only=True)

    def __len__(self) -> int:
        """Return the number of messages."""
        return int(self.channel.shape[0])

    def take(self, rows: slice | IntArray | BoolArray) -> "Block":
        """Return some of the messages."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _COLUMNS})

    def split(self, before_ns: float) -> "tuple[Block, Block]":
        """Return the messages before a time and the others; they ascend in log time."""
        n = int(np.searchsorted(self.log_time_ns, before_ns))
        return self.take(slice(n)), self.take(slice(n, None))

    @staticmethod
    def merged(parts: "Sequence[Block]", head: int = 0) -> "Block":
        """Return messages in order of log time, of equal times in the given order, one behind the other in memory.

        ``head``: bytes that are left free before each message.
        """
        columns = [np.concatenate([_NONE, *(getattr(part, name) for part in parts)]) for name in _COLUMNS]
        order = np.argsort(columns[_COLUMNS.index("log_time_ns")], kind="stable")
        channel, log_time, publish_time, sequence, _, length = (column[order] for column in columns)
        offset = np.cumsum(length + head) - length
        place = np.empty(len(order), np.int64)
        place[order] = offset
        buffer = np.empty(int((length + head).sum()), np.uint8)
        first = 0
        for part in parts:
            _copy(part, buffer, place[first : first + len(part)])
            first += len(part)
        return Block(buffer.data, channel, log_time, publish_time, sequence, offset, length)

    def without_large(self, most: int) -> "Block":
        """Return the block without payloads above ``most`` bytes."""
        large = self.length > most
        if not large.any():
            return self
        view, length = memoryview(self.buffer), np.where(large, 0, self.length)
        extents = zip(self.offset[~large].tolist(), self.length[~large].tolist(), strict=True)
        buffer = b"".join([view[start : start + n] for start, n in extents])
        dropped = frozenset(np.unique(self.channel[large]).tolist())
        return replace(self, buffer=buffer, offset=np.cumsum(length) - length, length=length, dropped=dropped)

    def message(self, row: int) -> bytes:
        """Return the payload of a message."""
        return bytes(self.buffer[self.offset[row] : self.offset[row] + self.length[row]])

    @property
    def nbytes(self) -> int:
        """Memory of the block in bytes."""
        return memoryview(self.buffer).nbytes + sum(int(getattr(self, name).nbytes) for name in _COLUMNS)

    @cached_property
    def rows(self) -> dict[int, IntArray]:
        """Rows by channel, ascending."""
        return rows_by_channel(self.channel)

    @property
    def counts(self) -> dict[int, int]:
        """Messages by channel."""
        return {channel: len(rows) for channel, rows in self.rows.items()}

    @property
    def span(self) -> Span:
        """The span of these messages."""
        return Span.of((id_, self.log_time_ns[rows]) for id_, rows in self.rows.items())


_COLUMNS = ("channel", "log_time_ns", "publish_time_ns", "sequence", "offset", "length")


class RawMessage(NamedTuple):
    """A message as ready bytes."""

    channel: int
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes


def block_of(messages: Iterable[RawMessage]) -> Block:
    """Return the block of single messages."""
    messages = list(messages)
    length = [len(message.data) for message in messages]
    columns = zip(*(message[:-1] for message in messages), strict=True) if messages else ((),) * 4
    return block_from_lists(b"".join(m.data for m in messages), *columns, [0, *accumulate(length)][:-1], length)


def items_at_bytes(buffer: bytes | memoryview, size: int, start: int = 0) -> NDArray[np.void]:
    """Return the ``size`` bytes at each byte from ``start`` on, as overlapping items: indexing copies them as a whole.

    Plain bytes need no alignment, and NumPy copies structured items member by member.
    """
    plain = np.dtype((np.void, size))
    places = memoryview(buffer).nbytes - start - size + 1
    return np.ndarray((places,), dtype=plain, buffer=buffer, offset=start, strides=(1,))


def _copy(block: Block, buffer: NDArray[np.uint8], place: IntArray) -> None:
    """Copy the payloads of a block to places [N] in a buffer, those of one length at once."""
    for size, rows in rows_by_channel(block.length).items():
        if size:
            items_at_bytes(buffer.data, size)[place[rows]] = items_at_bytes(block.buffer, size)[block.offset[rows]]


class SpanDamageError(Exception):
    """A span cannot be decoded. This package catches it and reports a loss."""


def describe_damage(error: Exception) -> tuple[str, str]:
    """Return kind and text of the loss that an error causes.

    A log that cannot be reached is not damaged: it raises a :class:`~.byte_source.SourceError`.
    """
    raise_source_error(error)
    if isinstance(error, LimitError):
        return "over-budget", f"expected {error.expected}, got {error.got} ({error.where}); {error.remedy}"
    if isinstance(error, LogError):
        return "bad-chunk", f"expected {error.expected}, got {error.got}"
    text = str(error) if isinstance(error, SpanDamageError | CutError) else f"{type(error).__name__}: {error}"
    return "bad-chunk", " ".join(text.split())[:_TOLD_CHARACTERS]


def count_text(count: int | None) -> str:
    """Return a number of messages in words."""
    return f"{count} messages" if count else "an unknown number of messages"


class Container(ABC):
    """One open file of a log. Opening it fills these attributes.

    Attributes
    ----------
    path : the file as the user named it.
    channels : by their id in this file. spans : in file order. lost : damage found while the file was opened.
    undeclared : messages by span that are not in its counts, as no record declares their channels.
    damaged : spans that could not be read. late : spans for which no time was left; their messages stay announced.
    size : bytes of the file. cut : whether the file is truncated. meter : resource limits.
    kind : of a log with this file only, as :class:`~.drive_log.DriveLog` has it.
    selective : whether a load can leave out the payloads of unwanted channels.
    profile : MCAP profile that a copy should carry. distro : ROS distribution that the file names; empty if none.
    remedy : remedy for a file of another format.
    zstd_messages : whether each message is a zstd frame.
    is_remote : whether each read is a network request. by_index : whether an index names all messages.
    """

    kind = ""
    selective = False
    is_remote = False
    by_index = False
    profile = "ros2"
    distro = ""
    remedy = ""
    zstd_messages = False

    def __init__(self, file: LogFile, size: int) -> None:
        self.path = file.place
        self.channels: dict[int, ChannelRecord] = {}
        self.spans: list[Span] = []
        self.lost: list[Loss] = []
        self.undeclared: dict[int, int] = {}
        self.damaged: set[int] = set()
        self.late: set[int] = set()
        self.meter = file.meter
        self.size = size
        self.cut = False
        self._closing = ExitStack()
        self._losses: Counter[str] = Counter()  # how many of a kind

    @abstractmethod
    def load(self, span: Span, want: frozenset[int] | None = None) -> Block:
        """Read a span's messages (at least of the channels in ``want``); any error is a loss of the span."""

    @abstractmethod
    def extent(self, span: Span) -> tuple[int, int]:
        """Return the bytes [start, end) of a span."""

    def records(self, kind: type[RecordT]) -> Iterator[RecordT]:
        """Read the attachments or metadata records; a damaged one is among the losses and left out."""
        del kind
        yield from ()

    def prefetch(self, spans: Iterable[Span]) -> None:
        """Prepare to load spans, in this order."""
        del spans

    def on_close(self, callback: Callable[[], None]) -> None:
        """Register a function to call when the container is closed; the last one is called first."""
        self._closing.callback(callback)

    def close(self) -> None:
        """Release the file."""
        self._closing.close()

    def no_log(self, expected: str, got: str) -> LogError:
        """Return the error for a file that cannot be opened."""
        return LogError(expected=expected, got=got, where=str(self.path), remedy=self.remedy)

    def lose(
        self, kind: str, what: str, start_ns: int | None = None, end_ns: int | None = None, count: int | None = None
    ) -> None:
        """Record damage of this file; the 21st and later losses of a kind are merged."""
        self._losses[kind] += 1
        more = self._losses[kind] - LOSSES_OF_A_KIND
        if more > 0:
            what = f"{more} more of this kind, the last: {what}"
        if more > 1:
            old = self.lost.pop(max(i for i, loss in enumerate(self.lost) if loss.kind == kind))
            start_ns, count = old.start_ns, None if old.count is None or count is None else old.count + count
        self.lost.append(Loss(kind, what, str(self.path), start_ns, end_ns, count))

    def drop_undeclared(self, called: str) -> None:
        """Remove the messages of undeclared channels from the spans' counts, with a loss per span."""
        for i, span in enumerate(self.spans):
            unknown = {c: n for c, n in span.counts.items() if c not in self.channels}
            if unknown:
                count = sum(unknown.values())
                ids = f"{sorted(unknown)[:_IDS_TOLD]}{' and more' if len(unknown) > _IDS_TOLD else ''}"
                what = f"{count} messages on {called.format(ids)} that no readable record declares"
                self.lose("unknown-channel", what, span.start_ns, span.end_ns, count)
                self.undeclared[i] = count
                declared = {c: n for c, n in span.counts.items() if c not in unknown}
                self.spans[i] = replace(span, counts=declared)


class FileContainer(Container):
    """A file that begins with ``magic`` (``magic_text`` in words), read once from record to record.

    Parameters
    ----------
    file : file to read.
    source : its bytes; None: of the local file.

    Raises
    ------
    LogError : the file has another format.
    """

    magic = b""
    magic_text = ""

    def __init__(self, file: LogFile, source: ByteSource | None = None) -> None:
        self.source = LocalFile(file.path, file.place) if source is None else source
        super().__init__(file, self.source.size)
        self.on_close(self.source.close)
        self.position = len(self.magic)  # of the walk
        self.chunks: list[Any] = []  # by index of the span
        try:
            if self.source.size < self.position or self.source.read(0, self.position) != self.magic:
                raise self.no_log(self.magic_text, "other content")
            with self.meter.running(self.source.size):
                self._open()
        except BaseException:
            self.source.close()
            raise

    def _open(self) -> None:
        """Walk the file. An error of the walk loses the rest of the file."""
        try:
            self._walk()
        except Exception as error:
            if isinstance(error, PdhefError) and not isinstance(error, LimitError):
                raise
            kind, text = describe_damage(error)
            self.lose(kind, f"what follows byte {self.position} of {self.source.size} is lost: {text}", self.last_ns())
            self.cut = True
        self._finish()

    def last_ns(self) -> int | None:
        """End of the last span so far; None before the first."""
        return self.spans[-1].end_ns if self.spans else None

    def add_span(self, chunk: Any, span: Span) -> None:
        """Add a span and its chunk at the end."""
        self.chunks.append(chunk)
        self.spans.append(replace(span, index=len(self.spans)))

    def extent(self, span: Span) -> tuple[int, int]:
        """Return the bytes of the span's chunk, which has them as ``start`` and ``end``."""
        chunk = self.chunks[span.index]
        return chunk.start, chunk.end

    def load(self, span: Span, want: frozenset[int] | None = None) -> Block:
        """Decode one chunk; see :class:`Container`."""
        del want
        return self._decoded(self.chunks[span.index], declare=False)

    @abstractmethod
    def _decoded(self, chunk: Any, *, declare: bool) -> Block:
        """Return the messages of a chunk; with ``declare``, add the channels that it declares."""

    def add_content(self, chunk: Any, claimed: Span | None = None) -> Block | None:
        """Add a chunk by its content; return None if it is damaged, which is a loss.

        ``claimed`` : times and counts by its header and index, if these are known.
        """
        try:
            block = self._decoded(chunk, declare=True)
        except Exception as error:  # noqa: BLE001 (the boundary)
            kind, text = describe_damage(error)
            count = sum(claimed.counts.values()) or None if claimed else None
            what = f"{count_text(count)} lost in the chunk at byte {chunk.start}: {text}"
            start_ns, end_ns = (claimed.start_ns, claimed.end_ns) if claimed else (self.last_ns(), None)
            self.lose(kind, what, start_ns, end_ns, count)
            return None
        if len(block):
            self.add_span(chunk, block.span)
        return block

    def lose_end(self, offset: int) -> None:
        """Note that the file ends inside a record."""
        what = f"the file ends inside a record at byte {offset} of {self.source.size}; what follows is gone"
        self.lose("truncated", what, self.last_ns())
        self.cut = True

    def lose_record(self, start: int, error: Exception) -> None:
        """Note that the record at byte ``start`` cannot be read: the boundary of the walk."""
        kind, text = describe_damage(error)
        kind = "bad-record" if kind == "bad-chunk" else kind
        self.lose(kind, f"the record at byte {start} is malformed: {text}")

    @abstractmethod
    def _walk(self) -> None:
        """Find channels, spans and losses, keeping :attr:`at` up to date."""

    def _places(self) -> Iterator[int]:
        """Yield the position of the walk up to the file's end; check the time limit now and then."""
        n = 0
        while self.position < self.source.size:
            n += 1
            if n % _RECORDS_A_CHECK == 0:
                self.meter.check()
            yield self.position

    @abstractmethod
    def _finish(self) -> None:
        """Finish open records and check the file as a whole."""


def rows_by_channel(channel: IntArray) -> dict[int, IntArray]:
    """Return the rows of each channel, ascending, from the channels [N] of messages, or of another whole number."""
    if not len(channel):
        return {}
    # 16 bits, if enough, sort much faster.
    fit = channel.view(np.uint64).max() <= np.iinfo(np.uint16).max  # an id below 0 is a huge one
    order = np.argsort(channel.astype(np.uint16) if fit else channel, kind="stable")
    ordered = channel[order]
    firsts = [0, *(np.flatnonzero(ordered[1:] != ordered[:-1]) + 1).tolist()]
    ends = [*firsts[1:], len(channel)]
    return {int(ordered[first]): order[first:end] for first, end in zip(firsts, ends, strict=True)}


def block_from_lists(buffer: bytes | memoryview, *columns: Sequence[int]) -> Block:
    """Build a block from sequences of integers, in the order of its columns."""
    return Block(buffer, *(np.array(column, dtype=np.int64) for column in columns))
