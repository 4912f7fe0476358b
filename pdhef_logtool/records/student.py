"""Quantiles of Student's t and of chi-square without SciPy, whose import takes longer than a short log."""

from __future__ import annotations

import math
from functools import cache
from statistics import NormalDist

_STEPS, _PRECISION = 20, 1e-12


@cache
def student_quantile(share: float, freedom: float) -> float:
    """Return the quantile with infinite or a whole number of degrees of freedom, by Newton's method."""
    t = NormalDist().inv_cdf(share)
    if math.isinf(freedom):
        return t
    t += (t**3 + t) / (4.0 * freedom)
    scale = math.exp(math.lgamma(0.5 * (freedom + 1.0)) - math.lgamma(0.5 * freedom)) / math.sqrt(math.pi * freedom)
    for _ in range(_STEPS):
        density = scale * (1.0 + t * t / freedom) ** (-0.5 * (freedom + 1.0))
        change = (share - _distribution(t, int(freedom))) / density
        t += change
        if abs(change) < _PRECISION * abs(t):
            break
    return t


def _distribution(t: float, freedom: int) -> float:
    """Return the probability of less than t (Abramowitz & Stegun 26.7.3, 26.7.4)."""
    angle = math.atan2(t, math.sqrt(freedom))
    is_odd = freedom % 2
    term = math.cos(angle) if is_odd else 1.0
    total = 0.0 if freedom == 1 else term
    for k in range(2 + is_odd, freedom - 1, 2):
        term *= math.cos(angle) ** 2 * (k - 1) / k
        total += term
    inside = math.sin(angle) * total
    return 0.5 + (angle + inside) / math.pi if is_odd else 0.5 + 0.5 * inside


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
