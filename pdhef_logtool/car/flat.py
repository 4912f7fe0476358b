"""TOML of a car: one file that holds all of it, as older versions wrote it and exports do, and the parts of a folder.

A person's file is written with its comments and the order of its entries; only what differs is touched.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import ConfigDict, Field

from pdhef_logtool.car.parts import FilterNoise, FilterTables, FittedPhysics, LearntOn, Sha256, Trust
from pdhef_logtool.car.vehicle import REMEDY, Record, VehicleParameters
from pdhef_logtool.records.documents import read_toml, validated
from pdhef_logtool.records.errors import VehicleError

#: What a file holds beside physics and sensors.
_TABLES = ("filter", "network", "identification")
#: A drive and a score, as older versions wrote them for people.
_SPAN = re.compile(r"(?P<name>.+): (?P<start_s>-?[\d.]+) to (?P<end_s>-?[\d.]+) s")
_SCORE = re.compile(r"(?P<name>[a-z:-]+): (?P<score_deg>[\d.]+) deg at trial (?P<trial>\d+)")


class _Network(Record):
    trust_cap: Annotated[float, Field(ge=0, le=1)] = 0.0
    evidence: str = "none"
    model_sha256: Sha256 | None = None


class _Identification(Record):
    model_config = ConfigDict(frozen=True, extra="allow")
    drives: Annotated[tuple[str | LearntOn, ...], Field(strict=False)] = ()
    tuning_scores: Annotated[tuple[str, ...], Field(strict=False)] = ()
    physics: FittedPhysics | None = None


class _FlatFile(VehicleParameters):
    """A vehicle.toml with the tables that it may hold beside physics and sensors."""

    filter: FilterTables = Field(default_factory=dict)
    network: _Network | None = None
    identification: _Identification = _Identification()


@dataclass(frozen=True, slots=True)
class FlatCar:
    """What one file says of a car."""

    vehicle: VehicleParameters
    noise: Mapping[str, FilterNoise] = field(default_factory=dict)
    trust: Trust | None = None
    learnt_on: tuple[LearntOn, ...] = ()
    physics: FittedPhysics | None = None


def read_flat(path: Path) -> FlatCar:
    """Read a vehicle.toml with the tables ``[filter.*]``, ``[network]`` and ``[identification]`` that it may hold.

    Raises
    ------
    VehicleError
        The file is missing, is no TOML, or holds wrong, unknown or missing entries; all of them are named at once.
    """
    raw, where = read_toml(path, "a vehicle TOML file", VehicleError), str(path)
    tables = validated(_FlatFile, raw, where, VehicleError, expected="the entries of vehicle.toml", remedy=REMEDY)
    own = VehicleParameters.model_fields
    given = tables.model_fields_set & own.keys()
    vehicle = VehicleParameters.model_construct(given, **{name: getattr(tables, name) for name in own})
    noise: dict[str, FilterNoise] = dict(tables.filter)
    for score in _parsed(tables.identification.tuning_scores, _SCORE, f"{where}: identification.tuning_scores"):
        if score["name"] in noise:
            told = {"score_deg": float(score["score_deg"]), "trial": int(score["trial"])}
            noise[score["name"]] = noise[score["name"]].model_copy(update=told)
    drives = [d for d in tables.identification.drives if isinstance(d, LearntOn)]
    spans = [d for d in tables.identification.drives if isinstance(d, str)]
    drives += [
        LearntOn(name=span["name"], start_s=float(span["start_s"]), end_s=float(span["end_s"]))
        for span in _parsed(spans, _SPAN, f"{where}: identification.drives")
    ]
    network = tables.network
    trust = None
    if network is not None:
        trust = Trust(trust_cap=network.trust_cap, evidence=network.evidence, network_sha256=network.model_sha256)
    return FlatCar(vehicle, noise, trust, tuple(drives), tables.identification.physics)


def load_vehicle(path: Path) -> VehicleParameters:
    """Return physics and sensors of a vehicle.toml; raises VehicleError as :func:`read_flat`."""
    return read_flat(path).vehicle


def _parsed(texts: Sequence[str], form: re.Pattern[str], where: str) -> list[re.Match[str]]:
    """Return what sentences of older files say; one that is not understood decides nothing in silence."""
    found = [form.fullmatch(text) for text in texts]
    wrong = [repr(text) for text, match in zip(texts, found, strict=True) if match is None]
    if wrong:
        raise VehicleError(expected="sentences as pdhef wrote them", got=", ".join(wrong), where=where)
    return [match for match in found if match is not None]


def flat_toml(
    text: str,
    before: VehicleParameters,
    after: VehicleParameters,
    noise: Mapping[str, FilterNoise],
    trust: Trust | None,
    identification: Mapping[str, Any],
    comments: Mapping[str, str] | None = None,
) -> str:
    """Return a person's file with everything that is known of the car in it.

    Parameters
    ----------
    text : the file, whose physics are ``before``; what differs in ``after`` is changed, the rest is left as it stands.
    identification : provenance, as plain values. comments : beside entries, by dotted name.
    """
    import tomlkit

    document = tomlkit.parse(text)
    _merge(document, _plain(before), _plain(after))
    tables: dict[str, Any] = {}
    if noise:
        # In one file all belongs together: digests would only stand in the way of a person's hand.
        plain = {name: _plain(one) for name, one in noise.items()}
        tables["filter"] = {n: {k: v for k, v in one.items() if "sha256" not in k} for n, one in plain.items()}
    if trust is not None:
        found = {"trust_cap": trust.trust_cap, "evidence": trust.evidence, "model_sha256": trust.network_sha256}
        tables["network"] = {k: v for k, v in found.items() if v is not None}
    given = {name: table for name, table in document.unwrap().items() if name in _TABLES}
    provenance = {**given.get("identification", {}), **identification}
    provenance.pop("tuning_scores", None)
    if provenance:
        tables["identification"] = provenance
    _merge(document, given, tables)
    _comment(document, comments or {})
    return tomlkit.dumps(document)


def part_toml(part: Record, head: str, comments: Mapping[str, str] | None = None) -> str:
    """Return a part of a car's folder as TOML; ``head`` stands above it, ``comments`` beside entries by dotted name."""
    import tomlkit

    document = tomlkit.document()
    for line in head.splitlines():
        document.add(tomlkit.comment(line))
    _merge(document, {}, _plain(part))
    _comment(document, comments or {})
    return tomlkit.dumps(document)


