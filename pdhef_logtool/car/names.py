"""Words that are accepted in place of the path of a car or of its intervals."""

from __future__ import annotations

from pathlib import Path

#: The car that comes with the package, by name.
SHIPPED_CARS = {"saloon": Path(__file__).parents[1] / "models" / "default"}
#: Instead of a file: no intervals of the car, or wide ones for a car that may differ from its vehicle file.
NO_INTERVALS, UNSURE = "none", "unsure"
