"""Signals of a drive, corrected once for each vehicle of its car: all estimators receive one of two read-only tables.

A car has a vehicle file, and a vehicle that the log calibrated or that drives with ground truth identified. The two
differ in steering ratio and offset, biases, and gain of the gyro. Without a friction of the log, the tyres of a vehicle
that the log or earlier drives determine have at least the friction that the lateral acceleration until then needed.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters, corrected_anew
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
    def of(cls, signals: Signals, car: Car) -> "DriveSignals":
        """Return the read-only tables of signals [N] that were read with the vehicle file of a car."""
        posterior = car.self_calibrated
        noise = AS_STATED if posterior is None else FilterNoise(r_std=dict(posterior.r_std))
        return cls(signals.read_only(), calibrated_signals(signals, car).read_only(), noise)

    def of_estimator(self, name: str) -> Signals:
        """Return the table for the vehicle that an estimator uses."""
        return self.calibrated if uses_calibration(name) else self.file


def calibrated_signals(signals: Signals, car: Car) -> Signals:
    """Return signals [N] that were read with a car's file as its calibrated or identified vehicle corrects them."""
    vehicle = car.calibrated_car.physics_vehicle
    corrected = corrected_anew(signals, car.vehicle, vehicle)
    return corrected if car.self_calibrated is None else with_reached_friction(corrected, vehicle)


def with_reached_friction(signals: Signals, vehicle: VehicleParameters) -> Signals:
    """Return signals [N] with the friction that a_y until each stamp needs, where it exceeds that of the vehicle.

    A friction of the log remains.
    """
    from pdhef_logtool.residual_model.low_pass import low_pass  # compiled

    ay, sustained_s = signals.ay_m_s2[:, None].copy(), 0.2  # above the times of tyre lag and roll, below a bend's
    steps_s = np.fmin(signals.steps_s, 0.5 * sustained_s)  # after a gap no single sample decides
    low_pass(ay, steps_s, 1.0 / (2.0 * math.pi * sustained_s), np.zeros(1), ay)
    most = vehicle.most_ay_m_s2(1.0) * (1.0 + GRAVITY_M_S2 * vehicle.roll_gradient_rad_per_m_s2)
    needed = np.fmax(np.fmax.accumulate(np.abs(ay[:, 0])) / most, vehicle.assumed_friction)
    return replace(signals, friction=np.where(np.isfinite(signals.friction), signals.friction, needed))
