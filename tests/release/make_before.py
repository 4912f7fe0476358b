"""Writes outputs of every kind, small, with the version whose tree is the working directory.

    cd TREE_OF_THAT_VERSION && PYTHONPATH=. python .../tests/release/make_before.py FOLDER

Pictures, pages and recordings are left out: nothing of ours reads them again.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

SAMPLES = [f"sample_logs/{name}.mcap" for name in ("dlc", "step")]
SLICE = ("--start", "2", "--end", "4.5")
NOT_READ = ("*.png", "*.html", "*.rrd", "*.mcap", "*.xml", "foxglove.json", "*.jsonl")


def _pdhef(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "pdhef_logtool", *arguments], check=True)


def main(folder: Path) -> None:
    """Write ``run``, ``again``, ``dataset``, ``bundle`` and ``car`` into a folder."""
    from pdhef_logtool.learning.network.dataset import read_dataset
    from pdhef_logtool.learning.network.fit import Recipe
    from pdhef_logtool.learning.network.train_command import train_on

    car, bundle, dataset = (str(folder / name) for name in ("car", "bundle", "dataset"))
    road = ("sample_logs/road.mcap", "--end", "60", "--parts", "static")
    _pdhef("identify", *road, "--car", "sample_logs/vehicle.toml", "-o", car)
    _pdhef("tune", SAMPLES[0], "--car", car, "-o", car, "--trials", "4", *SLICE)
    for split, log in zip(("train", "validation"), SAMPLES, strict=True):
        _pdhef("extract", log, "--car", car, "-o", dataset, "--split", split, *SLICE)
    tiny = Recipe(hidden=4, layers=1, head=(4,), epochs=1)
    train_on(read_dataset(Path(dataset)), Path(bundle), tiny)
    _pdhef("calibrate", *SAMPLES, "--car", car, "-o", car, "--vary", "0", "--network", bundle, *SLICE)
    estimators = ("-e", "pd-hef,physics,zero", "--annotate", "none", *SLICE)
    _pdhef("run", *SAMPLES, "-o", str(folder / "run"), "--car", car, "--network", bundle, *estimators)
    _pdhef("run", *SAMPLES, "-o", str(folder / "again"), "--car", "saloon", *estimators)
    for pattern in NOT_READ:
        for path in folder.rglob(pattern):
            shutil.rmtree(path) if path.is_dir() else path.unlink()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
