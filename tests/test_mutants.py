"""The mutants: drawn again by their seed, spread, and nothing else than code is changed."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import mutants
import pytest

pytestmark = pytest.mark.slow


def test_a_draw_repeats_and_is_spread_over_kinds_and_functions() -> None:
    drawn = mutants.draw("results", 60, seed=3)
    assert mutants.draw("results", 60, seed=3) == drawn
    assert not set(mutants.draw("results", 60, seed=4)) >= set(drawn)
    assert set(Counter(m.kind for m in drawn).values()) == {10}
    assert len({(m.file, m.function) for m in drawn}) == 60


def test_messages_defaults_and_imports_are_left_alone(tmp_path: Path) -> None:
    package = tmp_path / "pdhef_logtool" / "made"
    package.mkdir(parents=True)
    (package / "code.py").write_text('''"""Made."""
from typing import TYPE_CHECKING

LIMIT = 3 + 4
if TYPE_CHECKING:
    WIDTH = 5 - 1


def speak(a: int = 1 + 2) -> str:
    """Say 3 < 4."""
    print(3 * 4, a)
    assert a < 5
    return f"{a + 1}"


def act(a: int, b: int) -> int:
    """Act."""
    if a < b:
        raise ValueError(f"{a - b}", 2)
    return divmod(a, b)[0]
''')
    found = mutants.possible("made", tmp_path)
    assert {m.function for m in found} == {"act"}
    assert [(m.kind, m.new) for m in found] == [
        ("comparison", "(a >= b)"),
        ("removed statement", "pass"),
        ("swapped arguments", "(divmod(b, a))"),
        ("constant", "(1)"),
    ]
