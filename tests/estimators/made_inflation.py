"""Inflations of intervals for tests."""

from __future__ import annotations

from collections.abc import Sequence

from pdhef_logtool.car.parts import Inflation, SideslipCoefficients, YawRateCoefficients
from pdhef_logtool.estimators.intervals import SIDESLIP_TERMS, YAW_RATE_TERMS


def make_inflation(
    sideslip: Sequence[float],
    yaw_rate: Sequence[float],
    vy_factor: float = 1.0,
    grip_factors: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> Inflation:
    """Return an inflation of coefficients in the order of :data:`SIDESLIP_TERMS` and :data:`YAW_RATE_TERMS`."""
    return Inflation(
        sideslip=SideslipCoefficients(**dict(zip(SIDESLIP_TERMS, map(float, sideslip), strict=True))),
        yaw_rate=YawRateCoefficients(**dict(zip(YAW_RATE_TERMS, map(float, yaw_rate), strict=True))),
        vy_factor=float(vy_factor),
        grip_factors=grip_factors,
    )
