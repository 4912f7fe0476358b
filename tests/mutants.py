"""Mutants: small faults put into the code one at a time, to see whether the tests notice.

    python tests/mutants.py [--seed 1] [--count 30] [--only sinks] [--jobs 2] [--list] [--focused] [--json FILE]

A seeded draw spreads the faults over five packages, over kinds of faults and over functions: no function gets two.
Message texts are not changed, nor is code with effects that no test can observe. Each mutant is tested in a copy of
the tree. The tests of its package run first, the quick ones before the slow ones, then all others; the first failure
kills it. Before, the same tests must pass in a copy without a fault. Exit code 1: fewer than nine in ten died.
"""

from __future__ import annotations

import argparse
import ast
import copy
import functools
import json
import os
import random
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pdhef_logtool.compiled.sources import sources_digest

ROOT = Path(__file__).resolve().parents[1]
SOURCES = "pdhef_logtool"
#: By package that is mutated, the folders of the tests that know it best.
FOLDERS = {
    "estimators": ("estimators", "runs"),
    "evaluation": ("evaluation", "runs"),
    "mapping": ("mapping", "drive", "runs"),
    "learning": ("learning", "studies"),
    "results": ("results", "runs", "cli"),
}
NOT_COPIED = (".git", ".venv", "out", "build", "dist", "*.egg-info", ".hypothesis", ".*_cache", "*.tmp")
#: A mutant that loops for ever is stopped, and was noticed.
LONGEST_STAGE_S = 1800.0
ENOUGH = 0.9

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


@dataclass(frozen=True)
class Verdict:
    """Outcome of a mutant; ``by`` is the first test that failed, empty for a survivor."""

    mutant: Mutant
    killed: bool
    by: str
    wall_s: float


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


def draw(packages: Sequence[str], count: int, seed: int, root: Path = ROOT) -> list[Mutant]:
    """Draw ``count`` mutants, evenly over packages and kinds, at most one a function; the same for the same seed."""
    drawn: list[Mutant] = []
    for n, package in enumerate(packages):
        rng = random.Random(f"{seed} {package}")
        left = list(possible(package, root))
        kinds = sorted({m.kind for m in left})
        rng.shuffle(kinds)
        for i in range(count // len(packages) + (n < count % len(packages))):
            sites = [m for m in left if m.kind == kinds[i % len(kinds)]] or left
            function = rng.choice(sorted({(m.file, m.function) for m in sites}))
            drawn.append(rng.choice([m for m in sites if (m.file, m.function) == function]))
            left = [m for m in left if (m.file, m.function) != function]
    return drawn


def mutated(source: bytes, mutant: Mutant) -> bytes:
    """Return a file with the fault in it and as many bytes as before; the module's docstring gives or takes them."""
    old = mutant.old.encode()
    assert source[mutant.start : mutant.start + len(old)] == old
    changed = source[: mutant.start] + mutant.new.encode() + source[mutant.start + len(old) :]
    head = changed.index(b'"""') + 3
    more = len(changed) - len(source)
    return changed[:head] + (changed[head + more :] if more > 0 else b" " * -more + changed[head:])


def apply(mutant: Mutant, tree: Path) -> None:
    """Put the fault into a copy of the tree, and delete the compiled code that it affects.

    All compiled code belongs to one digest of all sources, and a fault would have all of it compiled again. For a fault
    in a compiled function, only the code of its module and of its direct and indirect importers is deleted. The rest is
    kept under the new digest.
    """
    path, digest = tree / mutant.file, sources_digest(tree)
    before = path.stat()
    path.write_bytes(mutated(path.read_bytes(), mutant))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    for compiled in path.parent.glob(f"__pycache__/{path.stem}.*.pyc"):
        compiled.unlink()
    stems = {module.stem for module in _importers(path, tree)} if mutant.compiled else set()
    for folder in (tree / SOURCES / "__pycache__/compiled").glob(f"{digest}-*"):
        for cached in folder.glob("*.nb[ic]"):
            if cached.name.partition(".")[0] in stems:
                cached.unlink()
        folder.rename(folder.with_name(folder.name.replace(digest, sources_digest(tree))))


def _importers(path: Path, tree: Path) -> set[Path]:
    """Return the module and all that import it, directly or through others."""
    imports = {p: set(_imported(p)) for p in (tree / SOURCES).rglob("*.py")}
    reached, new = {path}, {path}
    while new:
        names = {".".join(p.relative_to(tree).with_suffix("").parts).removesuffix(".__init__") for p in new}
        new = {p for p, found in imports.items() if found & names} - reached
        reached |= new
    return reached


def _imported(path: Path) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_bytes())):
        if isinstance(node, ast.ImportFrom):
            yield node.module or ""
            yield from (f"{node.module}.{a.name}" for a in node.names)
        elif isinstance(node, ast.Import):
            yield from (a.name for a in node.names)


