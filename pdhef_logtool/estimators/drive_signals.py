"""Signals of a drive, corrected once for each vehicle of its car: all estimators receive one of two read-only tables.

A car has a vehicle file, and a vehicle that the log calibrated or that drives with ground truth identified. The two
differ in steering ratio and offset, biases, and gain of the gyro.
"""

from __future__ import annotations

from dataclasses import dataclass

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.vehicle import corrected_anew
from pdhef_logtool.estimators.divergence import AS_STATED
from pdhef_logtool.estimators.presets import uses_calibration
from pdhef_logtool.records.signals import Signals


@dataclass(frozen=True, slots=True, eq=False)
class DriveSignals:
    """Signals [N] as the vehicle file corrects them, and as the calibrated or identified vehicle corrects them.

    ``noise`` : of the measurements that the drive shows, where it is larger than in the vehicle file.
    """

    file: Signals
    calibrated: Signals
    noise: FilterNoise = AS_STATED

    @classmethod
    def of(cls, signals: Signals, car: Car) -> DriveSignals:
        """Return the read-only tables of signals [N] that were read with the vehicle file of a car."""
        posterior = car.self_calibrated
        noise = AS_STATED if posterior is None else FilterNoise(r_std=dict(posterior.r_std))
        return cls(signals.read_only(), calibrated_signals(signals, car).read_only(), noise)

    def of_estimator(self, name: str) -> Signals:
        """Return the table for the vehicle that an estimator uses."""
        return self.calibrated if uses_calibration(name) else self.file


def calibrated_signals(signals: Signals, car: Car) -> Signals:
    """Return signals [N] that were read with a car's file as its calibrated or identified vehicle corrects them."""
    return corrected_anew(signals, car.vehicle, car.calibrated_car.physics_vehicle)
