"""The list of fixed mutants, and how each of them can end."""

from collections import Counter

import fixed_mutants


def test_the_list_has_different_mutants_of_most_packages_each_with_a_test():
    found = fixed_mutants.read_list()
    assert len(found) >= 300
    assert len({(m.file, m.old, m.new) for m in found}) == len(found)
    assert all((fixed_mutants.ROOT / m.file).read_text(encoding="utf-8").count(m.old) == 1 for m in found)
    assert all(m.tests and m.old != m.new and m.old.count("\n") == m.new.count("\n") for m in found)
    assert len(Counter(m.package for m in found)) >= 15
