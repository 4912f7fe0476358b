"""annotated.mcap: the source log with our topics merged in by log time, or our topics alone (sidecar)."""

import json
import math
import re
import struct
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mcap.records import Attachment
from numpy.typing import NDArray

from pdhef_logtool.evaluation.dead_reckoned import pose_known
from pdhef_logtool.logs.container import Block, ChannelRecord, RawMessage, block_of
from pdhef_logtool.logs.definitions import message_definition
from pdhef_logtool.logs.drive_log import Columns, DriveLog
from pdhef_logtool.logs.source_copy import iterate_copy, register_channels, source_profile
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.geometry import quat_from_yaw
from pdhef_logtool.records.signals import NS_PER_S, BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.plotted import log_lines, log_message, plotted_fields
from pdhef_logtool.results.sink import LONGEST_WHOLE_NS, TRUTH, Event, first_of_slots, rounded
from pdhef_logtool.storage.documents import jsonable

#: Everything below this name in a source log is ours and is replaced.
NAMESPACE = "/pdhef/"
STATE_TYPE = "pdhef_msgs/msg/VehicleStateEstimate"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
PLOT_TYPE = "pdhef_msgs/msg/PlottedEstimate"
PATH_TYPE = "nav_msgs/msg/Path"
LOG_TYPE, LOG_TOPIC = "rcl_interfaces/msg/Log", f"{NAMESPACE}log"
MAP_FRAME = "map"
BODY_FRAME = "base_link"
METRICS_RECORD = "pdhef.metrics"
REPORT_ATTACHMENT = "report.json"

_STATE_FIELDS = (
    "vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2", "sideslip_std_rad", "network_trust", "r_scale",
    "nis", "friction",
)  # fmt: skip
#: Places of v_x, v_y and yaw rate among x, y, z and the rotations about x, y, z.
_PLANAR = np.array([0, 1, 5])
#: Of zstd: of rounded numbers level 3 makes 1 % more bytes, level 6 3 % fewer in three times the time.
_LEVEL = 1
#: Between two poses of a track that is not shown first and between two plotted values; between two points of the map.
_POSE_STEP_NS, _PATH_STEP_NS = 50_000_000, NS_PER_S
#: Steps of the tracks that --estimators does not name; the shortest one for which the file is small enough.
_STEPS_NS = tuple(round(s * NS_PER_S) for s in (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0))
#: The shortest one of a long drive.
_LONG_STEP_NS = 200_000_000
#: Messages are encoded in pieces of this duration.
_PIECE_NS = 60_000_000_000
#: Of the map of a track.
_MOST_POSES = 1000
#: Bytes of a message with its index, and of report, figures and schemas: upper bounds over simulated drives.
_MESSAGE_BYTES, _DOCUMENT_BYTES = 70, 180_000


def topic_of(estimator: str, what: str) -> str:
    """Return the topic of a track as a legal ROS 2 name: ``/pdhef/phy_ukf/state`` of ``phy-ukf`` and ``state``."""
    token = re.sub(r"[^A-Za-z0-9_]", "_", estimator)
    return f"{NAMESPACE}{'_' if token[:1].isdigit() else ''}{token}/{what}"


