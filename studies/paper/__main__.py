"""Run the paper's experiment on the shipped car and write ``docs/paper.md``, its figures and its results.

    python -m studies.paper [--out docs] [--noise-seeds N] [--stored]

The constants that the paper leaves open come from ``python -m studies.paper.constants``.
"""

import re
import shutil

from pdhef_logtool.car.car import Car
from studies.gates.tool import Tool
from studies.pages import OF_PAGES, ROOT, options, read_json, write, write_json
from studies.paper.experiment import FIRST_NOISE_SEED, NOISE_SEEDS
from studies.paper.figures import draw
from studies.paper.page import write_page
from studies.paper.results import document, gather

#: Results of this command and of the constants, in the folder of results.
STORED = ("results.json", "constants.json")


def main() -> None:
    """Run the experiment and write the page from the stored results and figures."""
    given = options("paper", __doc__, OF_PAGES, noise_seeds=NOISE_SEEDS).parse_args()
    if not given.stored:
        seeds = range(FIRST_NOISE_SEED, FIRST_NOISE_SEED + given.noise_seeds)
        results = gather(Tool(ROOT, given.work.resolve()), Car.load("saloon"), noise_seeds=seeds)
        draw(results, given.results)
        write_json(given.results / STORED[0], document(results))
    page = write_page(*(read_json(given.results / name) for name in STORED))
    (given.out / "paper").mkdir(parents=True, exist_ok=True)
    for name in re.findall(r"\(paper/(\w+\.png)\)", page):
        shutil.copyfile(given.results / name, given.out / "paper" / name)
    write(given.out / "paper.md", page)


if __name__ == "__main__":
    main()
