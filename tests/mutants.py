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
    function: str
    kind: str
    start: int
    old: str
    new: str
    compiled: bool


def _faults(node: ast.AST) -> Iterator[tuple[str, ast.expr | None]]:
    """Yield the kind of each fault of a node, and what replaces it; None: nothing does."""
    match node:
        case ast.Compare(ops=[operator]):
            yield "comparison", ast.Compare(node.left, [_flip(operator)], node.comparators)
        case ast.BoolOp():
            yield "and/or", ast.BoolOp(_flip(node.op), node.values)
        case ast.BinOp() if type(node.op) in _OPPOSITE and not (_is_text(node.left) or _is_text(node.right)):
            yield "sign", ast.BinOp(node.left, _flip(node.op), node.right)
        case ast.UnaryOp(op=ast.USub()):
            yield "sign", node.operand
        case ast.Constant(value=bool(value)):
            yield "constant", ast.Constant(not value)
        case ast.Constant(value=int(value)):
            yield "constant", ast.Constant(value + 1)
        case ast.Constant(value=float(value)) if value == 0.0 or abs(value) >= 1e-9:  # below: a guard against 1 / 0
            yield "constant", ast.Constant(value * 2.0 if value else 1.0)
        case ast.Call() if _may_swap(node):
            for i, (first, second) in enumerate(zip(node.args, node.args[1:], strict=False)):
                if ast.dump(first) != ast.dump(second):
                    swapped = copy.copy(node)
                    swapped.args = [*node.args[:i], second, first, *node.args[i + 2 :]]
                    yield "swapped arguments", swapped
        case ast.AugAssign() | ast.Continue() | ast.Break() | ast.Raise() | ast.Expr(value=ast.Call()):
            yield "removed statement", None
        case ast.Assign() if all(isinstance(t, ast.Attribute | ast.Subscript) for t in node.targets):
            yield "removed statement", None


def _flip(operator: ast.AST) -> Any:
    return _OPPOSITE[type(operator)]()


def _is_text(node: ast.expr) -> bool:
    return isinstance(node, _TEXT) or (isinstance(node, ast.Constant) and isinstance(node.value, str))


def _may_swap(call: ast.Call) -> bool:
    name = ast.unparse(call.func).rpartition(".")[2]
    return name not in _COMMUTATIVE and not any(isinstance(a, ast.Starred) for a in call.args)


def _parts(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes below one that may have faults: no messages, assertions, annotations or idle keywords."""
    match node:
        case ast.JoinedStr() | ast.Assert() | ast.Raise():
            return
        case ast.FunctionDef() | ast.ClassDef():  # neither decorators, defaults nor annotations
            yield from node.body
        case ast.AnnAssign():
            yield from [node.value] if node.value is not None else []
        case ast.Call():
            yield from (node.func, *node.args, *(k.value for k in node.keywords if k.arg not in _IDLE_KEYWORDS))
        case _:
            yield from ast.iter_child_nodes(node)


def _is_message(node: ast.AST) -> bool:
    call = node.value if isinstance(node, ast.Expr) else node
    return isinstance(call, ast.Call) and bool(_WORDS.search(ast.unparse(call.func)))


def _sites(node: ast.AST, function: str, is_compiled: bool, at_import: frozenset[str]) -> Iterator[tuple[Any, ...]]:
    """Yield the faults below a node: kind, node, its replacement, function and whether numba compiles that."""
    for part in _parts(node):
        if isinstance(part, ast.FunctionDef | ast.ClassDef):
            name = f"{function}.{part.name}".lstrip(".")
            yield from _sites(part, name, is_compiled or _is_compiled(part, at_import), at_import)
        elif not isinstance(node, ast.Module | ast.ClassDef) and not _is_message(part):
            yield from ((kind, part, new, function, is_compiled) for kind, new in _faults(part))
            yield from _sites(part, function, is_compiled, at_import)


def _is_compiled(node: ast.FunctionDef | ast.ClassDef, at_import: frozenset[str]) -> bool:
    """Tell whether numba may hold a function: compiled itself, or called at import."""
    decorated = any("jit" in ast.unparse(d) for d in node.decorator_list)
    return isinstance(node, ast.FunctionDef) and (decorated or node.name in at_import)


@functools.cache
def possible(package: str, root: Path = ROOT) -> tuple[Mutant, ...]:
    """Return every fault that can be put into a package, in order of files and lines."""
    trees, at_import = _parsed(root / SOURCES)
    found: list[Mutant] = []
    for path, tree in trees.items():
        if path.is_relative_to(root / SOURCES / package):
            source, file = path.read_bytes(), path.relative_to(root).as_posix()
            lines = [0]
            for line in source.splitlines(keepends=True):
                lines.append(lines[-1] + len(line))
            for kind, node, new, function, compiled in _sites(tree, "", False, at_import):
                start = lines[node.lineno - 1] + node.col_offset
                old = source[start : lines[node.end_lineno - 1] + node.end_col_offset].decode()
                # As many lines as before: numba finds compiled functions by the line that they begin at.
                rows = "\n" * old.count("\n")
                text = f"pass{rows}" if new is None else f"({ast.unparse(new)}{rows})"
                found.append(Mutant(package, file, function, kind, start, old, text, compiled))
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