def vehicle_toml(vehicle: VehicleParameters, head: str = "", comments: Mapping[str, str] | None = None) -> str:
    """Return vehicle.toml of physics and sensors; reading it back gives the same."""
    return part_toml(vehicle, head, comments)


def _plain(part: Record) -> dict[str, Any]:
    plain: dict[str, Any] = part.model_dump(mode="json", exclude_none=True)
    return {k: v for k, v in plain.items() if v not in ([], {})}


def _merge(table: Any, before: Mapping[str, Any], after: Mapping[str, Any]) -> None:
    """Change a TOML table in place where ``after`` differs from ``before``; plain entries before tables and lists."""
    import tomlkit

    for key in before.keys() - after.keys():
        table.pop(key, None)
    for key, value in sorted(after.items(), key=lambda item: _rank(item[1])):
        if key in before and before[key] == value:
            continue
        if isinstance(value, Mapping) and isinstance(table.get(key), Mapping):
            old = before.get(key)
            _merge(table[key], old if isinstance(old, Mapping) else {}, value)
        elif isinstance(value, Mapping) and any(map(_rank, value.values())):
            table[key] = tomlkit.table()
            _merge(table[key], {}, value)
        elif isinstance(value, list) and _rank(value):
            table[key] = _lines(value)
        else:
            table[key] = value


def _rank(value: Any) -> int:
    """Return where an entry stands in a table: plain ones first, then lists a line an item, which may be long."""
    if isinstance(value, Mapping):
        return 2
    return int(isinstance(value, list) and any(isinstance(item, Mapping | str) for item in value))


def _lines(items: Sequence[Any]) -> Any:
    """Return a list with an item a line."""
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
    """Write comments beside entries that are there, by dotted name."""
    for name, text in comments.items():
        *tables, entry = name.split(".")
        place: Any = document
        for table in tables:
            place = place.get(table, {})
        if entry in place:
            place[entry].comment(text).trivia.comment_ws = "  "
