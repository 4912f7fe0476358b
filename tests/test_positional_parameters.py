"""No function takes more than eight positional parameters without a reason beside it."""

import ast
import re
from pathlib import Path

import pytest

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
