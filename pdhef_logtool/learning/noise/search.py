"""The search for filter noise that estimators share: one space, one objective, one number of trials.

See docs/method.md#noise.

A trial is a point of the space for every estimator. The first half of the trials is a scrambled Sobol sequence, the
same points for all. The rest are Gaussian steps from each estimator's own best point so far, in the logarithms of the
factors, with a width that shrinks on the same schedule and with the same random numbers for all. Nothing depends on
the number of processes or on which other estimators take part.

The objective is the mean over drives of ln √(RMSE² + floor²) of the sideslip, reported as its exponential, a geometric
mean in degrees: every drive counts by its relative error, so that neither one spin decides (as in a pooled RMSE) nor is
half of the drives ignored (as in a median). The floor keeps drives that hardly turn from deciding instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.estimators.phy_ukf import PHY_UKF_Q_STD
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.records.signals import BoolArray, FloatArray
from pdhef_logtool.records.tracks import StateTrack

#: Added to each drive's RMSE as squares: a gain far below this is worth little.
FLOOR_RAD = math.radians(0.05)
#: An estimate that is missing at more of the scored stamps counts as no better than sideslip 0 on that drive.
MIN_AVAILABILITY = 0.9
#: Share of the trials that explore the whole space.
EXPLORING_SHARE = 0.5
#: 1-sigma of the local steps, from first to last, as a share of each factor's logarithmic range.
STEP_FIRST, STEP_LAST = 0.15, 0.02
#: Two of these explore and two refine: fewer are no search.
MIN_TRIALS = 4
#: Significant digits of the values, so that what is written is what was scored.
DIGITS = 4
#: A best value this close to an end of its range, as a share of the range, is reported.
NEAR_END = 0.02


@dataclass(frozen=True, slots=True)
class Factor:
    """One dimension of the search: a 1-sigma that is drawn log-uniformly from [low, high]."""

    name: str
    unit: str
    low: float
    high: float

    def value(self, share: float) -> float:
        """Return the value at a share in [0, 1] of the logarithmic range."""
        return float(f"{self.low * (self.high / self.low) ** share:.{DIGITS}g}")

    def share(self, value: float) -> float:
        """Return the place of a value in the logarithmic range."""
        return math.log(value / self.low) / math.log(self.high / self.low)


#: The space of every estimator. It contains sensor-level and model-error-level noise and more on both sides; the other
#: noises (speed, a_x bias, further states) stay what they are.
FACTORS = (
    Factor("q_vy", "m/s/sqrt(s)", 0.002, 2.0),
    Factor("q_yaw_rate", "rad/s/sqrt(s)", 0.001, 1.0),
    Factor("r_ay", "m/s^2", 0.02, 5.0),
    Factor("r_yaw_rate", "rad/s", 0.0002, 0.05),
)


def filter_tuning(values: Sequence[float]) -> FilterNoise:
    """Return the noise for values in the order of :data:`FACTORS`."""
    q_vy, q_yaw_rate, r_ay, r_yaw_rate = values
    return FilterNoise(
        q_std=(PHY_UKF_Q_STD[0], q_vy, q_yaw_rate), r_std={"ay_m_s2": r_ay, "yaw_rate_rad_s": r_yaw_rate}
    )


@dataclass(frozen=True, slots=True)
class DriveError:
    """Sideslip error of one estimator on one drive.

    Attributes
    ----------
    rmse_rad : over the stamps that ``pdhef run`` scores; NaN where there is no estimate at all.
    truth_rms_rad : of the ground truth, which is the error of β = 0.
    scored, expected : stamps with an error, and stamps with ground truth above the low-speed limit.
    """

    rmse_rad: float
    truth_rms_rad: float
    scored: int
    expected: int

    @property
    def counted_rad(self) -> float:
        """The RMSE that counts: no less than that of β = 0 where too much of the estimate is missing."""
        if self.scored == 0:
            return self.truth_rms_rad
        if self.scored < MIN_AVAILABILITY * self.expected:
            return max(self.rmse_rad, self.truth_rms_rad)
        return self.rmse_rad


def drive_error(estimate: StateTrack, truth: StateTrack, low_speed_m_s: float) -> DriveError:
    """Score the sideslip of an estimate [N] against the ground truth [N] as ``pdhef run`` does."""
    error = signal_error(estimate, truth, "sideslip_rad", low_speed_m_s)
    error = error[np.isfinite(error)]
    scorable = truth.sideslip_rad[scorable_stamps(truth, low_speed_m_s)]
    return DriveError(
        rmse_rad=float(np.sqrt(np.mean(error**2))) if error.size else math.nan,
        truth_rms_rad=float(np.sqrt(np.mean(scorable**2))) if scorable.size else math.nan,
        scored=int(error.size),
        expected=int(scorable.size),
    )


def scorable_stamps(truth: StateTrack, low_speed_m_s: float) -> BoolArray:
    """Return where [N] the ground truth's sideslip is known above the low-speed limit."""
    finite: BoolArray = np.isfinite(signal_error(truth, truth, "sideslip_rad", low_speed_m_s))
    return finite


