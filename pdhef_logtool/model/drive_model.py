"""The model of a drive: reading of its log, sensors and car, without ground truth.

See docs/method.md#self-calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pdhef_logtool.car.car import Car, WithoutTruth
from pdhef_logtool.car.model import CarModel, TaughtParameter
from pdhef_logtool.car.parts import physics_sha256
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.drive.model_file import Sensors
from pdhef_logtool.drive.options import AUTO
from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.estimators.drive_signals import DriveSignals
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.evaluation.metrics.metric import SensorErrors
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.records.signals import Signals

if TYPE_CHECKING:
    from pdhef_logtool.estimators.calibration.calibration import SelfCalibration
    from pdhef_logtool.estimators.calibration.driving import Driving

_NEEDS = ("steer_rad", "yaw_rate_rad_s", "speed_m_s")
#: Smallest error scale of parameters from earlier drives: later driving may fit less.
_EARLIER_ERROR_SCALE = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class DriveModel:
    """All decisions about a drive. Estimators, metrics and outputs take signals and vehicles from it.

    Attributes
    ----------
    reading : field, unit, sign and axes of every signal.
    sensors : clocks, delays and alignment. errors : biases, gain and position of the IMU.
    car : the car with the vehicle of the posterior.
    posterior : of the car's parameters; None: the vehicle file is used unchanged.
    """

    reading: Mapping
    sensors: Sensors
    errors: SensorErrors
    car: Car
    posterior: SelfCalibration | None = None

    @classmethod
    def fit(cls, drive: Drive) -> DriveModel:
        """Return the model of a drive as its options ask for it; no ground truth is used.

        ``auto`` fits the car to the drive. With a model file the car has the parameters of earlier drives, with ``off``
        the prior means about its vehicle file; both are independent of this drive.
        """
        from pdhef_logtool.estimators.calibration.calibration import prior_calibration, self_calibrate

        car, taught = drive.car, drive.car.taught_prior
        # A validated car is not calibrated; the paper's suite has no speed for it.
        if car.has_evidence or not drive.options.use_speed:
            return cls.of(drive)
        if drive.options.model != AUTO or lacking(drive):
            return cls.of(drive, prior_calibration(car.vehicle, taught))
        posterior = self_calibrate([read_driving(drive)], car.vehicle, taught=taught)
        return cls.of(drive, posterior if posterior.refused else _with_consistency(drive, posterior))

    @classmethod
    def of(cls, drive: Drive, posterior: SelfCalibration | None = None) -> DriveModel:
        """Return the model of a drive with a posterior of its car."""
        car = drive.car
        if posterior is not None and not posterior.refused:
            car = replace(car, self_calibrated=_without_truth(drive, posterior))
        return cls(drive.mapping, drive.plan.sensors, _errors(drive, posterior), car, posterior)

    def apply(self, signals: Signals) -> DriveSignals:
        """Return the signals [N] of the drive, corrected for the vehicle file and for the vehicle of the posterior."""
        return DriveSignals.of(signals, self.car)

    @property
    def file(self) -> CarModel:
        """The content of model.toml: sensors and parameters for later drives of this car and recorder."""
        posterior, parameters = self.posterior, self.car.taught_prior
        if posterior is not None and posterior.parameters and not posterior.refused:
            parameters = for_later_drives(posterior)
        return model_of(self.car, self.sensors, parameters=parameters)

    @property
    def document(self) -> dict[str, Any] | None:
        """The entry ``self_calibration`` of report.json."""
        if self.posterior is None:
            return None
        return self.posterior.to_dict() | {"text": _text(self.posterior, self.car)}


def model_of(car: Car, sensors: Sensors, **entries: Any) -> CarModel:
    """Return the model of drives of a car with the sensors of one of them."""
    from pydantic import TypeAdapter

    plain = TypeAdapter(Sensors).dump_python(sensors, mode="json", exclude_none=True)
    file = car.datasheet
    return CarModel(vehicle=file.name, physics_sha256=physics_sha256(file), sensors=plain, **entries)


def for_later_drives(posterior: SelfCalibration) -> tuple[TaughtParameter, ...]:
    """Return a posterior without ground truth as the prior of another drive; peak force and steering ratio differ."""
    from pdhef_logtool.estimators.calibration.calibration import as_prior
    from pdhef_logtool.estimators.calibration.joint import PEAK, STEER_RATIO

    return as_prior([p for p in posterior.parameters if p.name not in (PEAK, STEER_RATIO)])


def _text(posterior: SelfCalibration, car: Car) -> str:
    """Return a posterior in one line."""
    if posterior.parameters or posterior.refused or not car.taught_prior:
        return posterior.text
    return "parameters of the car from earlier drives"


def lacking(drive: Drive) -> list[str]:
    """Return the missing signals that a calibration needs."""
    return [name for name in _NEEDS if name not in drive.available]


def read_driving(drive: Drive) -> Driving:
    """Return the driving of a drive that can be calibrated on; its ground truth is not looked at.

    Raises EstimatorError without a stamp.
    """
    from pdhef_logtool.estimators.calibration.driving import driving_of

    return driving_of(drive.friction.known(drive.whole(fill_friction=False).signals), drive.car.vehicle)


def file_errors(vehicle: VehicleParameters) -> SensorErrors:
    """Return the sensor errors of signals that were read with a vehicle file: only those that its entries describe."""
    gain = 1.0 + GRAVITY_M_S2 * vehicle.roll_gradient_rad_per_m_s2
    return SensorErrors(ay_gain=gain, lever_m=vehicle.imu_position_m[0], vehicle=vehicle)


def _with_consistency(drive: Drive, posterior: SelfCalibration) -> SelfCalibration:
    """Return a posterior with the part of ``d2`` of ``physics`` on it that correlates with the driving."""
    from pdhef_logtool.evaluation.metrics.lateral_consistency import driven_consistency, driving_products

    signals, model = drive.whole().signals, DriveModel.of(drive, posterior)
    track = run_estimator(make_estimator("physics", model.car), model.apply(signals).calibrated)
    slow = model.car.vehicle.low_speed_blend_m_s
    products = driving_products(track, signals, low_speed_m_s=slow, sensors=model.errors)
    return replace(posterior, driven_d2_m_s=driven_consistency(*products))


def _without_truth(drive: Drive, posterior: SelfCalibration) -> WithoutTruth:
    """Return the vehicle of a posterior for the estimators."""
    causal = not posterior.parameters
    note = "not causal: car calibrated on the whole log, without ground truth"
    return WithoutTruth(
        posterior.vehicle,
        posterior.noise,
        told_friction=drive.friction.bank is None,
        note=_text(posterior, drive.car) if causal else note,
        varied=posterior.varied,
        driven_d2_m_s=posterior.driven_d2_m_s,
        cg_std_m=drive.car.cg_std_m,
        causal=causal,
        error_scale=max(posterior.error_scale, _EARLIER_ERROR_SCALE if causal else 0.0),
    )


def _errors(drive: Drive, posterior: SelfCalibration | None) -> SensorErrors:
    """Return the sensor errors of a drive; a posterior with refused tyres is still valid for sensors."""
    from pdhef_logtool.estimators.calibration.joint import STEER_DELAY

    vehicle = drive.car.vehicle
    if posterior is None:
        return file_errors(vehicle)
    fitted, values = posterior.vehicle, {p.name: p.value for p in posterior.parameters}
    return replace(
        file_errors(fitted),
        ay_bias_m_s2=fitted.sensors.ay_bias_m_s2 - vehicle.sensors.ay_bias_m_s2,
        yaw_rate_bias_rad_s=fitted.sensors.yaw_rate_bias_rad_s - vehicle.sensors.yaw_rate_bias_rad_s,
        vehicle=vehicle if posterior.refused else fitted,
        read_with=vehicle,
        steer_delay_s=0.0 if posterior.refused else values.get(STEER_DELAY, 0.0),
        friction=None if drive.friction.bank is None else fitted.assumed_friction,
    )
