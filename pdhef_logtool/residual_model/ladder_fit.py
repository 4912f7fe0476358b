"""Fit of the ladder of residual models: ridge regression, with rung and λ by nested cross-validation over blocks.

A sideslip error of each drive is fitted up to a constant, which is not kept: it may be an offset of the ground truth or
of a sensor. With sums over blocks instead of samples, all fits of the cross-validation are small linear systems.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.residual_model.ladder import (
    LINEAR,
    NONE,
    RANDOM,
    REGION_RIDGE,
    Correction,
    LadderModel,
    plain,
)
from pdhef_logtool.residual_model.ladder_kernels import expand
from pdhef_logtool.residual_model.slow_features import EVEN_COUNT, ODD_COUNT, SPEED_COLUMN, SlowFeatures

#: Ridge parameters that are tried, in seconds of driving with features of variance 1. Blocks of the same drive favour
#: values down to 30 s; on other drives of the car a residual with less than 1000 s often increases the error.
LAMBDAS = (1000.0, 3000.0, 10000.0)
#: Blocks of the cross-validation: most of them, the shortest one, and its end that counts in no fold, because the
#: features of the next block remember it.
MOST_BLOCKS, LEAST_BLOCK_S, FORGET_S = 10, 4.0, 2.0
#: A rung is taken where its squared error in blocks that it has not seen is below that of the simpler one by so many
#: standard errors of the paired differences, and its RMSE by this share. λ: the largest within one standard error.
STANDARD_ERRORS, LEAST_GAIN = 1.3, 0.02
#: Random features, the length of their frequencies, and the driving that they need.
RANDOM_FEATURES, FREQUENCY, RANDOM_LEAST_S = 200, 0.4, 60.0
#: Directions of the posterior that are kept.
DIRECTIONS = 16
#: Mean over so many seconds that neither features nor errors have in a fit: a slow error may be due to bank.
SLOW_S = 5.0
#: Samples a second that a fit uses.
FIT_RATE_HZ = 25.0
QUANTILE = 0.98


@dataclass(frozen=True, slots=True, eq=False)
class TaughtDrive:
    """A drive with ground truth: features of its steps [K], the sideslip that ``physics`` lacks, NaN where unknown."""

    name: str
    stamps_ns: IntArray
    features: SlowFeatures
    lacking_rad: FloatArray

    @property
    def usable(self) -> BoolArray:
        """Whether features and error are known, [K]."""
        usable = np.isfinite(self.lacking_rad) & np.isfinite(self.features.odd).all(axis=1)
        return np.asarray(usable & np.isfinite(self.features.even).all(axis=1), dtype=np.bool_)


@dataclass(frozen=True, slots=True)
class RungTrial:
    """A rung in the nested cross-validation: RMSE in degrees in blocks that no choice has seen, without constants.

    ``difference_deg2`` of the squared error to the rung ``against``, with its standard error. ``taken``: whether it is
    better by enough.
    """

    rung: str
    rmse_deg: float
    against: str
    difference_deg2: float
    standard_error_deg2: float
    taken: bool


@dataclass(frozen=True, slots=True, eq=False)
class LadderFit:
    """The model, None for the rung ``none``; λ; the rungs that were tried; driving in s; blocks."""

    model: LadderModel | None
    ridge: float
    trials: tuple[RungTrial, ...]
    seconds: float
    blocks: int

    @property
    def rung(self) -> str:
        """The rung that was chosen."""
        return NONE if self.model is None else self.model.rung


@dataclass(frozen=True, slots=True, eq=False)
class _Sums:
    """Sums over samples of a drive's block, each in seconds: of 1, features, error, and their products."""

    seconds: float
    phi: FloatArray
    error: float
    phi_phi: FloatArray
    phi_error: FloatArray
    error_error: float

    @classmethod
    def of(cls, phi: FloatArray, error: FloatArray, step_s: float) -> _Sums:
        return cls(
            len(error) * step_s, phi.sum(axis=0) * step_s, float(error.sum()) * step_s,
            phi.T @ phi * step_s, phi.T @ error * step_s, float(error @ error) * step_s,
        )  # fmt: skip

    def __add__(self, other: _Sums) -> _Sums:
        return _Sums(
            self.seconds + other.seconds, self.phi + other.phi, self.error + other.error,
            self.phi_phi + other.phi_phi, self.phi_error + other.phi_error, self.error_error + other.error_error,
        )  # fmt: skip

    def centred(self) -> tuple[FloatArray, FloatArray]:
        """Return ΣφφT and Σφe without the means: what a free constant leaves of them."""
        mean = self.phi / self.seconds
        return self.phi_phi - np.outer(mean, self.phi), self.phi_error - mean * self.error

    def squares(self, weights: FloatArray, constant: float) -> float:
        """Return the sum of squares of error − φ·w − c."""
        w, c = weights, constant
        fitted = w @ self.phi_phi @ w + 2.0 * c * (w @ self.phi) + c * c * self.seconds
        return float(self.error_error - 2.0 * (w @ self.phi_error + c * self.error) + fitted)


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Sums of the blocks of all drives, and the drive of each block; ``whole`` also has the ends of the blocks."""

    blocks: tuple[_Sums, ...]
    drives: tuple[int, ...]
    whole: tuple[_Sums, ...]

    def only(self, columns: int) -> _Problem:
        """Return the problem with the first features alone."""

        def cut(s: _Sums) -> _Sums:
            return _Sums(
                s.seconds, s.phi[:columns], s.error, s.phi_phi[:columns, :columns], s.phi_error[:columns], s.error_error
            )

        return _Problem(tuple(map(cut, self.blocks)), self.drives, tuple(map(cut, self.whole)))

    def kept(self, without: Sequence[int]) -> dict[int, _Sums]:
        """Return the sums by drive without some blocks."""
        drives: dict[int, _Sums] = {}
        for k, (block, drive) in enumerate(zip(self.blocks, self.drives, strict=True)):
            if k not in without:
                drives[drive] = drives[drive] + block if drive in drives else block
        return drives

    def block_error(self, block: int, without: Sequence[int], ridge: float | None) -> float:
        """Return the sum of squares of a block after a fit without some blocks; ``ridge`` None fits constants alone."""
        drives = self.kept(without)
        size = self.blocks[0].phi.size
        weights = np.zeros(size) if ridge is None else _solve(list(drives.values()), ridge)
        trained = drives.get(self.drives[block])
        constant = 0.0 if trained is None else (trained.error - float(weights @ trained.phi)) / trained.seconds
        return self.blocks[block].squares(weights, constant)


def _solve(drives: Sequence[_Sums], ridge: float) -> FloatArray:
    """Return the weights of a ridge regression with a free constant for each drive."""
    size = drives[0].phi.size
    normal, right = ridge * np.eye(size), np.zeros(size)
    for drive in drives:
        phi_phi, phi_error = drive.centred()
        normal += phi_phi
        right += phi_error
    return np.asarray(np.linalg.solve(normal, right), dtype=np.float64)


def _expanded(
    features: tuple[FloatArray, FloatArray], odd_directions: FloatArray, even_directions: FloatArray, phases: FloatArray
) -> FloatArray:
    """Return the odd features [N, 16] of a drive, then its random ones."""
    odd, even = features
    out = np.empty((len(odd), ODD_COUNT + len(phases)))
    expand(odd, even, odd_directions, even_directions, phases, out)
    return out


def fit_ladder(drives: Sequence[TaughtDrive], *, rungs: Sequence[str] = (LINEAR, RANDOM), seed: int = 0) -> LadderFit:
    """Choose a rung and fit it; the result does not depend on a constant that is added to a drive's error."""
    samples = [s for s in map(_thinned, drives) if len(s[0]) * s[3] >= LEAST_BLOCK_S]
    seconds = math.fsum(len(s[0]) * s[3] for s in samples)
    if not samples or seconds < 2.0 * LEAST_BLOCK_S:
        return LadderFit(None, math.inf, (), seconds, 0)
    odd, even = (np.concatenate([s[i] for s in samples]) for i in (0, 1))
    scale = np.maximum(np.sqrt(np.mean(odd**2, axis=0)), 1e-9)
    even_mean, even_scale = even.mean(axis=0), np.maximum(even.std(axis=0), 1e-3)
    count = RANDOM_FEATURES if RANDOM in rungs and seconds >= RANDOM_LEAST_S else 0
    rng = np.random.default_rng(seed)
    odd_directions = rng.normal(size=(count, ODD_COUNT)) * FREQUENCY
    even_directions = rng.normal(size=(count, EVEN_COUNT)) * FREQUENCY
    phases = rng.uniform(0.0, 2.0 * math.pi, count)
    z, e, errors = [], [], []
    for sample_odd, sample_even, error, step_s in samples:
        z.append(np.ascontiguousarray(sample_odd / scale))
        e.append(np.ascontiguousarray((sample_even - even_mean) / even_scale))
        errors.append((error, step_s))
    phi = [_expanded(of, odd_directions, even_directions, phases) for of in zip(z, e, strict=True)]
    fast = [without_slow(np.column_stack([p, error]), round(SLOW_S / step)) for p, (error, step) in _zip(phi, errors)]
    problem = _problem([f[:, :-1] for f in fast], [(f[:, -1], step) for f, (_, step) in _zip(fast, errors)], seconds)
    linear = problem.only(ODD_COUNT)
    trials, chosen = _climb({LINEAR: linear} | ({RANDOM: problem} if count else {}))
    if chosen == NONE:
        return LadderFit(None, math.inf, trials, seconds, len(problem.blocks))
    taken = linear if chosen == LINEAR else problem
    ridge = _best_ridge(taken, ())
    weights = _solve(taken.whole, ridge)
    random = 0 if chosen == LINEAR else count
    used = np.concatenate(phi)[:, : ODD_COUNT + random]
    rmse_rad = math.radians(next(t.rmse_deg for t in trials if t.rung == chosen))
    normal = ridge * np.eye(used.shape[1]) + sum(drive.centred()[0] for drive in taken.whole)
    speed = np.quantile(even[:, SPEED_COLUMN], [1.0 - QUANTILE, QUANTILE])
    model = LadderModel(
        rung=chosen,  # type: ignore[arg-type]
        scale=plain(scale),
        even_mean=plain(even_mean),
        even_scale=plain(even_scale),
        odd_directions=plain(odd_directions[:random]),
        even_directions=plain(even_directions[:random]),
        phases=plain(phases[:random]),
        weights=plain(weights),
        factor=plain(_factor(normal, used, rmse_rad)),
        whitening=plain(_whitening(np.concatenate(z))),
        speed_m_s=plain(np.maximum(speed, 0.1)),
        largest_rad=plain(np.quantile(np.abs(used @ weights), 0.999)),
    )
    return LadderFit(model, ridge, trials, seconds, len(problem.blocks))


