"""Recorded drives with truth, with the mappings and vehicles kept under tests/reference."""

from __future__ import annotations

import math
from pathlib import Path

import polars as pl
import pytest

from pdhef_logtool.config import RunConfig
from pdhef_logtool.pipeline import run_logs

REFERENCE = Path(__file__).resolve().parents[1] / "reference"


def _run(log: Path, mapping: str, vehicle: str, out: Path) -> tuple[pl.DataFrame, pl.DataFrame, int]:
    config = RunConfig(
        mapping=REFERENCE / "mappings" / mapping, vehicle=REFERENCE / "vehicles" / vehicle, annotate="sidecar"
    )
    result = run_logs([str(log)], out, config)
    folder = out / "logs" / result.results[0].outcome.log
    return pl.read_parquet(out / "metrics.parquet"), pl.read_parquet(folder / "estimates.parquet"), result.exit_code


def _sideslip_rmse_deg(metrics: pl.DataFrame) -> dict[str, float]:
    rows = metrics.filter(
        (pl.col("signal") == "sideslip_rad") & (pl.col("metric") == "rmse") & (pl.col("segment") == "all")
    )
    return {e: math.degrees(v) for e, v in rows.select("estimator", "value").iter_rows()}


def test_250_lm_physics_filter_beats_zero_and_kinematic(shared_dir: Path, tmp_path: Path) -> None:
    metrics, estimates, code = _run(
        shared_dir / "data/drives/revs_250lm_a.mcap", "revs_250lm.toml", "revs_250lm.toml", tmp_path
    )
    rmse = _sideslip_rmse_deg(metrics)
    assert code == 0
    assert rmse["phy-ukf"] < min(rmse["zero"], rmse["kinematic"])
    dependent = metrics.filter(pl.col("metric") == "not_independent")
    assert set(dependent["signal"]) == {"vx_m_s", "yaw_rate_rad_s"}
    assert estimates.filter(pl.col("estimator") == "phy-ukf")["valid"].mean() > 0.999


@pytest.mark.parametrize("name", ["f1tenth_hoons_run2.bag", "f1tenth_xray_run24.bag"])
def test_f1tenth_bags_run(shared_dir: Path, tmp_path: Path, name: str) -> None:
    metrics, estimates, code = _run(shared_dir / "data/drives" / name, "f1tenth.toml", "f1tenth.toml", tmp_path)
    rmse = _sideslip_rmse_deg(metrics)
    assert code == 0
    assert {"zero", "kinematic", "open-loop", "phy-ukf"} <= rmse.keys()
    assert all(math.isfinite(v) and v < 90.0 for v in rmse.values())
    assert "not_independent" not in set(metrics["metric"])
    assert estimates.filter(pl.col("estimator") == "phy-ukf")["valid"].mean() > 0.99


def test_a_lost_chunk_is_said_and_the_rest_is_used(shared_dir: Path, tmp_path: Path) -> None:
    folder = shared_dir / "data/drives"
    _, intact, _ = _run(folder / "revs_250lm_a.mcap", "revs_250lm.toml", "revs_250lm.toml", tmp_path / "intact")
    _, hurt, code = _run(
        folder / "faulty/revs_250lm_a_flipped_byte.mcap", "revs_250lm.toml", "revs_250lm.toml", tmp_path / "hurt"
    )
    assert code == 3
    start = intact["stamp_ns"].min()
    assert isinstance(start, int)
    columns = [c for c in intact.columns if c != "estimator"]

    def part(frame: pl.DataFrame, from_s: float, to_s: float) -> pl.DataFrame:
        elapsed = (pl.col("stamp_ns") - start) / 1e9
        return frame.filter((pl.col("estimator") == "phy-ukf") & (elapsed >= from_s) & (elapsed < to_s)).select(columns)

    # The lost chunk spans 146.2 to 154.8 s of log time.
    assert part(hurt, 0.0, 146.0).equals(part(intact, 0.0, 146.0), null_equal=True)
    both = part(hurt, 160.0, 400.0).join(part(intact, 160.0, 400.0), on="stamp_ns", suffix="_intact")
    assert both.height > 13_000
    difference = (both["sideslip_rad"] - both["sideslip_rad_intact"]).abs().max()
    assert isinstance(difference, float)
    assert math.degrees(difference) < 0.01
