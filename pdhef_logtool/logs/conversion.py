"""Any log as an MCAP: messages as they are, columns of tables as ROS 2 messages of a type for each topic.

The type contains a field for each column, with the unit of the source in its comment, which reading takes up again.
"""

import re
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo, windows
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, ResourceLimits
from pdhef_logtool.logs.source_copy import iterate_copy, register_channels, source_profile
from pdhef_logtool.logs.table_columns import field_name, unique
from pdhef_logtool.logs.table_file import NO_SETTINGS, TableSettings
from pdhef_logtool.logs.writer import McapLogWriter
from pdhef_logtool.records.errors import LogError, OutputError
from pdhef_logtool.records.signals import NS_PER_S, Loss

_WINDOW_NS = 60 * NS_PER_S
_PACKAGE = "recorded_tables"
_DATA = re.compile(r"data\[(\d+)\]")


def convert_log(
    place: LogPlace,
    output: Path,
    limits: ResourceLimits = DEFAULT_LIMITS,
    msgs: Path | None = None,
    settings: TableSettings = NO_SETTINGS,
) -> tuple[tuple[Loss, ...], int]:
    """Write a log as an MCAP, complete or not at all; return its losses and the number of messages.

    Raises
    ------
    OutputError : the file exists or cannot be written. LogError : the log cannot be opened.
    """
    if output.exists():
        remedy = "remove it or name another"
        raise OutputError(expected="a new file", got="one that exists", where=str(output), remedy=remedy)
    with closing(open_log(place, limits, msgs, settings=settings)) as log:
        source = log.messages
        if log.start_ns < 0:
            raise LogError(expected="log times from 1970 on", got=f"{log.start_ns} ns", where=str(place))
        with McapLogWriter(output, profile="ros2" if source is None else source_profile(source)) as writer:
            if source is None:
                _write_tables(writer, log)
            else:
                channels = register_channels(writer, source)
                writer.write([], raws=iterate_copy(source, channels))
                for attachment in source.attachments():
                    writer.attachment(attachment)
                for record in source.metadata_records():
                    writer.metadata(record.name, record.metadata)
        return log.lost, sum(topic.messages for topic in log.topics)


def _write_tables(writer: McapLogWriter, log: DriveLog) -> None:
    columns: dict[str, dict[str, str]] = {}
    for topic in log.topics:
        fields = [f for f in log.fields(topic.name) if f.kind == "number" and not _DATA.fullmatch(f.path)]
        names = unique(field_name(f.path) for f in fields)
        lines = [f"float64 {n}" + f"  # [{f.unit}]" * bool(f.unit) for n, f in zip(names, fields, strict=True)]
        columns[topic.name] = {f.path: name for name, f in zip(names, fields, strict=True)}
        if width := sum(bool(_DATA.fullmatch(f.path)) for f in log.fields(topic.name)):
            lines.append(f"uint8[{width}] data")
            columns[topic.name]["data"] = "data"
        writer.add_topic(topic.name, _type_of(topic), definition="\n".join(lines))
    for start_ns, end_ns in windows(log.start_ns, log.end_ns, _WINDOW_NS, log.recording_span):
        read = log.read({topic: tuple(paths) for topic, paths in columns.items()}, start_ns, end_ns)
        renamed = {t: {name: _stored(read[t].fields[path]) for path, name in its.items()} for t, its in columns.items()}
        writer.write([replace(rows, fields=renamed[topic]) for topic, rows in read.items()])


def _stored(values: NDArray[Any]) -> NDArray[Any]:
    """Return a column, or bytes [N, k] with zeros behind the length of a frame."""
    return values if values.ndim == 1 else np.nan_to_num(values).astype(np.uint8)


def _type_of(topic: TopicInfo) -> str:
    if topic.type_name:
        return topic.type_name
    name = "".join(part[:1].upper() + part[1:] for part in field_name(topic.name).split("_"))
    return f"{_PACKAGE}/msg/{name}"
