"""Train on a set four times as large as the free memory, and measure the cost per row against a small set.

Run by tests: ``python larger_than_memory.py FOLDER MEGABYTES UNITS EPOCHS``. The set is files on the disk, as extract
writes them; the limit is the kernel's limit for the memory of this process.
"""

from __future__ import annotations

import json
import resource
import sys
import time
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.learning.network.cells import pick
from pdhef_logtool.learning.network.dataset import (
    drive_file,
    read_dataset,
    vehicle_entry,
    write_drive,
    write_manifest,
)
from pdhef_logtool.learning.network.fit import Recipe
from pdhef_logtool.learning.network.residuals import ResidualRows
from pdhef_logtool.learning.network.train_command import train_on
from pdhef_logtool.residual_model.features import FEATURES

#: Of one drive: a minute.
STEPS = 6000
#: Bytes of a row as arrays: features, targets and weight as float32. They came as float64 before.
ROW_BYTES = 4 * (len(FEATURES) + 3)


def write_set(folder: Path, drives: int, steps: int = STEPS) -> Path:
    """Write a set of random drives, one in ten of them to validate on."""
    entries, some = [], np.random.default_rng(0).normal(size=(steps, len(FEATURES)))
    for number in range(drives):
        features = np.roll(some, number, axis=0)
        weight = np.ones(steps)
        weight[-1] = 0.0
        rows = ResidualRows(
            stamps_ns=np.arange(steps) * 10_000_000,
            features=features,
            targets=0.01 * features[:, :2],
            step_s=np.full(steps, 0.01),
            weight=weight,
            segment=np.zeros(steps, dtype=np.int64),
            truth_velocity=features[:, :2],
            truth_std_rad=np.zeros(steps),
            region=np.full(steps, np.nan),
        )
        split = "validation" if number % 10 == 9 else "train"
        entry = {
            "name": f"d{number:05}", "log": f"d{number:05}", "split": split, "rows": steps, "usable_rows": steps - 1,
            "period_s": 0.01, "signals_sha256": None, "cells": {}, "car": "a car", "vehicle_sha256": "f" * 64,
        }  # fmt: skip
        write_drive(drive_file(folder, entry), rows, pick(rows), entry)
        entries.append(entry)
    vehicle = vehicle_entry("f" * 64, Car.load(None).datasheet)
    write_manifest(folder, entries, [], settings={"model": "physics"}, seed=0, vehicles={"f" * 64: vehicle})
    return folder


def held_bytes() -> int:
    """Return the memory of this process that counts against the limit."""
    status = Path("/proc/self/status").read_text()
    return 1024 * next(int(line.split()[1]) for line in status.splitlines() if line.startswith("VmData"))


def cost(folder: Path, work: Path, recipe: Recipe) -> tuple[float, str]:
    """Return CPU seconds a row of a training, and the digest of its weights."""
    data = read_dataset(folder)
    began = time.process_time()
    with patch("pdhef_logtool.learning.network.train_command._plot_history", lambda _: b""):  # it is not of a row
        found = train_on(data, work, recipe)
    return (time.process_time() - began) / sum(d.entry["rows"] for d in data.drives), found.bundle.sha256


def main() -> None:
    """Measure and print one document."""
    folder, limit = Path(sys.argv[1]), round(float(sys.argv[2]) * 1e6)
    units, epochs = int(sys.argv[3]), int(sys.argv[4])
    recipe = replace(Recipe(), hidden=units, head=(units,), epochs=epochs)
    drives = -(-4 * limit // (STEPS * ROW_BYTES))
    small, large = (write_set(folder / name, n) for name, n in (("small", max(10, drives // 8)), ("large", drives)))
    cost(small, folder / "warm", recipe)  # the first training loads modules: not counted per row
    alone, _ = cost(small, folder / "a", recipe)
    resource.setrlimit(resource.RLIMIT_DATA, (held_bytes() + limit,) * 2)
    among, sha256 = cost(large, folder / "b", recipe)
    holds = False
    try:
        np.ones(4 * limit // 8)  # the set as one array
    except MemoryError:
        holds = True
    told = {"limit_mb": limit / 1e6, "set_mb": drives * STEPS * ROW_BYTES / 1e6, "limit_holds": holds}
    print(json.dumps({**told, "us_a_row": [1e6 * alone, 1e6 * among], "ratio": among / alone, "sha256": sha256}))


if __name__ == "__main__":
    main()
