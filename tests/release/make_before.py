"""Writes outputs of every kind, small, with the version whose tree is the working directory.

    cd TREE_OF_THAT_VERSION && PYTHONPATH=. python .../tests/release/make_before.py FOLDER

Pictures, pages and recordings are left out: nothing of ours reads them again. FOLDER.zip is what the tests unpack.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

SAMPLES = [f"sample_logs/{name}.mcap" for name in ("dlc", "step")]
SLICE = ("--start", "2", "--end", "3.2")
NOT_READ = ("*.png", "*.html", "*.rrd", "*.mcap", "*.xml", "foxglove.json", "*.jsonl")


def _pdhef(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "pdhef_logtool", *arguments], check=True)


def main(folder: Path) -> None:
    """Write ``run``, ``again``, ``dataset``, ``bundle`` and ``car`` into a folder."""
    from pdhef_logtool.learning.network.dataset import read_dataset
    from pdhef_logtool.learning.network.fit import Recipe
    from pdhef_logtool.learning.network.train_command import train_on

    car, bundle, dataset = (str(folder / name) for name in ("car", "bundle", "dataset"))
    road = ("sample_logs/road.mcap", "--end", "60", "--stages", "identify")
    _pdhef("learn", *road, "--car", "sample_logs/vehicle.toml", "-o", car)
    _pdhef("learn", SAMPLES[0], "--stages", "noise", "--car", car, "-o", car, "--trials", "4", *SLICE)
    for split, log in zip(("train", "validation"), SAMPLES, strict=True):
        _pdhef("extract", log, "--car", car, "-o", dataset, "--split", split, *SLICE)
    tiny = Recipe(hidden=4, layers=1, head=(4,), epochs=1)
    train_on(read_dataset(Path(dataset)), Path(bundle), tiny)
    five = [*SAMPLES, *(f"sample_logs/{name}" for name in ("fishhook.mcap", "sweep.mcap", "faults.mcap"))]
    intervals = ("--stages", "intervals", "--vary", "0", "-e", "physics,zero", "--end", "6")
    _pdhef("learn", *five, "--car", car, "-o", car, *intervals)
    estimators = ("-e", "pd-hef,physics,zero", "--annotate", "none", "--start", "2", "--end", "4.5")
    _pdhef("run", SAMPLES[0], "-o", str(folder / "run"), "--car", car, "--network", bundle, *estimators)
    _pdhef("run", SAMPLES[0], "-o", str(folder / "again"), "--car", "saloon", *estimators)
    for pattern in NOT_READ:
        for path in folder.rglob(pattern):
            path.unlink()
    (folder / "again/logs/dlc/estimates.parquet").unlink()
    shutil.make_archive(str(folder), "zip", folder)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
