"""Statistics of fields in short pieces of a log: values on a common time grid, and relations between them."""

import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.drive_log import Columns, DriveLog
from pdhef_logtool.records.errors import PdhefError
from pdhef_logtool.records.interpolation import Bracket
from pdhef_logtool.records.signals import LEAST_DIVISOR, NS_PER_S, S_PER_NS, FloatArray, IntArray

#: Number and length of the pieces of the log to read; a shorter log is read whole.
PIECES = 8
PIECE_NS = 10 * NS_PER_S
#: Cell size of the grid; a car's motion changes little within it.
CELL_NS = NS_PER_S // 10
CELL_S = CELL_NS * S_PER_NS
#: Larger numbers are no measurements of a car.
LARGEST = 1e12
#: Longest gap that is interpolated, for sensors with one sample per second.
BRIDGED_CELLS = 12
#: Maximum number of columns to read of an array of unknown length.
MOST_COLUMNS = 16
#: Evidence and limits by subject, and the evidence for a reading in log odds (evidence.toml).
EVIDENCE: dict[str, dict[str, Any]] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
LOG_ODDS: dict[str, float] = EVIDENCE["log_odds"]
CLEAR: float = EVIDENCE["relations"]["clear"]
#: Quantiles between which values are usual; a sensor's code for "invalid" is outside.
_USUAL = (0.005, 0.995)
#: Smallest number of cells that gives information.
FEWEST_CELLS = 40


@dataclass(frozen=True, slots=True)
class Fit:
    """``y = slope * x + a`` over cells of 0.1 s, and the correlation of the two; both are 0 without a relation."""

    slope: float = 0.0
    correlation: float = 0.0

    @property
    def is_clear(self) -> bool:
        """Return whether the correlation, of any sign, counts as a relation."""
        return abs(self.correlation) > CLEAR


@dataclass(frozen=True, eq=False)
class Seen:
    """Values of a field in the pieces of the log.

    Attributes
    ----------
    values : float64 [N], raw. make_grid : returns ``cells`` and ``rate_hz``, which most fields do not need.
    """

    values: FloatArray
    make_grid: Callable[[], tuple[FloatArray, float]]

    @classmethod
    def of(cls, values: FloatArray, cells: FloatArray, rate_hz: float) -> "Seen":
        """Return computed values with their means on the grid."""
        return cls(values, lambda: (cells, rate_hz))

    @cached_property
    def _grid(self) -> tuple[FloatArray, float]:
        return self.make_grid()

    @property
    def cells(self) -> FloatArray:
        """Means on the grid, float64 [M], NaN in empty cells."""
        return self._grid[0]

    @property
    def rate_hz(self) -> float:
        """Sample rate while the field is recorded."""
        return self._grid[1]

    @property
    def largest(self) -> float:
        """Largest magnitude without a few outliers; NaN without a number."""
        finite = np.abs(self.values[np.isfinite(self.values)])
        return float(np.quantile(finite, _USUAL[1])) if finite.shape[0] else float("nan")

    @property
    def changes(self) -> bool:
        """Return whether it takes more than one value."""
        finite = self.values[np.isfinite(self.values)]
        return finite.shape[0] > 1 and bool(np.ptp(finite) > 0.0)

    @property
    def is_off_centre(self) -> bool:
        """Return whether it is far from 0 at all times, as a servo's command is and a steering angle is not."""
        return bool(abs(np.nanmedian(self.values)) > 3.0 * np.nanstd(self.values))


