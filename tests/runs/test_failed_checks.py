"""A failed check is told by a drive and an inspection; test_check_registry.py has the exit codes of a run."""

from __future__ import annotations

import json
from pathlib import Path

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.mapping import load_mapping
from pdhef_logtool.runs.inspection import inspect_log
from tests.runs.wrong_mapping import wrong_sign


def test_a_drive_has_its_checks_and_tells_the_failed_ones(sample_logs_dir: Path, tmp_path: Path) -> None:
    told: list[str] = []
    log, car = sample_logs_dir / "sweep.mcap", Car.load(sample_logs_dir / "vehicle.toml")
    mapping = load_mapping(wrong_sign(log, tmp_path))
    options = ReadOptions(waived=("steer_rad.sign", "steer.sign"))
    with read_drive(log, car, mapping, options, tell=told.append) as drive:
        (failed,) = (c for c in drive.checks if c.verdict == "failed")
    assert (failed.name, failed.waived) == ("steer_rad.sign", True)
    assert any("check steer_rad.sign failed (waived)" in text for text in told)
    assert any("--waive steer.sign: no check of this log is called that" in text for text in told)


def test_inspecting_shows_checks_of_the_same_names(sample_logs_dir: Path, tmp_path: Path) -> None:
    log = sample_logs_dir / "sweep.mcap"
    found = inspect_log(log, load_mapping(wrong_sign(log, tmp_path)))
    assert [c.name for c in found.checks if c.verdict == "failed"] == ["steer_rad.sign"]
    assert not found.is_partial
    (check,) = (c for c in json.loads(json.dumps(found.to_dict()))["checks"] if c["verdict"] == "failed")
    assert check["subject"] == "steer_rad"
