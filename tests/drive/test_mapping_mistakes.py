"""Unit, sign, axis and topic mistakes of a mapping file: each is named with the right remedy or not checkable."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from pdhef_logtool import PdhefError, ReadOptions, RunConfig, read_drive, run
from pdhef_logtool.cli.app import app
from pdhef_logtool.drive.checks import misread_channels
from studies.mapping_mistakes import look_at, mistaken, outcomes, subjects
from studies.pages import write_toml
from tests.drive.test_checks import checks_of, drive

pytestmark = pytest.mark.filterwarnings("error::RuntimeWarning")


@pytest.fixture(scope="module")
def mapping_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Path], dict[str, Any]]:
    """Return the mapping file that is recognised of a log."""

    def recognise(path: Path) -> dict[str, Any]:
        file = tmp_path_factory.mktemp("mapping") / "m.toml"
        assert CliRunner().invoke(app, ["inspect", str(path), "--write-mapping", str(file)]).exit_code == 0
        return tomllib.loads(file.read_text(encoding="utf-8"))

    return recognise


def test_every_mistake_in_a_double_lane_change_is_named(sample_logs_dir: Path, tmp_path: Path, mapping_of: Any) -> None:
    """A wrong unit, sign and axis of each signal; the speed and the tyres of the default car may leave one open."""
    path = sample_logs_dir / "dlc.mcap"
    mapping = mapping_of(path)
    kinds = [(subject, kind) for subject in subjects(mapping) for kind in ("x57.3", "/9.81", "sign", "axis")]
    found = list(outcomes(look_at, path, mapping, tmp_path, kinds))
    assert len(found) == len(kinds)
    assert not {f"{o.signal} {o.kind}": o.verdict for o in found if o.verdict not in ("named", "refused")}


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
    checks = checks_of({name: replace(channel, name=name, values=channel.values * factor)})
    (check,) = (c for c in checks if c.name == f"{name}.unit")
    assert check.verdict == "failed"
    assert remedy in check.remedy
    assert misread_channels([check]).keys() == {name}
    assert misread_channels([check], [check.name]) == {}


def run_with(path: Path, mapping: Path, out: Path) -> int:
    config = RunConfig(car=path.parent / "vehicle.toml", mapping=mapping, annotate="none", keep="metrics")
    return run([str(path)], out, config).exit_code


@pytest.mark.parametrize(("subject", "kind", "code"), [("steer_rad", "x57.3", 3), ("wheel_speed", "/57.3", 1)])
def test_what_uses_a_signal_with_a_wrong_unit_is_stopped(
    sample_logs_dir: Path, tmp_path: Path, mapping_of: Any, subject: str, kind: str, code: int
) -> None:
    path = sample_logs_dir / "fishhook.mcap"
    wrong = write_toml(tmp_path / "wrong.toml", mistaken(mapping_of(path), subject, kind))
    if code == 1:
        with pytest.raises(PdhefError, match=r"multiply its scale in the mapping by 57\.2958"):
            run_with(path, wrong, tmp_path / "out")
    else:
        assert run_with(path, wrong, tmp_path / "out") == code


def test_a_waived_check_stops_nothing(sample_logs_dir: Path, tmp_path: Path, mapping_of: Any) -> None:
    path = sample_logs_dir / "fishhook.mcap"
    wrong = write_toml(tmp_path / "wrong.toml", mistaken(mapping_of(path), "steer_rad", "x57.3"))
    car = sample_logs_dir / "vehicle.toml"
    for waived in ((), ("steer_rad.unit",)):
        with read_drive(path, car, wrong, ReadOptions(waived=waived)) as drive:
            assert ("steer_rad" in drive.available) == bool(waived)
