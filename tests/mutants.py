"""Mutants: small faults for ``fixed_mutants.py``, drawn by a seed over kinds of faults and over functions.

No function gets two. Message texts are not changed, nor is code with effects that no test can observe.
"""

import ast
import copy
import functools
import random
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SOURCES = "pdhef_logtool"
_OPPOSITE: dict[type[ast.AST], type[ast.AST]] = {
    **{a: b for x, y in ((ast.Lt, ast.GtE), (ast.Gt, ast.LtE), (ast.Eq, ast.NotEq)) for a, b in ((x, y), (y, x))},
    **{a: b for x, y in ((ast.Is, ast.IsNot), (ast.In, ast.NotIn), (ast.And, ast.Or)) for a, b in ((x, y), (y, x))},
    **{a: b for x, y in ((ast.Add, ast.Sub), (ast.Mult, ast.Div)) for a, b in ((x, y), (y, x))},
}
_COMMUTATIVE = {"min", "max", "minimum", "maximum", "hypot", "isclose", "allclose", "array_equal", "gcd", "dot"}
#: Calls with message texts, and keywords without effect or with an effect on layout only.
_WORDS = re.compile(r"(^|\.)(Loss|print|echo|warn|warning|info|debug|log|\w*Error)$")
_IDLE_KEYWORDS = {"strict", "stacklevel", "copy", "indent", "cache", "key"}
_TEXT = (ast.JoinedStr, ast.List, ast.Tuple, ast.Dict)


@dataclass(frozen=True)
class Mutant:
    """One fault: ``new`` instead of ``old`` from byte ``start`` on in ``file``; ``compiled``: numba may hold it."""

    package: str
    file: str
    line: int
    function: str
    kind: str
    start: int
    old: str
    new: str
    compiled: bool


class _Finder(ast.NodeVisitor):
    """Collects every possible fault in the functions of one file."""

    def __init__(self, package: str, file: str, source: bytes, run_at_import: frozenset[str]) -> None:
        self.found: list[Mutant] = []
        self._package, self._file, self._source, self._run_at_import = package, file, source, run_at_import
        self._lines = [0]
        for line in source.splitlines(keepends=True):
            self._lines.append(self._lines[-1] + len(line))
        self._names: list[str] = []
        self._compiled = [False]

    def visit_Module(self, node: ast.Module) -> None:
        self._definitions(node.body)

    def visit_ClassDef(self, node: ast.ClassDef) -> None:
        self._names.append(node.name)
        self._definitions(node.body)
        self._names.pop()

    def _definitions(self, body: list[ast.stmt]) -> None:
        for statement in body:
            if isinstance(statement, ast.ClassDef | ast.FunctionDef):
                self.visit(statement)

    def visit_FunctionDef(self, node: ast.FunctionDef) -> None:
        compiled = any("jit" in ast.unparse(d) for d in node.decorator_list) or node.name in self._run_at_import
        self._names.append(node.name)
        self._compiled.append(compiled or self._compiled[-1])
        for statement in node.body:  # neither decorators, defaults nor annotations
            self.visit(statement)
        self._names.pop()
        self._compiled.pop()

    def _add(self, kind: str, node: ast.expr | ast.stmt, new: ast.expr | None) -> None:
        assert node.end_lineno is not None and node.end_col_offset is not None
        start = self._lines[node.lineno - 1] + node.col_offset
        old = self._source[start : self._lines[node.end_lineno - 1] + node.end_col_offset].decode()
        # As many lines as before: numba finds compiled functions by the line that they begin at.
        rows = "\n" * old.count("\n")
        text = f"pass{rows}" if new is None else f"({ast.unparse(new)}{rows})"
        function = ".".join(self._names)
        where = (self._package, self._file, node.lineno, function)
        self.found.append(Mutant(*where, kind, start, old, text, self._compiled[-1]))

    def visit_Compare(self, node: ast.Compare) -> None:
        if len(node.ops) == 1:
            self._add("comparison", node, ast.Compare(node.left, [_flip(node.ops[0])], node.comparators))
        self.generic_visit(node)

    def visit_BoolOp(self, node: ast.BoolOp) -> None:
        self._add("and/or", node, ast.BoolOp(_flip(node.op), node.values))
        self.generic_visit(node)

    def visit_BinOp(self, node: ast.BinOp) -> None:
        text = any(
            isinstance(n, _TEXT) or (isinstance(n, ast.Constant) and isinstance(n.value, str))
            for n in (node.left, node.right)
        )
        if type(node.op) in _OPPOSITE and not text:
            self._add("sign", node, ast.BinOp(node.left, _flip(node.op), node.right))
        self.generic_visit(node)

    def visit_UnaryOp(self, node: ast.UnaryOp) -> None:
        if isinstance(node.op, ast.USub):
            self._add("sign", node, node.operand)
        self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> None:
        value = node.value
        if isinstance(value, bool):
            self._add("constant", node, ast.Constant(not value))
        elif isinstance(value, int):
            self._add("constant", node, ast.Constant(value + 1))
        elif isinstance(value, float) and (value == 0.0 or abs(value) >= 1e-9):  # below: a guard against division by 0
            self._add("constant", node, ast.Constant(value * 2.0 if value else 1.0))

    def visit_Call(self, node: ast.Call) -> None:
        name = ast.unparse(node.func)
        if _WORDS.search(name):
            return
        plain = not any(isinstance(a, ast.Starred) for a in node.args)
        if plain and name.rpartition(".")[2] not in _COMMUTATIVE:
            for i in range(len(node.args) - 1):
                first, second = node.args[i : i + 2]
                if ast.dump(first) != ast.dump(second):
                    swapped = copy.copy(node)
                    swapped.args = [*node.args[:i], second, first, *node.args[i + 2 :]]
                    self._add("swapped arguments", node, swapped)
        for part in (node.func, *node.args, *(k.value for k in node.keywords if k.arg not in _IDLE_KEYWORDS)):
            self.visit(part)

    def _removable(self, node: ast.stmt) -> None:
        self._add("removed statement", node, None)
        self.generic_visit(node)

    visit_AugAssign = visit_Continue = visit_Break = _removable

    def visit_Assign(self, node: ast.Assign) -> None:
        if all(isinstance(t, ast.Attribute | ast.Subscript) for t in node.targets):
            self._add("removed statement", node, None)
        self.generic_visit(node)

    def visit_AnnAssign(self, node: ast.AnnAssign) -> None:
        if node.value is not None:
            self.visit(node.value)

    def visit_Expr(self, node: ast.Expr) -> None:
        if isinstance(node.value, ast.Call) and not _WORDS.search(ast.unparse(node.value.func)):
            self._removable(node)

    def visit_Raise(self, node: ast.Raise) -> None:
        self._add("removed statement", node, None)

    def visit_JoinedStr(self, node: ast.JoinedStr) -> None:
        """Leave messages alone."""

    def visit_Assert(self, node: ast.Assert) -> None:
        """Leave assertions alone: they only narrow types."""


