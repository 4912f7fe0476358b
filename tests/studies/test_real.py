"""The table of recorded drives: what it says without the drives, and its arithmetic."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from studies import real


def test_without_the_drives_it_says_so_and_ends_with_0(monkeypatch, tmp_path: Path, capsys):
    monkeypatch.setattr(real, "DRIVES", tmp_path / "absent")
    assert real.main(["--out", str(tmp_path)]) == 0
    assert "needs ../shared" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


def row(name: str, error: np.ndarray, stamps: np.ndarray, half: float | None = None) -> real.Row:
    inside = None if half is None else np.abs(error) <= half
    width = math.nan if half is None else 2.0 * half / math.sqrt(np.nanmean(error**2))
    return real.Row(real.Errors(name, error, stamps, inside), width)


def test_errors_of_constant_size_have_no_spread_and_differ_by_their_difference():
    stamps = np.arange(6000, dtype=np.int64) * 10_000_000
    sign = np.where(np.arange(6000) % 2, 1.0, -1.0)
    yard = row(real.YARDSTICKS[0], np.radians(0.5) * sign, stamps, half=np.radians(1.0))
    half = np.where(np.arange(6000) < 3000, math.nan, np.radians(0.3) * sign)
    lines = real.case_table([yard, row("other", half, stamps)]).splitlines()
    assert lines[2] == f"| {yard.errors.name} | 0.500 [0.500, 0.500] | 100 % | – | 100 % | 4.0 |"
    assert lines[3] == "| other | 0.300 [0.300, 0.300] | 50 % | -0.200 [-0.200, -0.200] | – | – |"


def test_looks_are_counted_on_from_what_was_before_and_the_same_figures_count_once(tmp_path: Path):
    case, file = real.CASES[0], tmp_path / "real" / real.LOOKS_FILE
    before = real.LOOKS_BEFORE + real.LOOKS_BEFORE_PUBLISHED[case.name]
    assert real.count_look(file, case, "one") == before + 1
    assert real.count_look(file, case, "one") == before + 1
    assert real.count_look(file, real.CASES[-1], "one") == real.LOOKS_BEFORE + 1
    assert real.count_look(file, case, "two") == before + 2


def test_every_case_has_its_reference_files():
    for case in real.CASES:
        assert all(path.is_file() for path in real.files(case))
        assert case.fit is None or case.fit.log != case.score.log or case.fit.end_s <= case.score.start_s - real.GUARD_S
