"""Escaping of control characters in text from input files.

Names of topics, files and cars and the content of documents are third-party data: a terminal escape could hide a
warning, and a line break could fake one. All results and errors for users are escaped.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import PurePath
from typing import Any

#: The middle of longer texts is omitted.
MOST_SIGNS = 1000


def printable(text: object, most: int = MOST_SIGNS) -> str:
    r"""Return a text as one line of at most ``most`` characters; unprintable ones are escaped, ``\x1b``."""
    line = str(text)
    if not line.isprintable():
        line = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line)
    if len(line) > most:
        half = (most - 1) // 2
        line = f"{line[:half]}…{line[-half:]}"
    return line


def listed(names: Sequence[str], most: int = 5, count: int | None = None) -> str:
    """Return the first ``most`` names and the number of others, ``a, b and 3 more``, of ``count`` or of those given."""
    more = (len(names) if count is None else count) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def all_printable(value: Any) -> Any:
    """Return a copy of a record, a document or a list of them with all texts :func:`printable`."""
    if value is None or type(value) in (float, int, bool):  # in the order of their frequency in a report
        return value
    if type(value) is str:
        return printable(value)
    if isinstance(value, PurePath):
        return type(value)(printable(value))
    if isinstance(value, Mapping):
        return {all_printable(k): all_printable(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return type(value)(map(all_printable, value))
    if is_dataclass(value) and not isinstance(value, type):
        record = copy.copy(value)
        for f in fields(value):
            object.__setattr__(record, f.name, all_printable(getattr(value, f.name)))
        return record
    return value


def utf8(text: str) -> str:
    r"""Return a text that UTF-8 can encode: invalid bytes of a file name are escaped, ``\udcff``."""
    return text if text.isascii() else text.encode("utf-8", "backslashreplace").decode("utf-8")
