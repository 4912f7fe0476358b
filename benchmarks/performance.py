"""Run the speed benchmarks and print their tables; ``--write-docs`` puts them into docs/reliability.md.

    python -m benchmarks.performance [NAME ... | --against TREE] [--write-docs]

A benchmark is a module of this package: its docstring heads its section of the page, ``rows()`` measures.
``--against`` compares with another source tree, for example of the last release (``git worktree add``): commands of
both run in turns (:mod:`benchmarks.versions`).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from types import ModuleType

from benchmarks.measuring import Row, machine_facts
from studies.pages import DOCS, table, update

NAMES = ("hour", "where", "reading", "reading_mdf", "fleet_drive", "starting")
VERSIONS = "versions"
PAGE = "reliability.md"
_HEAD = "work, figure, target, , against peers"


def cells(row: Row) -> tuple[str, ...]:
    """Return a row as the cells of its table's line."""
    target = "" if row.target is None else f"{row.sense} {row.target:g} {row.unit}"
    verdict = {None: "", True: "pass", False: "MISS"}[row.passed]
    work = f"{row.work}: `{row.command}`" if row.command else row.work
    peers = ", ".join(f"{name} {_number(ratio)} x" for name, ratio in row.peers.items())
    return work, f"{_number(row.value)} {row.unit}", target, verdict, peers


def _number(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


def section(module: ModuleType, rows: Sequence[Row]) -> str:
    """Return the section of one benchmark."""
    about = cleandoc(module.__doc__ or "")
    machine = ", ".join(f"{key} {value}" for key, value in machine_facts().items())
    return f"{about}\n\n{table(_HEAD, map(cells, rows))}\n\nMachine: {machine}."


def main() -> None:
    """Run the benchmarks of the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.performance", description="Speed against peers.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; default: all")
    parser.add_argument("--write-docs", action="store_true", help="write the sections into docs/reliability.md")
    parser.add_argument("--against", type=Path, metavar="TREE", help="source tree of another version to compare with")
    arguments = parser.parse_args()
    if set(arguments.names) - set(NAMES):
        parser.error(f"expected names out of {', '.join(NAMES)}, got {', '.join(arguments.names)}")
    for name in (VERSIONS,) if arguments.against else arguments.names or NAMES:
        print(f"{name} ...", file=sys.stderr)
        module = import_module(f"benchmarks.{name}")
        rows = module.rows(arguments.against.resolve()) if arguments.against else module.rows()
        print(table(_HEAD, map(cells, rows)), end="\n\n", flush=True)
        if arguments.write_docs:
            update(DOCS, PAGE, {name: section(module, rows)})


if __name__ == "__main__":
    main()
