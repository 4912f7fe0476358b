"""Medians and ranges over seeds, and improvements with paired bootstrap bounds over the noise seeds."""

from __future__ import annotations

from typing import Any

import numpy as np
import polars as pl

BOOTSTRAP_DRAWS = 10_000
BOOTSTRAP_SEED = 0
LEVEL = 0.95


def spread(metrics: pl.DataFrame, scenario: str, scheme: str, figure: str) -> dict[str, Any] | None:
    """Return median, lowest and highest of a figure over the seeds; None where the scheme has no such figure."""
    values = metrics.filter(scenario=scenario, scheme=scheme, figure=figure)["value"].to_numpy()
    if not len(values):
        return None
    return {"median": float(np.median(values)), "low": min(values), "high": max(values), "n": len(values)}


def improvement(metrics: pl.DataFrame, scenario: str, scheme: str, baseline: str) -> dict[str, Any] | None:
    """Return the relative reduction of the sideslip RMSE, pooled over the seeds; None if a scheme is missing.

    Its bounds are those of a bootstrap in which seeds are drawn in pairs; NaN with fewer than two.
    """
    of = metrics.filter(scenario=scenario, figure="sideslip_deg")
    ours, theirs = (of.filter(scheme=name).select("noise_seed", "value") for name in (scheme, baseline))
    both = ours.join(theirs, on="noise_seed", suffix="_baseline").sort("noise_seed")
    if both.is_empty():
        return None
    squares = both.select("value", "value_baseline").to_numpy() ** 2

    def share(sums: np.ndarray) -> np.ndarray:
        return np.asarray(1.0 - np.sqrt(sums[..., 0] / sums[..., 1]))

    low = high = float("nan")
    if len(squares) > 1:
        draws = np.random.default_rng(BOOTSTRAP_SEED).integers(len(squares), size=(BOOTSTRAP_DRAWS, len(squares)))
        bounds = np.percentile(share(squares[draws].sum(axis=1)), [50.0 * (1.0 - LEVEL), 50.0 * (1.0 + LEVEL)])
        low, high = map(float, bounds)
    return {"value": float(share(squares.sum(axis=0))), "low": low, "high": high, "n": len(squares)}
