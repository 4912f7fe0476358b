"""Run the paper's experiment and write ``docs/paper.md``, its pictures and ``docs/paper/results.json``.

    python -m studies.paper [--models DIR ...] [--vehicle FILE] [-o DOCS] [--noise-seeds N]

Without ``--models`` the networks are the shipped one (training seed 0) and two more of the same training with other
seeds, which are trained first where they are not there yet (``python -m studies.defaults.train_default``).
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from pdhef_logtool.car.vehicle import load_vehicle
from pdhef_logtool.records.errors import PdhefError
from pdhef_logtool.residual_model.bundle import DOCUMENT_FILE, load_bundle
from studies.pages import DOCS, ROOT, SAMPLE_VEHICLE, options, write
from studies.paper.experiment import FIRST_NOISE_SEED, NOISE_SEEDS
from studies.paper.figures import draw
from studies.paper.page import write_page
from studies.paper.results import VEHICLE_FILE, document, gather

#: The shipped network, which is training seed 0.
SHIPPED = ROOT / "pdhef_logtool" / "models" / "default"
#: Further training seeds are trained into folders here; ignored by git.
TRAINED = ROOT / "out" / "paper"
TRAINING_SEEDS = (0, 1, 2)


def is_model(folder: Path) -> bool:
    """Whether a folder holds a model bundle."""
    return (folder / DOCUMENT_FILE).is_file()


def default_models() -> dict[int, Path]:
    """Return the model folders by training seed; what is missing is trained."""
    if not is_model(SHIPPED):
        raise SystemExit(f"no shipped network in {SHIPPED.relative_to(ROOT)}: name model folders with --models")
    folders = {TRAINING_SEEDS[0]: SHIPPED}
    for seed in TRAINING_SEEDS[1:]:
        folder = TRAINED / f"model-seed-{seed}"
        if not is_model(folder):
            print(f"training the network of seed {seed} ...", file=sys.stderr)
            command = [sys.executable, "-m", "studies.defaults.train_default", "--seed", str(seed), "-o", str(folder)]
            subprocess.run(command, cwd=ROOT, check=True)
        folders[seed] = folder
    return folders


def named_models(folders: list[Path]) -> dict[int, Path]:
    """Return folders by the training seed that their bundles name, by their number where two name the same."""
    seeds = [load_bundle(f).provenance.get("recipe", {}).get("seed") for f in folders]
    if len(set(seeds)) < len(seeds) or None in seeds:
        seeds = list(range(len(folders)))
    return dict(zip(seeds, folders, strict=True))


def vehicle_file(folder: Path) -> Path:
    """Return the vehicle file beside the weights, which belongs to them, or that of the sample logs."""
    beside = folder / VEHICLE_FILE
    return beside if beside.is_file() else SAMPLE_VEHICLE


def main() -> int:
    """Run what the command line asks for."""
    parser = options("paper", __doc__)
    parser.add_argument("--models", nargs="+", type=Path, metavar="DIR", help="model folders, one a training seed")
    parser.add_argument("--vehicle", type=Path, metavar="FILE", help="nominal vehicle; that of the first model")
    parser.add_argument("-o", "--output", type=Path, default=DOCS, metavar="DOCS", help="folder of paper.md")
    parser.add_argument("--noise-seeds", type=int, default=NOISE_SEEDS, metavar="N", help=f"{NOISE_SEEDS} by default")
    arguments = parser.parse_args()
    if arguments.noise_seeds < 1:
        parser.error("--noise-seeds needs at least one")
    try:
        folders = named_models(arguments.models) if arguments.models else default_models()
        nominal = load_vehicle(arguments.vehicle or vehicle_file(next(iter(folders.values()))))
        results = gather(
            nominal,
            folders,
            noise_seeds=range(FIRST_NOISE_SEED, FIRST_NOISE_SEED + arguments.noise_seeds),
            progress=lambda text: print(text, file=sys.stderr),
        )
    except PdhefError as error:
        print(error, file=sys.stderr)
        return 1
    pictures = arguments.output / "paper"
    pictures.mkdir(parents=True, exist_ok=True)
    for old in pictures.glob("figure*.png"):  # one that is no longer made must not stay
        old.unlink()
    draw(results, pictures)
    text = json.dumps(document(results), indent=1, allow_nan=False)
    (pictures / "results.json").write_text(text + "\n", encoding="utf-8")
    write(arguments.output / "paper.md", write_page(results))
    return 0


if __name__ == "__main__":
    sys.exit(main())
