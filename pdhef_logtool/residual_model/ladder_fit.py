"""Fit of residual models by ridge regression, with order and λ from nested cross-validation over drives or blocks.

A model is fitted through the response of the filter: the regressors are the changes of the sideslip by each feature as
a residual rate of v_y. From :data:`LEAST_DRIVES` drives on, whole drives are held out, otherwise blocks of drives.
The fit includes one constant per drive, which is discarded, because it may be an offset of the ground truth or of a
sensor. With sums over blocks instead of samples, all fits of the cross-validation are small linear systems.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.records.running_mean import running_mean
from pdhef_logtool.records.signals import LEAST_DIVISOR, S_PER_NS, BoolArray, FloatArray, IntArray
from pdhef_logtool.residual_model.features import EVEN_COUNT, ODD_COUNT, SPEED_COLUMN, SlowFeatures
from pdhef_logtool.residual_model.ladder import LINEAR, NONE, RANDOM, REGION_RIDGE, LadderModel, plain
from pdhef_logtool.residual_model.ladder_kernels import Basis, expand

#: Ridge parameters, in seconds of driving with features of variance 1. Blocks of the same drive favour values down to
#: 30 s, but on other drives of the car a residual with less than 1000 s often increases the error.
LAMBDAS = (1000.0, 3000.0, 10000.0)
#: Blocks of the cross-validation: largest number, shortest length, and time at the end that no fold uses, because the
#: features of the next block depend on it.
MOST_BLOCKS, LEAST_BLOCK_S, FORGET_S = 10, 4.0, 2.0
LEAST_DRIVES = 3
#: Arrays of the random features.
RANDOM_ARRAYS = ("odd_directions", "even_directions", "phases")
#: Number of features with responses computed together, for the memory of a long drive.
TOGETHER = 25
#: A model replaces a simpler one if its squared error in held-out blocks is lower by at least this many standard errors
#: of the paired differences, and its RMSE by this share. λ is the largest value within one standard error.
STANDARD_ERRORS, LEAST_GAIN = 1.3, 0.02
#: Number of random features, scale of their frequencies, and least duration of driving for them.
RANDOM_FEATURES, FREQUENCY, RANDOM_LEAST_S = 200, 0.4, 60.0
#: Features and errors of a fit are reduced by their means over this time, because slow errors may be due to bank.
SLOW_S = 5.0
#: Sample rate of a fit.
FIT_RATE_HZ = 25.0
QUANTILE = 0.98


@dataclass(frozen=True, slots=True, eq=False)
class TaughtDrive:
    """A drive with ground truth: features of its steps and the missing sideslip of ``physics`` [K], NaN if unknown.

    ``response`` : changes of the sideslip at the stamps [K, m] by rates of v_y at the steps [K, m].
    ``weight`` : of the sideslip, from the uncertainty of the ground truth.
    """

    name: str
    stamps_ns: IntArray
    features: SlowFeatures
    lacking_rad: FloatArray
    response: Callable[[FloatArray], FloatArray] = np.array
    weight: FloatArray | float = 1.0

    @property
    def usable(self) -> BoolArray:
        """Mask of steps with finite features and error, [K]."""
        usable = np.isfinite(self.lacking_rad) & np.isfinite(self.features.odd).all(axis=1)
        return np.asarray(usable & np.isfinite(self.features.even).all(axis=1), dtype=np.bool_)


@dataclass(frozen=True, slots=True)
class RungTrial:
    """A model in the nested cross-validation: RMSE in degrees over held-out blocks, without constants.

    ``difference_deg2``: difference of the squared error to the model ``against``, with its standard error. ``taken``:
    whether the model is significantly better.
    """

    rung: str
    rmse_deg: float
    against: str
    difference_deg2: float
    standard_error_deg2: float
    taken: bool


@dataclass(frozen=True, slots=True, eq=False)
class LadderFit:
    """The chosen model, None for ``none``; all tested models; driving in s; number of blocks."""

    model: LadderModel | None
    trials: tuple[RungTrial, ...]
    seconds: float
    blocks: int

    @property
    def rung(self) -> str:
        """Name of the chosen model."""
        return NONE if self.model is None else self.model.rung


@dataclass(frozen=True, slots=True, eq=False)
class _Sample:
    """Data of a drive for a fit [K]: its usable rows, error, its weight in s; duration of a row."""

    drive: TaughtDrive
    rows: IntArray
    error: FloatArray
    weight_s: FloatArray
    step_s: float

    @property
    def seconds(self) -> float:
        return len(self.error) * self.step_s


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """A least-squares problem by blocks of drives.

    ``blocks`` [B, c + 2, c + 2]: integrals over time of the products of (1, features, error), in s; ``drives`` [B]: the
    drive of each block; ``whole``: the sums of each drive, with the ends that no block contains.
    """

    blocks: FloatArray
    drives: IntArray
    whole: FloatArray

    def only(self, columns: int) -> "_Problem":
        """Return the problem with only the first features."""
        kept = [*range(columns + 1), -1]
        return _Problem(self.blocks[:, kept][:, :, kept], self.drives, self.whole[:, kept][:, :, kept])

    def block_error(self, block: int, without: Sequence[int], ridge: float | None) -> float:
        """Return the sum of squares of a block after a fit without some blocks; ``ridge`` None fits constants alone."""
        used = ~np.isin(np.arange(len(self.drives)), without)
        sums = {d: self.blocks[used & (self.drives == d)].sum(axis=0) for d in np.unique(self.drives)}
        weights = np.zeros(self.blocks.shape[1] - 2)
        if ridge is not None:
            weights = _solve([s for s in sums.values() if s[0, 0] > 0.0], ridge)
        first = sums[self.drives[block]][0]
        constant = (first[-1] - weights @ first[1:-1]) / first[0] if first[0] > 0.0 else 0.0
        left = np.concatenate([[-constant], -weights, [1.0]])
        return float(left @ self.blocks[block] @ left)


def _solve(drives: Sequence[FloatArray], ridge: float) -> FloatArray:
    """Return the weights of a ridge regression with a free constant for each drive."""
    # Products of features and error after subtraction of their means.
    normal = np.sum([(d - np.outer(d[0], d[0]) / d[0, 0])[1:, 1:] for d in drives], axis=0)
    return np.asarray(np.linalg.solve(normal[:-1, :-1] + ridge * np.eye(len(normal) - 1), normal[:-1, -1]))


def fit_ladder(drives: Sequence[TaughtDrive], *, rungs: Sequence[str] = (LINEAR, RANDOM)) -> LadderFit:
    """Choose a model and fit it; a constant that is added to a drive's error does not change the result."""
    samples = [s for s in map(_thinned, drives) if s.seconds >= LEAST_BLOCK_S]
    seconds = math.fsum(s.seconds for s in samples)
    if not samples or seconds < 2.0 * LEAST_BLOCK_S:
        return LadderFit(None, (), seconds, 0)
    odd, even = (np.concatenate([getattr(s.drive.features, n)[s.rows] for s in samples]) for n in ("odd", "even"))
    scale = np.maximum(np.sqrt(np.mean(odd**2, axis=0)), 1e-9)
    even_mean, even_scale = even.mean(axis=0), np.maximum(even.std(axis=0), 1e-3)
    count = RANDOM_FEATURES if RANDOM in rungs and seconds >= RANDOM_LEAST_S else 0
    rng = np.random.default_rng(0)
    basis = Basis(
        scale, even_mean, even_scale, rng.normal(size=(count, ODD_COUNT)) * FREQUENCY,
        rng.normal(size=(count, EVEN_COUNT)) * FREQUENCY, rng.uniform(0.0, 2.0 * math.pi, count),
    )  # fmt: skip
    responses = [_responses(basis, s) for s in samples]
    unit = max(float(np.sqrt(np.mean(np.concatenate([r[:, :ODD_COUNT] for r in responses]) ** 2))), LEAST_DIVISOR)
    problem = _problem(samples, [r / unit for r in responses], seconds)
    linear = problem.only(ODD_COUNT)
    trials, chosen = _climb({LINEAR: linear} | ({RANDOM: problem} if count else {}))
    if chosen == NONE:
        return LadderFit(None, trials, seconds, len(problem.blocks))
    taken = linear if chosen == LINEAR else problem
    random = 0 if chosen == LINEAR else count
    used = ODD_COUNT + random
    weights = _solve(list(taken.whole), _best_ridge(taken, ())) / unit
    phi = np.concatenate([_features(basis, s.drive.features, s.rows) for s in samples])[:, :used]
    speed = np.quantile(even[:, SPEED_COLUMN], [1.0 - QUANTILE, QUANTILE])
    model = LadderModel(
        rung=chosen,  # type: ignore[arg-type]
        **{name: plain(values) for name, values in _part(basis, slice(random))._asdict().items()},
        weights=plain(weights),
        whitening=plain(_whitening(odd / scale)),
        speed_m_s=plain(np.maximum(speed, 0.1)),
        largest_m_s2=plain(np.quantile(np.abs(phi @ weights), 0.999)),
    )
    return LadderFit(model, trials, seconds, len(problem.blocks))