def copy_tree(source: Path, folder: Path) -> Path:
    """Copy a working tree with its compiled code; the tests can still reach ``shared`` beside it."""
    tree = folder / "tree"
    shutil.copytree(source, tree, symlinks=True, ignore=shutil.ignore_patterns(*NOT_COPIED))
    if (ROOT.parent / "shared").is_dir():
        (folder / "shared").symlink_to((ROOT.parent / "shared").resolve())
    return tree


def run_tests(tree: Path, arguments: Sequence[str]) -> str | None:
    """Run pytest in a copy; return the failure, or None if all tests passed or none was chosen."""
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    environment |= {"PYTHONPATH": str(tree), "OMP_NUM_THREADS": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:randomly",
        "--tb=no",
        *arguments,
    ]
    try:
        done = subprocess.run(
            command, cwd=tree, env=environment, capture_output=True, text=True, timeout=LONGEST_STAGE_S, check=False
        )
    except subprocess.TimeoutExpired:
        return "did not end"
    if done.returncode in (0, 5):
        return None
    if done.returncode == 4:
        raise SystemExit(f"pytest cannot run {' '.join(arguments)}: {done.stderr}")
    failed = re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE)
    return failed[1] if failed else f"pytest ended with {done.returncode}"


def judge(mutant: Mutant, clean: Path, focused: bool) -> Verdict:
    """Run the tests on one mutant until one fails."""
    begin = time.monotonic()
    known = [f"tests/{f}" for f in FOLDERS[mutant.package]]
    others = sorted({p.parent.relative_to(clean).as_posix() for p in clean.glob("tests/*/test_*.py")} - set(known))
    stages = [[*known, "-m", "not slow"], [*known, "-m", "slow"], *([] if focused else [others])]
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        tree = copy_tree(clean, Path(folder))
        apply(mutant, tree)
        by = next((failed for stage in stages if (failed := run_tests(tree, stage))), "")
    return Verdict(mutant, bool(by), by, time.monotonic() - begin)


def _line(mutant: Mutant) -> str:
    old, new = (re.sub(r"\s+", " ", t) for t in (mutant.old, mutant.new))
    return f"{mutant.file}:{mutant.line} {mutant.function}, {mutant.kind}: {old}  ->  {new}"


def main() -> int:
    """Draw, judge and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=30)
    parser.add_argument("--only", choices=FOLDERS, action="append", help="one package; may be given again")
    parser.add_argument("--jobs", type=int, default=2, help="mutants at a time")
    parser.add_argument("--list", action="store_true", help="draw only")
    parser.add_argument("--focused", action="store_true", help="only the tests of the mutants' packages")
    parser.add_argument("--json", type=Path, help="write the verdicts here as well")
    options = parser.parse_args()
    packages = options.only or list(FOLDERS)
    mutants = draw(packages, options.count, options.seed)
    if options.list:
        print(*map(_line, mutants), sep="\n")
        return 0
    with tempfile.TemporaryDirectory(prefix="mutants-") as folder, ThreadPoolExecutor(options.jobs) as pool:
        clean = copy_tree(ROOT, Path(folder))
        chosen = sorted({f"tests/{f}" for p in packages for f in FOLDERS[p]}) if options.focused else ["tests"]
        failed = run_tests(clean, [*chosen, "-n", str(options.jobs), "--dist", "worksteal"])
        if failed:
            print(f"the tests do not pass without a mutant: {failed}", file=sys.stderr)
            return 2
        verdicts = []
        for verdict in pool.map(lambda m: judge(m, clean, options.focused), mutants):
            verdicts.append(verdict)
            print(f"{f'killed by {verdict.by}' if verdict.killed else 'SURVIVED'} in {verdict.wall_s:.0f} s")
            print(f"    {_line(verdict.mutant)}", flush=True)
    for package in packages:
        own = [v.killed for v in verdicts if v.mutant.package == package]
        print(f"{package}: {sum(own)} of {len(own)} died")
    died = sum(v.killed for v in verdicts)
    print(f"seed {options.seed}: {died} of {len(verdicts)} died")
    if options.json:
        document = {"seed": options.seed, "died": died, "verdicts": [asdict(v) for v in verdicts]}
        options.json.write_text(json.dumps(document, indent=2) + "\n")
    return 0 if died >= ENOUGH * len(verdicts) else 1


if __name__ == "__main__":
    sys.exit(main())
