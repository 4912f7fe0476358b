"""Parts of a car: fit.

Each part contains the digest of its inputs. If an input has changed, the part is stale and is not used, not even with a
warning: noise for other tyres can triple the error.
"""

import re
from typing import Annotated, Any, Literal

from pydantic import Field

from pdhef_logtool.car.vehicle import NonNegative, Positive, Record, Sensors, VehicleParameters
from pdhef_logtool.storage.documents import digest, one_of

Sha256 = Annotated[str, Field(pattern="^[0-9a-f]{64}$")]

#: The filter on physics with its own identified values and noise.
PHYSICS = "physics"
#: Filters with noise in a car, by the name of the estimator.
NOISY_FILTERS = ("phy-ukf:tuned", PHYSICS)
#: Factors on the process noise of v_y and yaw rate for the smoother of ``physics`` unless ground truth gives others;
#: from a search on simulated cars.
SMOOTHING = (0.5, 3.0)
#: Measurements of ``r_std``.
MEASUREMENTS = ("ay_m_s2", "yaw_rate_rad_s", "speed_m_s")

#: Entries of a vehicle file that do not influence estimates.
_NOT_PHYSICS = {"name", "truth_position_m", "gnss_antenna_position_m"}


def physics_sha256(vehicle: VehicleParameters) -> str:
    """Return the digest of physics and sensors of a vehicle file, independent of name, layout and comments.

    Entries at their defaults count as absent, so that new entries of a later version do not make a car stale.
    """
    return digest(vehicle.model_dump(mode="json", exclude=_NOT_PHYSICS, exclude_defaults=True))


def car_folder(name: str, physics_sha256: str) -> str:
    """Return the folder name ``car=...`` of a car's drives: short, portable, and different for different physics."""
    return f"car={re.sub(r'[^A-Za-z0-9._]+', '-', name)[:24]}-{physics_sha256[:8]}"


class LearntOn(Record):
    """A drive of an identification, with the span in seconds from the start of its log."""

    name: str
    sha256: str = ""
    start_s: float = 0.0
    end_s: float = 0.0


#: ``limit_gain`` of cars without validation by ground truth (docs/method.md#limit). A higher gain reduces the error of
#: single manoeuvres further, but on laps with a wrong file the estimate then drifts with bias and tilt.
LIMIT_GAIN = 1.5


class FilterNoise(Record):
    """Process and measurement 1-sigma of one filter, with the origin.

    Attributes
    ----------
    q_std : per square root of second, of v_x, v_y and yaw rate, and optionally of the a_x bias; for ``physics`` also of
        the two axle forces. Empty for the filter's default.
    r_std : by measurement; the filter's default for missing ones.
    limit_gain : growth of the process noise of the axle forces of ``physics`` beyond the linear range; 0 without.
    """

    q_std: Annotated[tuple[NonNegative, ...], Field(strict=False)] = ()
    r_std: dict[Annotated[str, one_of(MEASUREMENTS), Field(json_schema_extra={"enum": [*MEASUREMENTS]})], Positive] = (
        Field(default_factory=dict)
    )
    limit_gain: NonNegative = 0.0

    def measurement_std(self, sensors: Sensors) -> tuple[float, float, float]:
        """Return the 1-sigma of a_y, yaw rate and speed, from the sensors for missing ones."""
        ay, rate, speed = (self.r_std.get(m, std) for m, std in zip(MEASUREMENTS, sensors.measurement_std, strict=True))
        return ay, rate, speed


#: Noise by filter.
FilterTables = dict[
    Annotated[str, one_of(NOISY_FILTERS), Field(json_schema_extra={"enum": [*NOISY_FILTERS]})], FilterNoise
]


class FittedPhysics(Record):
    """Vehicle and noise that were identified with the filter ``physics``.

    ``smoothing``: as :data:`SMOOTHING`, found with the smoother.
    """

    values: VehicleParameters
    noise: FilterNoise
    smoothing: Annotated[tuple[Positive, Positive], Field(strict=False)] = SMOOTHING


class Fit(Record):
    """``fit.toml``: identified physics of the car.

    ``filter`` : noise of the filters on the vehicle file (docs/method.md#noise). ``physics`` : vehicle and noise of the
    filter ``physics``, which has other model parts.
    """

    format: Literal["pdhef-fit"] = "pdhef-fit"
    version: Literal[1] = 1
    physics_sha256: Sha256
    filter: FilterTables = Field(default_factory=dict)
    physics: FittedPhysics | None = None
    drives: Annotated[tuple[LearntOn, ...], Field(strict=False)] = ()


class Algorithm(Record):
    """Algorithm behind an estimator name. Names are presets; on another car, a name may select another algorithm.

    Attributes
    ----------
    algorithm : for example ``adaptive-physics``. version : of the algorithm.
    options : options that differ from their defaults.
    noise : process and measurement 1-sigma. use_speed : whether the speed sensor is used after the start.
    physics_sha256, network_sha256 : of the physics and the network of the car; None if not used.
    """

    algorithm: str
    version: Annotated[int, Field(ge=1)] = 1
    options: dict[str, Any] = Field(default_factory=dict)
    noise: dict[str, Any] = Field(default_factory=dict)
    use_speed: bool = True
    physics_sha256: Sha256 | None = None
    network_sha256: Sha256 | None = None

    @property
    def sha256(self) -> str:
        """Digest of all entries."""
        return digest(self.model_dump(mode="json"))

    @property
    def identity(self) -> str:
        """Algorithm, version and options as text."""
        options = ", ".join(f"{name}={self.options[name]}" for name in sorted(self.options))
        return f"{self.algorithm} {self.version}{options and f' ({options})'}"
