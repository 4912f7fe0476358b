"""Records of a mapping: source of each signal of a log, and its conversion to SI."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal, TypeAlias

from pdhef_logtool.records.checks import Check
from pdhef_logtool.storage.documents import digest, jsonable

#: Number of columns of the truth channels that are vectors; all other signals are scalars.
VECTOR_COLUMNS: dict[str, int] = {"ecef_position_m": 3, "ecef_velocity_m_s": 3, "enu_velocity_m_s": 3, "quat_wxyz": 4}

StampUnit: TypeAlias = Literal["ros", "s", "ms", "us", "ns"]
Clock: TypeAlias = Literal["utc", "device"]
Combine: TypeAlias = Literal["sum", "norm", "root", "signed"]

#: Encoding of a frame's bytes in a message: numbers, or digits as text.
CanDataEncoding: TypeAlias = Literal["bytes", "hex", "base64"]

#: Prefix of a field that names a signal of a DBC: ``can:<message>.<signal>``.
CAN_PREFIX = "can:"

#: Values of ``stamp`` for the recorder's times instead of a field of the message.
RECORDER_STAMPS = ("log_time", "publish_time")
#: Default of ``stamp``: the message's header.stamp or stamp if its schema has one, else log time.
AUTO_STAMP = "auto"


def near(name: str, names: Sequence[str], cutoff: float = 0.3) -> str:
    """Return the nearest of these names as a question for a message; empty if none is near."""
    close = get_close_matches(name, names, n=1, cutoff=cutoff)
    return f" (did you mean {close[0]}?)" if close else ""


@dataclass(frozen=True, slots=True)
class SignalSource:
    """Source of one signal: ``value_SI = scale * raw + offset``, measured at ``stamp - latency_s``.

    A scalar signal of several fields is their weighted sum, one scale per field: a component of a sensor with rotated
    axes. Other values of ``combine``: ``norm``, the length of the vector (a speed from components); ``root``, the root
    of the sum (a standard deviation from variances); ``signed``, a magnitude that is negative where the second field,
    its sign, is 1.

    Attributes
    ----------
    name : signal or ground truth name, a key of ``SIGNAL_UNITS`` or ``TRUTH_UNITS``.
    topic : topic name.
    field : dotted path; ``[3]`` indexes an array. A tuple of paths gives the columns of a vector signal, or the
        summands of a scalar one.
    stamp : dotted path of the measurement time, ``log_time``, ``publish_time``, or ``auto``.
    scale, offset : raw unit to SI; a tuple has one entry per column of a vector signal, a scale also one per summand.
    latency_s : delay of the stamp after the measurement.
    valid_min, valid_max : SI values outside are dropped and counted.
    stamp_unit : ``ros`` (a struct of seconds and nanoseconds) or the unit of a number.
    clock : ``utc`` for stamps on the log's clock; ``device`` to fit offset and drift to log time.
    """

    name: str
    topic: str
    field: str | tuple[str, ...]
    stamp: str = AUTO_STAMP
    scale: float | tuple[float, ...] = 1.0
    offset: float | tuple[float, ...] = 0.0
    latency_s: float = 0.0
    valid_min: float | None = None
    valid_max: float | None = None
    stamp_unit: StampUnit = "ros"
    clock: Clock = "utc"
    combine: Combine = "sum"

    @property
    def paths(self) -> tuple[str, ...]:
        """The field paths of the signal."""
        return self.field if isinstance(self.field, tuple) else (self.field,)

    @property
    def can_signal(self) -> tuple[str, str] | None:
        """Message and signal of the DBC, for a CAN source."""
        if not isinstance(self.field, str) or not self.field.startswith(CAN_PREFIX):
            return None
        message, _, signal = self.field.removeprefix(CAN_PREFIX).partition(".")
        return message, signal

    @property
    def read_topic(self) -> str:
        """Topic to read the source from; for a CAN signal the view that contains only its frames."""
        return self.topic if self.can_signal is None else self.label

    @property
    def label(self) -> str:
        """``/topic.field``, for texts and ``Channel.source``; sums of the same fields differ by name."""
        if isinstance(self.field, str):
            return f"{self.topic}.{self.field}"
        return f"{self.topic}.{'' if self.columns > 1 else self.name}{{{','.join(self.field)}}}"

    @property
    def columns(self) -> int:
        """Number of columns of the signal's values; 1 for a scalar."""
        return VECTOR_COLUMNS.get(self.name, 1)


@dataclass(frozen=True, slots=True)
class CanSettings:
    """Settings for reading raw CAN frames.

    Attributes
    ----------
    dbc : the files that describe the frames.
    id_field, data_field, length_field, extended_field : paths in the messages that contain frames; empty: search by
        name.
    data_encoding : encoding of the bytes in ``data_field``.
    bus_field, bus : if both are set, frames of other buses are ignored.
    id_mask : bits of the identifier that distinguish messages; all 29 by default.
    """

    dbc: tuple[Path, ...]
    id_field: str = ""
    data_field: str = ""
    data_encoding: CanDataEncoding = "bytes"
    length_field: str = ""
    extended_field: str = ""
    bus_field: str = ""
    bus: int | None = None
    id_mask: int = (1 << 29) - 1


