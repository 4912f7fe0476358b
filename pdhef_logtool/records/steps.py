"""Steps on measurement time and their availability at scored stamps, which makes estimates causal."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Self

import numpy as np

from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, BoolArray, FloatArray, IntArray

#: Longest prediction of an output after the newest processed step; beyond it, the stamp is not valid.
MAX_PREDICTION_S = 0.3
#: A longer step between stamps is a gap, after which all filters and monitors restart.
RESTART_GAP_S = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class StepColumns:
    """Base of records with arrays over the same steps, [K, ...], such records, or tuples of them as fields."""

    def joined(self, other: Self) -> Self:
        """Append the steps of the next window."""
        return _mapped(lambda a, b: np.concatenate([a, b]), self, other)  # type: ignore[no-any-return]

    def at(self, rows: slice | IntArray) -> Self:
        """Return the steps of a slice or of indices."""
        return _mapped(lambda column: column[rows], self)  # type: ignore[no-any-return]

    @property
    def arrays(self) -> list[Any]:
        """All arrays of the record."""
        arrays: list[Any] = []
        _mapped(arrays.append, self)
        return arrays


def _mapped(function: Callable[..., Any], *columns: Any) -> Any:
    """Return a function of the arrays of a record, a tuple or an array, and of others with the same entries."""
    first = columns[0]
    if isinstance(first, tuple):
        return tuple(_mapped(function, *parts) for parts in zip(*columns, strict=True))
    if isinstance(first, StepColumns):
        names = [f.name for f in fields(first)]
        return type(first)(*(_mapped(function, *(getattr(c, name) for c in columns)) for name in names))
    return function(*columns)


@dataclass(frozen=True, slots=True, eq=False)
class Release:
    """Newest available step at each scored stamp, [M]: ``arrived`` is False without any, and ``step`` is then 0."""

    step: IntArray
    arrived: BoolArray

    def rows(self, part: slice, first_step: int) -> "Release":
        """Return the stamps of a slice, with steps counted from ``first_step``."""
        return Release(self.step[part] - first_step, self.arrived[part])


def release(ready_ns: IntArray, stamps_ns: IntArray) -> Release:
    """Return for each scored stamp [M] the newest step with all data arrived by then (docs/method.md#delay).

    ``ready_ns`` [K] is non-decreasing.
    """
    index = np.searchsorted(ready_ns, stamps_ns, side="right").astype(np.int64) - 1
    return Release(np.maximum(index, 0), index >= 0)


def last_known(stamps_ns: IntArray, values: FloatArray) -> FloatArray:
    """Extend measurements [N], which are finite at single stamps, over up to :data:`RESTART_GAP_S`."""
    finite = np.isfinite(values)
    last = np.maximum.accumulate(np.where(finite, np.arange(values.shape[0]), -1))
    fresh = (last >= 0) & (stamps_ns - stamps_ns[np.maximum(last, 0)] <= RESTART_GAP_S * NS_PER_S)
    return np.where(fresh, values[np.maximum(last, 0)], np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Extrapolation(Release):
    """Start step and duration of the extrapolation to each scored stamp, [M].

    Attributes
    ----------
    horizon_s : time from the step to the stamp; NaN without one.
    usable : whether the step is valid and at most ``MAX_PREDICTION_S`` old.
    """

    horizon_s: FloatArray
    usable: BoolArray

    @classmethod
    def none(cls, valid: BoolArray) -> "Extrapolation":
        """Return no extrapolation: the stamps are those of the steps [K]."""
        count = len(valid)
        return cls(np.arange(count), np.ones(count, np.bool_), np.zeros(count), valid)


def extrapolation(steps_ns: IntArray, chosen: Release, valid: BoolArray, stamps_ns: IntArray) -> Extrapolation:
    """Return the extrapolation to scored stamps [M] from the chosen ones of steps [K] with stamps and validity."""
    horizon_s = np.where(chosen.arrived, (stamps_ns - steps_ns[chosen.step]) * S_PER_NS, np.nan)
    usable = (horizon_s <= MAX_PREDICTION_S) & valid[chosen.step]
    return Extrapolation(chosen.step, chosen.arrived, horizon_s, usable)