def _zip(
    columns: Sequence[FloatArray], errors: Sequence[tuple[FloatArray, float]]
) -> Iterator[tuple[FloatArray, tuple[FloatArray, float]]]:
    return zip(columns, errors, strict=True)


def without_slow(columns: FloatArray, count: int) -> FloatArray:
    """Return columns [K, c] less their mean over ``count`` rows about each."""
    rows, half = np.arange(len(columns)), count // 2
    sums = np.concatenate([np.zeros((1, columns.shape[1])), np.cumsum(columns, axis=0)])
    first, last = np.maximum(rows - half, 0), np.minimum(rows + half + 1, len(columns))
    return np.asarray(columns - (sums[last] - sums[first]) / (last - first)[:, None], dtype=np.float64)


def _thinned(drive: TaughtDrive) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    """Return odd and even features, the error, and the duration of a sample, at most so many a second."""
    step_s = float(np.median(np.diff(drive.stamps_ns))) * 1e-9 if len(drive.stamps_ns) > 1 else 1.0
    every = max(1, round(1.0 / (FIT_RATE_HZ * step_s)))
    rows = np.flatnonzero(drive.usable)[::every]
    return drive.features.odd[rows], drive.features.even[rows], drive.lacking_rad[rows], step_s * every


def _problem(phi: Sequence[FloatArray], errors: Sequence[tuple[FloatArray, float]], seconds: float) -> _Problem:
    length_s = max(seconds / MOST_BLOCKS, LEAST_BLOCK_S)
    blocks, drives, whole = [], [], []
    for number, (rows, (error, step_s)) in enumerate(zip(phi, errors, strict=True)):
        count = max(1, round(len(error) * step_s / length_s))
        whole.append(_Sums.of(rows, error, step_s))
        for part in np.array_split(np.arange(len(error)), count):
            inner = part[: max(1, len(part) - round(FORGET_S / step_s))]
            blocks.append(_Sums.of(rows[inner], error[inner], step_s))
            drives.append(number)
    return _Problem(tuple(blocks), tuple(drives), tuple(whole))


