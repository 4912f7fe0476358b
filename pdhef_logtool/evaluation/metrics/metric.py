"""Definition of a metric: columns of a drive and a formula over their values in a segment."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.evaluation.statistics import gathered
from pdhef_logtool.evaluation.units import SIGNALS, read_unit
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.tracks import StateTrack

ALL = "all"
#: Entries of :class:`Metric` beside its functions, by name.
_TABLE = tomllib.loads((Path(__file__).parents[1] / "metrics.toml").read_text(encoding="utf-8"))


@dataclass(frozen=True, slots=True)
class MetricRow:
    """One value of a metric. The first eight fields and ``algorithm`` are the columns of metrics.parquet.

    ``algorithm`` is the digest of the algorithm that ran under the estimator's name; empty for recorded estimates.

    ``independent`` is False if ground truth of this signal is one of the estimators' inputs; tables and rankings omit
    such rows. In the file, a row with metric ``not_independent`` marks its estimator and signal.
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


class CalibratedSignals(NamedTuple):
    """Signals [N] as the vehicle of a drive's model corrects them, for the metrics without ground truth.

    ``steer_delay_s`` : delay of the steering angle in them.
    """

    signals: Signals
    vehicle: VehicleParameters
    steer_delay_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class EvaluatedDrive:
    """The tracks of a drive by estimator, ground truth and signals, all at the same stamps [N].

    Attributes
    ----------
    masks : bool [N] by segment. truth, signals : None omits the metrics that need them.
    low_speed_m_s : sideslip is scored above this ground-truth speed. calibrated : None omits the consistencies.
    dependent : signals with an estimator input as their ground truth. algorithms : digests by estimator.
    """

    log: str
    tracks: Mapping[str, StateTrack]
    truth: StateTrack | None
    signals: Signals | None
    masks: Mapping[str, BoolArray]
    low_speed_m_s: float
    calibrated: CalibratedSignals | None = None
    dependent: Collection[str] = ()
    algorithms: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Columns [N] of one signal of one estimator, by name; a stamp counts where a column is finite.

    Columns ``of_steps`` have N − 1 rows, the steps between stamps: a segment contains a step if it contains both ends.
    Columns of the ``whole`` drive may have any length; only segment ``all`` has values.
    """

    estimator: str
    signal: str
    values: Mapping[str, NDArray[Any]]
    of_steps: bool = False
    whole: bool = False


Formula: TypeAlias = Callable[..., "float | None"]


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric, as its file registers it; all outputs use this record. ``metrics.toml`` has entries of our own.

    Attributes
    ----------
    name : in metrics.parquet and plans.
    label : head of a column, without the unit.
    definition : one or two sentences for the documentation and for pages.
    columns : returns the columns of a drive; metrics with the same function share its columns.
    formula : returns the value for a segment from the values of its columns, or None.
    over : names of these columns; stamps at which the first one is finite are used. Empty: the name of the metric. A
        later name may be that of a metric before it with the same function: its value.
    best : ``lower``, ``higher``, the best value, or None if no value is better than another.
    unit : of its values; None for the unit of the signal.
    whole : only segment ``all`` has a value. of_truth : it compares with ground truth.
    digits : decimal places in the terminal, in the unit for display.
    terminal : signals with a column in the terminal's table, which narrow terminals omit.
    brief : signals that report.json contains without a column in the terminal.
    """

    name: str
    label: str
    definition: str
    columns: Callable[[EvaluatedDrive], Iterable[Columns]]
    formula: Formula
    over: tuple[str, ...] = ()
    best: Literal["lower", "higher"] | float | None = None
    unit: str | None = None
    whole: bool = False
    of_truth: bool = False
    digits: int = 3
    terminal: tuple[str, ...] = ()
    brief: tuple[str, ...] = ()

    def unit_of(self, signal: str) -> str:
        """Return the unit of a signal's values in metrics.parquet."""
        return SIGNALS[signal] if self.unit is None else self.unit

    def head(self, signal: str | None = None) -> str:
        """Return the head of a column: the label with the unit for display, which may depend on ``signal``."""
        unit = self.unit if signal is None else self.unit_of(signal)
        return f"{self.label} {read_unit(unit)[0]}".strip() if unit else self.label

    @property
    def direction(self) -> str:
        """Text of the better direction; empty without one."""
        if self.best is None or isinstance(self.best, str):
            return self.best or ""
        return f"closest to {self.best:g}"


