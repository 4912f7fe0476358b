"""The list of fixed mutants, and how each of them can end."""

from __future__ import annotations

import subprocess
import sys
from collections import Counter
from pathlib import Path

import fixed_mutants
import mutants
import pytest
from fixed_mutants import GONE, SURVIVED, FixedMutant


def test_the_list_has_different_mutants_of_most_packages_each_with_a_test() -> None:
    found = fixed_mutants.read_list()
    assert len(found) >= 200
    assert len({(m.file, m.old, m.new) for m in found}) == len(found)
    assert all(m.tests and m.old != m.new and m.old.count("\n") == m.new.count("\n") for m in found)
    assert len(Counter(m.package for m in found)) >= 15


@pytest.mark.slow
def test_a_drawn_mutant_is_fixed_by_lines_that_are_once_in_its_file() -> None:
    for drawn in mutants.draw("results", 20, seed=1):
        mutant = fixed_mutants.fixed(drawn, ["tests/results"])
        text = (mutants.ROOT / mutant.file).read_text()
        assert text.count(mutant.old) == 1
        changed = mutant.source()
        assert changed is not None and changed != text
        compile(changed, mutant.file, "exec")


@pytest.mark.slow
def test_a_mutant_dies_survives_or_is_gone(tmp_path: Path) -> None:
    file, old = "pdhef_logtool/records/geometry.py", "        turned = turned % (2.0 * np.pi)"
    test = "tests/records/test_geometry.py::test_wrap_keeps_the_shape_and_takes_half_a_turn_as_minus_pi"
    found = [
        FixedMutant(file, old, old.replace("2.0", "(3.0)"), (test,)),
        FixedMutant(file, old, f"{old}  # the same", (test,)),
        FixedMutant(file, "no such line", "pass", (test,)),
    ]
    before = (mutants.ROOT / file).read_bytes()
    fixed_mutants.write_list(found, tmp_path / "list.json")
    assert set(fixed_mutants.read_list(tmp_path / "list.json")) == set(found)
    done = subprocess.run(
        [sys.executable, fixed_mutants.__file__, "--file", str(tmp_path / "list.json")],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    *lines, last = done.stdout.splitlines()
    assert sorted(line.split(":")[0] for line in lines) == [GONE, SURVIVED]
    assert last == "1 of 3 died, 1 survived, 1 are gone"
    assert (mutants.ROOT / file).read_bytes() == before
