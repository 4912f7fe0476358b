"""Damaged outputs of runs, with a fixed seed: ``own_files.py``."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from own_files import numbers, own_file_judge

CASES = 18


@pytest.mark.slow
def test_damaged_outputs_are_reported_and_recomputed(tmp_path: Path) -> None:
    judge_number = own_file_judge(tmp_path, 1)
    found = {number: judge_number(number) for number in numbers(CASES)}
    assert {number: verdict.problem for number, verdict in found.items() if verdict.problem} == {}
    ends = Counter(verdict.end for verdict in found.values())
    assert {"exit 0", "exit 1", "exit 3"} <= ends.keys()  # neither harmless nor all refused
