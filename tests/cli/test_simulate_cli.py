"""``pdhef simulate`` in all its forms: drives with faults, suites, condition tables, and the gate on RTK truth."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest

from tests.command_line import called
from truthsim.manoeuvres import MANOEUVRES

pytestmark = pytest.mark.slow


def test_a_drive_s_command_makes_the_same_file_again(tmp_path: Path) -> None:
    made = called(
        *("simulate", "step-steer", "--speed", "90", "--mu", "0.7", "--seed", "4", "--duration", "5"),
        *("--amplitude", "0.8", "--vehicle", "suv~3,mass=1.1", "--fault", "burst20:yaw_rate:2:3"),
        *("--sensor", "jitter_s=0.004", "--rtk-rate", "50", "-o", str(tmp_path / "a.mcap"), "--json"),
    )
    assert made.returncode == 0, made.stderr
    facts = json.loads(made.stdout)
    assert facts["peak_ay_m_s2"] < 0.7 * 9.81 and not facts["spun"]
    again = called(*shlex.split(facts["command"])[1:], "-o", str(tmp_path / "b.mcap"))
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_all_manoeuvres_are_listed_and_the_help_tells_of_faults() -> None:
    listed = json.loads(called("simulate", "--list", "--json").stdout)["manoeuvres"]
    assert [row["name"] for row in listed] == list(MANOEUVRES)
    text = called("simulate", "--help").stdout
    assert "KIND:WHAT:START:END" in text and "--keep-spins" in text and "suite" in text


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("suite", "--mu", "0.5"), 2, ("--mu", "suite")),
        (("suite", "--count", "0"), 2, ("count 0",)),
        (("--seed", "5", "suite", "--count", "0"), 2, ("count 0",)),
        (("--count=0", "suite"), 2, ("count 0",)),
        (("dlc", "--sensor", "jitter_s"), 2, ("NAME=NUMBER",)),
        (("dlc", "--sensor", "gps=1"), 2, ("gps", "jitter_s")),
        (("dlc", "--fault", "nonsense"), 2, ("--fault", "KIND:WHAT:START:END", "nonsense")),
        (("loop-the-loop",), 2, ("loop-the-loop", "--list")),
        (("dlc", "--vehicle", "tank"), 2, ("tank", "sedan")),
        (("dlc", "--without", "gps"), 2, ("gps", "wheels")),
        (("dlc-3888-2", "--speed", "100"), 1, ("70 km/h",)),
        (("dlc-3888-2", "--speed", "70", "--mu", "0.2", "--vehicle", "sedan,cg=0.45"), 1, ("spun", "--keep-spins")),
    ],
)
def test_mistakes_are_one_clear_line(
    arguments: tuple[str, ...], code: int, words: tuple[str, ...], tmp_path: Path
) -> None:
    result = called("simulate", *arguments, "-o", str(tmp_path / "x.mcap"))
    assert result.returncode == code, result.stderr
    assert len(result.stderr.strip().splitlines()) == 1 and all(word in result.stderr for word in words)
    assert not list(tmp_path.iterdir())
