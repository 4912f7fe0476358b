"""Unit, sign, axis and topic mistakes of a mapping file: each is named with the right remedy or not checkable."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.checks import check_drive
from pdhef_logtool.drive.checks.running import misread_channels
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import Mapping, auto_map, mapping_to_toml
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.records.signals import Channel
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from studies.mapping_mistakes import KINDS, mistaken, outcomes, subjects
from tests.drive.test_checks import drive

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


def mapping_of(path: Path) -> Mapping:
    log = open_log(path)
    try:
        return auto_map(log).mapping
    finally:
        log.close()


def test_every_mistake_in_a_double_lane_change_is_named(sample_logs_dir: Path) -> None:
    """64 of 64; a mistake that the drive does not excite may stay open, and none may pass."""
    path = sample_logs_dir / "dlc.mcap"
    found = list(outcomes(path, Car.load(sample_logs_dir / "vehicle.toml").vehicle))
    assert len(found) == len(KINDS) * len(subjects(mapping_of(path)))
    bad = {f"{o.signal} {o.kind}": o.verdict for o in found if o.verdict not in ("named", "refused")}
    assert not bad


@pytest.mark.slow
def test_mistakes_are_named_or_not_checkable(sample_logs_dir: Path) -> None:
    """At least 95 % over a spin, a sweep and a road; by drive it is 94 to 100 %."""
    decided = []
    for log, car in (("fishhook", "vehicle"), ("sweep", "vehicle_mu03"), ("road", "vehicle")):
        found = outcomes(sample_logs_dir / f"{log}.mcap", Car.load(sample_logs_dir / f"{car}.toml").vehicle)
        decided += [o for o in found if o.verdict not in ("open", "not checkable")]
    assert sum(o.verdict in ("named", "refused") for o in decided) >= 0.95 * len(decided)
    assert sum(o.verdict == "silent" for o in decided) <= 1


@pytest.mark.parametrize(
    ("name", "factor", "remedy"),
    [
        ("yaw_rate_rad_s", 2000.0, "raw counts"),
        ("ax_m_s2", 2000.0, "raw counts"),
        ("yaw_rate_rad_s", 300.0, "degrees"),
        ("roll_rate_rad_s", 300.0, "degrees"),
    ],
)
def test_impossible_magnitudes_need_no_second_signal(name: str, factor: float, remedy: str) -> None:
    channel = drive(3)[name.replace("roll", "yaw")]
    checks = check_drive({name: replace(channel, name=name, values=channel.values * factor)})
    (check,) = (c for c in checks if c.name == f"{name}.magnitude")
    assert check.verdict == "failed"
    assert remedy in check.remedy
    assert misread_channels([check]).keys() == {name}
    assert misread_channels([check], [check.name]) == {}


def test_a_model_car_that_spins_is_possible() -> None:
    stamps = np.arange(0, 20_000_000_000, 10_000_000, dtype=np.int64)
    values = {"yaw_rate_rad_s": 5.3 * np.sin(stamps * 1e-9), "ay_m_s2": 12.0 * np.sin(stamps * 1e-9)}
    channels = {n: Channel(n, "", f"/imu.{n}", stamps, stamps, v) for n, v in values.items()}
    assert not [c for c in check_drive(channels) if c.verdict == "failed"]


def run_with(path: Path, mapping: Mapping, out: Path) -> int:
    file = out.with_suffix(".toml")
    file.write_text(mapping_to_toml(mapping), encoding="utf-8")
    config = RunConfig(car=path.parent / "vehicle.toml", mapping=file, annotate="none", keep="metrics")
    return run_logs([str(path)], out, config).exit_code


@pytest.mark.parametrize(("subject", "kind", "code"), [("steer_rad", "x57.3", 3), ("wheel_speeds", "/57.3", 1)])
def test_what_uses_a_signal_with_a_wrong_unit_is_stopped(
    sample_logs_dir: Path, tmp_path: Path, subject: str, kind: str, code: int
) -> None:
    path = sample_logs_dir / "fishhook.mcap"
    wrong = mistaken(mapping_of(path), subject, kind)
    assert wrong is not None
    with read_drive(path, sample_logs_dir / "vehicle.toml", wrong) as found:
        assert found.plan.refused
        assert subject not in found.available or subject == "wheel_speeds"
        assert all(re.search(r"scale = (1|0\.9999)", text) for text in found.plan.refused.values())
    if code == 1:
        with pytest.raises(EstimatorError, match=r"multiply its scale in the mapping by 57\.2958"):
            run_with(path, wrong, tmp_path / "out")
    else:
        assert run_with(path, wrong, tmp_path / "out") == code


def test_a_waived_check_stops_nothing(sample_logs_dir: Path) -> None:
    path = sample_logs_dir / "fishhook.mcap"
    wrong = mistaken(mapping_of(path), "steer_rad", "x57.3")
    with read_drive(path, sample_logs_dir / "vehicle.toml", wrong, ReadOptions(waived=("steer_rad.unit",))) as found:
        assert "steer_rad" in found.available
        assert not found.plan.refused


def test_ground_truth_with_a_wrong_sign_scores_nothing(sample_logs_dir: Path) -> None:
    path = sample_logs_dir / "dlc.mcap"
    wrong = mistaken(mapping_of(path), "truth.vy_m_s", "sign")
    with read_drive(path, sample_logs_dir / "vehicle.toml", wrong) as found:
        assert "truth.vy_m_s" in found.plan.refused
        assert "vy_m_s" not in found.mapping.truth