def thinned_step_ns(source_bytes: int, *, rows: int, others: int, span_ns: int) -> int:
    """Return the time step of the other estimators' rows for an annotated log of at most twice its source.

    ``rows`` : stamps of a track. ``others`` : number of such tracks. Room for selected estimate and ground truth is
    kept: one state per stamp of the former, and four messages of both every 50 ms.
    """
    room = source_bytes - _DOCUMENT_BYTES - (rows + 4 * (span_ns // _POSE_STEP_NS)) * _MESSAGE_BYTES
    steps = [step for step in _STEPS_NS if span_ns <= LONGEST_WHOLE_NS or step >= _LONG_STEP_NS]
    fit = (step for step in steps if 3 * others * (span_ns // step) * _MESSAGE_BYTES <= room)
    return next(fit, _STEPS_NS[-1])


@dataclass(eq=False)
class AnnotatedMcap(AbstractContextManager["AnnotatedMcap"]):
    """The annotated log; as a context it leaves no file on an exception.

    Each track becomes ``state`` (:data:`STATE_TYPE`, every stamp), ``odometry`` (``nav_msgs/msg/Odometry``, the
    stamps that are valid and have a pose, as the message can state neither; of a track that is not shown first, 20 a
    second), ``plot`` (:data:`PLOT_TYPE`, 20 a second) and ``path`` (the map, one message at the start).
    :data:`LOG_TOPIC` has a line for each fault, failed check, loss, event and manoeuvre. Log and publish time are the
    scored stamp. Numbers are :func:`~pdhef_logtool.results.sink.rounded`.
    Everything that an earlier annotation left in the source is replaced.

    Parameters
    ----------
    path : the finished file.
    source : the log to copy in full; None, or a log without messages, for a sidecar that contains our topics alone.
    shown : tracks with a pose at every stamp; others have one every 50 ms. None: all.
    others_step_ns : step of all topics of the others; those that are shown then have 10 poses a second, and the ground
        truth 20 states. None: as above.
    min_speed_m_s : sideslip is not plotted below.
    span_ns : copy messages of the source in [start, end) only; None: all.
    left_out : topics of the source that are not copied; its attachments and metadata are not either. None: all are.

    Raises
    ------
    OutputError : When the file cannot be written.
    """

    path: Path
    source: DriveLog | None
    _: KW_ONLY
    shown: Container[str] | None = None
    others_step_ns: int | None = None
    min_speed_m_s: float = 1.0
    span_ns: tuple[int, int] | None = None
    left_out: Container[str] | None = None

    def __post_init__(self) -> None:
        """Begin the file."""
        self._source = None if self.source is None else self.source.messages
        profile = "ros2" if self._source is None else source_profile(self._source)
        self._writer = McapLogWriter(self.path, profile=profile, level=_LEVEL)
        self._states: set[str] = set()

    def __exit__(self, *_: object) -> None:
        """Remove an unfinished file."""
        self._writer.abort()

    def write(self, tracks: Sequence[StateTrack]) -> None:
        """Write the tracks, merged with the messages of the source.

        The losses of the source itself are complete afterwards.
        """
        raws: Iterator[Block] = iter(())
        waiting: list[Block] = []
        if self._source is not None:
            left_out = self.left_out or ()
            channels = register_channels(
                self._writer,
                self._source,
                leave_out=lambda topic: topic.startswith(NAMESPACE) or topic in left_out,
                whole_metadata=self.left_out is None,
            )
            raws = iterate_copy(self._source, channels, *(self.span_ns or (None, None)))
        for track in tracks:
            self._add_topics(track.name)
        rows = [self._rows(track) for track in tracks]
        for piece in _pieces(tracks):
            truth = next((t.between(*piece) for t in tracks if t.name == TRUTH), None)
            batches = [b for t, r in zip(tracks, rows, strict=True) for b in self._batches(t, r, piece, truth)]
            if ends := [int(b.log_time_ns[-1]) + 1 for b in batches if len(b.log_time_ns)]:
                self._writer.write(batches, raws=_until(raws, waiting, max(ends)))
        self._writer.write([], raws=_until(raws, waiting, math.inf))

    def _rows(self, track: StateTrack) -> tuple[IntArray, IntArray, IntArray]:
        """Return the rows with a state, an odometry message and plotted values."""
        stated = posed = np.arange(len(track))
        plotted = first_of_slots(track.stamps_ns, _POSE_STEP_NS)
        is_shown = self.shown is None or track.name in self.shown
        if self.others_step_ns is None:
            posed = posed if is_shown else plotted
        elif is_shown:
            posed = first_of_slots(track.stamps_ns, 2 * _POSE_STEP_NS)
            stated = plotted if track.name == TRUTH else stated
        else:
            stated = posed = plotted = first_of_slots(track.stamps_ns, self.others_step_ns)
        return stated, posed[pose_known(track)[posed]], plotted

    def _batches(
        self, track: StateTrack, rows: Sequence[IntArray], piece: tuple[int, int], truth: StateTrack | None
    ) -> list[Columns]:
        """Return the messages of a track in a piece of the drive."""
        first, last = np.searchsorted(track.stamps_ns, piece).tolist()
        part = track.rows(first, last)
        stated, posed, plotted = (r[slice(*np.searchsorted(r, (first, last)))] - first for r in rows)
        drawn = {n: rounded(n, c[plotted]) for n, c in plotted_fields(part, truth, self.min_speed_m_s).items()}
        of_topics = (stated, _state_fields(part, stated)), (posed, _odometry_fields(part, posed)), (plotted, drawn)
        return [
            Columns(topic_of(track.name, what), stamps_ns, stamps_ns, {"header.stamp": stamps_ns, **fields})
            for what, (use, fields) in zip(("state", "odometry", "plot"), of_topics, strict=True)
            for stamps_ns in [part.stamps_ns[use]]
        ]

    def finish(self, report: Mapping[str, Any], tracks: Sequence[StateTrack], events: Sequence[Event] = ()) -> None:
        """Write the maps of the tracks, the log, the metrics record and report.json, and give the file its name."""
        self._write_paths(tracks)
        if lines := log_lines(report, events, tracks):
            channel = self._raw_channel(LOG_TOPIC, LOG_TYPE)
            raws = [RawMessage(channel, x.stamp_ns, x.stamp_ns, i, log_message(x)) for i, x in enumerate(lines)]
            self._writer.write([], [block_of(raws)])
        if self._source is not None and self.left_out is None:
            for attachment in self._source.attachments():
                if not _is_our_report(attachment):
                    self._writer.attachment(attachment)
            for record in self._source.metadata_records():
                if record.name != METRICS_RECORD:
                    self._writer.metadata(record.name, record.metadata)
        self._writer.metadata(METRICS_RECORD, metrics_record(report))
        end_ns = int(report["log"]["end_ns"])
        text = json.dumps(jsonable(report), sort_keys=True, separators=(",", ":"), allow_nan=False)
        self._writer.attachment(Attachment(end_ns, end_ns, REPORT_ATTACHMENT, "application/json", text.encode()))
        self._writer.close()

    def _add_topics(self, estimator: str) -> None:
        state, odometry = topic_of(estimator, "state"), topic_of(estimator, "odometry")
        if state in self._states:
            raise OutputError(expected="estimators with different topics", got=estimator, where=state)
        self._states.add(state)
        self._writer.add_topic(state, STATE_TYPE, constants={"header.frame_id": BODY_FRAME})
        frames = {"header.frame_id": MAP_FRAME, "child_frame_id": BODY_FRAME}
        self._writer.add_topic(odometry, ODOMETRY_TYPE, constants=frames)
        self._writer.add_topic(topic_of(estimator, "plot"), PLOT_TYPE, constants={"header.frame_id": BODY_FRAME})

    def _write_paths(self, tracks: Sequence[StateTrack]) -> None:
        """Write the way of each track, as one message at the start of the log."""
        raws = []
        for track in tracks:
            rows = first_of_slots(track.stamps_ns, _PATH_STEP_NS)
            rows = rows[pose_known(track)[rows]]
            poses = np.stack([track.x_m[rows], track.y_m[rows], track.yaw_rad[rows]], axis=1)
            if len(poses):
                start_ns = min(int(t.stamps_ns[0]) for t in tracks if len(t))
                channel = self._raw_channel(topic_of(track.name, "path"), PATH_TYPE)
                data = _path_message(start_ns, poses[:: 1 + len(poses) // _MOST_POSES])
                raws.append(RawMessage(channel, start_ns, start_ns, 0, data))
        self._writer.write([], [block_of(raws)] if raws else [])

    def _raw_channel(self, topic: str, type_name: str) -> int:
        definition = message_definition(type_name).encode()
        return self._writer.add_channel(ChannelRecord(-1, topic, "cdr", type_name, "ros2msg", definition))


def _pieces(tracks: Sequence[StateTrack]) -> Iterator[tuple[int, int]]:
    """Yield parts [start, end) of the time of the tracks, so that their messages need little memory."""
    ends_ns = [(int(t.stamps_ns[0]), int(t.stamps_ns[-1])) for t in tracks if len(t)]
    if ends_ns:
        for start_ns in range(min(first for first, _ in ends_ns), max(last for _, last in ends_ns) + 1, _PIECE_NS):
            yield start_ns, start_ns + _PIECE_NS


def _until(raws: Iterator[Block], waiting: list[Block], end_ns: float) -> Iterator[Block]:
    """Yield the messages up to the first one at or after a time, which waits for the next call."""
    while (raw := waiting.pop() if waiting else next(raws, None)) is not None:
        ready, rest = raw.split(end_ns)
        yield ready
        if len(rest):
            waiting.append(rest)
            return


def metrics_record(report: Mapping[str, Any]) -> dict[str, str]:
    """Return the figures as ``estimator/signal/segment/metric`` → ``value unit n=samples`` (``null``: not computable).

    Further entries: ``log``, ``truth`` (``available``, ``no truth``) and ``estimator/algorithm`` (resolved, as JSON).
    """
    record = {
        "log": str(report["log"]["name"]),
        "truth": "available" if report["truth"]["available"] else "no ground truth",
    }
    for e in report["estimators"]:
        if e["algorithm"] is not None:
            record[f"{e['name']}/algorithm"] = json.dumps(e["algorithm"], sort_keys=True)
    for m in report["metrics"]:
        value = "null" if m["value"] is None else f"{float(m['value']):.9g}"
        record[f"{m['estimator']}/{m['signal']}/{m['segment']}/{m['metric']}"] = f"{value} {m['unit']} n={m['n']}"
    return record


def _is_our_report(attachment: Attachment) -> bool:
    """Return whether an attachment is our report.json, not somebody else's of the same name."""
    with suppress(ValueError, RecursionError):
        document = json.loads(attachment.data) if attachment.name == REPORT_ATTACHMENT else None
        return isinstance(document, dict) and document.get("format") == "pdhef.report"
    return False


def _state_fields(track: StateTrack, use: IntArray) -> dict[str, NDArray[Any]]:
    weight, reason = (c[use] if len(c) == len(track) else None for c in (track.mixture_weight, track.reason))
    values = {name: getattr(track, name)[use] for name in _STATE_FIELDS}
    values |= {"covariance": _covariance(track, use).reshape(-1, 9)}
    values |= {"mixture_weight": np.full(len(use), np.nan) if weight is None else weight}
    return {name: rounded(name, column) for name, column in values.items()} | {
        "valid": track.valid[use],
        "diverged": track.diverged[use],
        "reason": np.zeros(len(use), dtype=np.int64) if reason is None else reason,
    }


def _covariance(track: StateTrack, use: IntArray) -> FloatArray:
    """Return the covariances [K, 3, 3] of rows; NaN if unknown."""
    return track.covariance[use] if len(track.covariance) == len(track) else np.full((len(use), 3, 3), np.nan)


def _path_message(stamp_ns: int, poses: FloatArray) -> bytes:
    """Return ``nav_msgs/msg/Path`` in little-endian CDR; ``poses`` [N, 3]: x, y (m), yaw (rad)."""
    header = struct.pack("<iII4s", *divmod(stamp_ns, NS_PER_S), len(MAP_FRAME) + 1, MAP_FRAME.encode())
    data = bytearray(header + struct.pack("<I", len(poses)))
    for (x_m, y_m, _), (w, x, y, z) in zip(poses, quat_from_yaw(poses[:, 2]), strict=True):
        data += header
        data += b"\0" * (-len(data) % 8) + struct.pack("<7d", x_m, y_m, 0.0, x, y, z, w)
    return b"\0\1\0\0" + bytes(data)


def _odometry_fields(track: StateTrack, use: IntArray) -> dict[str, NDArray[Any]]:
    zero = np.zeros(len(use))
    names = ("x_m", "y_m", "vx_m_s", "vy_m_s", "yaw_rate_rad_s")
    x_m, y_m, vx_m_s, vy_m_s, yaw_rate_rad_s = (rounded(name, getattr(track, name)[use]) for name in names)
    covariance, full = rounded("covariance", _covariance(track, use)), np.zeros((len(use), 6, 6))
    is_known: BoolArray = np.all(np.isfinite(covariance), axis=(1, 2))  # zeros mean unknown to ROS
    full[:, _PLANAR[:, None], _PLANAR] = np.where(is_known[:, None, None], covariance, 0.0)
    return {
        "pose.pose.position": np.stack([x_m, y_m, zero], axis=1),
        "pose.pose.orientation": rounded("orientation", quat_from_yaw(track.yaw_rad[use])),
        "twist.twist.linear": np.stack([vx_m_s, vy_m_s, zero], axis=1),
        "twist.twist.angular": np.stack([zero, zero, yaw_rate_rad_s], axis=1),
        "twist.covariance": full.reshape(-1, 36),
    }