def _flip(operator: ast.AST) -> Any:
    return _OPPOSITE[type(operator)]()


@functools.cache
def possible(package: str, root: Path = ROOT) -> tuple[Mutant, ...]:
    """Return every fault that can be put into a package, in order of files and lines."""
    trees, at_import = _parsed(root / SOURCES)
    found: list[Mutant] = []
    for path, tree in trees.items():
        if path.is_relative_to(root / SOURCES / package):
            finder = _Finder(package, path.relative_to(root).as_posix(), path.read_bytes(), at_import)
            finder.visit(tree)
            found += finder.found
    return tuple(found)


@functools.cache
def _parsed(sources: Path) -> tuple[dict[Path, ast.Module], frozenset[str]]:
    """Return all modules, and the names that they call at import."""
    trees = {p: ast.parse(p.read_bytes()) for p in sorted(sources.rglob("*.py"))}
    return trees, frozenset(name for tree in trees.values() for name in _called_at_import(tree))


def _called_at_import(tree: ast.Module) -> Iterator[str]:
    for statement in tree.body:
        if not isinstance(statement, ast.FunctionDef | ast.ClassDef):
            for node in ast.walk(statement):
                if isinstance(node, ast.Call):
                    yield ast.unparse(node.func).rpartition(".")[2]


def draw(package: str, count: int, seed: int, root: Path = ROOT) -> list[Mutant]:
    """Draw ``count`` mutants of a package, evenly over kinds, at most one a function; the same for the same seed."""
    rng = random.Random(f"{seed} {package}")
    drawn: list[Mutant] = []
    left = list(possible(package, root))
    kinds = sorted({m.kind for m in left})
    rng.shuffle(kinds)
    for i in range(count):
        sites = [m for m in left if m.kind == kinds[i % len(kinds)]] or left
        function = rng.choice(sorted({(m.file, m.function) for m in sites}))
        drawn.append(rng.choice([m for m in sites if (m.file, m.function) == function]))
        left = [m for m in left if (m.file, m.function) != function]
    return drawn
