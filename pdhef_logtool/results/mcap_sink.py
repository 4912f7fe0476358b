"""annotated.mcap: the source log with our topics merged in by log time, or our topics alone (sidecar)."""

from __future__ import annotations

import json
import re
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import astuple
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.container import Attachment, RawChunk
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.source_copy import (
    iterate_attachments,
    iterate_copy,
    iterate_metadata,
    register_channels,
    source_profile,
)
from pdhef_logtool.logs.writer import McapLogWriter, RawMessage, TopicBatch
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.geometry import quat_from_yaw
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.sink import Event, Sink, first_of_slots, rounded
from pdhef_logtool.storage.documents import jsonable

#: Everything below this name in a source log is ours and is replaced.
NAMESPACE = "/pdhef/"
STATE_TYPE = "pdhef_msgs/msg/VehicleStateEstimate"
ODOMETRY_TYPE = "nav_msgs/msg/Odometry"
MAP_FRAME = "map"
BODY_FRAME = "base_link"
METRICS_RECORD = "pdhef.metrics"
REPORT_ATTACHMENT = "report.json"

_STATE_FIELDS = (
    "vx_m_s",
    "vy_m_s",
    "yaw_rate_rad_s",
    "sideslip_rad",
    "ay_m_s2",
    "sideslip_std_rad",
    "network_trust",
    "r_scale",
    "nis",
    "friction",
)
_ODOMETRY_FIELDS = ("x_m", "y_m", "vx_m_s", "vy_m_s", "yaw_rate_rad_s")
#: Places of v_x, v_y and yaw rate among x, y, z and the rotations about x, y, z.
_PLANAR = np.array([0, 1, 5])
#: Of zstd: of rounded numbers level 3 makes 1 % more bytes, level 6 3 % fewer in three times the time.
_LEVEL = 1
#: Between two poses of a track that is not shown first.
_POSE_STEP_NS = 50_000_000
#: Between two states, and poses, of such a track in a long drive that nobody asked for by its name.
LONG_STEP_NS = 200_000_000


def topic_of(estimator: str, what: str) -> str:
    """Return the topic of a track as a legal ROS 2 name: ``/pdhef/phy_ukf/state`` of ``phy-ukf`` and ``state``."""
    token = re.sub(r"[^A-Za-z0-9_]", "_", estimator)
    return f"{NAMESPACE}{'_' if token[:1].isdigit() else ''}{token}/{what}"


