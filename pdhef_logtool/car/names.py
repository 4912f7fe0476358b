"""Names of cars and of their files."""

from __future__ import annotations

from pathlib import Path

#: Cars of the package, by name.
SHIPPED_CARS = {"saloon": Path(__file__).parents[1] / "models" / "default"}
#: What earlier drives show about a car, in its folder and in the outputs of a run (:mod:`~.model`).
MODEL_FILE = "model.toml"
