"""A reduced log: the topics that a run reads of a log, in one small MCAP that replaces it.

Messages are kept byte for byte, so that all results are bit-equal. A metadata record describes the source: when it was
recorded, its losses, its other topics, and the mapping that was used. Each chunk contains one topic, so that reading a
topic reads no other bytes.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mcap.opcode import Opcode

from pdhef_logtool.logs.columnar_log import ColumnarLog
from pdhef_logtool.logs.container import MAX_TIME_NS, MCAP_MAGIC, Container
from pdhef_logtool.logs.drive_log import TopicInfo
from pdhef_logtool.logs.mcap_index import FOOTER
from pdhef_logtool.logs.mcap_log import McapContainer
from pdhef_logtool.logs.recording_span import RecordingSpan
from pdhef_logtool.logs.remote_place import LogPlace
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.records.version import LIBRARY

#: Of the record's content; another one is not read.
FORMAT = 2
#: Name of the MCAP metadata record, and of its one entry.
RECORD_NAME, RECORD_ENTRY = "pdhef_slim", "json"
#: Opcode, size; CRC of all before it.
_DATA_END = struct.Struct("<BQI")
_LONGEST_NS = 366 * 86_400_000_000_000
#: Losses that come up again when the kept messages are read.
_FOUND_AGAIN = frozenset({"undecodable", "bad-schema"})
_EXPECTED = f"a reduced log of format {FORMAT}"
_REMEDY = "delete it; pdhef run LOG --cache DIR writes it again"


@dataclass(frozen=True, slots=True)
class ReducedRecord:
    """Description of the source of a reduced log.

    Attributes
    ----------
    file, kind, identity : name, format and identity of the source. tool : version that wrote this.
    distro : ROS distribution of types that the source does not define.
    intervals, left_out : of its :class:`RecordingSpan`. topics : all of them with their messages, kept or not.
    losses : complete, as after a run of the whole source. size : bytes of the source.
    metadata : of the source. mapped : the mapping, as the package ``drive`` writes it.
    signals_sha256, truth_sha256 : hashes of the mapped channels.
    """

    format: int
    tool: str
    file: str
    kind: str
    identity: str
    distro: str
    intervals: tuple[tuple[int, int], ...]
    left_out: dict[str, dict[str, int]]
    topics: tuple[TopicInfo, ...]
    losses: tuple[Loss, ...]
    size: int
    metadata: dict[str, str]
    mapped: dict[str, Any]
    signals_sha256: str | None
    truth_sha256: str | None


class ReducedLog(ColumnarLog):
    """Reads like its source; a topic that was not kept has its number of messages, but no fields.

    Attributes
    ----------
    record : description of the source.
    """

    def __init__(self, path: LogPlace, container: Container, record: ReducedRecord) -> None:
        super().__init__(path, record.kind, [container], distro=record.distro)
        self.record = record
        self._recording_span = RecordingSpan(record.intervals, left_out=record.left_out)

    @property
    def index(self) -> None:
        """None: the log is small, and its index is not that of its source."""
        return None

    @property
    def reduced(self) -> ReducedLog:
        """The log itself."""
        return self

    def metadata(self) -> dict[str, str]:
        """Return the metadata of the source."""
        return dict(self.record.metadata)

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        """All topics of the source by name."""
        return self.record.topics

    @property
    def lost(self) -> tuple[Loss, ...]:
        """Losses of the source and of this file."""
        return (*self.record.losses, *(x for x in super().lost if x.kind not in _FOUND_AGAIN))

    @property
    def size(self) -> int:
        """Bytes of the source."""
        return self.record.size

    def attached(self, name: str) -> Path:
        """Return a file that was attached, to be read until the log is closed; raises LogError where there is none."""
        attachment = next((a for c in self.containers for a in c.attachments() if a.name == name), None)
        if attachment is None:
            raise LogError(expected=_EXPECTED, got=f"none with its {name}", where=str(self.path), remedy=_REMEDY)
        return self._extract(name, attachment.data)


def reduced_record(container: Container) -> ReducedRecord | None:
    """Return the record of a reduced log; None for any other file.

    Raises
    ------
    LogError : it is one that this version cannot read.
    """
    if not isinstance(container, McapContainer) or not container.library.startswith(LIBRARY.partition(" ")[0]):
        return None
    text = next((m.metadata.get(RECORD_ENTRY) for m in container.metadata_records() if m.name == RECORD_NAME), None)
    if text is None:
        return None
    from pydantic import TypeAdapter, ValidationError

    try:
        record = TypeAdapter(ReducedRecord).validate_json(text)
    except ValidationError as error:
        got = "; ".join(f"{'.'.join(map(str, e['loc']))}: {e['msg']}" for e in error.errors()[:3])
        raise LogError(expected=_EXPECTED, got=got, where=str(container.path), remedy=_REMEDY) from error
    if record.format != FORMAT:
        got = f"format {record.format} of version {record.tool}"
        raise LogError(expected=_EXPECTED, got=got, where=str(container.path), remedy=_REMEDY)
    edges = [ns for interval in record.intervals for ns in interval]
    lasts = sum(end - start for start, end in record.intervals)
    if edges != sorted(edges) or not all(-MAX_TIME_NS <= ns <= MAX_TIME_NS + 1 for ns in edges) or lasts > _LONGEST_NS:
        raise LogError(expected=_EXPECTED, got="times that no log has", where=str(container.path), remedy=_REMEDY)
    return record


def is_whole(path: Path) -> bool:
    """Return, by its checksums, whether a file that our writer wrote is as it was written."""
    data = path.read_bytes()
    foot = len(data) - FOOTER.size - len(MCAP_MAGIC)
    if foot < _DATA_END.size or not data.endswith(MCAP_MAGIC):
        return False
    opcode, _, summary, _, summary_crc = FOOTER.unpack_from(data, foot)
    if opcode != Opcode.FOOTER or not _DATA_END.size <= summary <= foot:
        return False
    end, _, data_crc = _DATA_END.unpack_from(data, summary - _DATA_END.size)
    view = memoryview(data)
    checked = zlib.crc32(view[: summary - _DATA_END.size]), zlib.crc32(view[summary : foot + FOOTER.size - 4])
    return bool(end == Opcode.DATA_END and checked == (data_crc, summary_crc))
