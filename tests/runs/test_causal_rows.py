"""Rows of estimates.parquet that are independent of later parts of the log."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import polars as pl
import pytest

from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs


def rows(sample_logs_dir: Path, out: Path, **options: Any) -> pl.DataFrame:
    config = RunConfig(car="saloon", keep="estimates", estimators=("zero", "pd-hef-smoothed"), **options)
    run_logs([str(sample_logs_dir / "dlc.mcap")], out, config, report=False)
    table = pl.read_parquet(out / "logs/dlc/estimates.parquet").with_columns(pl.col("estimator").cast(pl.String))
    return table.with_columns(after_s=(pl.col("stamp_ns") - pl.col("stamp_ns").min()) * 1e-9)


@pytest.mark.slow
def test_rows_are_causal_with_a_model_of_earlier_driving(sample_logs_dir: Path, tmp_path: Path) -> None:
    rows(sample_logs_dir, tmp_path / "earlier", end="4")
    table = rows(sample_logs_dir, tmp_path / "out", model=tmp_path / "earlier/logs/dlc/model.toml")
    of_zero = table.filter(estimator="zero")
    assert of_zero["causal"].filter(of_zero["after_s"] > 1.0).all()
    assert not table.filter(estimator="pd-hef-smoothed")["causal"].any()
    assert table.filter(estimator="truth")["causal"].is_null().all()
    assert table.filter(estimator="selected")["causal"].equals(table.filter(estimator="pd-hef")["causal"])


@pytest.mark.slow
def test_a_model_of_the_whole_log_is_causal_nowhere_in_it(sample_logs_dir: Path, tmp_path: Path) -> None:
    assert not rows(sample_logs_dir, tmp_path).filter(estimator="zero")["causal"].any()
