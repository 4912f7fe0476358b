"""Documented message types of vendors: ``vendors.toml`` and user files in the same format."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

from pdhef_logtool.logs.drive_log import TopicInfo
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.mapping.naming import VOCABULARY, Meaning
from pdhef_logtool.mapping.records import VECTOR_COLUMNS, SignalSource
from pdhef_logtool.records.errors import MappingFileError
from pdhef_logtool.records.signals import SIGNAL_UNITS, TRUTH_UNITS, WHEELS
from pdhef_logtool.storage.documents import checked, read_toml

#: Environment variable with the path of a user file, which has priority over the shipped types.
USERS_FILE = "PDHEF_VENDORS"

_WHEELS = {f"wheel_speed_{w}_{u}": [q, w] for w in WHEELS for u, q in (("m_s", "wheel speed"), ("rad_s", "wheel rate"))}
#: Quantity and part by signal and ground truth.
_QUANTITIES: dict[str, list[str]] = {**VOCABULARY["signals"], **_WHEELS}


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, defer_build=True)


class _FieldTable(_Entry):
    field: Annotated[str, Field(min_length=1)] | list[str]
    signal: str = ""
    truth: str = ""
    scale: float | list[float] = 1.0
    offset: float = 0.0

    @model_validator(mode="after")
    def _is_one_quantity(self) -> _FieldTable:
        scales = self.scale if isinstance(self.scale, list) else [self.scale]
        fields, columns = len(self.field) if isinstance(self.field, list) else 0, VECTOR_COLUMNS.get(self.truth, 1)
        wrong = {
            "give either signal or ground truth": bool(self.signal) == bool(self.truth),
            f"{self.signal!r} is no signal": self.signal not in {"", *SIGNAL_UNITS},
            f"{self.truth!r} is no ground-truth quantity": self.truth not in {"", *TRUTH_UNITS},
            "scale must not be 0": 0.0 in scales,
            "one field has one scale": isinstance(self.scale, list) and not fields,
            f"{self.truth or self.signal} is made of {columns} fields": fields != (columns if columns > 1 else 0),
        }
        if why := next((why for why, is_wrong in wrong.items() if is_wrong), ""):
            raise ValueError(why)
        return self


class _TypeTable(_Entry):
    type: list[str]
    vendor: str
    page: str
    read: str
    note: str = ""
    leave_out: str = ""
    has: list[str] = []
    fields: list[_FieldTable]


class _ReceiverTable(_Entry):
    message: str
    page: str
    has: list[str]
    without: list[str] = []
    fields: list[_FieldTable]


_Table = TypeVar("_Table", _TypeTable, _ReceiverTable)


@dataclass(frozen=True, slots=True)
class VendorField:
    """A documented field: ``value_SI = scale * raw + offset``.

    Attributes
    ----------
    section, name : ``signals`` or ``truth``, and the quantity there.
    unit : unit of the raw value, for reports. page : address of the documentation.
    """

    section: Literal["signals", "truth"]
    name: str
    scale: float
    offset: float
    unit: str
    page: str

    @property
    def meaning(self) -> Meaning:
        """The equivalent meaning of a name."""
        return replace(meaning_of_signal(self.name), unit=self.unit, scale=abs(self.scale))


def meaning_of_signal(name: str) -> Meaning:
    """Return the meaning of a signal or ground-truth quantity."""
    quantity, part = _QUANTITIES.get(name, ("", ""))
    return Meaning(quantity, part, 1.0, "", 1.0, "its type is documented")


def names_of(quantity: str, part: str, among: Iterable[str] = SIGNAL_UNITS) -> tuple[str, ...]:
    """Return the signals among ``among`` that match a quantity and part."""
    parts = (part,) if part else {"speed": ("x",), "steering": ("road", "wheel")}.get(quantity, ("",))
    return tuple(n for n in among if any(_QUANTITIES.get(n) == [quantity, p] for p in parts))


@dataclass(frozen=True, slots=True)
class VendorType:
    """A documented type: its fields by path, and vectors of ground truth, with an empty topic.

    Attributes
    ----------
    left_out : why no field is used; empty if fields are used.
    has : fields that identify a recorder's export, which has no type name; it may contain other channels. Of a
        receiver's message, at any depth. without : fields of an attitude, by which a message is ground truth.
    """

    fields: Mapping[str, VendorField] = field(default_factory=dict)
    vectors: tuple[SignalSource, ...] = ()
    left_out: str = ""
    has: frozenset[str] = frozenset()
    without: frozenset[str] = frozenset()

    def entries(self, path: str) -> dict[str, VendorField]:
        """Return the entry of a field, or of the elements of an array of unknown length, by path."""
        return {p: e for p, e in self.fields.items() if p in (path, path.replace("[]", p[len(path) - 2 :]))}


@dataclass(frozen=True, slots=True)
class Vendors:
    """Documented types by name in the spelling of ROS 2 without ``/msg``, and messages of GNSS receivers."""

    types: Mapping[str, VendorType] = field(default_factory=dict)
    receivers: tuple[VendorType, ...] = ()

    def typed(self, topic: TopicInfo, fields: Iterable[FieldInfo]) -> TopicInfo:
        """Return an untyped topic, JSON or a table, with the type name of the export that its fields match, if any."""
        if (topic.type_name and topic.encoding != "json") or plain_type(topic.type_name) in self.types:
            return topic
        there = {f.path for f in fields}
        names = (name for name, kind in self.types.items() if kind.has and kind.has <= there)
        return next((replace(topic, type_name=name) for name in names), topic)

    def of(self, type_name: str) -> VendorType:
        """Return a type; an empty one if it is not documented here."""
        return self.types.get(plain_type(type_name), VendorType())


def plain_type(type_name: str) -> str:
    """Return the name of a type in the spelling of ROS 2 without ``/msg``, in which all tables are written."""
    name = type_name.removeprefix("ros.").replace("::", "/").replace(".", "/").replace("/msg/", "/")
    return name.replace("foxglove_msgs/", "foxglove/")


def load_vendors(path: Path | None = None) -> Vendors:
    """Return the shipped types and a user's types, which have priority (``path`` or ``PDHEF_VENDORS``).

    Raises
    ------
    MappingFileError : A file is missing, is no TOML or contains wrong entries; all are named.
    """
    given = path or (Path(os.environ[USERS_FILE]) if os.environ.get(USERS_FILE) else None)
    if given is None:
        return _shipped()
    ours, users = _shipped(), _read(given)
    return Vendors({**ours.types, **users.types}, (*users.receivers, *ours.receivers))


@cache
def _shipped() -> Vendors:
    return _read(Path(str(files("pdhef_logtool").joinpath("mapping", "vendors.toml"))))


def _read(path: Path) -> Vendors:
    raw = read_toml(path, "a TOML file of vendors' types", MappingFileError)
    problems = [
        f"{key}: not known, expected [[types]] or [[receivers]]" for key in raw if key not in ("types", "receivers")
    ]
    types: dict[str, VendorType] = {}
    for model in _tables(raw, "types", _TypeTable, problems):
        fields = _single_fields(model.fields, f"{model.page}, read {model.read}")
        several = tuple(_vector(f) for f in model.fields if isinstance(f.field, list))
        kind = VendorType(fields, several, model.leave_out, frozenset(model.has))
        types |= {plain_type(name): kind for name in model.type}
    receivers = tuple(
        VendorType(_single_fields(m.fields, m.page), has=frozenset(m.has), without=frozenset(m.without))
        for m in _tables(raw, "receivers", _ReceiverTable, problems)
    )
    if problems:
        expected, remedy = "entries as in docs/formats.md", "see docs/formats.md for every entry"
        raise MappingFileError(expected=expected, got="; ".join(problems), where=str(path), remedy=remedy)
    return Vendors(types, receivers)


def _tables(raw: Mapping[str, Any], key: str, kind: type[_Table], problems: list[str]) -> Iterator[_Table]:
    """Yield the valid tables of a key; the errors of the others are added to ``problems``."""
    entries = raw.get(key, [])
    for number, table in enumerate(entries if isinstance(entries, list) else [], 1):
        if (model := checked(kind, table, f"{key}[{number}]", problems)) is not None:
            yield model


def _single_fields(tables: Iterable[_FieldTable], page: str) -> dict[str, VendorField]:
    """Return the fields of one column by path."""
    single = ((f.field, f.scale, f) for f in tables)
    return {p: _field(f, x, page) for p, x, f in single if isinstance(p, str) and isinstance(x, float)}


def _field(table: _FieldTable, scale: float, page: str) -> VendorField:
    name = table.signal or table.truth
    unit = (SIGNAL_UNITS | TRUTH_UNITS)[name]
    text = unit if scale == 1.0 else f"{unit} / {scale:.6g}"
    return VendorField("signals" if table.signal else "truth", name, scale, table.offset, text, page)


def _vector(table: _FieldTable) -> SignalSource:
    scale = tuple(table.scale) if isinstance(table.scale, list) else table.scale
    return SignalSource(table.truth, "", tuple(table.field), scale=scale, offset=table.offset)
