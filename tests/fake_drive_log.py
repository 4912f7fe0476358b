"""A log in memory with the reader's protocol, to test code that reads logs without files."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.drive_log import Columns, DriveLog, Requests, TopicInfo
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.logs.recording_span import RecordingSpan
from pdhef_logtool.records.signals import IntArray, Loss


@dataclass
class FakeTopic:
    type_name: str
    log_time_ns: IntArray
    fields: dict[str, NDArray]
    publish_time_ns: IntArray | None = None
    encoding: str = "cdr"
    examples: tuple[object, ...] = ()


@dataclass
class FakeLog(DriveLog):
    contents: dict[str, FakeTopic]
    path: Path = Path("memory.mcap")
    kind: str = "mcap"
    size: int = 0
    lost: tuple[Loss, ...] = ()
    reads: list[dict[str, list[str]]] = field(default_factory=list)

    @property
    def topics(self) -> tuple[TopicInfo, ...]:
        return tuple(
            TopicInfo(name, t.type_name, t.encoding, len(t.log_time_ns)) for name, t in sorted(self.contents.items())
        )

    @property
    def start_ns(self) -> int:
        return min((int(t.log_time_ns.min()) for t in self.contents.values() if len(t.log_time_ns)), default=0)

    @property
    def end_ns(self) -> int:
        return max((int(t.log_time_ns.max()) + 1 for t in self.contents.values() if len(t.log_time_ns)), default=0)

    @cached_property
    def recording_span(self) -> RecordingSpan:
        return RecordingSpan(((self.start_ns, self.end_ns),) if self.end_ns else ())

    def fields(self, topic: str, *, quiet: bool = False) -> tuple[FieldInfo, ...]:
        out = []
        for path, values in self.contents[topic].fields.items():
            if values.dtype == object:
                out.append(FieldInfo(path, "string"))
            elif values.dtype == np.int64 and path.endswith("stamp"):
                out.append(FieldInfo(path, "time"))
            elif values.ndim == 2:
                out += [FieldInfo(f"{path}[{i}]", "number") for i in range(values.shape[1])]
            else:
                out.append(FieldInfo(path, "number"))
        return tuple(out)

    def first_messages(self, topic: str, most: int) -> list[object]:
        return list(self.contents[topic].examples[:most])

    def read(
        self, requests: Requests, start_ns: int | None = None, end_ns: int | None = None, *, quiet: bool = False
    ) -> dict[str, Columns]:
        self.reads.append({t: list(p) for t, p in requests.items()})
        return {name: self._columns(name, paths, start_ns, end_ns) for name, paths in requests.items()}

    def close(self) -> None:
        pass

    def _columns(self, name: str, paths: Sequence[str], start_ns: int | None, end_ns: int | None) -> Columns:
        topic = self.contents[name]
        order = np.argsort(topic.log_time_ns, kind="stable")
        times = topic.log_time_ns[order]
        low = 0 if start_ns is None else int(np.searchsorted(times, start_ns))
        high = len(times) if end_ns is None else int(np.searchsorted(times, end_ns))
        pick = order[low:high]
        publish = topic.log_time_ns if topic.publish_time_ns is None else topic.publish_time_ns
        return Columns(
            topic=name,
            log_time_ns=topic.log_time_ns[pick],
            publish_time_ns=publish[pick],
            fields={p: self._field(topic, p)[pick] for p in paths},
        )

    def _field(self, topic: FakeTopic, path: str) -> NDArray:
        if path in topic.fields:
            return topic.fields[path]
        if path.endswith("]"):
            base, index = path[:-1].split("[")
            if base in topic.fields and int(index) < topic.fields[base].shape[1]:
                return topic.fields[base][:, int(index)]
        return np.full(len(topic.log_time_ns), np.nan)
