"""Identified cars on driving that took no part, 95 % confidence intervals.

Each car is identified on a wide sine sweep and, as another car, on a road, from a
vehicle file whose stiffness is wrong; each is then judged on drives of its own: of that kind with another speed and
seed, and of other kinds. ``studies.calibration`` writes the page.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import PHYSICS, FittedPhysics, FittedValues
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.evaluation.metrics import NORMAL_95
from pdhef_logtool.learning.car.fit_data import FitDrive
from pdhef_logtool.learning.car.physics_fit import fit_physics, varied_vehicles
from pdhef_logtool.learning.car.smoothing_fit import fit_smoothing
from pdhef_logtool.runs.estimating import calibrator
from studies.condition_drives import root_mean_square
from studies.many_cars import FIT_ITERATIONS, PARTS
from studies.pages import number, table
from studies.self_calibration import COVERAGE_HEAD, Simulated, coverage_cells, say, simulate

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


@dataclass(frozen=True, slots=True)
class Judged:
    """An interval on a drive: what the car was identified on, what is driven, RMSE in rad, and two intervals.

    ``own``, ``band`` : of the filter alone, and with the posterior: share of the errors inside, and the whole mean
    width over the RMSE.
    """

    fit: str
    driven: str
    rmse: float
    own: tuple[float, float]
    band: tuple[float, float]


def identified(simulated: Simulated) -> Car:
    """Return the car as the tool identifies ``physics`` on a drive, from a file with the root of its factors wrong."""
    file = simulated.file.with_stiffness(*np.sqrt(simulated.factors))
    drive = simulated.drive
    assert drive.truth is not None
    fit = [FitDrive(drive.name, drive.signals, drive.truth, independent_yaw_rate=True, log_start_ns=drive.log_start_ns)]
    fitted = fit_physics(fit, file, PARTS, starts=({},), iterations=FIT_ITERATIONS)

    def values(vehicle: VehicleParameters) -> FittedValues:
        return FittedValues.between(fitted.vehicle, vehicle)

    varied = tuple(map(values, varied_vehicles(fit, file, fitted)))
    smoothing = fit_smoothing(fit, file, fitted)
    physics = FittedPhysics(
        values=FittedValues.of(fitted.vehicle), noise=fitted.noise, smoothing=smoothing, varied=varied
    )
    return replace(Car.of(file), fitted_physics=physics).with_noise(PHYSICS, fitted.noise)


def judged(car: Car, fit: Simulated, simulated: Simulated) -> Judged:
    """Evaluate the interval of a car on a drive."""
    estimator, signals = make_estimator(PHYSICS, car), simulated.drive.signals
    plain, _ = run_window(estimator, signals)
    wide = calibrator(car, [estimator]).add(plain, signals)
    error = simulated.error(plain)
    finite = np.isfinite(error) & np.isfinite(plain.sideslip_std_rad)
    error, rmse = np.abs(error[finite]), root_mean_square(error[finite])

    def stands(std: np.ndarray) -> tuple[float, float]:
        half = NORMAL_95 * std[finite]
        return float(np.mean(error <= half)), float(2.0 * np.mean(half) / rmse)

    of_filter, band = stands(plain.sideslip_std_rad), stands(wide.sideslip_std_rad)
    return Judged(fit.manoeuvre, simulated.manoeuvre, rmse, of_filter, band)


def judge(cars: int, seed: int) -> list[Judged]:
    """Simulate, identify and judge."""
    results: list[Judged] = []
    drives = simulate(cars, seed, DRIVEN)
    for index in sorted({d.car for d in drives}):
        of_car = [d for d in drives if d.car == index]
        for kind in FIT_ON:
            fit = next((d for d in of_car if d.manoeuvre == kind), None)
            if fit is None:
                continue
            car = identified(fit)
            results += [judged(car, fit, d) for d in of_car if d is not fit and d not in fit_drives(of_car)]
            say(f"car {index}, identified on {kind}")
    return results


def fit_drives(drives: Sequence[Simulated]) -> list[Simulated]:
    """Return the drives that some car was identified on: they judge none."""
    return [
        next(d for d in drives if d.manoeuvre == kind) for kind in FIT_ON if any(d.manoeuvre == kind for d in drives)
    ]


def _groups(results: Sequence[Judged]) -> dict[str, list[Judged]]:
    """Return driving like that of the identification, and other driving."""
    return {
        "of the kind that it was identified on": [j for j in results if j.fit == j.driven],
        "of other kinds": [j for j in results if j.fit != j.driven],
        "all": list(results),
    }


def bands_table(results: Sequence[Judged]) -> str:
    """Return shares and widths, driving like that of the identification apart."""
    body = []
    for name, some in _groups(results).items():
        for which, pairs in (("its own", [j.own for j in some]), ("with the posterior", [j.band for j in some])):
            shares, width = coverage_cells(pairs)
            rmse = number(float(np.degrees(np.median([j.rmse for j in some]))))
            body.append([name, str(len(some)), rmse, which, *shares, width])
    return table(["driving", "drives", "RMSE, deg: median", "interval", *COVERAGE_HEAD], body, right_from=4)
