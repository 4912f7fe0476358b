"""Documents of users, read as TOML or JSON and checked by a pydantic model, and our own sealed documents.

A document of our own contains the digest of its other entries (:func:`seal`), by which its reader notices any change.
"""

import datetime as dt
import hashlib
import json
import math
import tomllib
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_origin

from pdhef_logtool.records.errors import OutputError, PdhefError
from pdhef_logtool.records.printable import utf8

if TYPE_CHECKING:
    from pydantic import AfterValidator, ValidationError

ModelT = TypeVar("ModelT")

#: Tables and lists inside one another: far more than any of our files has, far less than Python's stack.
MAX_DEPTH = 32
#: Twenty times the largest that is read.
MAX_BYTES = 4 << 20
#: The entry of a sealed document that is the digest of all others.
DIGEST = "digest"
#: TOML's whole numbers have 64 bits.
_WHOLE = range(-(2**63), 2**64)


def read_toml(
    path: Path, what: str, error: type[PdhefError], remedy: str = "", times: Collection[str] = ()
) -> dict[str, Any]:
    """Return the table of a TOML file; ``what`` names it in the error. Entries in ``times`` may be times, as texts.

    Raises
    ------
    PdhefError
        Of class ``error``: the file is missing, no UTF-8, no TOML, or nested beyond :data:`MAX_DEPTH`.
    """

    def parse(text: str) -> dict[str, Any]:
        document = tomllib.loads(text)
        return document | {n: str(document[n]) for n in times if isinstance(document.get(n), dt.datetime)}

    return _read(path, parse, what, error, remedy)


def read_json(
    path: Path, what: str, error: type[PdhefError], remedy: str = "", max_bytes: int = MAX_BYTES
) -> dict[str, Any]:
    """Return the object of a JSON file; otherwise as :func:`read_toml`, and a list or a number is refused as well."""
    return _read(path, json.loads, what, error, remedy, max_bytes)


def read_sealed(
    path: Path, what: str, error: type[PdhefError], remedy: str = "", max_bytes: int = MAX_BYTES
) -> dict[str, Any]:
    """Return a document that :func:`seal` made, without its digest; otherwise as :func:`read_json`.

    Raises
    ------
    PdhefError
        Of class ``error``: also a document that was changed since it was written.
    """
    document = read_json(path, what, error, remedy, max_bytes)
    if not is_sealed(document):
        raise error(expected=what, got="one that is not as it was written", where=path, remedy=remedy)
    return {key: value for key, value in document.items() if key != DIGEST}