def _features(basis: Basis, features: SlowFeatures, rows: IntArray | slice) -> FloatArray:
    """Return the features of rows, 0 where an input is unknown: the odd ones, then the random ones."""
    odd, even = features.odd[rows], features.even[rows]
    out = np.empty((len(odd), ODD_COUNT + len(basis.phases)))
    expand(odd, even, basis, out)
    return out


def _part(basis: Basis, part: slice) -> Basis:
    """Return a basis with a part of its random features."""
    return basis._replace(**{name: getattr(basis, name)[part] for name in RANDOM_ARRAYS})


def _responses(basis: Basis, sample: _Sample) -> FloatArray:
    """Return the changes of the sideslip by each feature as a rate, at the rows of a sample."""
    columns = []
    for first in range(0, max(len(basis.phases), 1), TOGETHER):
        part = _part(basis, slice(first, first + TOGETHER))
        phi = _features(part, sample.drive.features, slice(None))
        columns.append(sample.drive.response(phi if first == 0 else phi[:, ODD_COUNT:])[sample.rows])
    return np.concatenate(columns, axis=1)


def _thinned(drive: TaughtDrive) -> _Sample:
    """Return the data of a drive for a fit, at most :data:`FIT_RATE_HZ` rows per second."""
    step_s = float(np.median(np.diff(drive.stamps_ns))) * S_PER_NS if len(drive.stamps_ns) > 1 else 1.0
    every = max(1, round(1.0 / (FIT_RATE_HZ * step_s)))
    rows = np.flatnonzero(drive.usable)[::every]
    weight_s = step_s * every * np.broadcast_to(drive.weight, drive.lacking_rad.shape)[rows]
    return _Sample(drive, rows, drive.lacking_rad[rows], weight_s, step_s * every)


