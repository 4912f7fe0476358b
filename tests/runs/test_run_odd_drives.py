"""Drives that give no estimate: exit codes, notes and losses."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from reference_car import signals_at

from pdhef_logtool.estimators import table
from pdhef_logtool.estimators.base import Steps
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.runs import estimating
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.estimating import why_silent
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.runs.run_result import RunResult
from studies.torture.hours import Drive, read_samples, write_samples
from tests.command_line import called

SAID = "has no valid row although the car moves: its signals are there, but the estimator marks none as valid"


@dataclass(frozen=True)
class _Silent:
    """An estimator that is never sure of anything."""

    algorithm = "silent"
    version = 1

    name: str = "silent"
    causal: bool = True

    def run(self, signals: Signals, state: object) -> tuple[Steps, None]:
        nothing = np.zeros((len(signals), 4))
        return Steps(nothing, nothing, np.zeros(len(signals), np.bool_)), None


@pytest.fixture
def silenced(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the silent estimator in the place of ``phy-ukf``."""

    def runnable(*arguments: Any) -> Any:
        ready, skipped = table.runnable(*arguments)
        return [_Silent() if e.name == "phy-ukf" else e for e in ready], skipped

    monkeypatch.setattr(estimating, "runnable", runnable)


def _run(change: Callable[[Drive], Drive], folder: Path, sample_logs_dir: Path, *estimators: str) -> RunResult:
    log = folder / "odd.mcap"
    write_samples(log, [change(read_samples(sample_logs_dir / "step.mcap"))])
    config = RunConfig(estimators=estimators, car=Path("saloon"), keep="estimates", network=Path("none"))
    return run_logs([str(log)], folder / "out", config, report=False)


def test_standstill_alone_is_no_failure_and_is_said(tmp_path: Path, sample_logs_dir: Path) -> None:
    def standing(drive: Drive) -> Drive:
        level = {"w": 1.0}
        still = {t: {k: np.full_like(v, level.get(k[-1], 0.0)) for k, v in s.values.items()} for t, s in drive.items()}
        return {t: replace(s, values=still[t]) for t, s in drive.items()}

    result = _run(standing, tmp_path, sample_logs_dir, "zero", "phy-ukf")
    assert result.exit_code == 0
    (log,) = result.results
    assert log.report is not None
    assert any("the car is never faster than" in text for text in log.report["warnings"])


@pytest.mark.usefixtures("silenced")
def test_an_estimator_without_a_valid_row_while_the_car_moves(tmp_path: Path, sample_logs_dir: Path) -> None:
    result = _run(dict, tmp_path, sample_logs_dir, "zero", "phy-ukf")
    (log,) = result.results
    assert result.exit_code == 3
    assert log.report is not None
    silent = [x["what"] for x in log.report["losses"] if x["kind"] == "no-valid-row"]
    assert silent == [f"silent {SAID}"]


@pytest.mark.usefixtures("silenced")
def test_no_valid_row_of_any_estimator_fails_and_keeps_the_report(
    tmp_path: Path, sample_logs_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimating, "default_names", lambda _car, _available: ())  # physics has valid rows
    write_samples(tmp_path / "odd.mcap", [read_samples(sample_logs_dir / "step.mcap")])
    words = ("run", tmp_path / "odd.mcap", "-o", tmp_path / "out", "-e", "phy-ukf", "--car", "saloon")
    done = called(*words, "--network", "none", "--keep", "estimates", "--no-report", "--json")
    assert done.returncode == 1
    report = json.loads((tmp_path / "out" / "logs" / "odd" / "report.json").read_text())
    assert [x["kind"] for x in report["losses"]] == ["no-valid-row"]
    said = f"no estimator {SAID.replace('no', 'a', 1)}"
    assert done.stderr.splitlines()[-1] == f"pdhef: odd: {said}"


def test_a_signal_that_ends_before_the_car_moves_is_named_as_the_cause() -> None:
    stamps = np.arange(200, dtype=np.int64) * 10_000_000
    moving = stamps > stamps[99]
    signals = signals_at(stamps, ay_m_s2=np.where(moving, np.nan, 0.1), yaw_rate_rad_s=0.1, speed_m_s=10.0)
    assert why_silent(signals, moving) == "no samples of ay_m_s2 while it does"


@pytest.mark.parametrize(("share", "code"), [(0.005, 0), (0.03, 3)])
def test_the_share_of_dropped_samples_decides(share: float, code: int, tmp_path: Path, sample_logs_dir: Path) -> None:
    def jumbled(drive: Drive) -> Drive:
        """Repeat the stamps of some samples."""
        imu = drive["/imu/data"]
        stamps = imu.stamp_ns.copy()
        again = np.linspace(10, stamps.size - 10, round(share * stamps.size)).astype(int)
        stamps[again] = stamps[again - 1]
        return drive | {"/imu/data": replace(imu, stamp_ns=stamps)}

    result = _run(jumbled, tmp_path, sample_logs_dir, "zero")
    assert result.exit_code == code
    (log,) = result.results
    assert log.report is not None
    (count,) = [c for c in log.report["ledger"]["samples"] if c["name"] == "ay_m_s2"]
    assert count["used"] + sum(count["dropped"].values()) == count["total"]
    assert count["dropped"] == {"duplicate-stamp": round(share * count["total"])}
