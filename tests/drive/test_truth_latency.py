"""The latency of the ground truth is applied only if it exceeds two standard errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.drive.delays import LatencyEstimate
from pdhef_logtool.drive.plan import DrivePlan, plan_drive
from pdhef_logtool.drive.recorded import read_recorded
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping.choosing import auto_map
from pdhef_logtool.records.tracks import StateTrack

ERROR_S = 0.002


@pytest.fixture(scope="module")
def planned(sample_logs_dir: Path) -> Iterator[tuple[DriveLog, DrivePlan]]:
    with closing(open_log(sample_logs_dir / "step.mcap")) as log:
        yield log, plan_drive(log, auto_map(log).mapping, default_vehicle(), log.start_ns, log.end_ns)


def with_latency(plan: DrivePlan, latency_s: float, std_error_s: float = ERROR_S) -> DrivePlan:
    found = LatencyEstimate(latency_s, 0.99, std_error_s, True, False, "measured")
    return replace(plan, latency=found)


@pytest.mark.parametrize("std_errors", [2.001, -2.001, 2.5, -2.9, 30.0])
def test_a_latency_beyond_two_standard_errors_is_applied_with_its_sign(planned, std_errors):
    plan = with_latency(planned[1], std_errors * ERROR_S)
    assert plan.truth_latency_s == std_errors * ERROR_S


@pytest.mark.parametrize("std_errors", [0.0, 0.5, -1.1, 1.999, -1.999, 2.0, -2.0])
def test_a_latency_within_two_standard_errors_is_not(planned, std_errors):
    assert with_latency(planned[1], std_errors * ERROR_S).truth_latency_s == 0.0


def test_a_latency_that_nobody_could_measure_is_not_applied(planned):
    assert replace(planned[1], latency=None).truth_latency_s == 0.0
    assert with_latency(planned[1], 0.0, float("inf")).truth_latency_s == 0.0


def truth_of(log: DriveLog, plan: DrivePlan) -> StateTrack:
    truth = read_recorded(log, plan).truth
    assert truth is not None
    return truth


def test_the_rule_decides_what_the_estimates_are_compared_with(planned):
    """A shift of 50 ms is ten samples of the truth; at 3 standard errors the truth moves by it, at 1 not at all."""
    log, plan = planned
    at_zero = truth_of(log, replace(plan, latency=None))
    applied = truth_of(log, with_latency(plan, 0.05, 0.05 / 3.0))
    dropped = truth_of(log, with_latency(plan, 0.05, 0.05))
    np.testing.assert_array_equal(dropped.yaw_rate_rad_s, at_zero.yaw_rate_rad_s)
    np.testing.assert_array_equal(applied.stamps_ns, at_zero.stamps_ns)
    # A motion that the sensors show at t appears in the ground truth at t + latency.
    t = (at_zero.stamps_ns - at_zero.stamps_ns[0]) * 1e-9
    later = np.interp(t + 0.05, t, at_zero.yaw_rate_rad_s)
    inside = np.isfinite(applied.yaw_rate_rad_s) & (t < t[-1] - 0.1)
    assert inside.mean() > 0.9
    moved = np.abs(later - at_zero.yaw_rate_rad_s)[inside].max()
    assert np.abs(applied.yaw_rate_rad_s - later)[inside].max() < 0.1 * moved
