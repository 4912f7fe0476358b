"""The model of a drive: the one record of the knowledge about its recording and its car, without ground truth.

See docs/method.md#self-calibration.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.model import CarModel, TaughtParameter
from pdhef_logtool.car.parts import physics_sha256
from pdhef_logtool.car.posterior import Posterior
from pdhef_logtool.drive.friction import FrictionFrom, FrictionSource
from pdhef_logtool.drive.options import AUTO
from pdhef_logtool.drive.plan import Sensors
from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.estimators.drive_signals import DriveSignals, calibrated_signals
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.model.priors import CARRIED, STEER_DELAY, prior_posterior
from pdhef_logtool.records.signals import Signals

if TYPE_CHECKING:
    from pdhef_logtool.model.driving import Driving

_NEEDS = ("steer_rad", "yaw_rate_rad_s", "speed_m_s")


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
    friction: FrictionSource
    posterior: Posterior | None = None

    @classmethod
    def fit(cls, drive: Drive) -> "DriveModel":
        """Return the model of a drive by its option ``model``; no ground truth is used.

        ``auto`` fits the car to the drive. With a model file the car has the parameters of earlier drives, with ``off``
        the prior means about its vehicle file; both are independent of this drive.
        """
        # Compiled code is imported on demand.
        from pdhef_logtool.estimators.vehicle_ukf import of_car
        from pdhef_logtool.model.fit import fit_car
        from pdhef_logtool.model.measured_noise import measured_noise

        car, earlier = drive.car, drive.car.taught_prior
        # A validated car is not calibrated; the paper's suite has no speed for it.
        if car.has_evidence or not drive.options.use_speed:
            return cls.of(drive)
        if drive.options.model != AUTO or lacking(drive):
            return cls.of(drive, prior_posterior(car.vehicle, earlier))
        posterior = fit_car(read_driving(drive), car.vehicle, earlier)
        model = cls.of(drive, posterior)
        if model.car.self_calibrated is None:
            return model
        physics = of_car(model.car.calibrated_car)
        r_std = measured_noise(model.calibrated(drive.whole().signals), physics)
        return cls.of(drive, replace(posterior, r_std=r_std)) if r_std else model

    @classmethod
    def of(cls, drive: Drive, posterior: Posterior | None = None) -> "DriveModel":
        """Return the model of a drive with a posterior of its car."""
        car, friction = drive.car, drive.friction
        reached = None if posterior is None else posterior.reached_friction
        if posterior is not None and (not posterior.refused or (reached is not None and not friction.is_given)):
            car = replace(car, self_calibrated=posterior)
            if reached is not None:
                friction = FrictionSource(FrictionFrom.REACHED, reached)
        return cls(drive.mapping, drive.plan.sensors, car, friction, posterior)

    def apply(self, signals: Signals) -> DriveSignals:
        """Return the signals [N] of the drive, corrected for the vehicle file and for the vehicle of the posterior."""
        return DriveSignals.of(signals, self.car)

    def calibrated(self, signals: Signals) -> CalibratedSignals:
        """Return the signals [N] of the drive, corrected for the vehicle of the posterior."""
        posterior = self.posterior
        fitted = () if posterior is None or posterior.refused else posterior.parameters
        delay_s = next((p.value for p in fitted if p.name == STEER_DELAY), 0.0)
        vehicle = self.car.calibrated_car.physics_vehicle
        return CalibratedSignals(calibrated_signals(signals, self.car), vehicle, delay_s)

    @property
    def file(self) -> CarModel:
        """The content of model.toml: sensors and parameters for later drives of this car and recorder."""
        posterior, parameters = self.posterior, self.car.taught_prior
        if posterior is not None and posterior.parameters and not posterior.refused:
            parameters = for_later_drives(posterior)
        return model_of(self.car, self.sensors, parameters=parameters)


def model_of(car: Car, sensors: Sensors, **entries: Any) -> CarModel:
    """Return the model of drives of a car with the sensors of one of them."""
    from pydantic import TypeAdapter

    plain = TypeAdapter(Sensors).dump_python(sensors, mode="json", exclude_none=True)
    file, size = car.vehicle, None if car.source else car.vehicle.wheelbase_m
    return CarModel(vehicle=file.name, physics_sha256=physics_sha256(file), sensors=plain, wheelbase_m=size, **entries)


def for_later_drives(posterior: Posterior, names: Collection[str] = CARRIED) -> tuple[TaughtParameter, ...]:
    """Return the parameters of a drive that other drives of the car share."""
    level = float(f"{posterior.level_m_s2:.4g}")
    return tuple(
        TaughtParameter(name=p.name, value=float(f"{p.value:.9g}"), std=float(f"{p.sd:.6g}"), ay_m_s2=level)
        for p in posterior.parameters
        if p.name in names
    )


def lacking(drive: Drive) -> list[str]:
    """Return the missing signals that a calibration needs."""
    return [name for name in _NEEDS if name not in drive.available]


def read_driving(drive: Drive) -> "Driving":
    """Return the driving of a drive for the calibration; its ground truth is not used.

    Raises EstimatorError without a stamp.
    """
    from pdhef_logtool.model.driving import driving_of

    return driving_of(drive.whole().signals, drive.car.vehicle)
