"""Topics that arrive too late are read by their stamps and named; no estimate is then reported as causal."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest
from odd_clocks import S, rewrite

from pdhef_logtool.car.car import Car
from pdhef_logtool.cli.app import app
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.records.signals import Signals

STEERING = "/vehicle/status/steering_status"
INPUTS = ("steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s")


@pytest.fixture(scope="module")
def late(sample_logs_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the double lane change with steering that arrives 0.8 s later, with its stamps as they were."""
    path = tmp_path_factory.mktemp("late") / "late.mcap"
    rewrite(
        sample_logs_dir / "dlc.mcap", path, lambda _n, _s, topic: round(0.8 * S) if topic == STEERING else 0,
        lambda _n, _s, _topic: 0,
    )  # fmt: skip
    return path


def signals_of(path: Path, **options: Any) -> tuple[Signals, list[str], str]:
    options = {"friction": 1.0, **options}
    with read_drive(path, Car.load("saloon"), options=ReadOptions(**options)) as drive:
        return drive.whole().signals, drive.notes, drive.not_causal


def run(capsys: pytest.CaptureFixture[str], out: Path, *arguments: object) -> tuple[int, dict[str, Any], str]:
    given = ["run", *map(str, arguments), "-o", str(out), "--car", "saloon", "--no-report", "--annotate", "none"]
    code = app(given, prog_name="pdhef", standalone_mode=False) or 0
    (report,) = out.glob("logs/*/report.json")
    return code, json.loads(report.read_text(encoding="utf-8")), capsys.readouterr().err


def test_only_the_late_topic_is_read_by_stamp_and_it_is_named(late: Path, sample_logs_dir: Path) -> None:
    found, notes, not_causal = signals_of(late)
    sound, no_notes, causal = signals_of(sample_logs_dir / "dlc.mcap")
    assert causal == ""
    assert not any("stamps" in n for n in no_notes)
    for name in INPUTS:
        np.testing.assert_array_equal(getattr(found, name), getattr(sound, name)[: len(found)])
    lag = (found.ready_ns - found.stamps_ns)[10:-10]
    assert lag.max() < 0.1 * S, "0.8 s if the late topic were waited for"
    assert not_causal == "not causal: steer_rad read by stamp, not by arrival"
    (note,) = [n for n in notes if "stamps" in n]
    assert STEERING in note
    assert "0.81 s" in note
    assert "0.3 s" in note


@pytest.mark.slow
def test_a_run_of_it_scores_and_calls_nothing_causal(
    late: Path, sample_logs_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, report, err = run(capsys, tmp_path / "out", late, "--estimators", "zero,phy-ukf")
    assert code == 0
    assert STEERING in err
    assert [e["causal"] for e in report["estimators"]] == [False] * 2
    assert all("steer_rad read by stamp" in " ".join(e["notes"]) for e in report["estimators"])
    rows = pl.read_parquet(tmp_path / "out/logs/late/estimates.parquet").filter(estimator="phy-ukf")
    assert rows["valid"].mean() > 0.95  # type: ignore[operator]
    run(capsys, tmp_path / "sound", sample_logs_dir / "dlc.mcap", "--estimators", "zero,phy-ukf")
    sound = pl.read_parquet(tmp_path / "sound/logs/dlc/estimates.parquet").filter(estimator="phy-ukf")
    both = rows.join(sound, on="stamp_ns").filter("valid", "valid_right")
    assert (both["vy_m_s"] - both["vy_m_s_right"]).abs().max() < 1e-9  # type: ignore[operator]
