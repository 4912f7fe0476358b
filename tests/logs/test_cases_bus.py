"""Bus logs of the shared cases; the README beside them states the right values."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.records.errors import LogError
from tests.command_line import called

START_NS = 1_714_564_800 * 10**9


@pytest.fixture
def cases(shared_dir: Path) -> Path:
    if not (shared_dir / "cases" / "tables").is_dir():
        pytest.skip("needs ../shared/cases beside the repository")
    return shared_dir / "cases"


@pytest.fixture
def log(request: pytest.FixtureRequest, cases: Path) -> Iterator[DriveLog]:
    """A log of the cases with its DBC."""
    name, dbc = request.param
    with closing(open_log(cases / "tables" / f"{name}.blf", msgs=cases / "tables" / f"{dbc}.dbc")) as log:
        yield log


@pytest.mark.parametrize(
    "log",
    [
        ("can_reference", "car"),
        ("can_two_channels", "car"),
        ("can_short_frames", "car"),
        ("can_j1939", "j1939"),
        ("can_pretrigger", "car"),
    ],
    indirect=True,
    ids=lambda name: name[0],
)
def test_signals_of_one_car(log: DriveLog) -> None:
    wanted = {"STEER": "SteeringWheelAngle", "MOTION": "LatAccel", "SPEED": "VehicleSpeed"}
    read = log.read({topic: [path] for topic, path in wanted.items()})
    assert log.lost == ()
    values = {topic: read[topic].fields[path] for topic, path in wanted.items()}
    assert {topic: len(v) for topic, v in values.items()} == dict.fromkeys(wanted, 1000)
    expected = {"STEER": -0.0621 * 16 * 180 / np.pi, "MOTION": -0.061, "SPEED": 8.057 * 3.6}
    assert {topic: v.mean() for topic, v in values.items()} == pytest.approx(expected, rel=2e-3, abs=5e-4)
    stamps = np.concatenate([read[topic].log_time_ns for topic in wanted])
    assert (stamps.min() - START_NS) / 1e9 == pytest.approx(0.0, abs=1e-3)
    assert (stamps.max() - stamps.min()) / 1e9 == pytest.approx(19.98, abs=1e-3)


def test_a_file_of_3_mb_that_claims_3_gb_is_one_line(cases: Path) -> None:
    path = cases / "hostile" / "blf_bomb_3MB_3GB.blf"
    with pytest.raises(LogError, match="budget="):
        open_log(path)
    done = called("inspect", path)
    assert done.returncode == 1
    assert len(done.stderr.strip().splitlines()) == 1
