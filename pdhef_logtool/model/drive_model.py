"""The model of a drive: reading of its log, sensors and car, without ground truth.

See docs/method.md#self-calibration.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pdhef_logtool.car.car import Car, WithoutTruth
from pdhef_logtool.car.model import CarModel, TaughtParameter
from pdhef_logtool.car.parts import physics_sha256
from pdhef_logtool.drive.model_file import Sensors
from pdhef_logtool.drive.options import AUTO
from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.estimators.drive_signals import DriveSignals, calibrated_signals
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals
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
    sensors : clocks, delays and alignment. car : the car with the vehicle of the posterior.
    friction : its source, for the report.
    posterior : of the car's parameters; None: the vehicle file is used unchanged.
    """

    reading: Mapping
    sensors: Sensors
    car: Car
    friction: str
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
        return cls.of(drive, posterior)

    @classmethod
    def of(cls, drive: Drive, posterior: SelfCalibration | None = None) -> DriveModel:
        """Return the model of a drive with a posterior of its car."""
        car, friction = drive.car, drive.friction.label
        if posterior is not None and not posterior.refused:
            car = replace(car, self_calibrated=_without_truth(drive, posterior))
        elif posterior is not None and posterior.sliding_friction is not None and drive.friction.assumed:
            car = replace(car, self_calibrated=_sliding(posterior, posterior.sliding_friction))
            friction = f"largest lateral acceleration, {posterior.sliding_friction:.2f}"
        return cls(drive.mapping, drive.plan.sensors, car, friction, posterior)

    def apply(self, signals: Signals) -> DriveSignals:
        """Return the signals [N] of the drive, corrected for the vehicle file and for the vehicle of the posterior."""
        return DriveSignals.of(signals, self.car)

    def calibrated(self, signals: Signals) -> CalibratedSignals:
        """Return the signals [N] of the drive, corrected for the vehicle of the posterior."""
        posterior = self.posterior
        delay_s = 0.0 if posterior is None or posterior.refused else posterior.steer_delay_s
        vehicle = self.car.calibrated_car.physics_vehicle
        return CalibratedSignals(calibrated_signals(signals, self.car), vehicle, delay_s)

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

    return driving_of(drive.whole().signals, drive.car.vehicle)


def _sliding(posterior: SelfCalibration, friction: float) -> WithoutTruth:
    """Return the vehicle file with the friction that a sliding car reaches, where nothing else gives a friction."""
    vehicle = posterior.vehicle_file.model_copy(update={"friction": friction})
    note = f"not causal: friction {friction:.2f} from the largest lateral acceleration of the log, as the car slides"
    return WithoutTruth(vehicle, posterior.noise, note=note, error_scale=posterior.error_scale)


def _without_truth(drive: Drive, posterior: SelfCalibration) -> WithoutTruth:
    """Return the vehicle of a posterior for the estimators."""
    causal = not posterior.parameters
    note = "not causal: car calibrated on the whole log, without ground truth"
    return WithoutTruth(
        posterior.vehicle,
        posterior.noise,
        note=_text(posterior, drive.car) if causal else note,
        varied=posterior.varied,
        causal=causal,
        error_scale=max(posterior.error_scale, _EARLIER_ERROR_SCALE if causal else 0.0),
    )
