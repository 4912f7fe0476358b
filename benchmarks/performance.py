"""Run the speed benchmarks and print their tables; ``--write-docs`` puts them into docs/performance.md.

    python -m benchmarks.performance [NAME ...] [--write-docs] [--gate]
    python -m benchmarks.performance --against TREE

A benchmark is a module of this package: its docstring heads its section of the page, ``rows()`` measures. With
``--gate`` it ends with 4 if a target is missed. ``--against`` compares with another source tree, for example of
the last release (``git worktree add``): commands of both run in turns (:mod:`benchmarks.against`).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module
from inspect import cleandoc
from pathlib import Path

from benchmarks import against
from benchmarks.measuring import ROOT, Row, machine_facts

NAMES = ("hour", "reading", "reading_mdf", "fleet_drive", "starting")
DOCUMENT = ROOT / "docs" / "performance.md"
_HEADINGS = ("work", "figure", "target", "", "against peers")
_SECTION = "\n## "


def cells(row: Row) -> tuple[str, ...]:
    """Return a row as the cells of its table's line."""
    target = "" if row.target is None else f"{row.sense} {row.target:g} {row.unit}"
    verdict = {None: "", True: "pass", False: "MISS"}[row.passed]
    work = f"{row.work}: `{row.command}`" if row.command else row.work
    peers = ", ".join(f"{name} {_number(ratio)} x" for name, ratio in row.peers.items())
    return work, f"{_number(row.value)} {row.unit}", target, verdict, peers


def _number(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 100 else f"{value:.0f}"


def table(rows: Sequence[Row]) -> str:
    """Return the rows as a Markdown table."""
    lines = [_HEADINGS, ("---",) * len(_HEADINGS), *map(cells, rows)]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def section(name: str, rows: Sequence[Row]) -> str:
    """Return the section of one benchmark, from its name on."""
    about = cleandoc(import_module(f"benchmarks.{name}").__doc__ or "")
    machine = ", ".join(f"{key} {value}" for key, value in machine_facts().items())
    return f"{name}\n\n{about}\n\n{table(rows)}\n\nMachine: {machine}.\n"


def page(old: str, measured: dict[str, str]) -> str:
    """Return the page with new sections; its beginning, and those that were not measured, stay as they are."""
    beginning, *kept = old.split(_SECTION)
    sections = {text.split("\n", 1)[0]: text for text in kept} | measured
    return _SECTION.join([beginning, *(sections[name] for name in NAMES if name in sections)])


def main() -> int:
    """Run the benchmarks of the command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.performance", description="Speed against peers.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; default: all")
    parser.add_argument("--write-docs", action="store_true", help="write the sections into docs/performance.md")
    parser.add_argument("--against", type=Path, metavar="TREE", help="source tree of another version to compare with")
    parser.add_argument("--gate", action="store_true", help="end with 4 if a target is missed")
    arguments = parser.parse_args()
    if set(arguments.names) - set(NAMES):
        parser.error(f"expected names out of {', '.join(NAMES)}, got {', '.join(arguments.names)}")
    if arguments.against is not None:
        print(table(against.rows(arguments.against.resolve())))
        return 0
    missed = False
    for name in arguments.names or NAMES:
        print(f"{name} ...", file=sys.stderr)
        rows: list[Row] = import_module(f"benchmarks.{name}").rows()
        missed |= any(row.passed is False for row in rows)
        print(table(rows), end="\n\n", flush=True)
        if arguments.write_docs:
            old = DOCUMENT.read_text(encoding="utf-8") if DOCUMENT.exists() else ""
            DOCUMENT.write_text(page(old, {name: section(name, rows)}), encoding="utf-8")
    return 4 if arguments.gate and missed else 0


if __name__ == "__main__":
    sys.exit(main())
