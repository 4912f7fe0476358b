"""Fit of calibrated intervals: coefficients of the terms, so that 95 % of the errors lie inside, in every regime.

Error e, terms t_i ≥ 0, s² = g² Σ (k_i t_i)². With r = log |e| − log(1.96 s) the pinball loss of the quantile q,

    ρ(r) = q r for r > 0, −(1 − q) r else,

is minimal where a share q of the errors lies inside; taken on the logarithm it weighs a straight road like a limit
manoeuvre. Bins of grip use weigh alike, so do drives in a bin, and drives with the vehicle file as given and the same
ones with it made wrong: the sensors often do not show which it is, so that one interval has to apply to both.

Errors of one drive are alike, so that the drives are the unit. Five folds of drives validate a fit on drives that it
does not contain; factors then make a share of *those* errors lie inside, each for a range of grip use: a drive that is
lost near the limit does not widen the intervals on a straight road. That share is q (n + 1) / n of n drives, as in
conformal prediction: the next drive is one more that may be the worst.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np

from pdhef_logtool.car.parts import Inflation, SideslipCoefficients, YawRateCoefficients
from pdhef_logtool.estimators.error_features import grip_share
from pdhef_logtool.estimators.intervals import SIDESLIP_TERMS, YAW_RATE_TERMS, combined, grip_factor
from pdhef_logtool.evaluation.metrics import NORMAL_95
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray

#: Share inside.
COVERED = 0.95
#: Bins of true abs a_y over μ g (docs/method.md#evaluation), by name: lower and upper limit.
BINS: dict[str, tuple[float, float]] = {"low": (0.0, 0.3), "middle": (0.3, 0.6), "high": (0.6, np.inf)}
FOLDS = 5
#: A fit on fewer drives does not generalise to a further drive.
MIN_DRIVES = 5
#: Samples from which on a drive counts in full: a second of them.
FULL_SAMPLES = 20
#: Errors are not distinguished below this: 6e-5 degrees.
LEAST_ERROR = 1e-6
#: Smaller coefficients are set to 0.
LEAST_COEFFICIENT = 1e-3
#: Natural logarithm of the coefficients: range of the search, and its starts.
LOG_RANGE = (-9.0, 5.0)
LOG_STARTS = (-0.5, -2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Samples:
    """Errors of one estimator and the inputs of its interval; all [n] but the terms [n, m].

    ``vy_per_sideslip`` is the estimator's 1-sigma of v_y over its 1-sigma of the sideslip, the factor of a
    calibrated one. ``bin``: number of the bin of grip use, −1 for none. ``drive``: number of the drive, the same for
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
    """How the 95 % intervals of sideslip are in one bin, before and after; after is of drives not fitted to.

    ``width_*``: mean width over 3.92 times the RMSE; 1 for normal errors of known size.
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
    """The inflation of one estimator, the factor that unseen drives asked for in all, and how its intervals are."""

    inflation: Inflation
    unseen_factor: float
    coverage: tuple[Coverage, ...]


def fit_inflation(samples: Samples) -> Fitted:
    """Fit one estimator's coefficients.

    Raises
    ------
    ValueError
        There are fewer than :data:`MIN_DRIVES` drives with the vehicle file as given.
    """
    if np.unique(samples.drive[~samples.wrong]).size < MIN_DRIVES:
        raise ValueError(f"at least {MIN_DRIVES} drives are needed")
    samples = samples.where(samples.bin >= 0)
    weight = bin_weights(samples.bin + len(BINS) * samples.wrong, samples.drive)
    coefficients, unseen = _fit(samples, samples.terms, samples.sideslip_error, weight)
    share = grip_share(samples.terms)
    factors = grip_factors(samples, share, unseen, weight)
    std = grip_factor(share, factors) * unseen
    everywhere = np.ones(len(samples), dtype=np.bool_)
    rate, unseen_rate = _fit(samples, samples.yaw_rate_terms, samples.yaw_rate_error, weight)
    rate_factor = _factor(samples, samples.yaw_rate_error, unseen_rate, weight, everywhere)
    inflation = Inflation(
        sideslip=SideslipCoefficients(**dict(zip(SIDESLIP_TERMS, coefficients, strict=True))),
        yaw_rate=YawRateCoefficients(**{name: rate_factor * k for name, k in zip(YAW_RATE_TERMS, rate, strict=True)}),
        vy_factor=_factor(samples, samples.vy_error, std * samples.vy_per_sideslip, weight, everywhere),
        grip_factors=factors,
    )
    factor = _factor(samples, samples.sideslip_error, unseen, weight, everywhere)
    return Fitted(inflation, factor, tuple(coverage_rows(samples, std)))


def _fit(
    samples: Samples, terms: FloatArray, error: FloatArray, weight: FloatArray
) -> tuple[tuple[float, ...], FloatArray]:
    """Return coefficients, and the 1-sigma [n] of each drive by the coefficients of the other folds."""
    unseen = np.empty(len(samples))
    for seen, held in folds(samples.drive):
        unseen[held] = combined(terms[held], fit_coefficients(terms[seen], error[seen], weight[seen]))
    return fit_coefficients(terms, error, weight), unseen


def _factor(samples: Samples, error: FloatArray, std: FloatArray, weight: FloatArray, use: BoolArray) -> float:
    """Return the factor on ``std`` [n] that the samples of a mask [n] ask for; few drives ask for more."""
    share = share_for(COVERED, int(np.unique(samples.drive[use]).size))
    return covering_factor(error[use], std[use], weight[use], share)


def grip_factors(
    samples: Samples, share: FloatArray, std: FloatArray, weight: FloatArray
) -> tuple[float, float, float]:
    """Return the factors on ``std`` [n] by grip use [n]; a bin with few drives takes the previous factor."""
    whole = _factor(samples, samples.sideslip_error, std, weight, np.ones(len(samples), dtype=np.bool_))
    factors: list[float] = []
    for low, high in BINS.values():
        use = (share >= low) & (share < high)
        enough = np.unique(samples.drive[use]).size >= MIN_DRIVES
        before = factors[-1] if factors else whole
        factors.append(_factor(samples, samples.sideslip_error, std, weight, use) if enough else max(before, whole))
    low, middle, high = factors
    return low, middle, high


def share_for(covered: float, drives: int) -> float:
    """Return the share of known drives that must lie inside for ``covered`` of the next one, q (n + 1) / n.

    At most half of 1 − q is added: few drives do not determine such extreme quantiles.
    """
    return min(covered * (drives + 1) / drives, 0.5 * (1.0 + covered))


def fit_coefficients(
    terms: FloatArray, error: FloatArray, weight: FloatArray, covered: float = COVERED
) -> tuple[float, ...]:
    """Return the coefficients k [m] ≥ 0 that minimise the loss of this file's head.

    Parameters
    ----------
    terms : [n, m], not all 0 in any row. error, weight : [n]. covered : q.
    """
    from scipy.optimize import minimize

    squares = terms**2
    size = np.log(np.maximum(np.abs(error), LEAST_ERROR)) - np.log(NORMAL_95)

    def loss(log_k: FloatArray) -> tuple[float, FloatArray]:
        k2 = np.exp(2.0 * log_k)
        variance = squares @ k2
        r = size - 0.5 * np.log(variance)
        slope = np.where(r > 0.0, covered, covered - 1.0)
        share = (weight * slope / variance) @ squares * k2  # d loss = −slope d log s, d log s = k² t² / s² d log k
        return float(np.sum(weight * slope * r)), -share

    count = terms.shape[1]
    minima = [
        minimize(loss, np.full(count, start), jac=True, method="L-BFGS-B", bounds=[LOG_RANGE] * count)
        for start in LOG_STARTS
    ]
    best = np.exp(min(minima, key=lambda f: float(f.fun)).x)
    return tuple(float(k) if k >= LEAST_COEFFICIENT or i == 0 else 0.0 for i, k in enumerate(best))


def covering_factor(error: FloatArray, std: FloatArray, weight: FloatArray, covered: float = COVERED) -> float:
    """Return the factor g on ``std`` [n] at which a weighted share ``covered`` has abs e ≤ 1.96 g std."""
    ratio = np.abs(error) / NORMAL_95 / std
    order = np.argsort(ratio, kind="stable")
    below = np.cumsum(weight[order]) / np.sum(weight)
    return float(ratio[order][min(int(np.searchsorted(below, covered)), len(order) - 1)])


def bin_weights(bins: IntArray, drive: IntArray) -> FloatArray:
    """Return weights [n], sum 1, at which every bin that occurs counts alike, and in a bin every drive.

    A drive of fewer than :data:`FULL_SAMPLES` samples in a bin counts by their number.
    """
    weight = np.zeros(bins.shape[0])
    for number in np.unique(bins):
        use = bins == number
        _, place, count = np.unique(drive[use], return_inverse=True, return_counts=True)
        share = 1.0 / np.maximum(count[place], FULL_SAMPLES)
        weight[use] = share / share.sum()
    weight /= weight.sum()
    return weight


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
    """Return the number of the bin [n] of a grip use [n]; −1 for an unknown grip use."""
    number = np.full(grip_share.shape[0], -1, dtype=np.int64)
    for i, (low, high) in enumerate(BINS.values()):
        number[(grip_share >= low) & (grip_share < high)] = i
    return number
