"""Where the friction of a run comes from, from the log to the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from pdhef_logtool.car.toml_files import part_toml, read_vehicle_file
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs

pytestmark = pytest.mark.slow

#: The road of the drives with this vehicle file.
SLIPPERY = 0.3

TOLD = """fill_recognised = true
[signals.friction]
topic = "/truth/perfect/state"
field = "friction"
"""


@pytest.fixture(scope="module")
def files(sample_logs_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    vehicle = read_vehicle_file(sample_logs_dir / "vehicle.toml").vehicle.model_copy(update={"friction": None})
    (folder / "car.toml").write_text(part_toml(vehicle))
    (folder / "told.toml").write_text(TOLD)
    return folder


def run(log: Path, out: Path, **changes: Any) -> tuple[dict[str, Any], pl.DataFrame]:
    values: dict[str, Any] = {"keep": "estimates", "network": Path("none"), "estimators": ("phy-ukf",), **changes}
    result = run_logs([str(log)], out, RunConfig(**values), report=False)
    report = result.results[0].report
    assert report is not None
    table = pl.read_parquet(out / "logs" / log.stem / "estimates.parquet")
    return report, table.with_columns(pl.col("estimator").cast(pl.String))


@pytest.mark.parametrize(
    ("choice", "with_topic", "car", "source", "value"),
    [
        ("auto", True, "sample", "topic", SLIPPERY),
        ("auto", False, "sample", "vehicle file", 0.85),
        ("file", True, "sample", "vehicle file", 0.85),
        (0.5, False, "car", "option", 0.5),
        ("auto", False, "car", "no value given", 1.0),
    ],
)
def test_what_is_asked_for_is_told_to_the_estimators(
    choice: Any, with_topic: bool, car: str, source: str, value: float,
    files: Path, sample_logs_dir: Path, tmp_path: Path,
) -> None:  # fmt: skip
    file = sample_logs_dir / "vehicle.toml" if car == "sample" else files / "car.toml"
    mapping = files / "told.toml" if with_topic else None
    report, track = run(sample_logs_dir / "sweep.mcap", tmp_path, car=file, mapping=mapping, friction=choice, end="+3s")
    assert report["friction"]["source"] == source
    assert report["friction"]["given"] is (source != "no value given")
    assert report["friction"]["topic"] == ("/truth/perfect/state.friction" if source == "topic" else None)
    friction = track.filter(pl.col("estimator") != "truth")["friction"].drop_nulls().drop_nans().to_numpy()
    assert friction.size
    np.testing.assert_allclose(friction, value, atol=1e-6)
