"""Size limits: the counted figures, positional parameters, and that no limit rises without a reason."""

import ast
import re
from pathlib import Path

import pytest
import size_budget


def test_long_and_complex_functions_count_unless_they_are_compiled(tmp_path):
    body = "def f(x):\n" + "    if x:\n        x += 1\n" * 31
    (tmp_path / "a.py").write_text(body)
    assert size_budget.python_sizes(tmp_path)["long_functions"] == 1
    assert size_budget.complexity(ast.parse(body).body[0]) == 32
    (tmp_path / "compiled").mkdir()
    (tmp_path / "compiled" / "a.py").write_text("@njit(cache=True)\n" + body)
    sizes = size_budget.python_sizes(tmp_path / "compiled")
    assert (sizes["long_functions"], sizes["complex_functions"]) == (0, 0)


def test_a_size_above_its_limit_or_without_one_is_a_problem():
    assert list(size_budget.problems({"a.x": 3}, {"a.x": 3})) == []
    assert "a.x: 4, limit 3" in next(size_budget.problems({"a.x": 4}, {"a.x": 3}))
    assert "expected in both" in next(size_budget.problems({"a.x": 4}, {}))


def test_a_limit_rises_with_a_reason_only():
    before, after = {"a": {"x": 3}}, {"a": {"x": 4}}
    assert "raised from 3 to 4" in next(size_budget.unexplained(after, before))
    reasons = [{"figure": "a.x", "limit": 4, "reason": "a log format"}]
    assert list(size_budget.unexplained({**after, "raised": reasons}, before)) == []
    assert list(size_budget.unexplained(before, after)) == []


_ROOT = Path(__file__).resolve().parents[1]
MOST = 8
#: On the line of the ``def``, or directly above it or its decorators.
REASON = re.compile(r"#\s*positional: \S.*")


def overlong(source: str) -> list[str]:
    """Return name and count of the functions that take too many, and have no reason."""
    lines, found = source.splitlines(), []
    for node in ast.walk(ast.parse(source)):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        names = [a.arg for a in (*node.args.posonlyargs, *node.args.args)]
        count = len(names) - (names[:1] in (["self"], ["cls"]))
        first = min([node.lineno, *(d.lineno for d in node.decorator_list)])
        beside = [lines[n - 1] for n in (first - 1, node.lineno - 1, node.lineno) if n > 0]
        if count > MOST and not any(REASON.search(line) for line in beside):
            found.append(f"{node.name} ({count})")
    return found


@pytest.mark.slow
@pytest.mark.parametrize("package", ["pdhef_logtool", "truthsim", "studies", "benchmarks"])
def test_no_function_takes_many_positional_parameters(package):
    found = {str(p.relative_to(_ROOT)): overlong(p.read_text()) for p in sorted((_ROOT / package).rglob("*.py"))}
    assert found, "nothing was looked at"
    assert {path: names for path, names in found.items() if names} == {}
