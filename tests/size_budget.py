"""Size budget: figures of ``size_budget.toml`` that may only go down.

    python tests/size_budget.py [--write]

``make lint`` fails if the project is larger than a figure, or if a commit raises a figure without a ``[[raised]]``
entry that gives the reason. ``--write`` lowers the figures to the present sizes and raises none.

A code line contains code: no blank line, comment or docstring. A constant is a module-level name in capitals with a
number. Functions count as long above 60 code lines and as complex above a cyclomatic complexity of 20, outside compiled
kernels.
"""

import argparse
import ast
import io
import re
import subprocess
import sys
import tokenize
import tomllib
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FILE = Path(__file__).with_suffix(".toml")
PACKAGE = ROOT / "pdhef_logtool"
#: Sources with one limit for their total size.
WHOLE = ("truthsim", "studies", "benchmarks")
LONG_LINES, COMPLEX = 60, 20
#: Limits of large figures are multiples of this, so that an edit of a few lines needs no new limit.
STEPS = {"code_lines": 50, "words_of_docs": 200, "studies_code_lines": 50, "truthsim_code_lines": 50}
#: The group of pages that commands write, in mkdocs.yml.
EVIDENCE = "Evidence"
_NO_CODE = {
    tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENDMARKER,
}  # fmt: skip
_BRANCHES = (
    ast.If, ast.IfExp, ast.For, ast.While, ast.ExceptHandler, ast.With, ast.Assert, ast.comprehension, ast.match_case,
)  # fmt: skip
_Function = ast.FunctionDef | ast.AsyncFunctionDef


def code_lines(source: str, tree: ast.Module) -> set[int]:
    """Return the numbers of the lines that contain code."""
    docs: set[int] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | _Function) and ast.get_docstring(node, clean=False) is not None:
            docs.update(range(node.body[0].lineno, (node.body[0].end_lineno or 0) + 1))
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in _NO_CODE:
            lines.update(range(token.start[0], token.end[0] + 1))
    return lines - docs


def complexity(function: _Function) -> int:
    """Return the cyclomatic complexity: 1, and 1 for each branch and each further operand of a condition."""
    branches = sum(isinstance(node, _BRANCHES) for node in ast.walk(function))
    return 1 + branches + sum(len(n.values) - 1 for n in ast.walk(function) if isinstance(n, ast.BoolOp))


def is_kernel(function: _Function) -> bool:
    """Return whether numba compiles it."""
    return any(
        re.search("njit|_compiled|kernel|inline", ast.unparse(decorator)) for decorator in function.decorator_list
    )


def python_sizes(folder: Path) -> Counter[str]:
    """Return code lines, constants, long and complex functions of the sources below a folder."""
    return sum((file_sizes(path) for path in sorted(folder.rglob("*.py"))), Counter())


@cache
def file_sizes(path: Path) -> Counter[str]:
    """Return the sizes of one source."""
    source = path.read_text(encoding="utf-8")
    tree = ast.parse(source)
    lines = sorted(code_lines(source, tree))
    functions = [n for n in ast.walk(tree) if isinstance(n, _Function) and not is_kernel(n)]
    lengths = [bisect_right(lines, f.end_lineno or 0) - bisect_left(lines, f.lineno) for f in functions]
    return Counter(
        code_lines=len(lines),
        constants=sum(map(_is_constant, tree.body)),
        long_functions=sum(length > LONG_LINES for length in lengths),
        complex_functions=sum(complexity(f) > COMPLEX for f in functions),
    )


def _is_constant(node: ast.stmt) -> bool:
    if isinstance(node, ast.AnnAssign):
        targets, value = [node.target], node.value
    elif isinstance(node, ast.Assign):
        targets, value = node.targets, node.value
    else:
        return False
    names = [n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)]
    numbers = value is not None and any(
        isinstance(n, ast.Constant) and isinstance(n.value, int | float) and not isinstance(n.value, bool)
        for n in ast.walk(value)
    )
    return numbers and all(name.lstrip("_").isupper() for name in names)


def import_edges() -> int:
    """Return how many pairs of packages of ``pdhef_logtool`` there are of which the first imports the second."""
    edges = set()
    for path in PACKAGE.rglob("*.py"):
        package = path.relative_to(PACKAGE).parts[0]
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("pdhef_logtool."):
                edges.add((package, str(node.module).split(".")[1]))
    return len({(a, b) for a, b in edges if a != b and (PACKAGE / a).is_dir()})


def command_line_sizes() -> dict[str, int]:
    """Count commands, all their options, the options of ``run``, and estimator presets."""
    import typer

    from pdhef_logtool.cli.app import app
    from pdhef_logtool.estimators.table import SPECS

    group = typer.main.get_command(app)
    commands = {name: c for name, c in group.commands.items() if not c.hidden}

    def options(command: object) -> int:
        own = sum(p.param_type_name == "option" and not p.hidden for p in command.params)
        return own + sum(options(c) for c in getattr(command, "commands", {}).values())

    return {
        "commands": len({name.split()[0] for name in commands}),
        "options": sum(map(options, commands.values())),
        "options_of_run": options(commands["run"]),
        "presets": len({spec.name.partition(":")[0] for spec in SPECS}),
    }


