"""Results of earlier drives for a car: ``model.toml``, for later drives of the same car and recorder.

Every run writes one of its drive; ``pdhef learn`` pools drives. In a car's folder it is the prior of every calibration;
``pdhef run --model FILE`` takes the sensors from it as well, so that no estimate depends on later samples.
"""

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from pdhef_logtool.car.parts import LearntOn, Sha256, physics_sha256
from pdhef_logtool.car.vehicle import Positive, Record, VehicleParameters
from pdhef_logtool.records.errors import VehicleError
from pdhef_logtool.residual_model.ladder import LadderModel
from pdhef_logtool.storage.documents import read_toml, validated
from pdhef_logtool.storage.toml_text import toml_text

#: Sources of the error that teaching uses.
GROUND_TRUTH, ESTIMATED = "ground truth", "estimated reference"


class TaughtParameter(Record):
    """A parameter of the car for a later drive: mean and standard deviation, of the logarithm where fitted as such.

    ``ay_m_s2`` : lateral acceleration of the drives; 0 if unknown.
    """

    name: str
    value: float
    std: Positive
    ay_m_s2: Annotated[float, Field(ge=0)] = 0.0


class CarModel(Record):
    """The content of a model.toml.

    Attributes
    ----------
    vehicle, physics_sha256 : name and digest of the vehicle file of the drives.
    parameters : of the car for later drives; empty without a calibration.
    residual : of the sideslip after the calibration; None without one.
    calibrated : whether the residual is relative to the calibrated car; otherwise to the vehicle file.
    truth : source, :data:`GROUND_TRUTH`, :data:`ESTIMATED`, or both; empty if the sensors alone were used.
    evidence : in one line. drives : that were used.
    sensors : as :class:`pdhef_logtool.drive.plan.Sensors`; None without.
    wheelbase_m : of the car that was assumed without a vehicle file; None with one.
    """

    format: Literal["pdhef-model"] = "pdhef-model"
    version: Literal[1] = 1
    vehicle: str = ""
    physics_sha256: Sha256
    truth: str = ""
    evidence: str = ""
    parameters: Annotated[tuple[TaughtParameter, ...], Field(strict=False)] = ()
    calibrated: bool = True
    drives: Annotated[tuple[LearntOn, ...], Field(strict=False)] = ()
    residual: LadderModel | None = None
    sensors: Any = None
    wheelbase_m: Positive | None = None

    def toml(self, head: str) -> str:
        """Return the file, without loss; ``head`` : comment."""
        entries = {"format": self.format, "version": self.version}
        entries |= self.model_dump(mode="json", exclude_defaults=True, exclude={"sensors"})
        return toml_text(entries | ({"sensors": self.sensors} if self.sensors else {}), head)

    def over(self, other: "CarModel | None") -> "CarModel":
        """Return this model with the entries of another one that it lacks."""
        if other is None:
            return self
        return other.model_copy(update={k: getattr(self, k) for k in self.model_fields_set})

    def belongs_to(self, vehicle: VehicleParameters) -> bool:
        """Whether it is of this vehicle file; sensors alone belong to any."""
        return self.physics_sha256 == physics_sha256(vehicle) or not (self.parameters or self.residual)


def read_model(path: Path, what: str = "a model.toml", remedy: str = "") -> CarModel:
    """Read a model.toml; raises VehicleError if it is missing or wrong, with the expectation ``what``."""
    raw = read_toml(path, what, VehicleError, remedy)
    return validated(CarModel, raw, str(path), VehicleError, expected="the entries of a model.toml", remedy=remedy)
