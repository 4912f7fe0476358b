"""What is compiled beforehand, and what a first run asks for."""

from __future__ import annotations

import pytest

from pdhef_logtool.compiled import cache
from pdhef_logtool.runs import compiling


@pytest.mark.slow
@pytest.mark.parametrize("part", compiling.all_parts())
def test_every_part_compiles_what_it_is_named_for(part: str) -> None:
    compiling.compile_part(part, lambda _text, _share: None)
    assert part not in compiling._LAST or cache.is_kept(compiling._LAST[part])


def test_a_first_run_compiles_only_the_parts_that_it_needs_and_shares_them(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []
    monkeypatch.setattr(compiling, "compile_parts", lambda parts: asked.append(parts))
    monkeypatch.setattr(compiling, "_processors", lambda: 2)
    monkeypatch.setattr(cache, "is_kept", lambda _: False)
    compiling.compile_for(["pd-hef", "physics", "zero"])
    compiling.compile_for(["phy-ukf"])
    compiling.compile_for(["zero"])  # one part alone is compiled where it is used
    assert asked == [["filter", "checks"], ["phy-ukf", "checks"]]
    monkeypatch.setattr(cache, "is_kept", lambda _: True)
    compiling.compile_for(["pd-hef"])
    monkeypatch.setattr(cache, "is_kept", lambda _: False)
    monkeypatch.setattr(compiling, "_processors", lambda: 1)
    compiling.compile_for(["pd-hef"])
    assert len(asked) == 2


def test_parts_are_compiled_in_processes_that_say_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    compiling.compile_parts(["no such part", "nor this"])
    assert capfd.readouterr().err.count("compiling") <= 1
