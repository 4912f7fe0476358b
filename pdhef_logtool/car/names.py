"""Words that are accepted in place of the path of a car."""

from __future__ import annotations

from pathlib import Path

#: Cars of the package, by name.
SHIPPED_CARS = {"saloon": Path(__file__).parents[1] / "models" / "default"}
