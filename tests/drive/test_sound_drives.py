"""Simulated drives without any fault on which a check once failed."""

from __future__ import annotations

from pathlib import Path

import pytest

from pdhef_logtool.drive.reading import read_drive
from tests.command_line import called

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