class Pieces:
    """A few pieces of a log on a common grid of 0.1 s."""

    def __init__(self, log: DriveLog) -> None:
        self.log = log
        span = log.end_ns - log.start_ns
        count = max(1, min(PIECES, -(-span // PIECE_NS)))
        step = max(PIECE_NS, (span - PIECE_NS) // max(1, count - 1))
        self.starts = [log.start_ns + i * step for i in range(count)]
        self.cells_a_piece = PIECE_NS // CELL_NS

    def read(self, fields: Iterable[tuple[str, str]]) -> dict[tuple[str, str], Seen]:
        """Read fields, given by topic and path; an array becomes one entry per column, ``name[i]``.

        At most ``MOST_COLUMNS`` columns of an array are read. Unreadable fields are omitted.
        """
        requests: dict[str, list[str]] = {}
        for topic, path in dict.fromkeys(fields):
            requests.setdefault(topic, []).append(path)
        parts: dict[tuple[str, str], list[tuple[IntArray, FloatArray]]] = {}
        for number, start in enumerate(self.starts if requests else ()):
            for topic, columns in self._columns(requests, start).items():
                cells = (columns.log_time_ns - start) // CELL_NS
                is_inside = (cells >= 0) & (cells < self.cells_a_piece)
                cells = np.where(is_inside, cells + number * self.cells_a_piece, -1)
                for path in requests[topic]:
                    values = np.asarray(columns.fields[path], dtype=np.float64)
                    values = np.where(np.abs(values) < LARGEST, values, np.nan)
                    elements = enumerate(values.T[:MOST_COLUMNS])
                    its = {path: values} if values.ndim == 1 else {f"{path}[{i}]": v for i, v in elements}
                    for name, column in its.items():
                        parts.setdefault((topic, name), []).append((cells, column))
        whole = {key: [*map(np.concatenate, zip(*samples, strict=True))] for key, samples in parts.items()}
        return {key: Seen(values, partial(self._on_grid, values, cells)) for key, (cells, values) in whole.items()}

    def _columns(self, requests: Mapping[str, Sequence[str]], start: int) -> dict[str, Columns]:
        try:
            return self.log.read(requests, start, start + PIECE_NS, quiet=True)
        except PdhefError:  # each topic alone, without those that cannot be read
            alone = requests.items() if len(requests) > 1 else ()
            return {t: c for topic, paths in alone for t, c in self._columns({topic: paths}, start).items()}

    def _on_grid(self, values: FloatArray, cells: IntArray) -> tuple[FloatArray, float]:
        """Return the means of the usual values on the grid [M], and the sample rate."""
        low, high = _usual(values)
        use, size = (values >= low) & (values <= high) & (cells >= 0), len(self.starts) * self.cells_a_piece
        total, count = np.bincount(cells[use], values[use], size), np.bincount(cells[use], minlength=size)
        with np.errstate(invalid="ignore", divide="ignore"):
            means = _filled((total / count).reshape(len(self.starts), -1)).ravel()
        busy = max(1, int(np.count_nonzero(count)))
        return means, float(values.shape[0]) / (busy * CELL_S)

    def rate_of(self, cells: NDArray[Any], half: int = 2) -> NDArray[Any]:
        """Return the time derivative of values on the grid [M], real or complex, over ``half`` cells to each side."""
        rows = cells.reshape(len(self.starts), self.cells_a_piece)
        out = np.full_like(rows, np.nan)
        out[:, half:-half] = (rows[:, 2 * half :] - rows[:, : -2 * half]) / (2 * half * CELL_S)
        return out.ravel()

    def turning(self, direction: NDArray[np.complex128]) -> FloatArray:
        """Return the rate at which a complex direction [M] turns, rad/s [M]."""
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray((self.rate_of(direction) / direction).imag)

    def smooth(self, cells: FloatArray, half: int = 2) -> FloatArray:
        """Return the mean over ``half`` cells to each side [M], to match the bandwidth of :meth:`rate_of`."""
        rows = cells.reshape(len(self.starts), self.cells_a_piece)
        out = np.full_like(rows, np.nan)
        width, inner = 2 * half + 1, rows.shape[1] - 2 * half
        out[:, half:-half] = sum(rows[:, i : i + inner] for i in range(width)) / width
        return out.ravel()


def ratio(y: FloatArray, x: FloatArray, slow: float) -> float:
    """Return the ratio y/x where x is above ``slow``; 0 unless it is positive and nearly constant."""
    use = np.isfinite(y) & np.isfinite(x)
    use[use] &= x[use] > slow
    if np.count_nonzero(use) < FEWEST_CELLS:
        return 0.0
    times = y[use] / x[use]
    low, middle, high = np.quantile(times, [0.2, 0.5, 0.8])
    return float(middle) if high - low < 0.1 * middle else 0.0


def spread(cells: FloatArray) -> float:
    """Return the standard deviation of the finite values; 0 without any."""
    finite_cells = cells[np.isfinite(cells)]
    return float(finite_cells.std()) if finite_cells.shape[0] else 0.0


def _usual(values: FloatArray) -> tuple[float, float]:
    """Return the range of plausible values; a sensor's code for "invalid" lies outside."""
    finite = values[np.isfinite(values)]
    if finite.shape[0] == 0:
        return 0.0, 0.0
    low, high = np.quantile(finite, _USUAL)
    room = 3.0 * max(float(high - low), 1e-9)
    return float(low) - room, float(high) + room


def _filled(rows: FloatArray) -> FloatArray:
    """Interpolate empty cells in gaps of at most ``BRIDGED_CELLS`` [pieces, cells]."""
    for row in rows:
        filled = np.flatnonzero(np.isfinite(row))
        row[:] = Bracket(filled, np.arange(row.size), BRIDGED_CELLS).linear(row[filled])
    return rows


def fit(y: FloatArray, x: FloatArray) -> Fit:
    """Fit a line through the finite cells [M]; no relation if there are too few or one of the two is constant."""
    use = np.isfinite(y) & np.isfinite(x)
    if np.count_nonzero(use) < FEWEST_CELLS:
        return Fit()
    a, b = (np.clip(values, *np.quantile(values, _USUAL)) for values in (y[use], x[use]))
    da, db = a - a.mean(), b - b.mean()
    sa, sb = float(np.sqrt(np.mean(da * da))), float(np.sqrt(np.mean(db * db)))
    if not (sa > LEAST_DIVISOR and sb > LEAST_DIVISOR):
        return Fit()
    both = float(np.mean(da * db))
    return Fit(both / (sb * sb), both / (sa * sb))
