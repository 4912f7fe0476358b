"""What a metric is: a record that one file of this package exports, its function, and the row of its figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol, TypeAlias, TypeVar

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.evaluation.blocks import HeldRows, SegmentMasks, SegmentSums, packed, row_blocks
from pdhef_logtool.evaluation.track_errors import scorable
from pdhef_logtool.evaluation.units import SCORED_SIGNALS, SIGNALS, read_unit
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack

ALL = "all"
_T = TypeVar("_T")
#: A figure and the number of samples behind it.
Figure: TypeAlias = tuple[float, int]


@dataclass(frozen=True, slots=True)
class MetricRow:
    """One figure. The first eight fields and ``algorithm`` are the columns of metrics.parquet.

    ``algorithm`` is the digest of what ran under the estimator's name; empty where nobody has (recorded estimates).

    ``independent`` is False when ground truth of this signal is one of the estimators' inputs; tables and rankings
    leave such rows out. In the file a row with metric ``not_independent`` shows it for its estimator and signal.
    """

    log: str
    estimator: str
    signal: str
    segment: str
    metric: str
    value: float
    unit: str
    n: int
    independent: bool = True
    algorithm: str = ""


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric, as its file registers it; every output derives from this record what it needs.

    Attributes
    ----------
    name : in metrics.parquet and plans.
    label : head of a column, without the unit.
    definition : one or two sentences for the documentation and for pages.
    function : computes the figures; metrics that share a computation share the function. None: the scoring sets it.
    best : ``lower``, ``higher``, the value at which it is best, or None where no value is better than another.
    unit : of its figures; None: that of the signal.
    digits : decimal places in the terminal, in the unit that people read.
    terminal : signals whose figure has a column in the terminal's table; narrow terminals leave it out.
    brief : signals whose figure the report.json of a run with ``--keep metrics`` retains.
    """

    name: str
    label: str
    definition: str
    function: OfSignal | OfTrack | OfDrive | None
    best: Literal["lower", "higher"] | float | None = None
    unit: str | None = None
    digits: int = 3
    terminal: tuple[str, ...] = ()
    brief: tuple[str, ...] = ()

    def unit_of(self, signal: str) -> str:
        """Return the unit of its figures of a signal in metrics.parquet."""
        return SIGNALS[signal] if self.unit is None else self.unit

    def head(self, signal: str | None = None) -> str:
        """Return the head of a column: the label with the unit that people read; ``signal``: whose unit it may be."""
        unit = self.unit if signal is None else self.unit_of(signal)
        return f"{self.label} {read_unit(unit)[0]}".strip() if unit else self.label

    @property
    def direction(self) -> str:
        """Which values are better, in words; empty where none is."""
        if self.best is None or isinstance(self.best, str):
            return self.best or ""
        return f"closest to {self.best:g}"


@dataclass(frozen=True, slots=True)
class SignalBlock:
    """A block of M stamps of one signal of an estimate and of its ground truth.

    Attributes
    ----------
    start : its first row. error : estimate − ground truth [M], angles wrapped, also where it is not scored.
    scorable, scored : where ground truth can score the signal, and where the estimate is valid and finite besides [M].
    std : 1-sigma of the error [M], with that of ground truth where it is known; None where the estimate never has one.
    inside : mask [M] by segment.
    """

    signal: str
    start: int
    estimate: StateTrack
    truth: StateTrack
    error: FloatArray
    scorable: BoolArray
    scored: BoolArray
    std: FloatArray | None
    inside: Mapping[str, BoolArray]


class SignalFigures(Protocol):
    """The figures of one signal of one estimate, which is given block by block."""

    def add(self, block: SignalBlock) -> None:
        """Take the next block."""

    def of(self, segment: str) -> Mapping[str, Figure]:
        """Return the figures of a segment by metric; none where nothing in it counts."""


