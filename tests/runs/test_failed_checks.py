"""A failed check is told by a drive and an inspection; test_check_registry.py has the exit codes of a run."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import auto_map, load_mapping, mapping_to_toml
from pdhef_logtool.runs.inspection import inspect_log


@pytest.fixture
def wrong_sign(sample_logs_dir: Path, tmp_path: Path) -> Path:
    """Return a mapping of the sweep with the wrong sign of the steering."""
    log = open_log(sample_logs_dir / "sweep.mcap")
    text = mapping_to_toml(auto_map(log).mapping)
    log.close()
    at = text.index("scale", text.index("[signals.steer_rad]"))
    path = tmp_path / "mapping.toml"
    path.write_text(text[:at] + text[at:].replace("scale = 1.0", "scale = -1.0", 1))
    return path


def test_a_drive_has_its_checks_and_tells_the_failed_ones(sample_logs_dir: Path, wrong_sign: Path) -> None:
    told: list[str] = []
    mapping, car = load_mapping(wrong_sign), Car.load(sample_logs_dir / "vehicle.toml")
    options = ReadOptions(waived=("steer_rad.sign", "steer.sign"))
    with read_drive(sample_logs_dir / "sweep.mcap", car, mapping, options, tell=told.append) as drive:
        (failed,) = (c for c in drive.checks if c.verdict == "failed")
    assert (failed.name, failed.waived) == ("steer_rad.sign", True)
    assert any("check steer_rad.sign failed (waived)" in text for text in told)
    assert any("--waive steer.sign: no check of this log is called that" in text for text in told)


def test_inspecting_shows_checks_of_the_same_names(sample_logs_dir: Path, wrong_sign: Path) -> None:
    found = inspect_log(sample_logs_dir / "sweep.mcap", load_mapping(wrong_sign))
    assert [c.name for c in found.checks if c.verdict == "failed"] == ["steer_rad.sign"]
    assert not found.is_partial
    (check,) = (c for c in json.loads(json.dumps(found.to_dict()))["checks"] if c["verdict"] == "failed")
    assert check["subject"] == "steer_rad"
