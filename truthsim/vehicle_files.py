"""Vehicles as TOML files: three shipped ones and the user's.

A file contains every value of ``truthsim.vehicle.Vehicle`` by its name, with the tyres of the axles as tables
``[front_tyre]`` and ``[rear_tyre]``. All values are required and no others are allowed, because a default for a
forgotten value would belong to another car.
"""

import math
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, create_model, model_validator

from pdhef_logtool.records.errors import VehicleError
from pdhef_logtool.storage.documents import read_toml, validated
from truthsim.tyres import Tyre
from truthsim.vehicle import GRAVITY_M_S2, Vehicle

_FOLDER = Path(__file__).with_name("vehicles")

#: The vehicles that come with the simulator; the first is the default.
VEHICLES = ("sedan", "suv", "hatchback")

_SHARES = {"ackermann", "front_drive_share", "front_brake_share"}
_MAY_BE_NOUGHT = {
    "front_roll_centre_height_m",
    "rear_roll_centre_height_m",
    "pitch_centre_height_m",
    "front_anti_roll_n_m_per_rad",
    "rear_anti_roll_n_m_per_rad",
    "tyre_vertical_n_s_per_m",
    "rolling_resistance",
    "drag_area_m2",
    "stiffness_friction_power",
    "lateral_load_sensitivity",
    "longitudinal_load_sensitivity",
    "lateral_damping_s_per_m",
    "longitudinal_damping_s_per_m",
}
_ANY_SIGN = {"front_compliance_rad_per_n", "rear_compliance_rad_per_n"}
_BELOW_ONE = {"lateral_curvature", "longitudinal_curvature"}


def _field(name: str) -> Any:
    if name in _SHARES:
        return Field(ge=0.0, le=1.0)
    if name in _ANY_SIGN:
        return Field(gt=-1e-4, lt=1e-4)
    if name in _BELOW_ONE:
        return Field(gt=-20.0, lt=1.0)
    if name in _MAY_BE_NOUGHT:
        return Field(ge=0.0)
    return Field(gt=0.0)


_STRICT = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


def _tyre_model() -> type[BaseModel]:
    fields: dict[str, Any] = {name: (float, _field(name)) for name in Tyre._fields}
    return create_model("TyreFile", __config__=_STRICT, **fields)


def _require(holds: bool, words: str) -> None:
    if not holds:
        raise ValueError(words)


class _Checked(BaseModel):
    """Check relations between the values of a vehicle."""

    model_config = _STRICT

    @model_validator(mode="after")
    def _hangs_together(self) -> "_Checked":
        value: Any = self
        unsprung = 2.0 * (value.front_unsprung_mass_kg + value.rear_unsprung_mass_kg)
        _require(unsprung < 0.5 * value.mass_kg, "the unsprung masses together must be below half of mass_kg")
        sprung = value.mass_kg - unsprung
        height = (value.mass_kg * value.cg_height_m - unsprung * value.wheel_radius_m) / sprung
        centres = max(value.front_roll_centre_height_m, value.rear_roll_centre_height_m, value.pitch_centre_height_m)
        _require(height > centres, "roll and pitch centres must lie below the CG of the sprung mass")
        springs = 0.5 * value.track_m**2 * (value.front_spring_n_per_m + value.rear_spring_n_per_m)
        stiffness = springs + value.front_anti_roll_n_m_per_rad + value.rear_anti_roll_n_m_per_rad
        _require(
            stiffness > 1.5 * sprung * GRAVITY_M_S2 * height, "springs and anti-roll bars must hold the body upright"
        )
        for axle in ("front_tyre", "rear_tyre"):
            tyre = getattr(value, axle)
            _require(
                tyre.lateral_relaxation_min_m <= tyre.lateral_relaxation_m,
                f"{axle}: lateral_relaxation_min_m must not exceed lateral_relaxation_m",
            )
        # Waves that the step of 1 ms can follow: a wheel between tyre and spring.
        lightest = min(value.front_unsprung_mass_kg, value.rear_unsprung_mass_kg)
        stiffest = value.tyre_vertical_n_per_m + max(value.front_spring_n_per_m, value.rear_spring_n_per_m)
        _require(math.sqrt(stiffest / lightest) < 300.0, "a wheel must bounce below 300 rad/s on its tyre")
        return self


def _vehicle_model() -> type[BaseModel]:
    tyre = _tyre_model()
    fields: dict[str, Any] = {"description": (str, Field(min_length=1))}
    for name in Vehicle._fields:
        fields[name] = (tyre, ...) if name.endswith("_tyre") else (float, _field(name))
    return create_model("VehicleFile", __base__=_Checked, **fields)


def load_vehicle(name_or_path: str | Path) -> Vehicle:
    """Return a vehicle of ``VEHICLES`` by its name, or one from a TOML file.

    Raises
    ------
    VehicleError
        No such vehicle or file, or its content is wrong; the message names the value.
    """
    path = _FOLDER / f"{name_or_path}.toml" if str(name_or_path) in VEHICLES else Path(name_or_path)
    remedy = f"name one of {', '.join(VEHICLES)} or a file with the same values as truthsim/vehicles/sedan.toml"
    raw = read_toml(path, "a vehicle TOML file", VehicleError, remedy)
    expected = "the entries of a simulated vehicle"
    checked: Any = validated(_vehicle_model(), raw, str(path), VehicleError, expected=expected, remedy=remedy)
    values = {name: getattr(checked, name) for name in Vehicle._fields}
    for axle in ("front_tyre", "rear_tyre"):
        values[axle] = Tyre(**values[axle].model_dump())
    return Vehicle(**values)
