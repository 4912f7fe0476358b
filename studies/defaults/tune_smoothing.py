"""Tune the factors on the process noise of v_y and yaw rate for smoothing of cars without ground truth.

    python -m studies.defaults.tune_smoothing

Simulated cars with wrong files. Each drive is smoothed with all pairs of factors on two cars: one that calibrated
itself on that drive, and one that was identified on another drive. Criterion: the geometric mean of the smoothed error
over that of the filter. Writes results/smoothing.json; the result is entered as SMOOTHING in ``car/parts.py``.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import PHYSICS, FittedPhysics, FittedValues
from pdhef_logtool.car.vehicle import PhysicsParts
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.physics_filter import of_car
from pdhef_logtool.estimators.smoothed import SmoothedPhysics, for_smoothing
from pdhef_logtool.storage.files import write_bytes
from studies.condition_drives import root_mean_square
from studies.defaults.axle_forces import FitDrive
from studies.defaults.physics_fit import fit_physics
from studies.pages import options
from studies.self_calibration import Simulated, calibrate, simulate, taken

SEED, CARS = 79_000, 8
PAIRS = tuple(product((1.0, 0.7, 0.5, 0.35), (1.0, 2.0, 3.0)))
RESULT = Path(__file__).parent / "results" / "smoothing.json"
#: Ratio from which on a drive counts as one that smoothing has made worse.
WORSE = 1.05
#: Manoeuvre, km/h, seconds (None: its own). The first of each kind is identified on where it is one of ``FIT_ON``.
DRIVEN = (
    ("sine-sweep-wide", 90.0, None),
    ("road", 100.0, 120.0),
    ("dlc", 100.0, None),
    ("sine-with-dwell", 80.0, None),
    ("road", 80.0, 90.0),
    ("sine-sweep-wide", 70.0, None),
)
FIT_ON = ("sine-sweep-wide", "road")
#: With so little driving the parts are not chosen: those that a bare car cannot do without, and none that adapts.
PARTS = PhysicsParts(lag=True, load_transfer=True, braking=True, roll=True, biases=True)
FIT_ITERATIONS = 4


def identified(simulated: Simulated) -> Car:
    """Return the car as it is identified on a drive, from a file with the root of its factors wrong."""
    file = simulated.file.with_stiffness(*np.sqrt(simulated.factors))
    drive = simulated.drive
    assert drive.truth is not None
    drives = [FitDrive(drive.name, drive.signals, drive.truth)]
    fitted = fit_physics(drives, file, PARTS, starts=({},), iterations=FIT_ITERATIONS)
    physics = FittedPhysics(values=FittedValues.of(fitted.vehicle), noise=fitted.noise)
    return replace(Car.of(file), fitted_physics=physics).with_noise(PHYSICS, fitted.noise)


def fit_drives(drives: Sequence[Simulated]) -> list[Simulated]:
    """Return the drives that a car is identified on."""
    return [
        next(d for d in drives if d.manoeuvre == kind) for kind in FIT_ON if any(d.manoeuvre == kind for d in drives)
    ]


def cases(of_car: list[Simulated]) -> Iterator[tuple[str, Car, Simulated]]:
    """Yield how the car of some drives was taught, the car, and a drive that it is smoothed on."""
    for simulated in of_car:
        file = simulated.file.with_stiffness(*simulated.factors)
        calibration = calibrate(simulated.drive.signals, file)
        if not calibration.refused:
            yield "self-calibrated", taken(simulated.drive.signals, file, calibration).calibrated_car, simulated
    fits = fit_drives(of_car)
    for fit in fits:
        car = identified(fit)
        yield from (("identified", car, simulated) for simulated in of_car if simulated not in fits)


def ratios(car: Car, simulated: Simulated) -> list[float]:
    """Return the smoothed RMSE over the filter's by pair of factors."""
    physics = of_car(car)

    def rmse(estimator: Estimator) -> float:
        return root_mean_square(simulated.error(run_window(estimator, simulated.drive.signals)[0]))

    filtered = rmse(AdaptivePhysics(physics))
    return [rmse(SmoothedPhysics(AdaptivePhysics(for_smoothing(physics, p)))) / filtered for p in PAIRS]


def main() -> None:
    """Try all pairs on all cases, print what comes of each, write the result."""
    options("defaults.tune_smoothing", __doc__).parse_args()
    drives = simulate(CARS, SEED, DRIVEN)
    ratios_by_kind: dict[str, list[list[float]]] = {}
    for car in range(CARS):
        for taught, of, simulated in cases([d for d in drives if d.car == car]):
            ratios_by_kind.setdefault(taught, []).append(ratios(of, simulated))
    rows = []
    for i, (vy, rate) in enumerate(PAIRS):
        means = {taught: float(np.exp(np.mean(np.log(some), axis=0)[i])) for taught, some in ratios_by_kind.items()}
        worse = {
            f"{taught}_worse": float(np.mean(np.array(some)[:, i] > WORSE)) for taught, some in ratios_by_kind.items()
        }
        both = float(np.sqrt(np.prod(list(means.values()))))
        figures = {k: round(v, 4) for k, v in {"both": both, **means, **worse}.items()}
        rows.append({"vy_factor": vy, "yaw_rate_factor": rate, **figures})
        print(rows[-1])
    best = min(rows, key=lambda row: row["both"])
    print(f"chosen: {best}")
    document = {
        "made_by": "python -m studies.defaults.tune_smoothing",
        "criterion": "geometric mean over drives of the smoothed sideslip RMSE over the filter's, both kinds alike",
        "seed": SEED,
        "drives": {taught: len(some) for taught, some in ratios_by_kind.items()},
        "chosen": best,
        "grid": rows,
    }
    write_bytes(RESULT, (json.dumps(document, indent=2) + "\n").encode())


if __name__ == "__main__":
    main()
