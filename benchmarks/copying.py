"""A full annotated copy of the one-hour log: two estimators and the source, whose chunks are copied unchanged.

Peers: the same copy with every message of the source read and compressed again by our writer, and reader and Writer of
mcap copying the source alone (a tenth, scaled by 10).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.measuring import CACHE, Row, best_seconds
from benchmarks.one_hour_log import HOUR_S, START_NS, hour_log
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.source_copy import iterate_copy, register_channels
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.results.mcap_sink import AnnotatedMcapSink

_SLICE = 10
_SLICE_END_NS = START_NS + HOUR_S // _SLICE * 10**9
_WINDOW_S = 60
_REPORT = {"log": {"name": "hour", "end_ns": START_NS}, "truth": {"available": False}, "metrics": [], "estimators": []}


def _track(name: str, begin_s: int) -> StateTrack:
    stamps_ns = START_NS + begin_s * 10**9 + np.arange(_WINDOW_S * 100, dtype=np.int64) * 10_000_000
    t = np.asarray((stamps_ns - START_NS) * 1e-9, dtype=np.float64)
    return make_track(
        name, stamps_ns, vx_m_s=20.0 + np.sin(t), vy_m_s=0.1 * np.sin(t), yaw_rate_rad_s=0.2 * np.cos(t),
        x_m=20.0 * t, y_m=np.sin(t), yaw_rad=0.1 * np.sin(t),
    )  # fmt: skip


def annotate(path: Path) -> None:
    """Write the annotated copy as a run does."""
    log = open_log(path)
    sink = AnnotatedMcapSink(CACHE / "annotated.mcap", log)
    for begin_s in range(0, HOUR_S, _WINDOW_S):
        for name in ("pd-hef", "phy-ukf"):
            sink.append(_track(name, begin_s))
    sink.finish(_REPORT)
    log.close()


def copy_ours(path: Path, whole: bool, end_ns: int | None = None) -> None:
    """Copy the source alone, by chunks or by messages."""
    log = open_log(path).messages
    assert log is not None
    with McapLogWriter(CACHE / "copy.mcap") as writer:
        channels = register_channels(writer, log)
        writer.write([], iterate_copy(log, channels, None, end_ns, whole=whole))
    log.close()


def copy_with_mcap(path: Path, end_ns: int) -> None:
    """Copy the source with mcap's reader and Writer."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    with path.open("rb") as file, (CACHE / "copy_peer.mcap").open("wb") as out:
        reader, writer = make_reader(file, validate_crcs=True), Writer(out)
        writer.start(profile="ros2", library="peer")
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages(ending_before=end_ns):
            if channel.id not in channels:
                id_ = writer.register_schema(schema.name, schema.encoding, schema.data) if schema else 0
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, id_)
            to = channels[channel.id]
            writer.add_message(to, message.log_time, message.data, message.publish_time, message.sequence)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it without types


def rows() -> list[Row]:
    """Measure."""
    path = hour_log()
    ways = {
        "annotate": lambda: annotate(path),
        "chunks": lambda: copy_ours(path, whole=True),
        "messages": lambda: copy_ours(path, False, _SLICE_END_NS),
        "mcap": lambda: copy_with_mcap(path, _SLICE_END_NS),
    }
    seconds = best_seconds(ways)
    chunks, messages, mcap = seconds["chunks"], _SLICE * seconds["messages"], _SLICE * seconds["mcap"]
    peers = {"message by message": messages / chunks, "mcap": mcap / chunks}
    return [
        Row("full annotated copy (1.26 M + 1.44 M messages)", seconds["annotate"], "s"),
        Row("the source alone, chunks as they are", chunks, "s", peers=peers),
    ]
