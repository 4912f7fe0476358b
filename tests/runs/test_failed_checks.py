"""A failed check is in the report and makes the exit code of a run 3, until a person waives it by name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import auto_map, load_mapping, mapping_to_toml
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import run_logs
from pdhef_logtool.runs.inspection import inspect_log
from tests.run_report import follows


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


@pytest.mark.slow
@pytest.mark.parametrize(("waived", "code"), [((), 3), (("steer_rad.sign",), 0)])
def test_the_exit_code_of_a_run(
    sample_logs_dir: Path, tmp_path: Path, wrong_sign: Path, waived: tuple[str, ...], code: int
) -> None:
    config = RunConfig(
        estimators=("zero",), car=sample_logs_dir / "vehicle.toml", mapping=wrong_sign, keep="estimates", waived=waived
    )
    result = run_logs([str(sample_logs_dir / "sweep.mcap")], tmp_path / "out", config, report=False)
    assert result.exit_code == code
    report = json.loads((tmp_path / "out" / "logs" / "sweep" / "report.json").read_text())
    follows(report)
    (failed,) = (c for c in report["checks"] if c["verdict"] == "failed")
    assert failed["waived"] == ("steer_rad.sign" in waived)
    assert report["log"]["name"] == "sweep"
    assert [e["name"] for e in report["estimators"]] == ["zero"] == [report["selected_estimate"]]
