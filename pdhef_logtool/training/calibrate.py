"""Fit of calibrated intervals: coefficients of the terms, so that 95 % of the errors lie inside, in every regime.

Error e, terms t_i ≥ 0, s² = Σ (k_i t_i)². With r = log |e| − log(1.96 s) the pinball loss of the 95 % quantile,

    ρ(r) = 0.95 r for r > 0, −0.05 r else,

is minimal where a share of 0.95 of the errors lies inside; taken on the logarithm it weighs a straight road like a
limit manoeuvre. Bins of grip use weigh alike, and drives with a vehicle file made wrong have a share of their own.

Errors of one drive are alike, so that the drives are the unit: what a fit is worth is found on drives that it has not
seen (five folds of drives), and a last factor on all coefficients makes 95 % of *those* errors lie inside.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np

from pdhef_logtool.estimators.calibration import Inflation, combined
from pdhef_logtool.signals import BoolArray, FloatArray, IntArray

COVERED = 0.95
#: 95 % of a normal distribution lie within this many 1-sigma.
NORMAL_95 = 1.959963984540054
#: Bins of true abs a_y over μ g (METHOD §10), by name: lower and upper limit.
BINS: dict[str, tuple[float, float]] = {"low": (0.0, 0.3), "middle": (0.3, 0.6), "high": (0.6, np.inf)}
#: Weight of the drives whose vehicle file was made wrong, where there are any.
WRONG_SHARE = 0.3
FOLDS = 5
#: A fit on fewer drives says nothing of a further one.
MIN_DRIVES = 5
#: Errors are not told apart below this: 6e-5 degrees.
LEAST_ERROR = 1e-6
#: Coefficients below count for nothing.
LEAST_COEFFICIENT = 1e-3
#: Natural logarithm of the coefficients: range of the search, and its starts.
LOG_RANGE = (-9.0, 5.0)
LOG_STARTS = (-0.5, -2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Errors of one estimator and what was known when it was made; all [n] but the terms [n, m].

    ``vy_per_sideslip`` is the estimator's 1-sigma of v_y over its 1-sigma of the sideslip: what a calibrated one
    is multiplied by. ``bin``: number of the bin of grip use, −1 for none. ``drive``: number of the drive, the same for
    both runs of a drive. ``wrong``: the vehicle file was made wrong.
    """

    terms: FloatArray
    yaw_rate_terms: FloatArray
    vy_per_sideslip: FloatArray
    sideslip_error: FloatArray
    vy_error: FloatArray
    yaw_rate_error: FloatArray
    own_std: FloatArray
    bin: IntArray
    drive: IntArray
    wrong: BoolArray

    def __len__(self) -> int:
        """Return the number of samples."""
        return int(self.bin.shape[0])

    def where(self, mask: BoolArray) -> Samples:
        """Return the samples of a mask [n]."""
        return Samples(*(getattr(self, f.name)[mask] for f in fields(self)))


def join_samples(parts: Sequence[Samples]) -> Samples:
    """Join the samples of several drives."""
    return Samples(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Samples)))


@dataclass(frozen=True, slots=True)
class Coverage:
    """How the 95 % intervals of sideslip stand in one bin, before and after; after is of drives not fitted to.

    ``width_*``: mean width over 3.92 times the RMSE; 1 for normal errors whose size is known.
    """

    bin: str
    wrong_vehicle: bool
    drives: int
    samples: int
    rmse_rad: float
    covered_before: float
    covered_after: float
    width_before: float
    width_after: float


@dataclass(frozen=True, slots=True)
class Fitted:
    """The coefficients of one estimator, the factor that unseen drives asked for, and how its intervals stand."""

    inflation: Inflation
    unseen_factor: float
    coverage: tuple[Coverage, ...]


def fit_inflation(samples: Samples) -> Fitted:
    """Fit one estimator's coefficients.

    Raises
    ------
    ValueError
        There are fewer than :data:`MIN_DRIVES` drives.
    """
    if np.unique(samples.drive).size < MIN_DRIVES:
        raise ValueError(f"at least {MIN_DRIVES} drives are needed")
    samples = samples.where(samples.bin >= 0)
    weight = sample_weights(samples.bin, samples.wrong)
    unseen = np.empty(len(samples))
    unseen_rate = np.empty(len(samples))
    for seen, held in folds(samples.drive):
        k = fit_coefficients(samples.terms[seen], samples.sideslip_error[seen], weight[seen])
        unseen[held] = combined(samples.terms[held], k)
        k = fit_coefficients(samples.yaw_rate_terms[seen], samples.yaw_rate_error[seen], weight[seen])
        unseen_rate[held] = combined(samples.yaw_rate_terms[held], k)
    factor = covering_factor(samples.sideslip_error, unseen, weight)
    rate_factor = covering_factor(samples.yaw_rate_error, unseen_rate, weight)
    vy_factor = covering_factor(samples.vy_error, factor * unseen * samples.vy_per_sideslip, weight)
    inflation = Inflation(
        sideslip=_times(fit_coefficients(samples.terms, samples.sideslip_error, weight), factor),
        yaw_rate=_times(fit_coefficients(samples.yaw_rate_terms, samples.yaw_rate_error, weight), rate_factor),
        vy_factor=vy_factor,
    )
    return Fitted(inflation, factor, tuple(coverage_rows(samples, factor * unseen)))