def _problem(samples: Sequence[_Sample], phi: Sequence[FloatArray], seconds: float) -> _Problem:
    length_s = max(seconds / MOST_BLOCKS, LEAST_BLOCK_S)
    blocks, drives, whole = [], [], []
    for number, (sample, features) in enumerate(zip(samples, phi, strict=True)):
        table = np.column_stack([features, sample.error])
        table -= running_mean(table, round(SLOW_S / sample.step_s) // 2, sample.weight_s)
        table = np.column_stack([np.ones(len(table)), table])
        weighted = sample.weight_s[:, None] * table
        count = 1 if len(samples) >= LEAST_DRIVES else max(1, round(sample.seconds / length_s))
        whole.append(weighted.T @ table)
        for part in np.array_split(np.arange(len(table)), count):
            inner = part[: max(1, len(part) - round(FORGET_S / sample.step_s))]
            blocks.append(weighted[inner].T @ table[inner])
            drives.append(number)
    return _Problem(np.array(blocks), np.array(drives), np.array(whole))


def _climb(problems: dict[str, _Problem]) -> tuple[tuple[RungTrial, ...], str]:
    """Test the models in order; return all trials and the last accepted model."""
    some = next(iter(problems.values()))
    count, seconds = len(some.blocks), some.blocks[:, 0, 0]
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
    """Return the largest λ with a held-out error within one standard error of the lowest."""
    inner = [k for k in range(len(problem.blocks)) if k not in without]
    if len(inner) < 2:
        return LAMBDAS[-1]
    errors = np.array([[problem.block_error(k, (*without, k), ridge) for k in inner] for ridge in LAMBDAS])
    best = int(np.argmin(errors.sum(axis=1)))
    difference = errors - errors[best]
    spread = np.std(difference, axis=1, ddof=1) * math.sqrt(len(inner))
    near = np.flatnonzero(difference.sum(axis=1) <= spread)
    return LAMBDAS[int(near.max(initial=best))]


def _whitening(z: FloatArray) -> FloatArray:
    """Return the whitening matrix, with distance 1 at the :data:`QUANTILE` of the drives."""
    second = z.T @ z / len(z) + REGION_RIDGE * np.eye(z.shape[1])
    root = np.linalg.inv(np.linalg.cholesky(second))
    distance2 = np.sum((z @ root.T) ** 2, axis=1)
    return np.asarray(root / math.sqrt(max(float(np.quantile(distance2, QUANTILE)), LEAST_DIVISOR)), dtype=np.float64)
