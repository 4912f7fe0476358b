"""TOML files of a car: reading vehicle.toml, and writing it and the parts of a car's folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field

from pdhef_logtool.car.assumed_values import AssumedValue, completed
from pdhef_logtool.car.parts import Trust
from pdhef_logtool.car.vehicle import REMEDY, SENSOR_PROFILES, Record, Sensors, VehicleParameters
from pdhef_logtool.records.errors import VehicleError
from pdhef_logtool.storage.documents import read_toml, validated


class _Network(Record):
    trust_cap: Annotated[float, Field(ge=0, le=1)]
    evidence: str


def _what_may_be_left_out(schema: dict[str, Any]) -> None:
    """Make the JSON Schema that of a file: before :func:`~.assumed_values.completed`, only the mass is required."""
    schema["required"] = ["mass_kg"]
    positive = {"exclusiveMinimum": 0, "type": "number"}
    schema["properties"] |= {"wheelbase_m": positive, "front_weight_share": positive | {"exclusiveMaximum": 1}}


class VehicleEntries(VehicleParameters):
    """A vehicle.toml: physics and sensors, and optionally the residual gain that its author allows, with the reason."""

    model_config = ConfigDict(json_schema_extra=_what_may_be_left_out)

    network: _Network | None = None


@dataclass(frozen=True, slots=True)
class VehicleFile:
    """Contents of a vehicle.toml: physics and sensors, what of them it left out, and the table ``[network]``."""

    vehicle: VehicleParameters
    trust: Trust | None
    assumed: tuple[AssumedValue, ...]


def read_vehicle_file(path: Path) -> VehicleFile:
    """Read a vehicle.toml; values that it leaves out follow from mass and wheelbase (:mod:`~.assumed_values`).

    Raises
    ------
    VehicleError
        The file is missing or no TOML, or has wrong, unknown or missing entries; the message names all of them.
    """
    return vehicle_of_entries(read_toml(path, "a vehicle TOML, car folder or 'saloon'", VehicleError), where=str(path))


def with_sensors(vehicle: VehicleParameters, profile: Path | str) -> VehicleParameters:
    """Return a vehicle with a sensor profile: of a name, or the table ``[sensors]`` of a file like vehicle.toml.

    Raises
    ------
    VehicleError
        The file is missing or no TOML, or has no such table, or the table has wrong or unknown entries.
    """
    sensors = SENSOR_PROFILES.get(str(profile))
    if sensors is None:
        entries = read_toml(Path(profile), "a TOML file with [sensors]", VehicleError).get("sensors")
        expected, remedy = "a table [sensors] as in vehicle.toml", f"profiles by name: {', '.join(SENSOR_PROFILES)}"
        if not isinstance(entries, dict):
            raise VehicleError(expected=expected, got="none", where=str(profile), remedy=remedy)
        sensors = validated(Sensors, entries, f"{profile}: sensors", VehicleError, expected=expected, remedy=REMEDY)
    return vehicle.model_copy(update={"sensors": sensors})


def vehicle_of_entries(raw: Mapping[str, Any], *, where: str) -> VehicleFile:
    """Return the vehicle of the entries of a vehicle.toml; raises VehicleError as :func:`read_vehicle_file`."""
    entries, assumed = completed(raw)
    expected = "the entries of vehicle.toml"
    file = validated(VehicleEntries, entries, where, VehicleError, expected=expected, remedy=REMEDY)
    fields = VehicleParameters.model_fields
    vehicle = VehicleParameters.model_construct(
        file.model_fields_set & fields.keys(), **{name: getattr(file, name) for name in fields}
    )
    trust = None if file.network is None else Trust(**file.network.model_dump())
    return VehicleFile(vehicle, trust, assumed)


def load_vehicle(path: Path) -> VehicleParameters:
    """Return physics and sensors of a vehicle.toml; raises VehicleError as :func:`read_vehicle_file`."""
    return read_vehicle_file(path).vehicle


def part_toml(part: Record, head: str, comments: Mapping[str, str] | None = None) -> str:
    """Return a part of a car's folder as TOML with ``head`` above it and ``comments`` beside entries by dotted name."""
    import tomlkit

    document = tomlkit.document()
    for line in head.splitlines():
        document.add(tomlkit.comment(line))
    plain: dict[str, Any] = part.model_dump(mode="json", exclude_none=True)
    _fill(document, {k: v for k, v in plain.items() if v not in ([], {})})
    _comment(document, comments or {})
    return tomlkit.dumps(document)


def vehicle_toml(vehicle: VehicleParameters, head: str = "", comments: Mapping[str, str] | None = None) -> str:
    """Return vehicle.toml of physics and sensors; reading it back gives the same."""
    return part_toml(vehicle, head, comments)


def _fill(table: Any, entries: Mapping[str, Any]) -> None:
    """Add entries to a TOML table in place; plain entries before lists and tables."""
    import tomlkit

    for key, value in sorted(entries.items(), key=lambda item: _rank(item[1])):
        if isinstance(value, Mapping) and any(map(_rank, value.values())):
            table[key] = tomlkit.table()
            _fill(table[key], value)
        else:
            table[key] = _lines(value) if isinstance(value, list) and _rank(value) else value


def _rank(value: Any) -> int:
    """Return the position of an entry in a table: plain ones first, then lists with an item per line, then tables."""
    if isinstance(value, Mapping):
        return 2
    return int(isinstance(value, list) and any(isinstance(item, Mapping | str) for item in value))


def _lines(items: Sequence[Any]) -> Any:
    """Return a list with an item per line."""
    import tomlkit

    array = tomlkit.array().multiline(True)
    for item in items:
        if isinstance(item, Mapping):
            inline = tomlkit.inline_table()
            inline.update(item)
            item = inline
        array.append(item)
    return array


def _comment(document: Any, comments: Mapping[str, str]) -> None:
    """Write comments beside entries that exist, by dotted name; a table's name may contain no dot."""
    for name, text in comments.items():
        *tables, entry = name.split(".")
        place: Any = document
        for table in tables:
            place = place.get(table, {})
        if entry in place:
            place[entry].comment(text).trivia.comment_ws = "  "
