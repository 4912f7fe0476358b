"""Low-passed channels on one even grid, and regressions with standard errors from the number of independent samples."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from pdhef_logtool.records.interpolation import Bracket
from pdhef_logtool.records.signals import LEAST_DIVISOR, NS_PER_S, S_PER_NS, BoolArray, Channel, FloatArray
from pdhef_logtool.records.student import student_quantile

MS_PER_S = 1e3
GRID_S = 0.05
#: −3 dB at 1 Hz: removes noise and vibration, keeps manoeuvres.
LOW_PASS_HZ = 1.0
#: Samples are interpolated onto the grid over gaps of at most this length, and of this many of their periods.
MAX_GAP_S, MAX_GAP_PERIODS = 0.5, 2.5
#: A spike is further from the median than this many 99 % ranges of the channel, for less than this time.
SPIKE_RANGES, SPIKE_S = 5.0, 0.2
#: A slower sensor does not resolve manoeuvres.
LONGEST_GAP_S = 2.5
#: 21 hours about the middle of the drive. One wrong stamp could otherwise make a grid of decades.
MAX_CELLS = 1_500_000
#: Moving: faster than this share of the drive's fast speeds, and than a speed that is too low for the relations.
MOVING_SHARE, MIN_MOVING_M_S = 0.25, 0.5
#: Number of blocks of a drive for the jackknife: minimum and maximum.
LEAST_BLOCKS, MOST_BLOCKS = 4, 10


def columns_on_grid(channels: Mapping[str, Channel]) -> dict[str, FloatArray]:
    """Return the scalar channels with two samples or more on one even grid of ``GRID_S``; NaN in gaps."""
    sound = {n: without_spikes(c) for n, c in channels.items() if len(c) > 1 and c.values.ndim == 1}
    used = {n: c for n, c in sound.items() if len(c) > 1}
    if not used:
        return {}
    start = min(int(c.stamps_ns[0]) for c in used.values())
    end = max(int(c.stamps_ns[-1]) for c in used.values())
    reach = int(MAX_CELLS * GRID_S * 0.5e9)
    middle = int(np.median([int(c.stamps_ns[len(c) // 2]) for c in used.values()]))
    start, end = max(start, middle - reach), min(end, middle + reach)
    cells = int((end - start) * S_PER_NS / GRID_S) + 1
    return {name: _on_grid(channel, start, cells) for name, channel in used.items()}


def without_spikes(channel: Channel) -> Channel:
    """Return a channel without short spikes far outside its range, by which buses mark invalid values.

    Values are limited to 1e12, and values below 1e-12 are set to 0, so that their squares are finite.
    """
    values = np.clip(channel.values, -1e12, 1e12)
    values[np.abs(values) < LEAST_DIVISOR] = 0.0
    channel = replace(channel, values=values).take(np.isfinite(values))
    low, middle, high = np.quantile(channel.values, (0.005, 0.5, 0.995)) if len(channel) else (0.0, 0.0, 0.0)
    out = np.abs(channel.values - middle) > SPIKE_RANGES * max(high - low, 1e-9)
    if not out.any():
        return channel
    first, end = np.flatnonzero(np.diff(out, prepend=False, append=False)).reshape(-1, 2).T
    short = channel.stamps_ns[end - 1] - channel.stamps_ns[first] < SPIKE_S * NS_PER_S
    out &= np.repeat(short, end - first)[np.cumsum(out) - 1]
    return channel.take(~out)


def derivative(column: FloatArray) -> FloatArray:
    """Differentiate a column of the grid by time, 1/s; NaN at its ends and beside gaps."""
    out = np.full(column.shape[0], np.nan)
    out[1:-1] = (column[2:] - column[:-2]) / (2.0 * GRID_S)
    return out


def earlier(column: FloatArray, by_s: float) -> FloatArray:
    """Return a column of the grid shifted to an earlier time; NaN if unknown."""
    cell = np.arange(column.shape[0]) + by_s / GRID_S
    return column if by_s == 0.0 else np.interp(cell, np.arange(column.shape[0]), column, left=np.nan, right=np.nan)


def moving_at(speed: FloatArray, least_m_s: float = MIN_MOVING_M_S) -> BoolArray:
    """Return where the car moves, relative to the drive's fast speeds, so that 1:10 cars are included."""
    finite = np.abs(speed[np.isfinite(speed)])
    if finite.shape[0] == 0:
        return np.zeros(speed.shape[0], np.bool_)
    limit = max(least_m_s, MOVING_SHARE * float(np.quantile(finite, 0.9)))
    return np.asarray(np.abs(speed) > limit, dtype=np.bool_)