@dataclass(frozen=True, slots=True)
class QualityGate:
    """Condition for the use of ground truth: the field is in [``min``, ``max``] or one of ``values``."""

    topic: str
    field: str
    min: float | None = None
    max: float | None = None
    values: tuple[float, ...] = ()
    stamp: str = AUTO_STAMP
    stamp_unit: StampUnit = "ros"
    clock: Clock = "utc"
    latency_s: float = 0.0

    def as_source(self) -> SignalSource:
        """Return the gate's field as a source that can be read like a signal."""
        timing: dict[str, Any] = {n: getattr(self, n) for n in ("stamp", "stamp_unit", "clock", "latency_s")}
        return SignalSource("truth_quality", self.topic, self.field, **timing)

    def describe(self) -> str:
        """Return the gate's condition in words."""
        parts = []
        if self.min is not None or self.max is not None:
            low = "-inf" if self.min is None else f"{self.min:g}"
            high = "inf" if self.max is None else f"{self.max:g}"
            parts.append(f"in [{low}, {high}]")
        if self.values:
            parts.append("one of " + ", ".join(f"{v:g}" for v in self.values))
        return f"{self.topic}.{self.field} " + " or ".join(parts)


@dataclass(frozen=True, slots=True)
class Mapping:
    """All sources of a log by signal name.

    Attributes
    ----------
    signals, truth : by name; inputs of estimators, and ground truth for scoring.
    quality : gate on ground truth, if any.
    origin : ``file`` or ``auto`` (recognised types).
    notes : sentences about this mapping for the report.
    can : settings for raw CAN frames, for sources with a field ``can:<message>.<signal>``.
    estimates : estimates recorded by other programs, by estimator and quantity (``ESTIMATE_UNITS``). Only ``pdhef
        metrics`` reads them; :meth:`sources` excludes them.
    fill_recognised : recognised types provide the signals that the file lacks.
    checks : undecided checks of fields that were taken by their names.
    open_signs : groups of signals (ground truth: ``truth.NAME``) with an undocumented common sign.
    file : name of the file. recorder : type by topic of the logs that it is for.
    recorders : the mappings of a folder; each log uses the one that fits its recorder.
    rate_hz, group : of logs of tables (:class:`~pdhef_logtool.logs.table_file.TableSettings`).
    """

    signals: dict[str, SignalSource] = field(default_factory=dict)
    truth: dict[str, SignalSource] = field(default_factory=dict)
    quality: QualityGate | None = None
    origin: Literal["file", "auto"] = "file"
    notes: tuple[str, ...] = ()
    can: CanSettings | None = None
    estimates: dict[str, dict[str, SignalSource]] = field(default_factory=dict)
    fill_recognised: bool = False
    checks: tuple[Check, ...] = ()
    open_signs: tuple[tuple[str, ...], ...] = ()
    file: str = field(default="", compare=False, repr=False)
    recorder: tuple[tuple[str, str], ...] = ()
    recorders: "tuple[Mapping, ...]" = ()
    rate_hz: float | None = None
    group: str = ""

    @property
    def dbc(self) -> tuple[Path, ...]:
        """All DBC files of the mapping."""
        mine = () if self.can is None else self.can.dbc
        return (*mine, *(path for mapping in self.recorders for path in mapping.dbc))

    @property
    def sha256(self) -> str:
        """Hash of all sources with their scales, stamps, latencies and limits, and of the ground-truth gate."""
        tables = {name: value for name in ("rate_hz", "group") if (value := getattr(self, name))}
        return digest(jsonable({"signals": self.signals, "truth": self.truth, "quality": self.quality, **tables}))

    def changed(self, change: Callable[[SignalSource], SignalSource]) -> "Mapping":
        """Return the mapping with the result of ``change`` for each source of a signal or of ground truth."""
        return self.with_sources({name: change(source) for name, source in self.by_subject.items()})

    def sources(self) -> Iterator[SignalSource]:
        """Yield every source: signals, ground truth, the gate."""
        yield from self.signals.values()
        yield from self.truth.values()
        if self.quality is not None:
            yield self.quality.as_source()

    @property
    def by_subject(self) -> dict[str, SignalSource]:
        """Signals by name, and ground truth by ``truth.NAME``."""
        return {**self.signals, **{f"truth.{name}": source for name, source in self.truth.items()}}

    def with_sources(self, changed: dict[str, SignalSource], notes: Iterable[str] = ()) -> "Mapping":
        """Return the mapping with other sources, named as in :attr:`by_subject`, and further notes."""
        every = self.by_subject | changed
        truth = {n.removeprefix("truth."): s for n, s in every.items() if n.startswith("truth.")}
        signals = {n: s for n, s in every.items() if not n.startswith("truth.")}
        return replace(self, signals=signals, truth=truth, notes=(*self.notes, *notes))

    @property
    def topics(self) -> tuple[str, ...]:
        """Names of the topics that the mapping reads, sorted."""
        return tuple(sorted({s.topic for s in self.sources()}))