class Reference:
    """Ground truth [N] and masks by segment of a drive, and intermediate results that its estimates share.

    ``scorable``: where ground truth can score each signal.
    """

    def __init__(self, truth: StateTrack, masks: Mapping[str, BoolArray], *, log: str, low_speed_m_s: float) -> None:
        if ALL not in masks:
            masks = {ALL: np.ones(len(truth), dtype=np.bool_), **masks}
        self.truth = truth
        self.masks = packed(masks, len(truth))
        self.log = log
        self.scorable = _scorable_bits(truth, low_speed_m_s)
        self._shared: dict[Callable[[Reference], object], object] = {}

    def once(self, make: Callable[[Reference], _T]) -> _T:
        """Return what ``make`` returns for this reference; it is called once."""
        if make not in self._shared:
            self._shared[make] = make(self)
        return self._shared[make]  # type: ignore[return-value]


def _scorable_bits(truth: StateTrack, low_speed_m_s: float) -> SegmentMasks:
    blocks = []
    for a, b in row_blocks(len(truth)):
        part = HeldRows(truth.rows(a, b))
        blocks.append(packed({s: scorable(part, s, low_speed_m_s) for s in SCORED_SIGNALS}, b - a).bits)
    return SegmentMasks([*SCORED_SIGNALS], np.concatenate(blocks))


@dataclass(frozen=True, slots=True)
class SensorErrors:
    """Errors of a log's sensors, relative to the vehicle that its signals were read with.

    Attributes
    ----------
    ay_bias_m_s2, yaw_rate_bias_rad_s : reading minus true value. ay_gain : of a_y, by body roll. lever_m : position of
        the accelerometer ahead of the centre of gravity.
    vehicle, read_with : with which the log explains its yaw rate, and with which its signals were read; None: unknown.
    steer_delay_s : of the steering angle. friction : of the road; None: that of the signals.
    """

    ay_bias_m_s2: float = 0.0
    yaw_rate_bias_rad_s: float = 0.0
    ay_gain: float = 1.0
    lever_m: float = 0.0
    vehicle: VehicleParameters | None = None
    read_with: VehicleParameters | None = None
    steer_delay_s: float = 0.0
    friction: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class EvaluatedDrive:
    """All tracks of a drive with what its sensors measured, at the same stamps [N].

    ``tracks`` by estimator. ``sensors``: errors of the sensors, as the log calibrated them.
    """

    log: str
    tracks: Mapping[str, StateTrack]
    truth: StateTrack | None
    signals: Signals
    masks: SegmentMasks
    low_speed_m_s: float
    sensors: SensorErrors


@dataclass(frozen=True, slots=True)
class OfSignal:
    """Function of a metric of each scored signal: called for a reference, an estimate [N] and a signal."""

    start: Callable[[Reference, StateTrack, str], SignalFigures]


@dataclass(frozen=True, slots=True)
class OfTrack:
    """Function of a metric of a whole track [N]: called with ground truth or None, masks and the name of the log."""

    rows: Callable[[StateTrack, StateTrack | None, SegmentMasks, str], Iterable[MetricRow]]


@dataclass(frozen=True, slots=True)
class OfDrive:
    """Function of a metric that takes the sensors or several tracks; recorded estimates have no such figures."""

    rows: Callable[[EvaluatedDrive], Iterable[MetricRow]]


def mean_by_segment(name: str, values: Callable[[SignalBlock], FloatArray | None]) -> OfSignal:
    """Return the function of a metric that is a mean over the scored stamps of a segment.

    ``values``: returns the summand at each stamp [M], NaN where there is none; None where the estimate lacks what it
    takes.
    """
    return OfSignal(lambda _reference, _estimate, _signal: _Mean(name, values))


class _Mean:
    def __init__(self, name: str, values: Callable[[SignalBlock], FloatArray | None]) -> None:
        self._name, self._values = name, values
        self._sums = SegmentSums()

    def add(self, block: SignalBlock) -> None:
        values = self._values(block)
        if values is not None:
            self._sums.add(block.inside, np.where(block.scored, values, np.nan))

    def of(self, segment: str) -> dict[str, Figure]:
        n, sums = self._sums.totals().get(segment, (0, np.zeros(1)))
        return {self._name: (float(sums[0]) / n, n)} if n else {}