def independent_samples(use: BoolArray) -> float:
    """Return how many independent samples the cells of a mask [N] contain after the low pass."""
    return 2.0 * LOW_PASS_HZ * GRID_S * int(np.count_nonzero(use))


def student(blocks: int) -> float:
    """Return the Student factor for a standard error from this many blocks (at least two) at 95 %."""
    return student_quantile(0.975, blocks - 1) / 1.96


def _on_grid(channel: Channel, start_ns: int, cells: int) -> FloatArray:
    """Average a channel into the grid's cells and low-pass it; NaN in gaps."""
    cell_of = np.rint((channel.stamps_ns - start_ns) * (S_PER_NS / GRID_S)).astype(np.int64)
    inside = (cell_of >= 0) & (cell_of < cells)
    count = np.bincount(cell_of[inside], minlength=cells).astype(np.float64)
    total = np.bincount(cell_of[inside], weights=channel.values[inside], minlength=cells)
    filled_cells = np.flatnonzero(count > 0.0)
    if filled_cells.shape[0] < 2:
        return np.full(cells, np.nan)
    period_s = float(np.median(np.diff(channel.stamps_ns))) * S_PER_NS
    gap_s = min(max(MAX_GAP_S, MAX_GAP_PERIODS * period_s), LONGEST_GAP_S)
    bracket = Bracket(filled_cells, np.arange(cells), int(gap_s / GRID_S + 1e-9))
    return _low_pass(bracket.linear(total[filled_cells] / count[filled_cells]), bracket.inside)


def _low_pass(values: FloatArray, good: BoolArray) -> FloatArray:
    """Apply a zero-phase Gaussian low pass to the good cells; NaN where they cover too little of the kernel."""
    sigma = np.sqrt(np.log(2.0)) / (2.0 * np.pi * LOW_PASS_HZ) / GRID_S
    reach = int(np.ceil(4.0 * sigma))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    columns = (good.astype(np.float64), np.where(good, values, 0.0))
    weight, total = (np.convolve(x, kernel / kernel.sum())[reach : reach + len(x)] for x in columns)
    return np.where(weight > 0.8, total / np.maximum(weight, 0.8), np.nan)


def median_known(column: FloatArray) -> float:
    """Return the median of the finite values of a column [N]; 0 without any."""
    finite = column[np.isfinite(column)]
    return float(np.median(finite)) if finite.size else 0.0


def fit(
    measured: FloatArray, regressors: Sequence[FloatArray], use: BoolArray, least: float = 4.0
) -> tuple[FloatArray, FloatArray, float] | None:
    """Regress a column on others where ``use`` and all are known; ``least``: independent samples per coefficient.

    Returns
    -------
    coefficients, standard errors by the number of independent samples, and 1-sigma of the residual; None if there are
    too few samples or the regressors are collinear.
    """
    matrix = np.stack(regressors, axis=1)
    usable = use & np.isfinite(measured) & np.isfinite(matrix).all(axis=1)
    samples = independent_samples(usable)
    if samples < least * len(regressors):
        return None
    a, b = matrix[usable], measured[usable]
    scale = np.linalg.norm(a, axis=0)
    if (scale <= LEAST_DIVISOR).any() or np.linalg.cond(a / scale) > 1e4:
        return None
    coefficients = np.linalg.lstsq(a / scale, b, rcond=None)[0] / scale
    spread = float(np.sqrt(np.mean((b - a @ coefficients) ** 2) * samples / (samples - len(regressors))))
    covariance = np.linalg.inv(a.T @ a / a.shape[0]) * spread**2 / samples
    errors = np.maximum(np.sqrt(np.diag(covariance)), _block_errors(a / scale, b, samples) / scale)
    return coefficients, errors, spread


def _block_errors(a: FloatArray, b: FloatArray, samples: float) -> FloatArray:
    """Return the jackknife's standard errors of a regression over blocks of the drive; 0 with too few samples.

    The residual is not white noise: grade, crossfall, roll and sliding last as long as a bend.
    """
    count = min(MOST_BLOCKS, int(samples // (2.0 * a.shape[1])))
    if count < LEAST_BLOCKS:
        return np.zeros(a.shape[1])
    edges = np.linspace(0, a.shape[0], count + 1).astype(int)
    squares = [a[i:j].T @ a[i:j] for i, j in pairwise(edges)]
    products = [a[i:j].T @ b[i:j] for i, j in pairwise(edges)]
    square, product = sum(squares), sum(products)
    without = [np.linalg.lstsq(square - s, product - p, rcond=None)[0] for s, p in zip(squares, products, strict=True)]
    return np.asarray(np.std(without, axis=0) * np.sqrt(count - 1.0) * student(count))
