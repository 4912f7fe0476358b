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


def print_table(figures: list[Figure]) -> None:
    """Print the figures for a terminal."""
    rows = [_HEADINGS, *(cells(f) for f in figures)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(_HEADINGS))]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


def write_document(figures: list[Figure]) -> None:
    """Write the figures and the machine they are from to ``docs/benchmarks.md``."""
    lines = [_INTRODUCTION, "| " + " | ".join(_HEADINGS) + " |", "| --- " * len(_HEADINGS) + "|"]
    lines += ["| " + " | ".join(cells(f)) + " |" for f in figures]
    lines += ["", "Machine: " + ", ".join(f"{key} {value}" for key, value in machine_facts().items()) + ".", ""]
    DOCUMENT.write_text("\n".join(lines), encoding="utf-8")


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
    print_table(figures)
    if arguments.write_docs:
        write_document(figures)
    return 4 if arguments.gate and any(f.passed is False for f in figures) else 0


if __name__ == "__main__":
    sys.exit(main())
