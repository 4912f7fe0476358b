"""TOML files of a car: reading vehicle.toml, and writing it and the parts of a car's folder."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field

from pdhef_logtool.car.assumed_values import AssumedValue, completed
from pdhef_logtool.car.vehicle import REMEDY, SENSOR_PROFILES, Record, Sensors, VehicleParameters
from pdhef_logtool.records.errors import VehicleError
from pdhef_logtool.storage.documents import checked, read_toml, validated
from pdhef_logtool.storage.toml_text import toml_text


class _Network(Record):
    gain: Annotated[float, Field(ge=0, le=1)]


class _Wheelbase(Record):
    """Entries that a file may state in place of the axle distances."""

    wheelbase_m: Annotated[float, Field(gt=0, le=30)] = 1.0
    front_weight_share: Annotated[float, Field(gt=0, lt=1)] = 0.5


def _what_may_be_left_out(schema: dict[str, Any]) -> None:
    """Change the JSON Schema for files: before :func:`~.assumed_values.completed`, only the mass is required."""
    schema["required"] = ["mass_kg"]
    positive = {"exclusiveMinimum": 0, "type": "number"}
    schema["properties"] |= {"wheelbase_m": positive, "front_weight_share": positive | {"exclusiveMaximum": 1}}


class VehicleEntries(VehicleParameters):
    """A vehicle.toml: physics and sensors, and optionally the residual gain that its author chose."""

    model_config = ConfigDict(json_schema_extra=_what_may_be_left_out)

    network: _Network | None = None


@dataclass(frozen=True, slots=True)
class VehicleFile:
    """Contents of a vehicle.toml: physics and sensors, the assumed values, and the table ``[network]``."""

    vehicle: VehicleParameters
    network_gain: float | None
    assumed: tuple[AssumedValue, ...]


def read_vehicle_file(path: Path) -> VehicleFile:
    """Read a vehicle.toml; missing values follow from mass and wheelbase (:mod:`~.assumed_values`).

    Raises
    ------
    VehicleError
        The file is missing or is not TOML, or has wrong, unknown or missing entries; the message lists all of them.
    """
    return vehicle_of_entries(read_toml(path, "a vehicle TOML, car folder or 'saloon'", VehicleError), where=path)


def with_sensors(vehicle: VehicleParameters, profile: Path | str) -> VehicleParameters:
    """Return a vehicle with a named sensor profile, or with the table ``[sensors]`` of a file like vehicle.toml.

    Raises
    ------
    VehicleError
        The file is missing or is not TOML, or has no such table, or the table has wrong or unknown entries.
    """
    sensors = SENSOR_PROFILES.get(str(profile))
    if sensors is None:
        entries = read_toml(Path(profile), "a TOML file with [sensors]", VehicleError).get("sensors")
        expected, remedy = "a table [sensors] as in vehicle.toml", f"profiles by name: {', '.join(SENSOR_PROFILES)}"
        if not isinstance(entries, dict):
            raise VehicleError(expected=expected, got="none", where=profile, remedy=remedy)
        sensors = validated(Sensors, entries, f"{profile}: sensors", VehicleError, expected=expected, remedy=REMEDY)
    return vehicle.model_copy(update={"sensors": sensors})


def vehicle_of_entries(raw: Mapping[str, Any], *, where: object) -> VehicleFile:
    """Return the vehicle of the entries of a vehicle.toml; raises VehicleError as :func:`read_vehicle_file`."""
    problems: list[str] = []
    checked(_Wheelbase, {name: raw[name] for name in _Wheelbase.model_fields if name in raw}, "", problems)
    entries, assumed = completed(raw)
    file = None if problems else checked(VehicleEntries, entries, "", problems)
    if file is None:
        # Values that follow from a wrong entry, such as a length in mm, are wrong too.
        stated = [p for p in problems if re.split("[:.]", p)[0] in (*raw, "mass_kg")]
        got = "; ".join(stated or problems)
        raise VehicleError(expected="the entries of vehicle.toml", got=got, where=where, remedy=REMEDY)
    fields = VehicleParameters.model_fields
    values = {name: getattr(file, name) for name in fields}
    vehicle = VehicleParameters.model_construct(file.model_fields_set & fields.keys(), **values)
    return VehicleFile(vehicle, None if file.network is None else file.network.gain, assumed)


def part_toml(part: Record, head: str = "") -> str:
    """Return a part of a car's folder, for example its vehicle file, as TOML with ``head`` above it, without loss."""
    plain: dict[str, Any] = part.model_dump(mode="json", exclude_none=True)
    return toml_text({k: v for k, v in plain.items() if v not in ([], {})}, head)