class AnnotatedMcapSink(Sink):
    """Writes the annotated log window by window; what the source contains passes through a chunk at a time.

    Sound chunks that contain nothing but what stays are written as they are, others message by message.

    Each track becomes ``state`` (:data:`STATE_TYPE`, every stamp) and ``odometry`` (``nav_msgs/msg/Odometry``, the
    stamps that are valid and have a pose, as the message can state neither; of a track that is not shown first, 20 a
    second). Log and publish time are the scored stamp. Numbers are :func:`~pdhef_logtool.results.sink.rounded`.
    Everything that an earlier annotation left in the source is replaced.

    Parameters
    ----------
    path : where the finished file is.
    source : the log to copy in full; None, or a log without messages, for a sidecar that contains our topics alone.
    names : of the tracks that are written; None: all.
    shown : of the tracks whose pose is written at every stamp; of others every 50 ms. None: all.
    thin : both state and pose of the others are written every :data:`LONG_STEP_NS` alone.
    span_ns : only what of it was recorded in [start, end); None: all of it.

    Raises
    ------
    OutputError : When the file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        source: DriveLog | None,
        names: Container[str] | None = None,
        *,
        shown: Container[str] | None = None,
        thin: bool = False,
        span_ns: tuple[int, int] | None = None,
    ) -> None:
        self._source = None if source is None else source.messages
        self._names, self._shown, self._thin = names, shown, thin
        self._last_ns: dict[str, int] = {}  # of the tracks that are not shown
        self._topics: dict[str, str] = {}
        self._window: dict[str, list[TopicBatch]] = {}
        self._raws: Iterator[RawMessage | RawChunk] = iter(())
        self._next: RawMessage | RawChunk | None = None
        profile = "ros2" if self._source is None else source_profile(self._source)
        self._writer = McapLogWriter(path, profile=profile, level=_LEVEL)
        if self._source is None:
            return
        try:
            channels = register_channels(
                self._writer, self._source, leave_out=lambda topic: topic.startswith(NAMESPACE)
            )
        except BaseException:
            self._writer.abort()
            raise
        self.lost = channels.lost
        self._raws = iterate_copy(self._source, channels, *(span_ns or (None, None)))

    def append(self, track: StateTrack) -> None:
        """Take one track of this window."""
        if self._names is not None and track.name not in self._names:
            return
        if track.name in self._window:
            self._write_window()
        if track.name not in self._topics:
            self._add_topics(track.name)
        stated = posed = np.arange(len(track))
        if len(track) and self._shown is not None and track.name not in self._shown:
            step_ns = LONG_STEP_NS if self._thin else _POSE_STEP_NS
            posed = first_of_slots(track.stamps_ns, step_ns, self._last_ns.get(track.name))
            self._last_ns[track.name] = int(track.stamps_ns[-1])
            stated = posed if self._thin else stated
        is_finite = track.valid & np.isfinite(track.x_m) & np.isfinite(track.y_m) & np.isfinite(track.yaw_rad)
        self._window[track.name] = [_state_batch(track, stated), _odometry_batch(track, posed[is_finite[posed]])]

    def finish(self, report: Mapping[str, Any], events: Sequence[Event] = ()) -> None:  # noqa: ARG002
        """Write what is left of the source, the metrics record and report.json, and give the file its name."""
        try:
            self._write_window()
            self._writer.write([], raws=self._raws_before(None))
            if self._source is not None:
                for attachment in iterate_attachments(self._source):
                    if not _is_our_report(attachment):
                        self._writer.attachment(*astuple(attachment))
                for record in iterate_metadata(self._source):
                    if record.name != METRICS_RECORD:
                        self._writer.metadata(record.name, record.metadata)
            self._writer.metadata(METRICS_RECORD, metrics_record(report))
            end_ns = int(report["log"]["end_ns"])
            text = json.dumps(jsonable(report), sort_keys=True, separators=(",", ":"), allow_nan=False)
            self._writer.attachment(REPORT_ATTACHMENT, "application/json", text.encode(), end_ns, end_ns)
            self._writer.close()
        except BaseException:
            self.abort()
            raise

    def abort(self) -> None:
        """Remove what was written."""
        self._writer.abort()

    def _add_topics(self, estimator: str) -> None:
        state, odometry = topic_of(estimator, "state"), topic_of(estimator, "odometry")
        if state in self._topics.values():
            raise OutputError(expected="estimators with different topics", got=estimator, where=state)
        self._writer.add_topic(state, STATE_TYPE, constants={"header.frame_id": BODY_FRAME})
        frames = {"header.frame_id": MAP_FRAME, "child_frame_id": BODY_FRAME}
        self._writer.add_topic(odometry, ODOMETRY_TYPE, constants=frames)
        self._topics[estimator] = state

    def _write_window(self) -> None:
        batches = [batch for pair in self._window.values() for batch in pair]
        self._window.clear()
        ends = [int(b.log_time_ns[-1]) + 1 for b in batches if len(b.log_time_ns)]
        if ends:
            self._writer.write(batches, raws=self._raws_before(max(ends)))

    def _raws_before(self, end_ns: int | None) -> Iterator[RawMessage | RawChunk]:
        while True:
            raw = self._next if self._next is not None else next(self._raws, None)
            self._next = None
            if raw is None:
                return
            at_ns = raw.start_ns if isinstance(raw, RawChunk) else raw.log_time_ns
            if end_ns is not None and at_ns >= end_ns:
                self._next = raw
                return
            yield raw


def metrics_record(report: Mapping[str, Any]) -> dict[str, str]:
    """Return the figures as ``estimator/signal/segment/metric`` → ``value unit n=samples`` (``null``: not computable).

    ``log``, ``truth`` (``available``, ``no truth``) and ``estimator/algorithm`` (what ran, as JSON) are beside them.
    """
    record = {
        "log": str(report["log"]["name"]),
        "truth": "available" if report["truth"]["available"] else "no ground truth",
    }
    for e in report["estimators"]:
        if e["algorithm"] is not None:
            record[f"{e['name']}/algorithm"] = json.dumps(e["algorithm"], sort_keys=True)
    for m in report["metrics"]:
        value = "null" if m["value"] is None else repr(float(m["value"]))
        record[f"{m['estimator']}/{m['signal']}/{m['segment']}/{m['metric']}"] = f"{value} {m['unit']} n={m['n']}"
    return record


def _is_our_report(attachment: Attachment) -> bool:
    """Return whether an attachment is our report.json, not somebody else's of the same name."""
    if attachment.name != REPORT_ATTACHMENT:
        return False
    try:
        document = json.loads(attachment.data)
    except (ValueError, RecursionError):
        return False
    return isinstance(document, dict) and document.get("format") == "pdhef.report"


