"""What every log reader offers: topics, field types, and columns of the fields asked for, in windows of log time."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from numpy.typing import NDArray

from pdhef_logtool.logs.byte_account import ByteLedger
from pdhef_logtool.logs.occupied_time import OccupiedTime
from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.records.signals import IntArray, Loss


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """One topic of a log. ``type_name`` is in ROS 2 form (``sensor_msgs/msg/Imu``) for ROS messages."""

    name: str
    type_name: str
    encoding: str  # "cdr" | "ros1" | "json" | "protobuf" | ...
    messages: int


@dataclass(frozen=True, slots=True)
class FieldInfo:
    """One scalar leaf of a topic's schema.

    ``path`` is dotted (``linear_acceleration.x``); fixed arrays appear as ``name[i]`` per element when they have at
    most 16 elements, sequences as ``name[]``. ``kind`` is ``number``, ``bool``, ``string`` or ``time`` (a ROS
    builtin time, whose path names the whole struct, for example ``header.stamp``). ``code`` is NumPy's of a number in a
    binary message (``f4``), empty where the encoding has no such types.
    """

    path: str
    kind: str
    code: str = field(default="", compare=False)


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


class DriveLog(Protocol):
    """A readable log. Instances come from :func:`pdhef_logtool.logs.open_log.open_log`."""

    @property
    def path(self) -> LogPlace:
        """The file, folder or object."""

    @property
    def kind(self) -> str:
        """``mcap``, ``rosbag1``, ``rosbag2-sqlite3`` or ``rosbag2-mcap``."""

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """All topics, by name."""

    @property
    def start_ns(self) -> int:
        """First log time that counts; 0 for a log without messages."""

    @property
    def end_ns(self) -> int:
        """Last log time that counts + 1 (intervals are [start, end)); 0 for a log without messages."""

    @property
    def occupied(self) -> OccupiedTime:
        """When the log was recorded; what was recorded at other times is never read."""

    @property
    def lost(self) -> tuple[Loss, ...]:
        """What could not be read, as far as is known by now (complete after a full read)."""

    @property
    def byte_ledgers(self) -> tuple[ByteLedger, ...]:
        """Where the bytes of each file went, as far as is known by now."""

    def fields(self, topic: str, *, quiet: bool = False) -> tuple[FieldInfo, ...]:
        """Return the scalar leaves of a topic's schema; empty when the encoding carries none.

        ``quiet`` only looks: a schema that does not parse is no loss then.
        """

    def unreadable(self, topic: str) -> str:
        """Return why no field of a topic is known; empty where one is."""

    def borrowed(self, topic: str) -> tuple[Path, ...]:
        """Return the files of an installed ROS that a topic's type is read by, as the log does not define it."""

    def first_messages(self, topic: str, most: int) -> list[object]:
        """Return the first messages of a topic whole, with their texts; what does not decode is left out.

        ``value_at`` of ``message_schema`` reads places in them.
        """

    def read(
        self,
        requests: Mapping[str, Sequence[str]],
        start_ns: int | None = None,
        end_ns: int | None = None,
        *,
        quiet: bool = False,
        stamps: Collection[str] = (),
    ) -> dict[str, Columns]:
        """Read the fields asked for of messages with log time in [start, end). Unasked topics are not decoded.

        ``quiet`` only looks: messages that do not decode are no loss then. ``stamps`` are further topics, of which
        only the times are read.
        """

    def read_stamps(self, start_ns: int | None = None, end_ns: int | None = None) -> dict[str, Columns]:
        """Read only log and publish times of every topic (``fields`` empty); payloads are not decoded."""

    def close(self) -> None:
        """Release the files."""


def windows(
    start_ns: int, end_ns: int, length_ns: int, occupied: OccupiedTime | None = None
) -> Iterator[tuple[int, int]]:
    """Cut [start, end) into consecutive windows of at most ``length_ns``; those in a silence are left out."""
    at = start_ns
    for begin, end in ((start_ns, end_ns),) if occupied is None else occupied.intervals:
        at += max(0, (begin - at) // length_ns) * length_ns
        while at < min(end, end_ns):
            yield at, min(at + length_ns, end_ns)
            at += length_ns
