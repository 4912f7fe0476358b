"""The first pass over a log, in which it calibrates its car without truth, and what comes of it.

See docs/method.md#self-calibration.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.car.car import Car, WithoutTruth
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.drive.cached import read_cached
from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.presets import preset_of
from pdhef_logtool.estimators.self_calibrated import OPEN_LOOP, SELF_CALIBRATED
from pdhef_logtool.estimators.table import ALL_ESTIMATORS, make_estimator
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.records.errors import PdhefError
from pdhef_logtool.runs import selection
from pdhef_logtool.runs.config import RunConfig

if TYPE_CHECKING:
    from pdhef_logtool.estimators.calibration.calibration import SelfCalibration
    from pdhef_logtool.estimators.calibration.driving import Driving
    from pdhef_logtool.evaluation.metrics.metric import SensorErrors

#: Squares are summed window by window, over spans that no window cuts: another length would be another figure.
_WINDOW_S = 600.0
_NEEDS = ("steer_rad", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s")


def calibrate_drive(drive: Drive, config: RunConfig) -> SelfCalibration | None:
    """Return what a drive says of its car; None where nobody asks or the log lacks a sensor for it."""
    if config.calibrate == "off" or not _asked(config, drive.car) or lacking(drive):
        return None
    from pdhef_logtool.estimators.calibration.calibration import self_calibrate

    return self_calibrate([read_driving(drive)], drive.car.vehicle)


def calibrate_pool(
    inputs: Sequence[LogInput], car: Car, mapping: Mapping | None, config: RunConfig
) -> SelfCalibration | None:
    """Return what all logs of a run together say of its car; None where nobody asks. A log that fails is left out."""
    if not _asked(config, car):
        return None
    from pdhef_logtool.estimators.calibration.calibration import self_calibrate

    found = []
    for log_input in inputs:
        try:
            with read_cached(log_input, car, mapping, config.read_options) as drive:
                if not lacking(drive):
                    found.append(read_driving(drive))
        except PdhefError:
            continue  # the run itself says what is wrong with it
    return self_calibrate(found, car.vehicle)


def lacking(drive: Drive) -> list[str]:
    """Return the signals without which a drive calibrates nothing, those that it lacks."""
    return [name for name in _NEEDS if name not in drive.available]


def read_driving(drive: Drive) -> Driving:
    """Return the driving of a drive that can be calibrated on; its truth is not looked at."""
    from pdhef_logtool.estimators.calibration.driving import DrivingReader

    reader = DrivingReader(drive.car.vehicle)
    for window in drive.windows(fill_friction=_told(drive)):
        reader.add(window.signals)
    return reader.finish()


def checked(drive: Drive, calibration: SelfCalibration | None) -> SelfCalibration | None:
    """Return a calibration with its d2, refused where that of ``physics`` on it exceeds that on the file.

    The factor is that of the guard; on simulated drives with right and wrong files d2 never rose by more than 1 %.
    """
    if calibration is None or calibration.refused:
        return calibration
    from pdhef_logtool.estimators.physics_filter import of_car

    alone = self_calibrated(drive, replace(calibration, varied=()))  # d2 asks for no interval
    estimators = (of_car(drive.car), make_estimator("physics", alone))
    (file, _), (found, driven) = _d2_of(drive, estimators, log_sensors(drive.car.vehicle, calibration))
    calibration = replace(calibration, driven_d2_m_s=driven)
    if not found > selection.FACTOR * file:
        return calibration
    why = f"physics contradicts the sensors more on it than on the file, d2 is {found:.3g} against {file:.3g} m/s"
    return replace(calibration, refused=why)


def _d2_of(drive: Drive, estimators: Sequence[Estimator], sensors: SensorErrors) -> list[tuple[float, float]]:
    """Return d2 of estimators over a drive, and its part that goes with the driving, window by window, in m/s.

    The windows have a fixed length. NaN where it cannot be told.
    """
    from pdhef_logtool.evaluation.metrics import ALL, lateral_consistency

    slow = drive.car.vehicle.low_speed_blend_m_s
    carries: list[Any] = [None] * len(estimators)
    squares, counts = [0.0] * len(estimators), [0] * len(estimators)
    products, seconds = [np.zeros((4, 4)) for _ in estimators], [0.0] * len(estimators)
    for window in drive.windows(fill_friction=_told(drive), window_s=_WINDOW_S):
        signals = window.signals
        whole = {ALL: np.ones(len(signals), dtype=np.bool_)}
        for i, estimator in enumerate(estimators):
            track, carries[i] = run_window(estimator, signals, carries[i], None)
            for row in lateral_consistency.consistency_rows(
                [track], signals, whole, log="", low_speed_m_s=slow, sensors=sensors
            ):
                squares[i] += row.value**2 * row.n
                counts[i] += row.n
            more, lasted = lateral_consistency.driving_products(track, signals, low_speed_m_s=slow, sensors=sensors)
            products[i] += more
            seconds[i] += lasted
    whole_d2 = (math.sqrt(total / n) if n else math.nan for total, n in zip(squares, counts, strict=True))
    return list(zip(whole_d2, map(lateral_consistency.driven_consistency, products, seconds), strict=True))


def self_calibrated(drive: Drive, calibration: SelfCalibration | None) -> Car:
    """Return the car of a drive with what was found, unless it was refused."""
    if calibration is None or calibration.refused:
        return drive.car
    note = "not causal: its car was calibrated on the whole log, without truth"
    found = WithoutTruth(
        calibration.vehicle,
        calibration.noise,
        told_friction=_told(drive),
        note=note,
        varied=calibration.varied,
        driven_d2_m_s=calibration.driven_d2_m_s,
    )
    return replace(drive.car, self_calibrated=found)


def log_sensors(vehicle: VehicleParameters, calibration: SelfCalibration | None) -> SensorErrors:
    """Return what the sensors of a log have that was read with a vehicle: as calibrated on it, else as its file says.

    What is refused for its tyres is no worse for its sensors.
    """
    from pdhef_logtool.evaluation.metrics.metric import SensorErrors

    if calibration is None or not calibration.parameters:
        gain = 1.0 + GRAVITY_M_S2 * vehicle.roll_gradient_rad_per_m_s2
        return SensorErrors(ay_gain=gain, lever_m=vehicle.imu_position_m[0])
    found = {p.name: p.value for p in calibration.parameters}
    return SensorErrors(
        ay_bias_m_s2=found["a_y bias"] - vehicle.sensors.ay_bias_m_s2,
        yaw_rate_bias_rad_s=found["yaw rate bias"] - vehicle.sensors.yaw_rate_bias_rad_s,
        ay_gain=found["roll gain"],
        lever_m=found["lever of a_y"],
        superelevation=found["superelevation"],
    )


def _asked(config: RunConfig, car: Car) -> bool:
    """Whether an estimator of a run takes a calibration; the paper's suite has no speed to calibrate with."""
    names = config.estimators
    if car.has_evidence or config.sensors == "esp":
        return False
    return names is None or bool({ALL_ESTIMATORS, OPEN_LOOP, *SELF_CALIBRATED} & {*names, *map(preset_of, names)})


def _told(drive: Drive) -> bool:
    """Whether the friction of a drive is told, and no estimate with the file as it stands."""
    return drive.friction.bank is None