def described(
    columns: Callable[[EvaluatedDrive], Iterable[Columns]], **formulas: Formula | tuple[Any, ...]
) -> tuple[Metric, ...]:
    """Return metrics over the same columns, with the entries of ``metrics.toml``.

    ``formulas``: by the name of a metric; a tuple has the names of the columns after it, unless there is only its own.
    """
    metrics = []
    for name, stated in formulas.items():
        formula, *over = stated if isinstance(stated, tuple) else (stated,)
        entries: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in _TABLE[name].items()}
        metrics.append(Metric(name, columns=columns, formula=formula, over=tuple(over), **entries))
    return tuple(metrics)


def rms(values: FloatArray, *_: FloatArray) -> float:
    """Return the root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def mean(values: NDArray[Any], *_: FloatArray) -> float:
    """Return the mean."""
    return float(np.mean(values))


_Place: TypeAlias = "IntArray | slice"


def _places(masks: Mapping[str, BoolArray]) -> list[tuple[str, _Place]]:
    """Return the indices of ``all`` and of each segment that is not empty."""
    parts = ((name, mask) for name, mask in masks.items() if name != ALL and mask.any())
    return [(ALL, slice(None)), *((name, slice(None) if mask.all() else np.flatnonzero(mask)) for name, mask in parts)]


def _rows(
    drive: EvaluatedDrive, columns: Columns, family: Sequence[Metric], segment: str, place: _Place
) -> Iterator[MetricRow]:
    """Yield the rows of one signal of one estimator in a segment."""

    @cache
    def known(first: str) -> _Place:
        finite = np.isfinite(columns.values[first][place])
        return place if finite.all() else np.arange(len(columns.values[first]))[place][finite]

    @cache
    def where_known(name: str, first: str) -> NDArray[Any]:
        return columns.values[name][known(first)]

    of_family: dict[str, float] = {}
    estimator, signal = columns.estimator, columns.signal
    digest = drive.algorithms.get(estimator, "")
    for metric in family:
        over = metric.over or (metric.name,)
        if not {*columns.values, *of_family} >= {*over} or (metric.whole and segment != ALL):
            continue
        values: list[Any] = [where_known(n, over[0]) if n in columns.values else of_family[n] for n in over]
        n = len(values[0])
        value = metric.formula(*values) if n else None
        if value is not None:
            of_family[metric.name] = value
            unit, independent = metric.unit_of(signal), not (metric.of_truth and signal in drive.dependent)
            yield MetricRow(drive.log, estimator, signal, segment, metric.name, value, unit, n, independent, digest)


#: Modules of this package that export ``METRICS``. Add the name of a new one here.
MODULES = ("errors", "innovations", "lateral_consistency", "yaw_consistency", "reference", "sensors", "handling")


@cache
def registered() -> Mapping[str, Metric]:
    """Return the metrics by name; their files are imported at the first call."""
    metrics: dict[str, Metric] = {}
    for module in MODULES:
        for metric in import_module(f"{__package__}.{module}").METRICS:
            if metric.name in metrics:
                raise ValueError(f"METRICS: {metric.name!r} of {module}.py is registered twice")
            metrics[metric.name] = metric
    return MappingProxyType(metrics)


def evaluate_drive(drive: EvaluatedDrive, names: Collection[str] | None = None) -> list[MetricRow]:
    """Return the values of all metrics, or of the metrics with these names.

    By estimator, in the order of the tracks, then by metric, signal and segment.
    """
    metrics = [m for m in registered().values() if names is None or m.name in names]
    stamps = _places(drive.masks)
    steps = _places({name: mask[1:] & mask[:-1] for name, mask in drive.masks.items()})
    rows: dict[str, list[MetricRow]] = {name: [] for name in drive.tracks}
    for columns_of, family in gathered((m.columns, m) for m in metrics).items():
        for columns in columns_of(drive):
            places = stamps[:1] if columns.whole else steps if columns.of_steps else stamps
            for segment, place in places:
                rows.setdefault(columns.estimator, []).extend(_rows(drive, columns, family, segment, place))
    return [row for of_estimator in rows.values() for row in of_estimator]
