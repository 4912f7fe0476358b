"""The mutants: drawn again by their seed, spread, one fault each, and no compiled function survives its own fault."""

from __future__ import annotations

import ast
import shutil
from collections import Counter
from pathlib import Path

import mutants
import pytest
from mutants import FOLDERS, ROOT, Mutant

from pdhef_logtool.compiled.sources import sources_digest

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def drawn() -> list[Mutant]:
    return mutants.draw(list(FOLDERS), 60, seed=3)


def test_the_draw_repeats_and_another_seed_draws_others(drawn: list[Mutant]) -> None:
    assert mutants.draw(list(FOLDERS), 60, seed=3) == drawn
    assert not set(mutants.draw(list(FOLDERS), 60, seed=4)) >= set(drawn)


def test_faults_are_spread_over_packages_kinds_and_functions(drawn: list[Mutant]) -> None:
    assert Counter(m.package for m in drawn) == dict.fromkeys(FOLDERS, 12)
    assert set(Counter(m.kind for m in drawn).values()) == {10}
    assert len({(m.file, m.function) for m in drawn}) == 60
    for m in drawn:
        assert m.file.startswith(f"pdhef_logtool/{m.package}/")


def test_each_is_one_other_program_of_as_many_bytes_and_lines(drawn: list[Mutant]) -> None:
    for m in drawn[::3]:
        source = (ROOT / m.file).read_bytes()
        changed = mutants.mutated(source, m)
        assert len(changed) == len(source)
        assert changed.count(b"\n") == source.count(b"\n"), m
        before, after = (ast.parse(s).body[1:] for s in (source, changed))  # the docstring gave the bytes
        different = [a for a, b in zip(before, after, strict=True) if ast.dump(a) != ast.dump(b)]
        assert [d.name for d in different] == [m.function.split(".")[0]]


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


def test_a_fault_in_a_compiled_function_forgets_all_that_may_hold_it(tmp_path: Path) -> None:
    code = {
        "low.py": '"""Low level, made for the test."""\nfrom pdhef_logtool.compiled.cache import njit\n\n\n'
        "@njit(cache=True)\ndef half(x):\n    return x / 2.0\n\n\ndef plain(x):\n    return x - 1.0\n",
        "high.py": '"""High."""\nfrom pdhef_logtool.made.low import half\n',
        "top.py": '"""Top."""\nfrom pdhef_logtool.made import high\n',
        "apart.py": '"""Apart."""\n',
    }
    package = tmp_path / "pdhef_logtool" / "made"
    cache, compiled = package / "__pycache__", tmp_path / "pdhef_logtool" / "__pycache__" / "compiled"
    cache.mkdir(parents=True)
    for name, text in code.items():
        (package / name).write_text(text)
        (cache / f"{name[:-3]}.cpython-311.pyc").touch()

    def kept() -> list[str]:
        """Return the files of the only folder, which is named after the digest of the present sources."""
        (folder,) = compiled.iterdir()
        assert folder.name == f"{sources_digest(tmp_path)}-0"
        return sorted(p.name.partition(".")[0] for p in folder.iterdir())

    def keep() -> None:
        folder = compiled / f"{sources_digest(tmp_path)}-0"
        folder.mkdir(parents=True)
        for name in code:
            (folder / f"{name[:-3]}.f-5.py311.nbi").touch()

    keep()
    by_name = {m.function: m for m in mutants.possible("made", tmp_path) if m.kind == "sign"}
    times = (package / "low.py").stat().st_mtime_ns

    mutants.apply(by_name["plain"], tmp_path)  # no compiled code changes
    assert kept() == ["apart", "high", "low", "top"]
    assert not list(cache.glob("low.*.pyc"))
    assert (package / "low.py").stat().st_mtime_ns == times

    (package / "low.py").write_text(code["low.py"])
    shutil.rmtree(compiled)
    keep()
    mutants.apply(by_name["half"], tmp_path)
    assert kept() == ["apart"]
    assert "return (x * 2.0)" in (package / "low.py").read_text()


def test_a_survivor_is_told_from_the_dead_and_no_tests_kill_nothing(tmp_path: Path) -> None:
    (tmp_path / "test_a.py").write_text("def test_good(): pass\ndef test_bad(): assert 0\n")
    assert mutants.run_tests(tmp_path, ["test_a.py", "-k", "good"]) is None
    assert mutants.run_tests(tmp_path, ["test_a.py", "-k", "nothing"]) is None
    assert mutants.run_tests(tmp_path, ["test_a.py"]) == "test_a.py::test_bad"
