"""Documented message types of vendors: ``vendors.toml`` and user files in the same format."""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field, model_validator

from pdhef_logtool.logs.drive_log import TopicInfo
from pdhef_logtool.logs.message_schema import FieldInfo
from pdhef_logtool.mapping.mapping_file import problem_of
from pdhef_logtool.mapping.naming import VOCABULARY, Meaning
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.records.errors import MappingFileError
from pdhef_logtool.records.signals import SIGNAL_UNITS, TRUTH_UNITS, WHEELS
from pdhef_logtool.storage.documents import read_toml, validated

#: Environment variable with the path of a user file, which has priority over the shipped types.
USERS_FILE = "PDHEF_VENDORS"

_WHEELS = {f"wheel_speed_{w}_{u}": [q, w] for w in WHEELS for u, q in (("m_s", "wheel speed"), ("rad_s", "wheel rate"))}
#: Quantity and part by signal and ground truth.
_QUANTITIES: dict[str, list[str]] = {**VOCABULARY["signals"], **_WHEELS}


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, defer_build=True)


class _FieldTable(_Entry):
    field: Annotated[str, Field(min_length=1)] | tuple[str, ...]
    signal: str = ""
    truth: str = ""
    scale: float | tuple[float, ...] = 1.0
    offset: float = 0.0

    @property
    def source(self) -> SignalSource:
        return SignalSource(self.signal or self.truth, "", self.field, scale=self.scale, offset=self.offset)

    @model_validator(mode="after")
    def _is_one_quantity(self) -> "_FieldTable":
        source = self.source
        problem = problem_of(source)
        if bool(self.signal) == bool(self.truth):
            problem = "give either signal or ground truth"
        elif source.name not in (SIGNAL_UNITS if self.signal else TRUTH_UNITS):
            problem = f"{source.name!r} is no {'signal' if self.signal else 'ground-truth quantity'}"
        elif isinstance(self.field, tuple) != (source.columns > 1):
            problem = f"{source.name} is made of {source.columns} fields"
        if problem:
            raise ValueError(problem)
        return self


class _Table(_Entry):
    page: str
    has: frozenset[str] = frozenset()
    fields: tuple[_FieldTable, ...]

    def documented(self, page: str, left_out: str = "", without: frozenset[str] = frozenset()) -> "VendorType":
        signals, truth = (tuple(f.source for f in self.fields if getattr(f, of)) for of in ("signal", "truth"))
        return VendorType(signals, truth, page, left_out, self.has, without)


class _TypeTable(_Table):
    type: tuple[str, ...]
    vendor: str
    read: str
    note: str = ""
    leave_out: str = ""


class _ReceiverTable(_Table):
    message: str
    without: frozenset[str] = frozenset()


class _File(_Entry):
    types: tuple[_TypeTable, ...] = ()
    receivers: tuple[_ReceiverTable, ...] = ()


def meaning_of_source(source: SignalSource) -> Meaning:
    """Return the meaning of a source of one field; its unit is for reports."""
    quantity, part = _QUANTITIES.get(source.name, ("", ""))
    scale = source.scale if isinstance(source.scale, float) else 1.0
    unit = (SIGNAL_UNITS | TRUTH_UNITS).get(source.name, "") + ("" if scale == 1.0 else f" / {scale:.6g}")
    return Meaning(quantity, part, 1.0, unit, abs(scale), "its type is documented")


def names_of(quantity: str, part: str, among: Iterable[str] = SIGNAL_UNITS) -> tuple[str, ...]:
    """Return the signals among ``among`` that match a quantity and part."""
    parts = (part,) if part else {"speed": ("x",), "steering": ("road", "wheel")}.get(quantity, ("",))
    return tuple(n for n in among if any(_QUANTITIES.get(n) == [quantity, p] for p in parts))


@dataclass(frozen=True, slots=True)
class VendorType:
    """A documented type: its sources of signals and of ground truth, with an empty topic.

    Attributes
    ----------
    page : address of the documentation.
    left_out : why no field is used; empty if fields are used.
    has : fields that identify a recorder's export, which has no type name; it may contain other channels. Of a
        receiver's message, at any depth. without : fields of an attitude, by which a message is ground truth.
    """

    signals: tuple[SignalSource, ...] = ()
    truth: tuple[SignalSource, ...] = ()
    page: str = ""
    left_out: str = ""
    has: frozenset[str] = frozenset()
    without: frozenset[str] = frozenset()

    @property
    def fields(self) -> dict[str, SignalSource]:
        """Sources of one field by path."""
        return {s.field: s for s in (*self.signals, *self.truth) if isinstance(s.field, str)}

    def entries(self, path: str) -> dict[str, SignalSource]:
        """Return the source of a field, or of the elements of an array of unknown length, by path."""
        return {p: s for p, s in self.fields.items() if p in (path, path.replace("[]", p[len(path) - 2 :]))}


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
    expected, remedy = "entries as in docs/formats.md", "see docs/formats.md for every entry"
    file = validated(_File, raw, path, MappingFileError, expected=expected, remedy=remedy)
    of_types = [(t.type, t.documented(f"{t.page}, read {t.read}", t.leave_out)) for t in file.types]
    types = {plain_type(name): kind for names, kind in of_types for name in names}
    return Vendors(types, tuple(r.documented(r.page, without=r.without) for r in file.receivers))