def words_of_docs(root: Path = ROOT) -> int:
    """Return the number of words of the hand-written pages: those outside the group Evidence, without their tables."""
    navigation = (root / "mkdocs.yml").read_text(encoding="utf-8")
    group = re.search(rf"^  - {EVIDENCE}:\n((?:      - .*\n)*)", navigation, re.MULTILINE)
    generated = set(re.findall(r"(\w+\.md)", group[1])) if group else set()
    pages = [path for path in (root / "docs").glob("*.md") if path.name not in generated]
    texts = (path.read_text(encoding="utf-8") for path in pages)
    return sum(len(re.sub(r"<!-- table: .*?<!-- end -->", "", text, flags=re.DOTALL).split()) for text in texts)


def measure() -> dict[str, dict[str, int]]:
    """Return all sizes by the tables of the file."""
    packages = sorted(p.parent.name for p in PACKAGE.glob("*/__init__.py"))
    sizes = {name: python_sizes(PACKAGE / name) for name in packages}
    total = python_sizes(PACKAGE)
    totals = {k: total[k] for k in ("code_lines", "constants", "long_functions", "complex_functions")}
    whole = {f"{name}_code_lines": python_sizes(ROOT / name)["code_lines"] for name in WHOLE}
    project = {**totals, "import_edges": import_edges(), **command_line_sizes(), "words_of_docs": words_of_docs()}
    return {"project": project | whole} | {
        name: {k: size[k] for k in ("code_lines", "constants")} for name, size in sizes.items()
    }


def _flat(document: Mapping[str, object]) -> dict[str, int]:
    return {f"{t}.{k}": v for t, table in document.items() if isinstance(table, dict) for k, v in table.items()}


def problems(sizes: Mapping[str, int], limits: Mapping[str, int]) -> Iterator[str]:
    """Yield a line for each size above its limit, size without a limit, and limit without a size."""
    for name in sorted(sizes.keys() | limits.keys()):
        if name not in sizes or name not in limits:
            yield f"{name}: expected in both, the project and {FILE.name}; update the file"
        elif sizes[name] > limits[name]:
            yield f"{name}: {sizes[name]}, limit {limits[name]}; remove something, or raise it there with a reason"


def unexplained(document: Mapping[str, object], former: Mapping[str, object]) -> Iterator[str]:
    """Yield a line for each limit that is higher than before and has no entry ``[[raised]]`` with a reason."""
    before, now = _flat(former), _flat(document)
    entries = document.get("raised", [])
    assert isinstance(entries, list)
    explained = {(e["figure"], e["limit"]) for e in entries if e.get("reason")}
    for name, limit in now.items():
        if limit > before.get(name, limit) and (name, limit) not in explained:
            yield f"{name}: raised from {before[name]} to {limit} without a [[raised]] entry that gives the reason"


def _of_commit(commit: str) -> dict[str, object]:
    name = FILE.relative_to(ROOT).as_posix()
    shown = subprocess.run(["git", "show", f"{commit}:{name}"], cwd=ROOT, capture_output=True, text=True, check=False)
    return tomllib.loads(shown.stdout) if shown.returncode == 0 else {}


def lowered(text: str, sizes: Mapping[str, int]) -> str:
    """Return the file's text with each limit lowered to the size, if the limit is larger."""
    table, lines = "", []
    for line in text.splitlines():
        if header := re.fullmatch(r"\[(\w+)\]", line):
            table = header[1]
        elif figure := re.match(r"(\w+) = (\d+)$", line):
            size = sizes.get(f"{table}.{figure[1]}", int(figure[2]))
            step = STEPS.get(figure[1], 1)
            size = -(-size // step) * step
            line = f"{figure[1]} = {min(size, int(figure[2]))}"
        lines.append(line)
    return "\n".join(lines) + "\n"


def main() -> int:
    """Compare; return 1 if something is too large."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n", 1)[0])
    parser.add_argument("--write", action="store_true", help="lower the figures to the present sizes")
    write = parser.parse_args().write
    sys.path.insert(0, str(ROOT))
    sizes = _flat(measure())
    if write:
        FILE.write_text(lowered(FILE.read_text(encoding="utf-8"), sizes), encoding="utf-8")
    document = tomllib.loads(FILE.read_text(encoding="utf-8"))
    said = [*problems(sizes, _flat(document))]
    for commit in ("HEAD", "HEAD^"):
        said += [line for line in unexplained(document, _of_commit(commit)) if line not in said]
    for line in said:
        print(f"{FILE.name}: {line}", file=sys.stderr)
    return int(bool(said))


if __name__ == "__main__":
    sys.exit(main())