@dataclass(frozen=True, slots=True)
class Score:
    """Figures of one trial over all drives, in degrees; ``objective_deg`` is minimised, the others have no floor."""

    objective_deg: float
    median_deg: float
    pooled_deg: float


def score_drives(errors: Sequence[DriveError]) -> Score:
    """Return the figures over drives; every drive counts alike but in ``pooled_deg``."""
    counted = np.array([e.counted_rad for e in errors])
    weight = np.array([e.expected for e in errors], dtype=np.float64)
    return Score(
        objective_deg=math.degrees(math.exp(float(np.mean(np.log(np.hypot(counted, FLOOR_RAD)))))),
        median_deg=math.degrees(float(np.median(counted))),
        pooled_deg=math.degrees(math.sqrt(float(np.sum(weight * counted**2) / np.sum(weight)))),
    )


@dataclass(frozen=True, slots=True)
class Trial:
    """One point of one estimator: its values in the order of the factors, and what it scored."""

    number: int
    stage: Literal["sobol", "refine"]
    values: tuple[float, ...]
    score: Score


#: Scores a point of every estimator, by name.
Evaluate = Callable[[Mapping[str, tuple[float, ...]]], Mapping[str, Score]]


def search(
    evaluate: Evaluate,
    names: Sequence[str],
    factors: Sequence[Factor] = FACTORS,
    *,
    trials: int,
    seed: int,
    progress: Callable[[int], None] = lambda _done: None,
) -> dict[str, tuple[Trial, ...]]:
    """Return every trial of every estimator, ``trials`` each; :func:`best_trial` picks the winner.

    Parameters
    ----------
    evaluate : called once a trial with one point for each of ``names``.
    seed : of the Sobol scrambling and of the local steps.
    progress : called with the number of trials that are done.
    """
    exploring = max(1, round(EXPLORING_SHARE * trials))
    shares = sobol_points(len(factors), exploring, seed)
    steps = local_steps(len(factors), trials - exploring, seed)
    trials_of: dict[str, list[Trial]] = {name: [] for name in names}
    for number in range(trials):
        points: dict[str, tuple[float, ...]] = {}
        for name in names:
            if number < exploring:
                place = shares[number]
            else:
                best = best_trial(trials_of[name])
                centre = np.array([f.share(v) for f, v in zip(factors, best.values, strict=True)])
                place = np.clip(centre + steps[number - exploring], 0.0, 1.0)
            points[name] = tuple(f.value(float(s)) for f, s in zip(factors, place, strict=True))
        scores = evaluate(points)
        for name in names:
            stage: Literal["sobol", "refine"] = "sobol" if number < exploring else "refine"
            trials_of[name].append(Trial(number, stage, points[name], scores[name]))
        progress(number + 1)
    return {name: tuple(of_name) for name, of_name in trials_of.items()}


def best_trial(trials: Sequence[Trial]) -> Trial:
    """Return the trial with the smallest objective, the first of equals."""
    return min(trials, key=lambda t: (t.score.objective_deg, t.number))


def sobol_points(dimensions: int, count: int, seed: int) -> FloatArray:
    """Return the first ``count`` points [count, dimensions] in [0, 1) of a scrambled Sobol sequence."""
    from scipy.stats import qmc

    exponent = max(0, (count - 1).bit_length())
    points: FloatArray = qmc.Sobol(dimensions, scramble=True, seed=seed).random_base2(exponent)[:count]
    return points


def local_steps(dimensions: int, count: int, seed: int) -> FloatArray:
    """Return the steps [count, dimensions] of the refinement in shares of the ranges; their width shrinks."""
    width = np.geomspace(STEP_FIRST, STEP_LAST, count) if count else np.empty(0)
    normal = np.random.default_rng([seed, dimensions]).standard_normal((count, dimensions))
    return np.asarray(width[:, None] * normal, dtype=np.float64)


def at_an_end(trial: Trial, factors: Sequence[Factor] = FACTORS) -> tuple[str, ...]:
    """Return the names of the factors whose value is at an end of its range."""
    shares = ((f.name, f.share(v)) for f, v in zip(factors, trial.values, strict=True))
    return tuple(name for name, s in shares if not NEAR_END < s < 1.0 - NEAR_END)
