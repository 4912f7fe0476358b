"""Words that are accepted in place of the path of a car, and the file of its model."""

from pathlib import Path

#: Cars of the package, by name.
SHIPPED_CARS = {"saloon": Path(__file__).parents[1] / "models" / "default"}
#: Model of a car in its folder, and of a drive in the outputs of a run.
MODEL_FILE = "model.toml"
