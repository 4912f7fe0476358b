"""Reduced logs: what a run reads of a log, written so that a run of it gives the same figures bit for bit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import Drive, read_drive
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.logs.reduced_copy import copy_topics, write_record
from pdhef_logtool.logs.reduced_log import FORMAT, ReducedRecord
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.mapping.frames import holds_fixed_frames
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.version import __version__

if TYPE_CHECKING:
    from pdhef_logtool.logs.columnar_log import ColumnarLog


def slim_log(
    log: LogInput,
    target: Path,
    mapping: Mapping | None,
    options: ReadOptions,
    tell: Callable[[str], None] = lambda _text: None,
) -> ReducedRecord:
    """Write the reduced log of a whole log, and return what is known of the log beside its messages.

    Parameters
    ----------
    mapping : None recognises types. options : of them count those that show how a log is opened and which ground truth
    counts.
    tell : as for :func:`~pdhef_logtool.drive.reading.read_drive`.

    Raises
    ------
    PdhefError : Nothing of the log can be read, it has no messages to keep, the mapping names what it lacks, or the
        file cannot be written.
    """
    whole = replace(options, start=None, end=None)
    with read_drive(replace(log, span_s=None), Car.load(None), mapping, whole, tell=tell) as drive:
        _messages_of(drive)
        for _ in (drive.recorded(),):
            pass
        return write_slim(drive, target)


def write_slim(drive: Drive, target: Path) -> ReducedRecord:
    """Write the reduced log of a drive that was read from start to end, and return its record."""
    log = _messages_of(drive)
    lost, ledgers = log.lost, drive.byte_ledgers  # before the copy, which may look at more than a run does
    record = ReducedRecord(
        format=FORMAT,
        tool=__version__,
        file=drive.file,
        kind=log.kind,
        identity=drive.sha256,
        distro=log.distro,
        intervals=log.recording_span.intervals,
        left_out={topic: dict(by_reason) for topic, by_reason in log.recording_span.left_out.items()},
        topics=log.topics,
        losses=tuple(replace(x, where=drive.without_folder(x.where)) for x in lost),
        byte_ledgers=ledgers,
        metadata=log.metadata(),
        mapped=drive.chosen.to_dict(),
        signals_sha256=drive.signals_sha256,
        truth_sha256=drive.truth_sha256,
    )
    mapping = drive.chosen.mapping
    topics = {*mapping.topics, *(s.topic for named in mapping.estimates.values() for s in named.values())}
    topics |= {t.name for t in log.topics if holds_fixed_frames(t)}
    with McapLogWriter(target, profile="ros1" if log.kind == "rosbag1" else "ros2") as writer:
        copy_topics(writer, log, topics)
        for name, path in zip(drive.chosen.dbc_names, () if mapping.can is None else mapping.can.dbc, strict=True):
            writer.attachment(name, "text/plain", log.definition(path).read_bytes(), 0, 0)
        write_record(writer, record)
    return record


def _messages_of(drive: Drive) -> ColumnarLog:
    log = drive.log.messages
    if log is None:
        raise LogError(
            expected="a log of messages, which a reduced log keeps",
            got=f"a log of kind {drive.log.kind}, which has only columns",
            where=str(drive.path),
            remedy="read the log itself",
        )
    return log