def seal(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a JSON-able document with the digest of its entries."""
    plain = jsonable(document)
    return {**plain, DIGEST: digest(plain)}


def is_sealed(document: Mapping[str, Any]) -> bool:
    """Return whether a document is as :func:`seal` made it."""
    return document.get(DIGEST) == digest({key: value for key, value in document.items() if key != DIGEST})


def file_sha256(path: Path) -> str:
    """Return the sha256 of a file's content; raises OSError."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def checked_sha256(path: Path, named: str | None, document: str, remedy: str) -> str:
    """Return the sha256 of a file; raises OutputError if it cannot be read, or is not as ``document`` names it."""
    try:
        sha256 = file_sha256(path)
    except OSError as error:
        got = error.strerror or str(error)
        raise OutputError(expected=f"a readable {path.name}", got=got, where=path, remedy=remedy) from error
    if named not in (None, sha256):
        expected, got = f"the {path.name} that {document} names", "another content: it is damaged, or of another run"
        raise OutputError(expected=expected, got=got, where=path, remedy=remedy)
    return sha256


def _read(
    path: Path, parse: Callable[[str], Any], what: str, error: type[PdhefError], remedy: str, max_bytes: int = MAX_BYTES
) -> dict[str, Any]:
    try:
        document = parse(read_text(path, max_bytes))
        got = _oddity(document)
    except FileNotFoundError:
        raise error(expected=what, got="no such file", where=path, remedy=remedy, missing=True) from None
    except OSError as problem:
        got = problem.strerror or str(problem)
    except RecursionError:
        got = "tables or lists that are nested too deeply"
    except ValueError as problem:  # of the decoder, either parser, or a number of thousands of digits
        got = str(problem)
    if got:
        raise error(expected=what, got=got, where=path, remedy=remedy)
    return dict(document)


def read_text(path: Path, max_bytes: int = MAX_BYTES) -> str:
    """Return the text of a document; raises OSError, or ValueError if it is no UTF-8 or longer than any document."""
    with path.open("rb") as file:
        data = file.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise ValueError(f"more than {max_bytes >> 20} MiB")
    return data.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")


def _oddity(document: object) -> str:
    """Return the feature that makes a document unacceptable, for example too deep nesting; empty without one."""
    if not isinstance(document, dict):
        return f"a {type(document).__name__} instead of named entries"
    level: list[object] = [document]
    for _ in range(MAX_DEPTH):
        if any(isinstance(value, int) and value not in _WHOLE for value in level):
            return "a whole number of more than 64 bits"
        if dates := [value for value in level if isinstance(value, dt.date | dt.time)]:
            return f"a date or time without quotes: {dates[0]}"
        parts = (v.values() if isinstance(v, dict) else v for v in level if isinstance(v, dict | list))
        level = [value for part in parts for value in part]
        if not level:
            return ""
    return "tables or lists that are nested too deeply"


def validated(
    model: type[ModelT], raw: object, where: object, error: type[PdhefError], *, expected: str, remedy: str = ""
) -> ModelT:
    """Return the record of a parsed document.

    Parameters
    ----------
    model : pydantic model or dataclass that forbids extra entries.

    Raises
    ------
    PdhefError
        Of class ``error``: entries are wrong, missing, unknown or contradict one another; all are named.
    """
    problems: list[str] = []
    record = checked(model, raw, "", problems)
    if record is None:
        raise error(expected=expected, got="; ".join(problems), where=where, remedy=remedy)
    return record


def checked(model: type[ModelT], raw: object, table: str, problems: list[str]) -> ModelT | None:
    """Return the record of a parsed table at ``table`` in its document; None after adding to ``problems``."""
    from pydantic import ValidationError

    try:
        # As JSON, whose lists are tuples and whose texts are paths to a strict model, too.
        record: ModelT = model.__pydantic_validator__.validate_json(json.dumps(raw, default=str))  # type: ignore[attr-defined]
    except ValidationError as error:
        problems += _problems(error, model, raw, table)
        return None
    return record


def unknown(name: str, names: Iterable[str], table: str = "") -> str:
    """Return the message for an unknown entry ``name`` of a table, with the most similar of the known ``names``."""
    return f"{_at(table, name)}: {_unknown(name, names, table)}"


def _unknown(name: str, names: Iterable[str], table: str) -> str:
    names = tuple(names)
    # The start of a name, such as "ay" of "ay_m_s2", is a better match than a name with similar letters.
    near = [k for k in names if name and k.startswith(name)] or get_close_matches(name, names, n=1, cutoff=0.4)
    if near:
        return f"unknown, did you mean {_at(table, near[0])}?"
    return "unknown" + (f", known are {', '.join(names)}" if 0 < len(names) <= 12 else "")


def one_of(names: Iterable[str]) -> "AfterValidator":
    """Return the check that a text, for instance a key, is one of ``names``; the error names the most similar one."""
    from pydantic import AfterValidator
    from pydantic_core import PydanticCustomError

    allowed = tuple(names)

    def check(name: str) -> str:
        if name not in allowed:
            raise PydanticCustomError("unknown_name", "should be one of {names}", {"names": allowed})
        return name

    return AfterValidator(check)


def _at(table: str, name: str) -> str:
    return f"{table}.{name}" if table and name else table or name or "file"


def _problems(error: "ValidationError", model: type, raw: object, table: str) -> list[str]:
    texts_by_entry: dict[str, list[str]] = {}
    for e in error.errors(include_url=False, include_input=False):
        place, value = _place(e["loc"], raw, missing=e["type"].startswith("missing"))
        entry = _at(table, ".".join(place))
        if e["type"] in ("extra_forbidden", "unexpected_keyword_argument", "unknown_name"):
            names = e["ctx"]["names"] if e["type"] == "unknown_name" else _entries(model, place[:-1])
            text = _unknown(place[-1], names, ".".join(p for p in (table, *place[:-1]) if p))
        elif e["type"].startswith("missing"):
            text = "is missing"
        else:
            text = e["msg"].removeprefix("Value error, ")
            for pydantic, ours in (("Input should", "should"), ("a valid array", "a list"), ("an object", "a table")):
                text = text.replace(pydantic, ours)
            # The message of a table names its entries.
            text += f", got {value!r:.60}" if isinstance(value, str | int | float) else ""
        texts_by_entry.setdefault(entry, []).append(text)
    # A union reports one message an alternative; together they are one problem.
    return [f"{entry}: {' or '.join(dict.fromkeys(texts))}" for entry, texts in texts_by_entry.items()]


def _place(loc: tuple[int | str, ...], raw: object, *, missing: bool) -> tuple[list[str], object]:
    """Return the keys of pydantic's ``loc`` that are the document's, without a union's alternatives, and the value."""
    place = []
    for part in loc:
        if isinstance(raw, Mapping) and (part in raw or (missing and part == loc[-1])):
            raw = raw.get(part)
        elif isinstance(raw, list | tuple) and isinstance(part, int) and part < len(raw):
            raw = raw[part]
        else:
            continue
        place.append(str(part))
    return place, raw


def _entries(annotation: Any, place: Sequence[str]) -> tuple[str, ...]:
    """Return the entry names of a model's table at a place."""
    fields = getattr(annotation, "__pydantic_fields__", None)
    if fields is not None:
        if not place:
            return tuple(fields)
        return _entries(fields[place[0]].annotation, place[1:]) if place[0] in fields else ()
    if isinstance(annotation, type) and is_dataclass(annotation):
        return () if place else tuple(annotation.__dataclass_fields__)
    # The items of a container are one level deeper, the alternatives of a union on the same level.
    inner = place[1:] if get_origin(annotation) in (dict, list, tuple) else place
    return next((names for member in get_args(annotation) if (names := _entries(member, inner))), ())


def jsonable(value: Any) -> Any:
    """Turn records, mappings, sequences, numpy values and paths into JSON values; NaN and infinity become None.

    Raises
    ------
    TypeError
        For anything else.
    """
    if isinstance(value, str):  # in order of how many there are in a report
        return utf8(value)
    if value is None or isinstance(value, int):
        return value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict) or (not isinstance(value, list | tuple) and isinstance(value, Mapping)):  # ABCs are slow
        return {utf8(str(k)): jsonable(v) for k, v in value.items()}
    if isinstance(value, set | frozenset):
        value = sorted(value)
    if isinstance(value, (list, tuple, Sequence)):
        return [jsonable(v) for v in value]
    if isinstance(value, PurePath):
        return utf8(str(value))
    if hasattr(value, "model_dump"):  # of pydantic
        return jsonable(value.model_dump())
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: jsonable(getattr(value, f.name)) for f in fields(value)}
    import numpy as np

    if isinstance(value, np.generic | np.ndarray):
        return jsonable(value.tolist())
    raise TypeError(f"no JSON form of {type(value).__name__}")


def digest(document: Any) -> str:
    """Return the sha256 of a JSON-able value; it does not depend on the order of keys."""
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