def _state_batch(track: StateTrack, use: IntArray) -> TopicBatch:
    stamps_ns = track.stamps_ns[use]
    n = len(stamps_ns)
    none: FloatArray = np.full(n, np.nan)
    covariance = np.full((n, 9), np.nan)
    if track.covariance.shape[0] == len(track):
        covariance = track.covariance[use].reshape(n, 9)
    has_mixture, has_reason = (len(c) == len(track) for c in (track.mixture_weight, track.reason))
    values = {name: getattr(track, name)[use] for name in _STATE_FIELDS}
    values |= {"covariance": covariance, "mixture_weight": track.mixture_weight[use] if has_mixture else none}
    fields: dict[str, NDArray[Any]] = {name: rounded(name, column) for name, column in values.items()}
    fields |= {
        "header.stamp": stamps_ns,
        "valid": track.valid[use],
        "diverged": track.diverged[use],
        "reason": track.reason[use] if has_reason else np.zeros(n, dtype=np.int64),
    }
    return TopicBatch(topic_of(track.name, "state"), stamps_ns, stamps_ns, fields)


def _odometry_batch(track: StateTrack, use: IntArray) -> TopicBatch:
    stamps_ns = track.stamps_ns[use]
    n = len(stamps_ns)
    zero = np.zeros(n)
    x_m, y_m, vx_m_s, vy_m_s, yaw_rate_rad_s = (rounded(c, getattr(track, c)[use]) for c in _ODOMETRY_FIELDS)
    covariance = track.covariance[use] if track.covariance.shape[0] == len(track) else np.empty((0, 3, 3))
    fields = {
        "header.stamp": stamps_ns,
        "pose.pose.position": np.stack([x_m, y_m, zero], axis=1),
        "pose.pose.orientation": rounded("orientation", quat_from_yaw(track.yaw_rad[use])),
        "twist.twist.linear": np.stack([vx_m_s, vy_m_s, zero], axis=1),
        "twist.twist.angular": np.stack([zero, zero, yaw_rate_rad_s], axis=1),
        "twist.covariance": _twist_covariance(rounded("covariance", covariance), n),
    }
    return TopicBatch(topic_of(track.name, "odometry"), stamps_ns, stamps_ns, fields)


def _twist_covariance(covariance: FloatArray, n: int) -> FloatArray:
    """Place [N, 3, 3] over v_x, v_y, r into [N, 36]; all zero, ROS's sign for unknown, where it is not known."""
    full = np.zeros((n, 6, 6))
    if covariance.shape[0]:
        is_finite: BoolArray = np.all(np.isfinite(covariance), axis=(1, 2))
        full[:, _PLANAR[:, None], _PLANAR] = np.where(is_finite[:, None, None], covariance, 0.0)
    return full.reshape(n, 36)
