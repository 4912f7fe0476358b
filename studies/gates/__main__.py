"""Recompute the frozen figures of the tool and print those that moved; exit code 1 if one did.

    python -m studies.gates [--quick] [--only TEXT ...] [--tree FOLDER] [--jobs 2] [--work out/gates] [--freeze COMMIT]

``studies/results/gates.csv`` has one figure in a line: gate, row, figure, value, unit, relative and absolute tolerance
(the larger one counts), commit. A figure of a deleted feature is removed by hand. ``--freeze`` writes the values of the
tree under test, for figures in the file and for rows missing from it. It saves row by row and resumes where it stopped.
The tool is used by its command line and its files only.
"""

import math
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import NamedTuple

import polars as pl

from studies.gates.rows import Figure, Figures, GateRow, all_rows
from studies.gates.tool import Tool
from studies.pages import RESULTS, ROOT, options

FILE = RESULTS / "gates.csv"
#: The largest change of a geometric mean over the errors of a gate.
MEAN_TOLERANCE = 0.01
HEAD = ("gate", "row", "figure", "value", "unit", "relative", "absolute", "commit")


class Frozen(NamedTuple):
    """A figure of the file and the commit that it is of."""

    figure: Figure
    commit: str


Key = tuple[str, str, str]


def read(file: Path) -> dict[Key, Frozen]:
    """Return the frozen figures by gate, row and figure."""
    if not file.is_file():
        return {}
    kinds = {name: pl.Float64 if name in ("value", "relative", "absolute") else pl.String for name in HEAD}
    rows = pl.read_csv(file, schema=kinds).iter_rows()
    return {(gate, row, name): Frozen(Figure(*figure), commit) for gate, row, name, *figure, commit in rows}


def write(file: Path, frozen: dict[Key, Frozen]) -> None:
    """Write the frozen figures in the order of the rows."""
    order = {(row.gate, row.name): i for i, row in enumerate(all_rows())}
    rows = [
        (*key, f"{figure.value:.6g}", figure.unit, f"{figure.relative:g}", f"{figure.absolute:g}", commit)
        for key, (figure, commit) in sorted(frozen.items(), key=lambda kv: (order.get(kv[0][:2], -1), kv[0]))
    ]
    pl.DataFrame(rows, HEAD, orient="row").write_csv(file)


def moved(was: Figure, now: Figure | None) -> bool:
    """Return whether a figure is absent, or differs by more than its tolerance."""
    if now is None:
        return True
    limit = max(was.relative * abs(was.value), was.absolute)
    # Frozen values have six digits.
    return not abs(now.value - was.value) <= limit + 1e-5 * abs(was.value)


def measure(tool: Tool, row: GateRow) -> tuple[Figures, str]:
    """Return the figures of a row, and why there are none."""
    begin = time.monotonic()
    try:
        figures = row.measure(tool)
    except (OSError, RuntimeError, KeyError, ValueError, subprocess.SubprocessError) as error:
        return {}, f"{row.gate}: {row.name}: {type(error).__name__}: {error}"
    print(f"{row.gate}/{row.name}: {len(figures)} figures, {time.monotonic() - begin:.0f} s", file=sys.stderr)
    return figures, ""


def compare(row: GateRow, figures: Figures, frozen: dict[Key, Frozen]) -> Iterator[str]:
    """Yield a line for each figure of a row that moved."""
    for (gate, name, figure), (was, _) in frozen.items():
        now = figures.get(figure)
        if (gate, name) == (row.gate, row.name) and moved(was, now):
            text = "absent" if now is None else f"{now.value:.5g}"
            share = "" if now is None or not was.value else f" ({100.0 * (now.value / was.value - 1.0):+.1f} %)"
            yield f"{gate}: {name}: {figure}: {was.value:.5g} -> {text} {was.unit}{share}"


def freeze(row: GateRow, figures: Figures, frozen: dict[Key, Frozen], commit: str) -> None:
    """Write the figures of a row that are in the file, or all of a row that is not."""
    known = {key for key in frozen if key[:2] == (row.gate, row.name)}
    for name, figure in figures.items():
        key = (row.gate, row.name, name)
        if not known or key in known:
            frozen[key] = Frozen(figure, commit)
    write(FILE, frozen)


def means(measured: dict[tuple[str, str], Figures], frozen: dict[Key, Frozen]) -> Iterator[str]:
    """Print the geometric mean of each gate's errors over the frozen ones; yield a line for each that moved.

    Errors below the absolute tolerance count as this.
    """
    for gate in dict.fromkeys(gate for gate, _ in measured):
        logs = [
            math.log(max(now.value, now.absolute) / max(was.value, was.absolute))
            for key, (was, _) in frozen.items()
            if key[0] == gate and was.unit == "deg" and (now := measured.get(key[:2], {}).get(key[2]))
        ]
        if logs:
            change = math.exp(sum(logs) / len(logs)) - 1.0
            line = f"{gate}: geometric mean of {len(logs)} errors: {100.0 * change:+.2f} %"
            print(line, file=sys.stderr)
            if abs(change) > MEAN_TOLERANCE:
                yield line


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the rows, and freeze or compare them."""
    parser = options("gates", __doc__, "work", jobs=2)
    parser.add_argument("--quick", action="store_true", help="a representative part")
    parser.add_argument("--only", nargs="+", default=[], help="parts of gate/row")
    parser.add_argument("--tree", type=Path, default=ROOT, help="source tree under test")
    parser.add_argument("--freeze", metavar="COMMIT", help="write the figures as those of this commit")
    given = parser.parse_args(arguments)
    rows = [r for r in all_rows() if r.quick or not given.quick]
    rows = [r for r in rows if not given.only or any(text in f"{r.gate}/{r.name}" for text in given.only)]
    for row in rows:
        if absent := [str(file) for file in row.needs if not file.exists()]:
            print(f"{row.gate}/{row.name}: skipped, because {', '.join(absent)} is absent", file=sys.stderr)
    rows = [r for r in rows if all(file.exists() for file in r.needs)]
    frozen, begin, tool = read(FILE), time.monotonic(), Tool(given.tree.resolve(), given.work.resolve())
    if given.freeze:
        done = {key[:2] for key, value in frozen.items() if value.commit == given.freeze}
        rows = [r for r in rows if (r.gate, r.name) not in done]
    shutil.rmtree(tool.work, ignore_errors=True)
    measured, lines = dict[tuple[str, str], Figures](), list[str]()
    with ThreadPoolExecutor(given.jobs) as pool:
        for row, (figures, failure) in zip(rows, pool.map(partial(measure, tool), rows), strict=True):
            if failure:
                lines.append(failure)
                continue
            measured[row.gate, row.name] = figures
            if given.freeze:
                freeze(row, figures, frozen, given.freeze)
            else:
                lines += compare(row, figures, frozen)
    lines += () if given.freeze else means(measured, frozen)
    print("\n".join(lines) or "no figure moved")
    print(f"{len(measured)} of {len(rows)} rows, {time.monotonic() - begin:.0f} s", file=sys.stderr)
    return int(bool(lines) and not given.freeze)


if __name__ == "__main__":
    sys.exit(main())
