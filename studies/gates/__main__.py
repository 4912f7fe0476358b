"""Recompute the frozen figures of the tool and print those that moved; exit code 1 if one did.

    python -m studies.gates [--quick] [--only TEXT ...]       [--tree FOLDER] [--jobs 2] [--work out/gates]
                            [--freeze COMMIT]

``studies/results/gates.csv`` has one figure in a line: gate, row, figure, value, unit, relative and absolute tolerance
(the larger one counts), commit. A figure of a deleted feature is removed by hand. ``--freeze`` writes the values of the
tree under test, for figures in the file and for rows missing from it. It saves row by row and resumes where it stopped;
``--again`` also freezes rows that are of this commit already. The tool is used by its command line and its files only.
"""

from __future__ import annotations

import math
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import polars as pl

from studies.gates.rows import FULL, QUICK, Figure, Figures, GateRow, SkippedRowError, all_rows
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


def compare(row: GateRow, figures: Figures, frozen: dict[Key, Frozen]) -> list[str]:
    """Return a line for each figure of a row that moved."""
    lines = []
    for (gate, name, figure), (was, _) in frozen.items():
        now = figures.get(figure)
        if (gate, name) == (row.gate, row.name) and moved(was, now):
            text = "absent" if now is None else f"{now.value:.5g}"
            share = "" if now is None or not was.value else f" ({100.0 * (now.value / was.value - 1.0):+.1f} %)"
            lines.append(f"{gate}: {name}: {figure}: {was.value:.5g} -> {text} {was.unit}{share}")
    return lines


def mean_ratio(pairs: Sequence[tuple[Figure, Figure]]) -> float:
    """Return the geometric mean of new over frozen errors; errors below the absolute tolerance count as this."""
    logs = [math.log(max(now.value, now.absolute) / max(was.value, was.absolute)) for was, now in pairs]
    return math.exp(sum(logs) / len(logs))


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure the rows, and freeze or compare them."""
    parser = options("gates", __doc__)
    parser.add_argument("--quick", action="store_true", help="a representative part")
    parser.add_argument("--only", nargs="+", default=[], help="parts of gate/row")
    parser.add_argument("--tree", type=Path, default=ROOT, help="source tree under test")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--work", type=Path, default=ROOT / "out" / "gates")
    parser.add_argument("--freeze", metavar="COMMIT", help="write the figures as those of this commit")
    parser.add_argument("--again", action="store_true", help="freeze rows of this commit again")
    parser.add_argument("--list", action="store_true", help="print the rows")
    given = parser.parse_args(arguments)
    rows = [r for r in all_rows() if (QUICK if given.quick else FULL) in r.sets]
    rows = [r for r in rows if not given.only or any(text in f"{r.gate}/{r.name}" for text in given.only)]
    if given.list:
        print("\n".join(f"{r.gate}/{r.name}" for r in rows))
        return 0
    frozen = read(FILE)
    if given.freeze and not given.again:
        done = {key[:2] for key, value in frozen.items() if value.commit == given.freeze}
        rows = [r for r in rows if (r.gate, r.name) not in done]
    return Session(Tool(given.tree.resolve(), given.work.resolve()), frozen, given.freeze).measure(rows, given.jobs)


class Session:
    """One call: the tool, the frozen and the measured figures."""

    def __init__(self, tool: Tool, frozen: dict[Key, Frozen], commit: str | None) -> None:
        self.tool, self.frozen, self.commit = tool, frozen, commit
        self.lines: list[str] = []
        self.measured: dict[tuple[str, str], Figures] = {}
        self.lock = threading.Lock()

    def measure(self, rows: Sequence[GateRow], jobs: int) -> int:
        """Measure rows in threads and report; return the exit code."""
        shutil.rmtree(self.tool.work, ignore_errors=True)
        begin = time.monotonic()
        with ThreadPoolExecutor(jobs) as pool:
            list(pool.map(self.measure_row, rows))
        skipped = len(rows) - len(self.measured)
        self.lines += self.means()
        print("\n".join(self.lines) or "no figure moved")
        print(
            f"{len(self.measured)} rows, {skipped} without figures, {time.monotonic() - begin:.0f} s", file=sys.stderr
        )
        return int(bool(self.lines) and not self.commit)

    def measure_row(self, row: GateRow) -> None:
        """Measure one row; freeze it or compare it."""
        begin = time.monotonic()
        try:
            figures = row.measure(self.tool)
        except SkippedRowError as reason:
            print(f"{row.gate}/{row.name}: skipped: {reason}", file=sys.stderr)
            return
        except (OSError, RuntimeError, KeyError, ValueError, subprocess.SubprocessError) as error:
            with self.lock:
                self.lines.append(f"{row.gate}: {row.name}: {type(error).__name__}: {error}")
            return
        print(f"{row.gate}/{row.name}: {len(figures)} figures, {time.monotonic() - begin:.0f} s", file=sys.stderr)
        with self.lock:
            self.measured[row.gate, row.name] = figures
            if self.commit:
                self.freeze(row, figures, self.commit)
            else:
                self.lines += compare(row, figures, self.frozen)

    def freeze(self, row: GateRow, figures: Figures, commit: str) -> None:
        """Write the figures of a row that are in the file, or all of a row that is not."""
        known = {key for key in self.frozen if key[:2] == (row.gate, row.name)}
        for name, figure in figures.items():
            key = (row.gate, row.name, name)
            if not known or key in known:
                self.frozen[key] = Frozen(figure, commit)
        write(FILE, self.frozen)

    def means(self) -> list[str]:
        """Print the geometric mean of each gate's errors; return a line for each that moved."""
        lines = []
        for gate in dict.fromkeys(gate for gate, _ in self.measured):
            pairs = [
                (was.figure, self.measured[key[:2]][key[2]])
                for key, was in self.frozen.items()
                if key[0] == gate and was.figure.unit == "deg" and key[2] in self.measured.get(key[:2], {})
            ]
            if not pairs or self.commit:
                continue
            ratio = mean_ratio(pairs)
            print(f"{gate}: geometric mean of {len(pairs)} errors: {100.0 * (ratio - 1.0):+.2f} %", file=sys.stderr)
            if abs(ratio - 1.0) > MEAN_TOLERANCE:
                lines.append(f"{gate}: geometric mean of {len(pairs)} errors: {100.0 * (ratio - 1.0):+.2f} %")
        return lines


if __name__ == "__main__":
    sys.exit(main())
