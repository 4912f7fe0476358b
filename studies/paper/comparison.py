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
    """Median, smallest and largest of a figure over the noise seeds."""

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
    """

    value: float
    low: float
    high: float
    n: int


def _chosen(runs: Iterable[Run], scenario: str, scheme: str, figure: str) -> list[Run]:
    return [r for r in runs if r.scenario == scenario and r.scheme == scheme and figure in r.values]


def spread(experiment: Experiment, scenario: str, scheme: str, figure: str) -> Spread | None:
    """Return a figure of a scheme over the seeds; None where the scheme has no such figure."""
    values = [r.values[figure] for r in _chosen(experiment.runs, scenario, scheme, figure)]
    if not values:
        return None
    return Spread(float(np.median(values)), min(values), max(values), len(values))


def improvement(
    experiment: Experiment, scenario: str, scheme: str, baseline: str, figure: str = "sideslip_deg"
) -> Improvement | None:
    """Return 1 − RMSE(scheme) / RMSE(baseline), pooled over the seeds, with its bounds; None if one is missing."""
    ours = _chosen(experiment.runs, scenario, scheme, figure)
    theirs = _chosen(experiment.runs, scenario, baseline, figure)
    if not ours or not theirs:
        return None
    a, b = ({r.noise_seed: r.values[figure] ** 2 for r in runs} for runs in (ours, theirs))
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
    value = float(share(squares.sum(axis=0)))
    return Improvement(value, low, high, len(seeds))
