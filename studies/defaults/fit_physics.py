"""Fit ``physics`` of the shipped car: its parts, values and noise, on five minutes of simulated driving.

    python -m studies.defaults.fit_physics [-o FOLDER] [--work out/fit-physics] [--jobs 2]

The drives last 12.5 s, like the training drives of networks, with true friction and exact ground truth. The paper's
scenarios, with their different speeds and friction, are excluded. All other values come from the vehicle file.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

from pdhef_logtool.car.car import FIT_FILE, SHIPPED_CARS, Car
from pdhef_logtool.car.parts import Fit, LearntOn, physics_sha256
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.drive import reading
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import Tell
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.residual_model.bundle import NO_MODEL
from studies.defaults.axle_forces import FitDrive
from studies.defaults.physics_fit import find_physics
from studies.pages import options

SEED, DRIVES = 5000, 24
HEAD = "Written by python -m studies.defaults.fit_physics; [filter] by studies.defaults.train_default."


_FRICTION = SignalSource("friction", "/truth/perfect/state", "friction")


def read_drive(path: Path, car: Car) -> reading.WholeDrive:
    """Read a simulated log with its true friction.

    The exact ground truth has the clock of the sensors, so that no latency is estimated: a stuck gyro would bend it.
    """

    def with_true_friction(_log: DriveLog, mapping: Mapping, _tell: Tell) -> Mapping:
        return replace(mapping, signals={**mapping.signals, "friction": _FRICTION})

    with reading.read_drive(path, car, options=ReadOptions(friction=None), adjust=with_true_friction) as drive:
        drive.plan = replace(drive.plan, latency=None)
        return drive.whole()


def main(arguments: list[str] | None = None) -> int:
    """Simulate, fit, write."""
    parser = options("defaults.fit_physics", __doc__)
    parser.add_argument("-o", "--output", type=Path, default=SHIPPED_CARS["saloon"], help="the car's folder")
    parser.add_argument("--work", type=Path, default=Path("out/fit-physics"), help="logs; kept")
    parser.add_argument("--jobs", type=int, default=2)
    given = parser.parse_args(arguments)
    simulate = ("simulate", "suite", "--count", str(DRIVES), "--seed", str(SEED), "--jobs", str(given.jobs))
    subprocess.run([sys.executable, "-m", "pdhef_logtool", *simulate, "-o", str(given.work)], check=True)
    car = Car.load(given.output, network=NO_MODEL)
    drawn = json.loads((given.work / "manifest.json").read_text(encoding="utf-8"))["drives"]
    drives, learnt_on = [], []
    for entry in drawn:
        read = read_drive(given.work / entry["file"], Car(car.vehicle))
        assert read.truth is not None
        drives.append(FitDrive(read.name, read.signals, read.truth))
        learnt_on.append(LearntOn(name=read.name, sha256=entry["sha256"], end_s=entry["duration_s"]))

    def say(text: str, share: float) -> None:
        print(f"{100 * share:3.0f} % {text}", flush=True)

    result, physics, tried = find_physics(drives, car.vehicle, progress=say)
    # The smoother uses the filter's noise: the network predicts most of the model residual.
    physics = physics.model_copy(update={"smoothing": (1.0, 1.0)})
    print(f"sideslip RMSE on what it was fitted to: {result.rms_deg:.4f} deg")
    print(*tried, sep="\n")
    part = Fit(physics_sha256=physics_sha256(car.vehicle), physics=physics, drives=tuple(learnt_on))
    (given.output / FIT_FILE).write_text(part_toml(part, HEAD), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
