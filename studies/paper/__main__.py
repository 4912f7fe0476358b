"""Run the paper's experiment on the shipped car and write ``docs/paper.md``, its figures and its results.

    python -m studies.paper [-o DOCS] [--noise-seeds N] [--render]

The constants that the paper leaves open come from ``python -m studies.paper.constants``.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

from pdhef_logtool.car.car import Car
from pdhef_logtool.records.errors import PdhefError
from studies.pages import DOCS, RESULTS, options, write
from studies.paper.experiment import FIRST_NOISE_SEED, NOISE_SEEDS
from studies.paper.figures import draw
from studies.paper.page import PAGE_FIGURES, write_page
from studies.paper.results import document, gather

#: Results of this command and of the constants, in the folder of results.
STORED = ("results.json", "constants.json")


def render(results: Path, docs: Path) -> None:
    """Write the page from the stored results and figures of a folder."""
    stored, constants = (json.loads((results / n).read_text(encoding="utf-8")) for n in STORED)
    (docs / "paper").mkdir(parents=True, exist_ok=True)
    for name in PAGE_FIGURES:
        shutil.copyfile(results / name, docs / "paper" / name)
    write(docs / "paper.md", write_page(stored, constants))


def main() -> int:
    """Run the command line."""
    parser = options("paper", __doc__)
    parser.add_argument("-o", "--output", type=Path, default=DOCS, metavar="DOCS", help="folder of paper.md")
    parser.add_argument("--results", type=Path, default=RESULTS / "paper", help="folder of results and figures")
    parser.add_argument("--noise-seeds", type=int, default=NOISE_SEEDS, metavar="N", help=f"{NOISE_SEEDS} by default")
    parser.add_argument("--render", action="store_true", help="write the page from stored results")
    arguments = parser.parse_args()
    if arguments.render:
        render(arguments.results, arguments.output)
        return 0
    if arguments.noise_seeds < 1:
        parser.error("--noise-seeds needs at least one")
    seeds = range(FIRST_NOISE_SEED, FIRST_NOISE_SEED + arguments.noise_seeds)
    try:
        results = gather(Car.load("saloon"), noise_seeds=seeds, progress=lambda text: print(text, file=sys.stderr))
    except PdhefError as error:
        print(error, file=sys.stderr)
        return 1
    arguments.results.mkdir(parents=True, exist_ok=True)
    draw(results, arguments.results)
    text = json.dumps(document(results), indent=1, allow_nan=False)
    write(arguments.results / STORED[0], text + "\n")
    render(arguments.results, arguments.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
