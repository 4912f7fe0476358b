"""Runs with a cache of slim logs: the figures of the logs themselves, which are not read again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import polars as pl
import pytest

from pdhef_logtool.drive import slim_cache
from pdhef_logtool.records.errors import EXIT_OK, UsageError
from pdhef_logtool.runs.config import RunConfig, load_config
from pdhef_logtool.runs.fleet import run_logs

NAMES = ("dlc", "step_rosbag2")


def _run(logs: Path, out: Path, **changes: Any) -> tuple[pl.DataFrame, list[dict[str, Any]]]:
    config = RunConfig(estimators=("zero", "kinematic"), annotate="sidecar", **changes)
    paths = [str(next(logs.glob(f"{name}*"))) for name in NAMES]
    assert run_logs(paths, out, config, report=False).exit_code == EXIT_OK
    reports = [json.loads((out / f"logs/{name}/report.json").read_text()) for name in NAMES]
    for report in reports:
        report["remarks"] = [r for r in report["remarks"] if not r.startswith("a reduced log replaces")]
    return pl.read_parquet(out / "metrics.parquet"), reports


def _cars(folder: Path, sample_logs_dir: Path) -> Path:
    (folder / "cars.toml").write_text('default = "saloon"\n[metadata]\nmanoeuvre = {"step steer" = "saloon"}\n')
    return folder / "cars.toml"


@pytest.mark.slow
def test_the_figures_are_those_of_the_logs_which_are_read_once(
    sample_logs_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cars = _cars(tmp_path, sample_logs_dir)
    own = _run(sample_logs_dir, tmp_path / "own", cars=cars)
    cache = str(tmp_path / "cache")
    first = _run(sample_logs_dir, tmp_path / "first", cars=cars, cache=cache)
    monkeypatch.setattr(slim_cache, "slim_log", lambda *_: pytest.fail("a log is read again"))
    second = _run(sample_logs_dir, tmp_path / "second", cars=cars, cache=cache)
    for metrics, reports in (first, second):
        assert metrics.equals(own[0])
        assert reports == own[1]
    assert len(list((tmp_path / "cache").rglob("*.mcap"))) == len(NAMES)


def test_a_cache_and_a_full_copy_exclude_each_other(tmp_path: Path) -> None:
    assert RunConfig(cache="x").annotation == "sidecar"
    assert "cache" not in RunConfig(cache="x").to_dict()
    with pytest.raises(UsageError, match="leave out --cache"):
        load_config(None, {"cache": "x", "annotate": "full"})
    with pytest.raises(UsageError, match="reduced logs contain the positions"):
        load_config(None, {"cache": "x", "no_position": True})
    assert RunConfig(cache="x", no_position=True).read_options.cache is None
    (tmp_path / "pdhef.toml").write_text('cache = "slim"\n')
    assert load_config(tmp_path / "pdhef.toml", {}).cache == str(tmp_path / "slim")
    (tmp_path / "pdhef.toml").write_text('cache = "s3://cars/slim"\n')
    assert load_config(tmp_path / "pdhef.toml", {}).cache == "s3://cars/slim"