def _climb(problems: dict[str, _Problem]) -> tuple[tuple[RungTrial, ...], str]:
    """Try the rungs in order; return what was tried, and the last one that was taken."""
    some = next(iter(problems.values()))
    count, seconds = len(some.blocks), np.array([b.seconds for b in some.blocks])
    errors = {NONE: np.array([some.block_error(k, (k,), None) for k in range(count)])}
    trials = [RungTrial(NONE, _rmse_deg(errors[NONE], seconds), "", 0.0, 0.0, True)]
    chosen = NONE
    if count < 3:
        return tuple(trials), chosen
    for rung, problem in problems.items():
        errors[rung] = np.array([problem.block_error(k, (k,), _best_ridge(problem, (k,))) for k in range(count)])
        difference = (errors[rung] - errors[chosen]) * math.degrees(1.0) ** 2
        spread = float(np.std(difference, ddof=1)) * math.sqrt(count)
        total = float(difference.sum())
        rmse, before = (_rmse_deg(errors[name], seconds) for name in (rung, chosen))
        taken = total + STANDARD_ERRORS * spread < 0.0 and rmse < (1.0 - LEAST_GAIN) * before
        whole_s = float(seconds.sum())
        trials.append(RungTrial(rung, rmse, chosen, total / whole_s, spread / whole_s, taken))
        chosen = rung if taken else chosen
    return tuple(trials), chosen


