"""Prior of one fitted parameter: its distribution before any drive is used."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Prior:
    """Prior of one parameter, normal in its own or, if ``log``, in logarithmic scale; ``low`` bounds the value."""

    name: str
    unit: str
    mean: float
    std: float
    log: bool = False
    low: float | None = None
    tuning: bool = False  # belongs to the filter, not to the car: never put back to its prior

    def value(self, theta: float) -> float:
        """Return the parameter at a normalised distance from the prior."""
        return self.mean * math.exp(self.std * theta) if self.log else self.mean + self.std * theta

    def theta(self, value: float) -> float:
        """Return the normalised distance of a value."""
        return math.log(value / self.mean) / self.std if self.log else (value - self.mean) / self.std