def fit_coefficients(terms: FloatArray, error: FloatArray, weight: FloatArray) -> tuple[float, ...]:
    """Return the coefficients k [m] ≥ 0 that minimise the loss of this file's head.

    Parameters
    ----------
    terms : [n, m], not all 0 in any row. error : [n]. weight : [n], sum 1.
    """
    from scipy.optimize import minimize

    squares = terms**2
    size = np.log(np.maximum(np.abs(error), LEAST_ERROR)) - np.log(NORMAL_95)

    def loss(log_k: FloatArray) -> tuple[float, FloatArray]:
        k2 = np.exp(2.0 * log_k)
        variance = squares @ k2
        r = size - 0.5 * np.log(variance)
        slope = np.where(r > 0.0, COVERED, COVERED - 1.0)
        share = (weight * slope / variance) @ squares * k2  # d loss = −slope d log s, d log s = k² t² / s² d log k
        return float(np.sum(weight * slope * r)), -share

    count = terms.shape[1]
    found = [
        minimize(loss, np.full(count, start), jac=True, method="L-BFGS-B", bounds=[LOG_RANGE] * count)
        for start in LOG_STARTS
    ]
    best = np.exp(min(found, key=lambda f: float(f.fun)).x)
    return tuple(float(k) if k >= LEAST_COEFFICIENT or i == 0 else 0.0 for i, k in enumerate(best))


def covering_factor(error: FloatArray, std: FloatArray, weight: FloatArray) -> float:
    """Return the factor on ``std`` [n] at which a weight of 95 % of the errors [n] lies within 1.96 of it."""
    ratio = np.abs(error) / (NORMAL_95 * std)
    order = np.argsort(ratio, kind="stable")
    below = np.cumsum(weight[order]) / np.sum(weight)
    return float(ratio[order][min(int(np.searchsorted(below, COVERED)), len(order) - 1)])


def sample_weights(bins: IntArray, wrong: BoolArray) -> FloatArray:
    """Return weights [n], sum 1: bins count alike, wrong vehicle files as :data:`WRONG_SHARE` of each."""
    weight = np.zeros(bins.shape[0])
    for number in np.unique(bins):
        here = bins == number
        parts = [(here & ~wrong, 1.0 - WRONG_SHARE), (here & wrong, WRONG_SHARE)]
        for mask, share in parts:
            if mask.any():
                weight[mask] = share / np.count_nonzero(mask)
        weight[here] /= weight[here].sum()
    total: FloatArray = weight / weight.sum()
    return total


def folds(drive: IntArray) -> Iterator[tuple[BoolArray, BoolArray]]:
    """Yield the samples to fit on and those held out, [n] each; a drive is never on both sides."""
    numbers = np.unique(drive)
    place = np.searchsorted(numbers, drive) % FOLDS
    for fold in range(min(FOLDS, numbers.size)):
        held = place == fold
        yield ~held, held


def coverage_rows(samples: Samples, std: FloatArray) -> Iterator[Coverage]:
    """Yield coverage and width of the intervals ``own_std`` (before) and ``std`` (after), [n] each, by bin."""
    error = np.abs(samples.sideslip_error)
    for wrong in (False, True):
        for number, name in enumerate(BINS):
            use = (samples.bin == number) & (samples.wrong == wrong)
            if not use.any():
                continue
            rmse = float(np.sqrt(np.mean(error[use] ** 2)))
            before, after = samples.own_std[use], std[use]
            yield Coverage(
                bin=name,
                wrong_vehicle=wrong,
                drives=int(np.unique(samples.drive[use]).size),
                samples=int(np.count_nonzero(use)),
                rmse_rad=rmse,
                covered_before=float(np.mean(error[use] <= NORMAL_95 * before)),
                covered_after=float(np.mean(error[use] <= NORMAL_95 * after)),
                width_before=float(np.mean(before)) / max(rmse, LEAST_ERROR),
                width_after=float(np.mean(after)) / max(rmse, LEAST_ERROR),
            )


def bin_numbers(grip_share: FloatArray) -> IntArray:
    """Return the number of the bin [n] of a grip use [n]; −1 where it is not known."""
    number = np.full(grip_share.shape[0], -1, dtype=np.int64)
    for i, (low, high) in enumerate(BINS.values()):
        number[(grip_share >= low) & (grip_share < high)] = i
    return number


def _times(coefficients: tuple[float, ...], factor: float) -> tuple[float, ...]:
    return tuple(k * factor for k in coefficients)
