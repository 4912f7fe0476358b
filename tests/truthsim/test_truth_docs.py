"""The simulator's page is what its command makes, and keeps what it cannot make."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from types import ModuleType

import pytest

from studies import truthsim_docs

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "truthsim.md").read_text(encoding="utf-8")


def blocks(page: str) -> dict[str, str]:
    found = re.findall(r"<!-- begin (\w+) -->\n(.*?)\n?<!-- end \1 -->", page, re.DOTALL)
    return dict(found)


@pytest.fixture
def command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    monkeypatch.setattr(truthsim_docs, "INDEPENDENT", tmp_path / "absent")
    return truthsim_docs


def test_the_page_is_what_the_command_makes(command: ModuleType, tmp_path: Path) -> None:
    # Without the runs of the other simulator, as in a clean clone.
    shutil.copy(ROOT / "docs" / "truthsim.md", tmp_path / "truthsim.md")
    command.main(tmp_path)
    here, made = blocks(PAGE), blocks((tmp_path / "truthsim.md").read_text(encoding="utf-8"))
    assert set(here) == {"gradients", "responses", "relaxation", "peaks", "speed"}
    assert {k: v for k, v in made.items() if k != "speed"} == {k: v for k, v in here.items() if k != "speed"}
    times = re.match(r"more than (\d+) times real time", made["speed"])
    assert times is not None and int(times[1]) >= 50
    wanted = set(re.findall(r"!\[[^\]]*\]\((truthsim/\w+\.png)\)", PAGE))
    figures = {f"truthsim/{p.name}" for p in (tmp_path / "truthsim").iterdir()}
    assert figures == wanted == {f"truthsim/{p.name}" for p in (ROOT / "docs" / "truthsim").iterdir()}
    assert all((tmp_path / f).stat().st_size < 150_000 for f in figures)


def test_a_block_without_its_place_is_an_error(command: ModuleType) -> None:
    with pytest.raises(SystemExit, match="gradients"):
        command.fill("no comments here", {"gradients": "x"}, "page.md")
