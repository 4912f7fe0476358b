"""Run the speed benchmarks and print one table.

    python -m benchmarks [NAME ...] [--write-docs] [--gate]

With ``--gate`` it ends with 4 if a target is missed.
"""

from __future__ import annotations

import argparse
import sys
from importlib import import_module

from benchmarks.measuring import ROOT, Figure, machine_facts

NAMES = ("reading", "writing", "copying", "filtering")
DOCUMENT = ROOT / "docs" / "benchmarks.md"
_HEADINGS = ("benchmark", "figure", "value", "target", "")
_INTRODUCTION = """# Benchmarks

Written by `python -m benchmarks --write-docs`; `make bench` prints the same table. Seconds are processor seconds of one
thread, the best of several interleaved rounds; ratios are to a peer in the same run. What each benchmark measures, and
on what, heads its file in `benchmarks/`.
"""


def cells(figure: Figure) -> tuple[str, ...]:
    """Return a figure as the cells of a table row."""
    target = "" if figure.limit is None else f"{figure.sense} {figure.limit:g} {figure.unit}"
    verdict = {None: "", True: "pass", False: "MISS"}[figure.passed]
    value = f"{figure.value:.3g}" if abs(figure.value) < 100 else f"{figure.value:.0f}"
    return figure.benchmark, figure.name, f"{value} {figure.unit}", target, verdict


def table(figures: list[Figure]) -> str:
    """Return the figures as a Markdown table."""
    rows = [_HEADINGS, ("---",) * len(_HEADINGS), *map(cells, figures)]
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def main() -> int:
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description="Speed against peers in the same run.")
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(NAMES)}; all when none is given")
    parser.add_argument("--write-docs", action="store_true", help="write docs/benchmarks.md (needs all benchmarks)")
    parser.add_argument("--gate", action="store_true", help="end with 4 if a target is missed")
    arguments = parser.parse_args()
    if set(arguments.names) - set(NAMES):
        parser.error(f"expected names out of {', '.join(NAMES)}, got {', '.join(arguments.names)}")
    if arguments.write_docs and arguments.names:
        parser.error("--write-docs needs all benchmarks: give no names")
    figures: list[Figure] = []
    for name in arguments.names or NAMES:
        print(f"{name} ...", file=sys.stderr)
        figures += import_module(f"benchmarks.{name}").run()
    print(table(figures))
    if arguments.write_docs:
        machine = ", ".join(f"{key} {value}" for key, value in machine_facts().items())
        DOCUMENT.write_text(f"{_INTRODUCTION}\n{table(figures)}\n\nMachine: {machine}.\n", encoding="utf-8")
    return 4 if arguments.gate and any(f.passed is False for f in figures) else 0


if __name__ == "__main__":
    sys.exit(main())
