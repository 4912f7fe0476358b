"""A sensor that fails for a while, or a wheel that locks, accuses no other signal; sound drives accuse none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.mapping import MappedChannels
from tests.command_line import called
from tests.drive.test_checks import checked, survey, verdicts
from truthsim.drive import simulate_drive, write_drive
from truthsim.faults import parse_fault


@pytest.fixture(scope="module")
def sweep(sample_logs_dir: Path) -> MappedChannels:
    return survey(sample_logs_dir / "sweep.mcap")


def spoilt(found: MappedChannels, name: str, kind: str, share: tuple[float, float]) -> MappedChannels:
    """Return the log with a channel dead, stuck or noisy from one share of its samples to another."""
    channel = found.signals[name]
    values, n = channel.values.copy(), len(channel)
    part = slice(int(share[0] * n), int(share[1] * n))
    if kind == "dead":
        values[part] = 0.0
    elif kind == "stuck":
        values[part] = values[part.start]
    else:
        values[part] += 3.0 * np.random.default_rng(1).standard_normal(values[part].shape[0])
    return replace(found, signals={**found.signals, name: replace(channel, values=values)})


@pytest.mark.parametrize("kind", ["dead", "stuck"])
def test_a_gyro_that_is_silent_for_a_while_fails_nothing_else(sweep: MappedChannels, kind: str) -> None:
    known = verdicts(checked(sweep), "failed")
    assert known == set()
    assert verdicts(checked(spoilt(sweep, "yaw_rate_rad_s", kind, (0.4, 0.7))), "failed") == set()
    most = checked(spoilt(sweep, "yaw_rate_rad_s", kind, (0.2, 0.9)))
    assert verdicts(most, "failed") == {"yaw_rate_rad_s.gain"}


def test_a_burst_of_noise_fails_nothing(sweep: MappedChannels) -> None:
    found = spoilt(sweep, "ay_m_s2", "noise", (0.4, 0.7))
    assert verdicts(checked(found), "failed") == set()


def test_a_wheel_that_reads_0_in_a_bend_makes_no_unit_wrong(tmp_path: Path) -> None:
    """The rear wheels slip when the car brakes to a stop: their difference is no yaw rate any more."""
    drive = simulate_drive(
        "brake-in-turn",
        speed_km_h=90.46174692977121,
        friction=0.9838833092370343,
        seed=484091166,
        duration_s=12.5,
        amplitude=1.0865356241287265,
        faults=(parse_fault("dead:wheel_fl:2.40:4.98"),),
    )
    path = tmp_path / "brake.mcap"
    write_drive(drive, path)
    with read_drive(path, Path(__file__).parents[2] / "sample_logs" / "vehicle.toml") as opened:
        assert [c.name for c in opened.checks if c.verdict == "failed"] == []
        passed = {c.name for c in opened.checks if c.verdict == "passed"}
    assert {f"wheel_speed_{w}_m_s.unit" for w in ("fl", "fr", "rl", "rr")} <= passed


DRIVES = {
    "a path along one axis shows no frame":
        "sine-sweep --speed 54.13 --mu 0.825 --seed 1267727376 --duration 25 --amplitude 0.5055 --vehicle "
        "sedan~97894498",
    "the crossfall of a straight road decides no sign":
        "road --speed 46.71 --mu 0.689 --seed 8192170 --duration 25 --vehicle sedan~176164575",
    "noise across the path shows no scale":
        "road --speed 59.04 --mu 0.935 --seed 528562405 --duration 12.5 --vehicle sedan~1192796631",
    "a curvature that is noise decides no sign of a sideslip":
        "ramp-steer --speed 81.81 --mu 0.426 --seed 1068668474 --duration 12.5 --amplitude 0.2748",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("drive", DRIVES)
def test_nothing_is_wrong_with_a_sound_drive(drive: str, tmp_path: Path, sample_logs_dir: Path) -> None:
    log = tmp_path / "drive.mcap"
    assert called("simulate", *DRIVES[drive].split(), "-o", log).returncode == 0
    with read_drive(log, sample_logs_dir / "vehicle.toml") as read:
        assert [c for c in read.checks if c.verdict == "failed"] == []
        assert read.notes == []
        assert read.recorded().changes == ()
