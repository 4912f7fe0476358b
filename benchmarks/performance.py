"""Run the speed benchmarks and print their tables; ``--write-docs`` puts them into docs/reliability.md.

    python -m benchmarks.performance [NAME ... | --against TREE] [--write-docs]

A benchmark is a module of this package: its docstring heads its section of the page, ``rows()`` measures.
``--against`` compares with another source tree, for example of the last release (``git worktree add``): commands of
both run in turns (:mod:`benchmarks.versions`).
"""

import argparse
import sys
from importlib import import_module
from inspect import cleandoc
from pathlib import Path

from benchmarks.measuring import machine_facts
from studies.pages import DOCS, template, update

NAMES = ("hour", "where", "reading", "reading_mdf", "fleet_drive", "starting")
VERSIONS = "versions"
PAGE = "reliability.md"


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
        text = template(__file__, about=cleandoc(module.__doc__ or ""), rows=rows, machine=machine_facts())
        print(text, flush=True)
        if arguments.write_docs:
            update(DOCS, PAGE, {name: text.rstrip("\n")})


if __name__ == "__main__":
    main()
