"""Where the friction of a run comes from, from the log to report and terminal; an estimate on the simulated drives."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from rich.console import Console

from pdhef_logtool.car.toml_files import read_vehicle_file, vehicle_toml
from pdhef_logtool.cli.run_tables import render_run
from pdhef_logtool.estimators.friction_bank import USUAL_FRICTION
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.runs.run_result import RunResult
from tests.run_report import follows

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
    (folder / "car.toml").write_text(vehicle_toml(vehicle))
    (folder / "told.toml").write_text(TOLD)
    return folder


def run(log: Path, out: Path, **changes: Any) -> tuple[RunResult, dict[str, Any], pl.DataFrame]:
    values: dict[str, Any] = {"keep": "estimates", "network": Path("none"), "estimators": ("phy-ukf",), **changes}
    result = run_logs([str(log)], out, RunConfig(**values), report=False)
    report = result.results[0].report
    assert report is not None
    table = pl.read_parquet(out / "logs" / log.stem / "estimates.parquet")
    return result, report, table.with_columns(pl.col("estimator").cast(pl.String))


@pytest.fixture(scope="module")
def slippery(files: Path, sample_logs_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Any:
    return run(sample_logs_dir / "sweep.mcap", tmp_path_factory.mktemp("out"), car=files / "car.toml")


def test_a_slippery_road_is_found(slippery: Any) -> None:
    _, report, track = slippery

    follows(report)
    said = report["friction"]
    assert (said["source"], said["estimated"]) == ("estimate", True)
    last = track.filter(estimator="phy-ukf")["friction"].to_numpy()[-200:]
    assert np.abs(last - SLIPPERY).max() < 0.1 < abs(USUAL_FRICTION - SLIPPERY)
    shown = [s for s in report["segments"] if s["name"] == "friction observable"]
    seconds = sum(s["end_ns"] - s["start_ns"] for s in shown) * 1e-9
    assert said["observable_share"] > 0.2
    assert seconds == pytest.approx(said["observable_share"] * report["log"]["duration_s"], rel=0.1)
    assert 0.5 <= said["observable_std"] < 0.6, "no drive has shown that the tyres of the file are right"


def test_the_terminal_and_the_warnings_say_it(slippery: Any) -> None:
    result, report, _ = slippery
    assert any("estimated online" in r for r in report["remarks"])
    console = Console(file=io.StringIO(), width=200)
    render_run(result, console)
    said = " ".join(console.file.getvalue().split())  # type: ignore[attr-defined]
    assert f"friction estimated ({report['friction']['summary']})" in said
    assert "of the time" in report["friction"]["summary"]


def test_ordinary_driving_shows_no_friction(files: Path, sample_logs_dir: Path, tmp_path: Path) -> None:
    _, report, track = run(sample_logs_dir / "road.mcap", tmp_path, car=files / "car.toml", end="+90s")
    assert report["friction"]["observable_share"] < 0.02
    friction = track.filter(pl.col("estimator") != "truth")["friction"].drop_nulls().drop_nans().to_numpy()
    assert np.mean(friction < 0.6) < 0.02


def test_the_friction_of_the_log_does_not_reach_an_estimate(
    slippery: Any, files: Path, sample_logs_dir: Path, tmp_path: Path
) -> None:
    told = {"car": files / "car.toml", "mapping": files / "told.toml", "friction": "estimate"}
    _, report, track = run(sample_logs_dir / "sweep.mcap", tmp_path, **told)
    assert report["friction"] == slippery[1]["friction"]
    assert track.equals(slippery[2])


@pytest.mark.parametrize(
    ("choice", "with_topic", "car", "source", "value"),
    [
        ("auto", True, "sample", "topic /truth/perfect/state.friction", SLIPPERY),
        ("auto", False, "sample", "vehicle file, 0.85", 0.85),
        ("file", True, "sample", "vehicle file, 0.85", 0.85),
        (0.5, False, "car", "option, 0.5", 0.5),
    ],
)
def test_what_is_asked_for_is_told_to_the_estimators(
    choice: Any, with_topic: bool, car: str, source: str, value: float,
    files: Path, sample_logs_dir: Path, tmp_path: Path,
) -> None:  # fmt: skip
    file = sample_logs_dir / "vehicle.toml" if car == "sample" else files / "car.toml"
    mapping = files / "told.toml" if with_topic else None
    _, report, track = run(
        sample_logs_dir / "sweep.mcap", tmp_path, car=file, mapping=mapping, friction=choice, end="+3s"
    )
    said = report["friction"]
    assert (said["source"], said["estimated"], said["observable_share"]) == (source, False, None)
    friction = track.filter(pl.col("estimator") != "truth")["friction"].drop_nulls().drop_nans().to_numpy()
    assert friction.size
    np.testing.assert_allclose(friction, value, atol=1e-6)


def test_a_vehicle_file_without_friction_cannot_be_asked_for_it(
    files: Path, sample_logs_dir: Path, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match="--friction"):
        run(sample_logs_dir / "sweep.mcap", tmp_path, car=files / "car.toml", friction="file")
