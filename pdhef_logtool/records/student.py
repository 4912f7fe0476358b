"""Quantiles of Student's t without SciPy, because its import takes longer than processing a short log."""

import math
from functools import cache
from statistics import NormalDist

#: Of Newton's method: largest number of steps, and relative precision.
STEPS, PRECISION = 20, 1e-12


@cache
def student_quantile(share: float, freedom: float) -> float:
    """Return the quantile with infinite or a whole number of degrees of freedom, by Newton's method."""
    t = NormalDist().inv_cdf(share)
    if math.isinf(freedom):
        return t
    t += (t**3 + t) / (4.0 * freedom)
    scale = math.exp(math.lgamma(0.5 * (freedom + 1.0)) - math.lgamma(0.5 * freedom)) / math.sqrt(math.pi * freedom)
    for _ in range(STEPS):
        density = scale * (1.0 + t * t / freedom) ** (-0.5 * (freedom + 1.0))
        change = (share - _distribution(t, int(freedom))) / density
        t += change
        if abs(change) < PRECISION * abs(t):
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
