"""The car of a drive as fitted to the sensors of the drive, without ground truth."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from pdhef_logtool.car.parts import LIMIT_GAIN, FilterNoise
from pdhef_logtool.car.vehicle import VehicleParameters

#: Standard deviation of a_y in ``physics`` on a calibrated car, m/s²: model error, larger than the sensor's noise.
AY_STD = 1.0
#: Process noise of ``physics`` on a calibrated car: PHYSICS_Q_STD with more for the axle forces, so that kinematics
#: have more influence beyond the linear range, where the fitted tyres are least certain.
Q_STD = (0.085, 0.12, 0.012, 0.086, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class FittedParameter:
    """One parameter: value, prior mean, posterior and prior 1-sigma, in its logarithm where ``log``."""

    name: str
    unit: str
    value: float
    prior: float
    sd: float
    prior_sd: float
    log: bool

    @property
    def excited(self) -> bool:
        """Whether its standard deviation is below half the prior's."""
        return self.sd < 0.5 * self.prior_sd

    @property
    def text(self) -> str:
        """Name, value and 1-sigma."""
        sd = f"± {self.sd:.0%}" if self.log else f"± {self.sd:.2g}"
        return f"{self.name} {self.value:.4g} {self.unit} {sd}"


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """The car of a drive. Without parameters it is the prior, which is independent of the drive.

    Attributes
    ----------
    vehicle : for the estimators. parameters : of the fit to the drive.
    refused : why the fit is not used; empty if it is.
    varied : vehicles one 1-sigma away, one per direction with a large effect on the sideslip.
    error_scale : RMS error of the fit over the assumed one.
    from_earlier : whether earlier drives determine the prior.
    reached_friction : friction of ``vehicle`` if the fit is rejected because the car slides; None otherwise.
    seconds : used driving. level_m_s2 : its lateral acceleration; 0 if unknown.
    r_std : larger measurement noise that the drive shows, by measurement.
    """

    vehicle: VehicleParameters
    parameters: tuple[FittedParameter, ...] = ()
    refused: str = ""
    varied: tuple[VehicleParameters, ...] = ()
    error_scale: float = 1.0
    from_earlier: bool = False
    reached_friction: float | None = None
    seconds: float = 0.0
    level_m_s2: float = 0.0
    r_std: Mapping[str, float] = field(default_factory=dict)

    @property
    def causal(self) -> bool:
        """Whether ``vehicle`` depends on no sample of the drive."""
        return not self.parameters

    @property
    def noise(self) -> FilterNoise:
        """Noise of the estimator ``physics`` for the calibrated vehicle."""
        ay_std = max(AY_STD, self.vehicle.sensors.ay_std_m_s2)
        return FilterNoise(q_std=Q_STD, r_std={"ay_m_s2": ay_std, **self.r_std}, limit_gain=LIMIT_GAIN)

    @property
    def text(self) -> str:
        """Summary in one line."""
        if self.refused:
            return f"not calibrated, the vehicle file is used: {self.refused}"
        if not self.parameters:
            prior = "parameters of the car from earlier drives"
            return prior if self.from_earlier else "not calibrated: all parameters keep their prior"
        excited, idle = ([p for p in self.parameters if p.excited is is_excited] for is_excited in (True, False))
        shown = ", ".join(p.text for p in excited) or "no parameter is excited"
        rest = f"; not excited: {', '.join(p.name for p in idle)}" if idle and excited else ""
        noise = ", ".join(f"{name} {value:.2g}" for name, value in self.r_std.items())
        noisy = f"; noise of the measurements as in the log: {noise}" if noise else ""
        return f"calibrated without ground truth on {self.seconds:.0f} s: {shown}{rest}{noisy}"

    @property
    def note(self) -> str:
        """A warning for readers of the estimates."""
        if self.reached_friction is not None:
            reached = f"friction {self.reached_friction:.2f} from the largest lateral acceleration of the log"
            return f"not causal: {reached}, as the car slides"
        return self.text if self.causal else "not causal: car calibrated on the whole log, without ground truth"

    def to_dict(self) -> dict[str, Any]:
        """Return the entry ``self_calibration`` of report.json."""
        return {
            "refused": self.refused or None,
            "text": self.text,
            "parameters": [{k: getattr(p, k) for k in ("name", "unit", "value", "sd", "log")} for p in self.parameters],
        }