def _rmse_deg(squares: FloatArray, seconds: FloatArray) -> float:
    return math.degrees(math.sqrt(max(float(squares.sum()), 0.0) / float(seconds.sum())))


def _best_ridge(problem: _Problem, without: tuple[int, ...]) -> float:
    """Return the largest λ whose error in held-out blocks is within one standard error of the lowest."""
    inner = [k for k in range(len(problem.blocks)) if k not in without]
    if len(inner) < 2:
        return LAMBDAS[-1]
    errors = np.array([[problem.block_error(k, (*without, k), ridge) for k in inner] for ridge in LAMBDAS])
    best = int(np.argmin(errors.sum(axis=1)))
    difference = errors - errors[best]
    spread = np.std(difference, axis=1, ddof=1) * math.sqrt(len(inner))
    near = np.flatnonzero(difference.sum(axis=1) <= spread)
    return LAMBDAS[int(near.max(initial=best))]


def _factor(normal: FloatArray, phi: FloatArray, rmse_rad: float) -> FloatArray:
    """Return L [k, m] whose product with its transpose is the posterior covariance in the directions that count."""
    root = rmse_rad * np.linalg.inv(np.linalg.cholesky(normal)).T
    moved = phi @ root
    _, axes = np.linalg.eigh(moved.T @ moved)
    return np.asarray(root @ axes[:, ::-1][:, :DIRECTIONS], dtype=np.float64)


def _whitening(z: FloatArray) -> FloatArray:
    """Return the matrix of the distance, 1 at that of :data:`QUANTILE` of the drives."""
    second = z.T @ z / len(z) + REGION_RIDGE * np.eye(z.shape[1])
    root = np.linalg.inv(np.linalg.cholesky(second))
    distance2 = np.sum((z @ root.T) ** 2, axis=1)
    return np.asarray(root / math.sqrt(max(float(np.quantile(distance2, QUANTILE)), 1e-9)), dtype=np.float64)


def corrected_rmse_deg(drive: TaughtDrive, correction: Correction | None) -> tuple[float, float]:
    """Return the RMSE of a drive's error in degrees with a correction, and the same without its constant."""
    lacking = drive.lacking_rad if correction is None else drive.lacking_rad - correction.gain * correction.residual_rad
    error = np.degrees(lacking[drive.usable])
    return float(np.sqrt(np.mean(error**2))), float(np.std(error))
