"""The interface of log formats: topics, field types, and columns of the requested fields, in windows of log time.

A format implements :class:`DriveLog`, or gives its columns to :class:`~pdhef_logtool.logs.table_log.TableLog`, and is
listed in :mod:`~pdhef_logtool.logs.formats`. Features of some logs only (copies of messages) are
capabilities: properties that are None by default.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from numpy.typing import NDArray

from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.logs.recording_span import RecordingSpan
from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.records.signals import IntArray, Loss

if TYPE_CHECKING:
    from pdhef_logtool.logs.columnar_log import ColumnarLog


#: Fields to read by topic; without fields its times alone.
Requests: TypeAlias = Mapping[str, Sequence[str]]


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic of a log. ``type_name`` is in ROS 2 form (``sensor_msgs/msg/Imu``) for ROS messages."""

    name: str
    type_name: str
    encoding: str  # of its messages: "cdr" | "ros1" | "json" | "protobuf" | ...; of tables the kind of log
    messages: int


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Fields of one topic over a window, in order of log time (stable).

    Attributes
    ----------
    log_time_ns, publish_time_ns : int64 [N].
    fields : by path; float64 [N] for numbers and booleans, float64 [N, k] for a path that names an array as a whole
        (or a vector struct such as x, y, z), int64 nanoseconds [N] for a ``time`` path. NaN where a message lacks
        the field or the index.
    """

    topic: str
    log_time_ns: IntArray
    publish_time_ns: IntArray
    fields: Mapping[str, NDArray]  # type: ignore[type-arg]

    def __len__(self) -> int:
        """Return the number of messages."""
        return int(self.log_time_ns.shape[0])


class DriveLog(ABC):
    """A readable log. Instances come from :func:`pdhef_logtool.logs.open_log.open_log`.

    Attributes
    ----------
    path : file, folder or object.
    kind : name of the format, for reports: ``mcap``, ``rosbag1``, ``rosbag2-sqlite3``, ``rosbag2-mcap``, ...
    size : bytes of all files.
    recording_span : when the log was recorded; messages of other times are never read.
    given_databases : DBC files given with the log.
    """

    path: LogPlace
    kind: str
    size: int
    recording_span: RecordingSpan
    given_databases: tuple[Path, ...] = ()

    @property
    @abstractmethod
    def topics(self) -> tuple[TopicInfo, ...]:
        """All topics, by name."""

    @property
    @abstractmethod
    def lost(self) -> tuple[Loss, ...]:
        """Losses so far (complete after a full read)."""

    @abstractmethod
    def fields(self, topic: str, *, quiet: bool = False) -> tuple[FieldInfo, ...]:
        """Return the scalar leaves of a topic; empty if its type is unknown.

        With ``quiet`` a schema that does not parse is not reported as a loss.
        """

    @abstractmethod
    def read(
        self, requests: Requests, start_ns: int | None = None, end_ns: int | None = None, *, quiet: bool = False
    ) -> dict[str, Columns]:
        """Read the requested fields of messages with log time in [start, end). No other topic is decoded.

        Of a topic without fields the times alone are read. With ``quiet`` messages that do not decode are not reported
        as a loss.

        Raises
        ------
        MappingError : the log has no such topic, no such field, or cannot decode the topic.
        """

    @abstractmethod
    def close(self) -> None:
        """Release the files."""

    @property
    def start_ns(self) -> int:
        """First log time that counts; 0 for a log without messages."""
        return self.recording_span.start_ns

    @property
    def end_ns(self) -> int:
        """Last log time that counts + 1 (intervals are [start, end)); 0 for a log without messages."""
        return self.recording_span.end_ns

    @property
    def messages(self) -> "ColumnarLog | None":
        """The log as messages with bytes that can be copied to another file; None: it has columns only."""
        return None

    def metadata(self) -> dict[str, str]:
        """Return the metadata of the log by ``key`` and ``record.key``."""
        return {}

    @property
    def databases(self) -> tuple[Path, ...]:
        """The DBC files of the frames in the log's topics: those given with it, otherwise those in it."""
        return self.given_databases

    def definition(self, path: Path) -> Path:
        """Return the file that contains a definition of the log."""
        return path

    def unreadable(self, topic: str) -> str:
        """Return why a topic has no readable fields; empty if it has some."""
        del topic
        return ""

    def first_messages(self, topic: str, most: int) -> list[object]:
        """Return the first messages of a topic, decoded with texts; messages that do not decode are left out.

        ``values_at`` of ``message_schema`` reads places in them.
        """
        del topic, most
        return []


def windows(
    start_ns: int, end_ns: int, length_ns: int, recording_span: RecordingSpan | None = None
) -> Iterator[tuple[int, int]]:
    """Cut [start, end) into consecutive windows of at most ``length_ns``; those in a silence are left out."""
    window_ns = start_ns
    for begin, end in ((start_ns, end_ns),) if recording_span is None else recording_span.intervals:
        window_ns += max(0, (begin - window_ns) // length_ns) * length_ns
        while window_ns < min(end, end_ns):
            yield window_ns, min(window_ns + length_ns, end_ns)
            window_ns += length_ns
