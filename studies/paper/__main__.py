"""Run the paper's experiment and write ``docs/paper.md`` and its details in ``studies/results/paper``.

    python -m studies.paper [-o DOCS] [--noise-seeds N] [--render]

The cars are the shipped one (training seed 0), two more with networks from the same training with other seeds, and one
trained without lane changes and sine sweeps. Missing cars are trained first
(``python -m studies.defaults.train_default``).
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path

from pdhef_logtool.car.car import NETWORK_FILE, Car
from pdhef_logtool.records.errors import PdhefError
from studies.pages import DOCS, RESULTS, ROOT, options, write
from studies.paper.experiment import FIRST_NOISE_SEED, NOISE_SEEDS
from studies.paper.figures import draw
from studies.paper.page import PAGE_FIGURES, write_details, write_page
from studies.paper.results import document, gather
from studies.paper.withheld import Withheld, counts, withheld_car

#: Further training seeds are trained into folders here; ignored by git.
TRAINED = ROOT / "out" / "paper"
#: Drives and residuals of the shipped network's training.
WORK = ROOT / "out" / "train-default"
TRAINING_SEEDS = (0, 1, 2)


def default_cars() -> dict[int, Car]:
    """Return the shipped car and the cars of further training seeds; missing ones are trained."""
    cars = {TRAINING_SEEDS[0]: Car.load("saloon")}
    for seed in TRAINING_SEEDS[1:]:
        folder = TRAINED / f"car-seed-{seed}"
        if not (folder / NETWORK_FILE).is_file():
            print(f"training the network of seed {seed} ...", file=sys.stderr)
            command = [sys.executable, "-m", "studies.defaults.train_default", "--seed", str(seed), "-o", str(folder)]
            command += ["--work", str(WORK)]
            subprocess.run(command, cwd=ROOT, check=True)
        cars[seed] = Car.load(folder)
    return cars


def render(results: Path, docs: Path) -> None:
    """Write the page and its details from ``results.json`` and the figures of a folder."""
    stored = json.loads((results / "results.json").read_text(encoding="utf-8"))
    (docs / "paper").mkdir(parents=True, exist_ok=True)
    for name in PAGE_FIGURES:
        shutil.copyfile(results / name, docs / "paper" / name)
    write(results / "details.md", write_details(stored, results))
    write(docs / "paper.md", write_page(stored))


def main() -> int:
    """Run the command line."""
    parser = options("paper", __doc__)
    parser.add_argument("-o", "--output", type=Path, default=DOCS, metavar="DOCS", help="folder of paper.md")
    parser.add_argument("--results", type=Path, default=RESULTS / "paper", help="folder of the details")
    parser.add_argument("--noise-seeds", type=int, default=NOISE_SEEDS, metavar="N", help=f"{NOISE_SEEDS} by default")
    parser.add_argument("--render", action="store_true", help="write the pages from stored results")
    arguments = parser.parse_args()
    if arguments.render:
        render(arguments.results, arguments.output)
        return 0
    if arguments.noise_seeds < 1:
        parser.error("--noise-seeds needs at least one")
    try:
        cars = default_cars()
        withheld = Withheld(counts(WORK), withheld_car(WORK, TRAINED / "car-withheld"))
        results = gather(
            cars,
            withheld=withheld,
            noise_seeds=range(FIRST_NOISE_SEED, FIRST_NOISE_SEED + arguments.noise_seeds),
            progress=lambda text: print(text, file=sys.stderr),
        )
    except PdhefError as error:
        print(error, file=sys.stderr)
        return 1
    for old in arguments.results.glob("figure*.png"):  # of a former run
        old.unlink()
    arguments.results.mkdir(parents=True, exist_ok=True)
    draw(results, arguments.results)
    text = json.dumps(document(results), indent=1, allow_nan=False)
    write(arguments.results / "results.json", text + "\n")
    render(arguments.results, arguments.output)
    return 0


if __name__ == "__main__":
    sys.exit(main())
