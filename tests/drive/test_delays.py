"""Of sensors that go together the late one is named without truth; a latency of the truth is applied if significant."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.drive.checks import delay_checks
from pdhef_logtool.drive.delays import LatencyEstimate, late_sensors
from pdhef_logtool.drive.plan import DrivePlan, plan_drive
from pdhef_logtool.drive.survey import mapping_proposals, survey_log
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import MappedChannels, Mapping, auto_map, fit_clocks
from pdhef_logtool.records.signals import WHEELS, Channel
from tests.drive.test_checks import survey

WHEEL_NAMES = tuple(f"wheel_speed_{w}_m_s" for w in WHEELS)


@pytest.fixture(scope="module")
def dlc(sample_logs_dir: Path) -> MappedChannels:
    return survey(sample_logs_dir / "dlc.mcap")


def delayed(found: MappedChannels, names: tuple[str, ...], delay_s: float) -> dict[str, Channel]:
    """Return a log's signals, some of them late."""
    late = round(delay_s * 1e9)
    return {n: replace(c, stamps_ns=c.stamps_ns + late) if n in names else c for n, c in found.signals.items()}


@pytest.mark.parametrize("name", ["dlc", "sweep", "fishhook", "step"])
def test_sound_sensors_are_not_late(sample_logs_dir: Path, name: str) -> None:
    assert late_sensors(survey(sample_logs_dir / f"{name}.mcap").signals) == ()


@pytest.mark.parametrize("names", [("yaw_rate_rad_s",), WHEEL_NAMES])
def test_gyro_and_wheels_are_told_apart_and_known_to_20_ms(dlc: MappedChannels, names: tuple[str, ...]) -> None:
    (late,) = late_sensors(delayed(dlc, names, 0.12))
    assert set(late.names) == set(names)
    assert late.exact
    assert late.delay_s == pytest.approx(0.12, abs=0.02)
    assert {c.name for c in delay_checks([late])} == {f"{n}.delay" for n in names}


@pytest.mark.parametrize(("name", "delay_s"), [("steer_rad", 0.12), ("ay_m_s2", 0.25)])
def test_what_the_car_stands_between_is_late_by_at_least_so_much(
    dlc: MappedChannels, name: str, delay_s: float
) -> None:
    (late,) = late_sensors(delayed(dlc, (name,), delay_s))
    assert late.names == (name,)
    assert not late.exact
    assert 0.0 < late.delay_s < delay_s
    assert delay_checks([late])[0].remedy.endswith("at least")


def test_a_late_gyro_is_put_right_once_without_truth(sample_logs_dir: Path) -> None:
    log = open_log(sample_logs_dir / "dlc.mcap")
    recognised = auto_map(log).mapping
    gyro = replace(recognised.signals["yaw_rate_rad_s"], latency_s=-0.12)
    mapping = replace(recognised, signals={**recognised.signals, gyro.name: gyro}, truth={}, origin="file")

    def proposed(given: Mapping) -> dict[str, float]:
        clocks = fit_clocks(log, given, log.start_ns, log.end_ns)
        found = survey_log(log, given, clocks, (log.start_ns, log.end_ns))
        return {p.subject: p.source.latency_s for p in mapping_proposals(found) if p.source is not None}

    latency_s = proposed(mapping)
    assert latency_s == {"yaw_rate_rad_s": pytest.approx(0.0, abs=0.02)}
    right = replace(gyro, latency_s=latency_s["yaw_rate_rad_s"])
    assert proposed(replace(mapping, signals={**mapping.signals, gyro.name: right})) == {}
    log.close()


ERROR_S = 0.002


@pytest.fixture(scope="module")
def planned(sample_logs_dir: Path) -> DrivePlan:
    with closing(open_log(sample_logs_dir / "step.mcap")) as log:
        return plan_drive(log, auto_map(log).mapping, default_vehicle(), log.start_ns, log.end_ns)


def with_latency(plan: DrivePlan, latency_s: float, std_error_s: float = ERROR_S) -> DrivePlan:
    found = LatencyEstimate(latency_s, 0.99, std_error_s, True, False, "measured")
    return replace(plan, latency=found)


@pytest.mark.parametrize("std_errors", [2.001, -2.001, 30.0, 0.0, -1.1, 1.999, 2.0, -2.0])
def test_a_latency_is_applied_if_it_is_beyond_two_standard_errors(planned, std_errors):
    applied = std_errors * ERROR_S if abs(std_errors) > 2.0 else 0.0
    assert with_latency(planned, std_errors * ERROR_S).truth_latency_s == applied
    assert replace(planned, latency=None).truth_latency_s == 0.0
