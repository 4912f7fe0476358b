"""Drives that give no estimate: exit codes, notes and losses."""

import json
from dataclasses import dataclass
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
from studies.mcap_logs import messages, stamp_ns, stamped, write_log
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
def silenced(monkeypatch):
    """Put the silent estimator in the place of ``phy-ukf``."""

    def runnable(*arguments: Any) -> Any:
        ready, skipped = table.runnable(*arguments)
        return [_Silent() if e.name == "phy-ukf" else e for e in ready], skipped

    monkeypatch.setattr(estimating, "runnable", runnable)


def _run(log: Path, out: Path, *estimators: str) -> RunResult:
    config = RunConfig(estimators=estimators, car=Path("saloon"), keep="estimates", network=Path("none"))
    return run_logs([str(log)], out, config, report=False)


def test_standstill_alone_is_no_failure_and_is_said(tmp_path):
    names = "time [s],speed [m/s],steering_angle [rad],accel_x [m/s^2],accel_y [m/s^2],yaw_rate [rad/s]"
    noise = np.random.default_rng(0).normal(0.0, 0.01, (1000, 5))
    log = tmp_path / "odd.csv"
    np.savetxt(log, np.c_[np.arange(1000) / 100.0, noise], "%.4f", ",", header=names, comments="")
    result = _run(log, tmp_path / "out", "zero", "phy-ukf")
    assert result.exit_code == 0
    (log,) = result.results
    assert any("the car is never faster than" in text for text in log.report["warnings"])


@pytest.mark.usefixtures("silenced")
def test_an_estimator_without_a_valid_row_while_the_car_moves(tmp_path, sample_logs_dir):
    result = _run(sample_logs_dir / "step.mcap", tmp_path, "zero", "phy-ukf")
    (log,) = result.results
    assert result.exit_code == 3
    silent = [x["what"] for x in log.report["losses"] if x["kind"] == "no-valid-row"]
    assert silent == [f"silent {SAID}"]


@pytest.mark.usefixtures("silenced")
def test_no_valid_row_of_any_estimator_fails_and_keeps_the_report(tmp_path, sample_logs_dir, monkeypatch):
    monkeypatch.setattr(estimating, "default_names", lambda _car, _available: ())  # physics has valid rows
    words = ("run", sample_logs_dir / "step.mcap", "-o", tmp_path, "-e", "phy-ukf", "--car", "saloon")
    done = called(*words, "--network", "none", "--keep", "estimates", "--no-report", "--json")
    assert done.returncode == 1
    report = json.loads((tmp_path / "logs" / "step" / "report.json").read_text())
    assert [x["kind"] for x in report["losses"]] == ["no-valid-row"]
    said = f"no estimator {SAID.replace('no', 'a', 1)}"
    assert done.stderr.splitlines()[-1] == f"pdhef: step: {said}"


def test_a_signal_that_ends_before_the_car_moves_is_named_as_the_cause():
    stamps = np.arange(200, dtype=np.int64) * 10_000_000
    moving = stamps > stamps[99]
    signals = signals_at(stamps, ay_m_s2=np.where(moving, np.nan, 0.1), yaw_rate_rad_s=0.1, speed_m_s=10.0)
    assert why_silent(signals, moving) == "no samples of ay_m_s2 while it does"


@pytest.mark.parametrize(("share", "code"), [(0.005, 0), (0.03, 3)])
def test_the_share_of_dropped_samples_decides(share, code, tmp_path, sample_logs_dir):
    """Some samples of the IMU have the stamp of the one before."""
    drive = [*messages(sample_logs_dir / "step.mcap")]
    imu = [i for i, m in enumerate(drive) if m.topic == "/imu/data"]
    for k in np.linspace(10, len(imu) - 10, round(share * len(imu))).astype(int):
        drive[imu[k]] = stamped(drive[imu[k]], stamp_ns(drive[imu[k - 1]]))
    result = _run(write_log(tmp_path / "odd.mcap", drive, "ros2"), tmp_path / "out", "zero")
    assert result.exit_code == code
    (log,) = result.results
    (count,) = [c for c in log.report["ledger"]["samples"] if c["name"] == "ay_m_s2"]
    assert count["used"] + sum(count["dropped"].values()) == count["total"]
    assert count["dropped"] == {"duplicate-stamp": round(share * count["total"])}
