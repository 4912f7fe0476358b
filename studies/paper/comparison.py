"""Medians and ranges over seeds, and improvements with paired bootstrap bounds over the noise seeds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from studies.paper.experiment import Experiment, Run

BOOTSTRAP_DRAWS = 10_000
BOOTSTRAP_SEED = 0
LEVEL = 0.95


@dataclass(frozen=True, slots=True)
class Spread:
    """Median, smallest and largest of a figure over all noise and training seeds."""

    median: float
    low: float
    high: float
    n: int


@dataclass(frozen=True, slots=True)
class Improvement:
    """Relative reduction of the pooled RMSE of one scheme against another.

    Attributes
    ----------
    low, high : percentile bounds, noise seeds drawn in pairs; NaN with fewer than two.
    seeds_low, seeds_high : the same share by each network alone, smallest and largest.
    """

    value: float
    low: float
    high: float
    n: int
    seeds_low: float
    seeds_high: float

    @property
    def proven(self) -> bool:
        """Whether the whole interval lies above 0."""
        return bool(self.low > 0.0)


def _chosen(runs: Iterable[Run], scenario: str, scheme: str, figure: str) -> list[Run]:
    return [r for r in runs if r.scenario == scenario and r.scheme == scheme and figure in r.values]


def spread(experiment: Experiment, scenario: str, scheme: str, figure: str) -> Spread | None:
    """Return a figure of a scheme over the seeds; None where the scheme has no such figure."""
    values = [r.values[figure] for r in _chosen(experiment.runs, scenario, scheme, figure)]
    if not values:
        return None
    return Spread(float(np.median(values)), min(values), max(values), len(values))


def _mean_squares(runs: list[Run], figure: str, training_seed: int | None = None) -> dict[int, float]:
    """Return the mean square error by noise seed, over all networks or one; schemes without a network always count."""
    squares_by_seed: dict[int, list[float]] = {}
    for run in runs:
        if training_seed is None or run.training_seed in (None, training_seed):
            squares_by_seed.setdefault(run.noise_seed, []).append(run.values[figure] ** 2)
    return {seed: float(np.mean(v)) for seed, v in squares_by_seed.items()}


def improvement(
    experiment: Experiment, scenario: str, scheme: str, baseline: str, figure: str = "sideslip_deg"
) -> Improvement | None:
    """Return 1 − RMSE(scheme) / RMSE(baseline), pooled over the seeds, with its bounds; None if one is missing."""
    ours = _chosen(experiment.runs, scenario, scheme, figure)
    theirs = _chosen(experiment.runs, scenario, baseline, figure)
    if not ours or not theirs:
        return None
    a, b = _mean_squares(ours, figure), _mean_squares(theirs, figure)
    seeds = sorted(a.keys() & b.keys())
    if not seeds:
        return None
    squares = np.array([[a[s], b[s]] for s in seeds])

    def share(sums: np.ndarray) -> np.ndarray:
        return np.asarray(1.0 - np.sqrt(sums[..., 0] / sums[..., 1]))

    low = high = float("nan")
    if len(seeds) > 1:
        rng = np.random.default_rng(BOOTSTRAP_SEED)
        draws = rng.integers(len(seeds), size=(BOOTSTRAP_DRAWS, len(seeds)))
        bounds = np.percentile(share(squares[draws].sum(axis=1)), [50.0 * (1.0 - LEVEL), 50.0 * (1.0 + LEVEL)])
        low, high = float(bounds[0]), float(bounds[1])
    by_network = []
    for training_seed in sorted({r.training_seed for r in (*ours, *theirs) if r.training_seed is not None}):
        c, d = _mean_squares(ours, figure, training_seed), _mean_squares(theirs, figure, training_seed)
        by_network.append(float(share(np.array([[c[s], d[s]] for s in seeds]).sum(axis=0))))
    value = float(share(squares.sum(axis=0)))
    by_network = by_network or [value]
    return Improvement(value, low, high, len(seeds), min(by_network), max(by_network))
