"""Simulated cars with wrong vehicle files, calibrated on their own drives, for the studies that choose settings."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.car.car import Car, WithoutTruth
from pdhef_logtool.car.toml_files import load_vehicle
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.reading import WholeDrive
from pdhef_logtool.estimators.calibration.calibration import SelfCalibration, self_calibrate
from pdhef_logtool.estimators.calibration.driving import driving_of
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.records.errors import SimulationError
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.self_calibrating import driven_d2
from studies.condition_drives import SIDESLIP, as_logged
from studies.drawn_cars import BASE, KINDS, draw_car
from truthsim.batch import sensor_noise
from truthsim.drive import Drive, simulate_drive
from truthsim.sensors import SensorNoise
from truthsim.vehicle_choice import choose_vehicle

#: Manoeuvre, km/h, seconds (None: its own).
DRIVEN: tuple[tuple[str, float, float | None], ...] = (("sine-sweep-wide", 90.0, None), ("road", 100.0, 240.0))
FRICTIONS = (0.85, 1.0)
WRONG = (0.5, 2.0)


@dataclass(frozen=True, slots=True, eq=False)
class Simulated:
    """A drive of a simulated car with its right file."""

    car: int
    manoeuvre: str
    drive: WholeDrive
    file: VehicleParameters
    factors: tuple[float, float]

    def error(self, track: StateTrack) -> FloatArray:
        """Return the sideslip error [N] of an estimate in rad, NaN where it is not scored."""
        assert self.drive.truth is not None
        return signal_error(track, self.drive.truth, SIDESLIP, self.file.low_speed_blend_m_s)


def simulate(cars: int, seed: int, driven: Sequence[tuple[str, float, float | None]] = DRIVEN) -> list[Simulated]:
    """Return the drives of the cars; one that cannot be driven is left out, with a message."""
    return [simulated for simulated, _, _ in simulated_drives(cars, seed, driven)]


def simulated_drives(
    cars: int, seed: int, driven: Sequence[tuple[str, float, float | None]], **sensors: float
) -> Iterator[tuple[Simulated, Drive, SensorNoise]]:
    """Yield what :func:`simulate` returns, with the drive as it is simulated and its sensors; ``sensors`` are given."""
    for index in range(cars):
        rng = np.random.default_rng([seed, index])
        car = draw_car(rng, load_vehicle(BASE), (*KINDS, "hatchback"))
        front, rear = np.exp(rng.uniform(np.log(WRONG[0]), np.log(WRONG[1]), 2))
        friction = float(rng.choice(FRICTIONS))
        file = car.vehicle.model_copy(update={"friction": friction})
        for manoeuvre, speed, duration_s in driven:
            noise = sensor_noise(dict(car.sensors) | sensors)
            try:
                drive = simulate_drive(
                    manoeuvre,
                    speed_km_h=speed,
                    friction=friction,
                    seed=int(rng.integers(2**31)),
                    duration_s=duration_s,
                    vehicle=choose_vehicle(car.text),
                    vehicle_name=car.text,
                    noise=noise,
                )
            except SimulationError as error:
                say(f"car {index}, {manoeuvre} is left out: {error}")
                continue
            logged = as_logged(drive, Car.of(file))
            yield Simulated(index, manoeuvre, logged, file, (float(front), float(rear))), drive, noise


def calibrate(signals: Signals, file: VehicleParameters) -> SelfCalibration:
    """Calibrate a car on the signals of a log, read with its file."""
    return self_calibrate([driving_of(signals, file)], file)


def taken(signals: Signals, file: VehicleParameters, calibration: SelfCalibration) -> Car:
    """Return a car as a run of a log has it after a calibration, which may have been refused."""
    if calibration.refused:
        return Car.of(file)
    calibrated = WithoutTruth(
        calibration.vehicle, calibration.noise, told_friction=True, note="", error_scale=calibration.error_scale
    )
    car = replace(Car.of(file), self_calibrated=calibrated)
    driven = driven_d2(signals, car, calibration)
    return replace(car, self_calibrated=replace(calibrated, varied=calibration.varied, driven_d2_m_s=driven))


def say(text: str) -> None:
    """Print progress to standard error."""
    print(text, file=sys.stderr)
