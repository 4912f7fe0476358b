"""The page of targets: cells of other pages, and what is made of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies.pages import DOCS
from studies.targets import lines_of, tables_of, value


def test_a_table_is_found_behind_its_heading(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(
        "# A\n\n## B\n\n| x | y |\n| --- | ---: |\n| one | 1.5 (0.1) |\n| two | – |\n\n## C\n\n| x |\n| - |\n| z |\n"
    )
    found = tables_of(page, "B")
    assert found == {"one": {"x": "one", "y": "1.5 (0.1)"}, "two": {"x": "two", "y": "–"}}
    assert value(found["one"]["y"]) == 1.5 and value("94%") == 94.0
    assert value(found["two"]["y"]) != value(found["two"]["y"])


@pytest.mark.parametrize(("on_roads", "met"), [(0.5, True), (2.0, False)])
def test_every_target_is_looked_up_and_judged(on_roads: float, met: bool) -> None:
    lines = lines_of(DOCS, {"physics": 0.1, "pd-hef": 0.1 * on_roads}, 0.8)
    by_asked = {line.asked: line for line in lines}
    assert len(by_asked) == len(lines) > 15
    assert all((DOCS / f"{line.page}.md").is_file() and "nan" not in line.measured for line in lines)
    assert not by_asked["bands of the saloon on roads: 90 to 98 %"].met
    worst = by_asked["none of them above 1.05"]
    assert worst.met is met and worst.measured.startswith("road 2.00") is not met
