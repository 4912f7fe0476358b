"""Size limits: the counted figures, and that no limit rises without a reason."""

import ast

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
