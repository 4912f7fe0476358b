"""``linear-regression``: sideslip as a linear function of the network's low-passed features, a baseline.

v_y = v_x tan β, the rest as in ``pure-lstm``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

from pdhef_logtool.estimators.direct_network import DirectNetwork

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.presets import Options


class LinearRegression(DirectNetwork):
    """Sideslip by a linear regression on the network's features, through a low pass."""

    algorithm = "linear-regression"
    weights: ClassVar[str] = "coefficients"


def build(name: str, car: Car, options: Options) -> LinearRegression:
    """Return ``linear-regression`` for a car with such a model."""
    assert car.network is not None and car.network.linear_regression is not None
    return LinearRegression(car.vehicle, car.network.linear_regression, use_speed=options.use_speed, name=name)
