"""Quantiles of chi-square without SciPy, because its import takes longer than processing a short log."""

from __future__ import annotations

import math
from statistics import NormalDist

_STEPS, _PRECISION = 20, 1e-12


def chi_square_quantile(share: float, freedom: float) -> float:
    """Return the quantile by Newton's method from the approximation of Wilson and Hilferty."""
    spread = 2.0 / (9.0 * freedom)
    x = freedom * (1.0 - spread + NormalDist().inv_cdf(share) * math.sqrt(spread)) ** 3
    for _ in range(_STEPS):
        density = 0.5 * math.exp((0.5 * freedom - 1.0) * math.log(0.5 * x) - 0.5 * x - math.lgamma(0.5 * freedom))
        below, term, k = 0.0, 2.0 * x * density / freedom, freedom
        while term > _PRECISION**2 * below:  # series of the probability of less than x (Abramowitz & Stegun 6.5.29)
            below, k = below + term, k + 2.0
            term *= x / k
        change = (share - below) / density
        x += change
        if abs(change) < _PRECISION * x:
            break
    return x
