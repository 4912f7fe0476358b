"""Logs of tables as a whole."""

import io
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, ResourceLimits
from pdhef_logtool.logs.table_file import TableFile, Tables, TableSettings
from pdhef_logtool.records.signals import IntArray, Loss


@dataclass
class Contents:
    """Messages and stamps by topic, units and columns by field."""

    kind: str
    topics: dict[str, int]
    stamps_ns: dict[str, IntArray]
    units: dict[str, str]
    columns: dict[str, NDArray[Any]]
    lost: tuple[Loss, ...]

    @property
    def counts(self) -> list[tuple[str, int | None]]:
        return [(loss.kind, loss.count) for loss in self.lost]

    def what(self, severity: str = "lost") -> str:
        return "; ".join(f"{loss.where}: {loss.what}" for loss in self.lost if loss.severity == severity)


def opened(path: Path, data: bytes | str | None = None, **settings: Any) -> Contents:
    """Open a log, after ``data`` are written to it."""
    if data is not None:
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(data.encode() if isinstance(data, str) else data)
    with closing(open_log(path, settings=TableSettings(**settings))) as log:
        fields = {topic.name: log.fields(topic.name) for topic in log.topics}
        read = log.read({name: [f.path for f in its] for name, its in fields.items()})
        units = {f.path: f.unit for its in fields.values() for f in its}
        columns = {path: values for its in read.values() for path, values in its.fields.items()}
        stamps = {name: its.log_time_ns for name, its in read.items()}
        topics = {t.name: t.messages for t in log.topics}
        return Contents(log.kind, topics, stamps, units, columns, log.lost)


def parsed(
    reader: Callable[[TableFile], Tables], file: bytes | Path, limits: ResourceLimits = DEFAULT_LIMITS
) -> Contents:
    """Read a file in this process."""
    with file.open("rb") if isinstance(file, Path) else io.BytesIO(file) as stream:
        size = stream.seek(0, io.SEEK_END)
        stream.seek(0)
        read = reader(TableFile(stream, size, "a", limits))
        stamps = {t.name: t.stamps_ns for t in read.tables}
        fields = [(f, t) for t in read.tables for f in t.fields]
        columns = {f.path: t.load(f.path, slice(0, len(t.stamps_ns))) for f, t in fields}
    topics = {name: len(its) for name, its in stamps.items()}
    return Contents(read.kind, topics, stamps, {f.path: f.unit for f, _ in fields}, columns, tuple(read.losses))
