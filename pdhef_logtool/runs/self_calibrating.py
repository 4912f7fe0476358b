"""The first pass over a log: calibration of its car without ground truth, and its results.

See docs/method.md#self-calibration.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from pdhef_logtool.car.car import Car, WithoutTruth
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.runs.config import RunConfig

if TYPE_CHECKING:
    from pdhef_logtool.estimators.calibration.calibration import SelfCalibration
    from pdhef_logtool.estimators.calibration.driving import Driving
    from pdhef_logtool.evaluation.metrics.metric import SensorErrors

_NEEDS = ("steer_rad", "yaw_rate_rad_s", "speed_m_s")


def calibrate_drive(drive: Drive, config: RunConfig) -> SelfCalibration | None:
    """Return the calibration of a car by a drive, its prior if a sensor is missing; None if not requested."""
    if config.calibrate == "off" or not _asked(config, drive.car):
        return None
    from pdhef_logtool.estimators.calibration.calibration import prior_calibration, self_calibrate

    if lacking(drive):
        return prior_calibration(drive.car.vehicle, drive.car.taught_prior)
    return self_calibrate([read_driving(drive)], drive.car.vehicle, taught=drive.car.taught_prior)


def lacking(drive: Drive) -> list[str]:
    """Return the missing signals that a calibration needs."""
    return [name for name in _NEEDS if name not in drive.available]


def read_driving(drive: Drive) -> Driving:
    """Return the driving of a drive that can be calibrated on; its ground truth is not looked at.

    Raises EstimatorError without a stamp.
    """
    from pdhef_logtool.estimators.calibration.driving import driving_of

    return driving_of(drive.friction.known(drive.whole(fill_friction=False).signals), drive.car.vehicle)


def checked(drive: Drive, calibration: SelfCalibration | None) -> SelfCalibration | None:
    """Return a calibration with the part of ``d2`` of ``physics`` on it that correlates with the driving."""
    if calibration is None or calibration.refused:
        return calibration
    from pdhef_logtool.evaluation.metrics.lateral_consistency import driven_consistency, driving_products

    signals, car = drive.whole().signals, self_calibrated(drive, calibration)
    track = run_estimator(make_estimator("physics", car), calibrated_signals(signals, car))
    slow, sensors = car.vehicle.low_speed_blend_m_s, log_sensors(car.vehicle, calibration)
    products = driving_products(track, signals, low_speed_m_s=slow, sensors=sensors)
    return replace(calibration, driven_d2_m_s=driven_consistency(*products))


def self_calibrated(drive: Drive, calibration: SelfCalibration | None) -> Car:
    """Return the car of a drive with the calibration, unless it was refused."""
    if calibration is None or calibration.refused:
        return drive.car
    causal = not calibration.parameters
    applied = WithoutTruth(
        calibration.vehicle,
        calibration.noise,
        told_friction=drive.friction.bank is None,
        note=calibration.text if causal else "not causal: car calibrated on the whole log, without ground truth",
        varied=calibration.varied,
        driven_d2_m_s=calibration.driven_d2_m_s,
        cg_std_m=drive.car.cg_std_m,
        causal=causal,
        error_scale=max(calibration.error_scale, 2.0 if causal else 0.0),  # later driving may fit less
    )
    return replace(drive.car, self_calibrated=applied)


def log_sensors(
    vehicle: VehicleParameters, calibration: SelfCalibration | None, *, told_friction: bool = True
) -> SensorErrors:
    """Return the sensor errors of a log that was read with a vehicle: as calibrated, else as in its file.

    A calibration with refused tyres is still valid for sensors. ``told_friction`` : whether the friction is known.
    """
    from pdhef_logtool.estimators.calibration.joint import AY_BIAS, AY_GAIN, IMU_X, RATE_BIAS, STEER_DELAY
    from pdhef_logtool.evaluation.metrics.metric import SensorErrors

    if calibration is None or not calibration.parameters:
        gain = 1.0 + GRAVITY_M_S2 * vehicle.roll_gradient_rad_per_m_s2
        return SensorErrors(ay_gain=gain, lever_m=vehicle.imu_position_m[0], vehicle=vehicle)
    fitted = {p.name: p.value for p in calibration.parameters}
    return SensorErrors(
        ay_bias_m_s2=fitted[AY_BIAS] - vehicle.sensors.ay_bias_m_s2,
        yaw_rate_bias_rad_s=fitted[RATE_BIAS] - vehicle.sensors.yaw_rate_bias_rad_s,
        ay_gain=fitted[AY_GAIN],
        lever_m=fitted[IMU_X],
        vehicle=vehicle if calibration.refused else calibration.vehicle,
        read_with=vehicle,
        steer_delay_s=0.0 if calibration.refused else fitted[STEER_DELAY],
        friction=None if told_friction else calibration.vehicle.assumed_friction,
    )


def _asked(config: RunConfig, car: Car) -> bool:
    """Whether the candidates of the selected estimate take a calibration; the paper's suite has no speed for it."""
    return not car.has_evidence and config.sensors != "esp"
