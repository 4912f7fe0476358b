"""TOML documents of nested mappings, lists, numbers and strings."""

import json
import re
from collections.abc import Iterator, Mapping
from typing import Any


def toml_text(entries: Mapping[str, Any], head: str = "") -> str:
    """Return entries as TOML with the lines of ``head`` as comments above.

    A table contains plain entries first, then lists with an item per line, then tables; otherwise the order is kept.
    """
    lines = [f"# {line}".rstrip() for line in head.splitlines()]
    return "\n".join([*lines, *_table((), entries)]).lstrip("\n") + "\n"


def _table(name: tuple[str, ...], entries: Mapping[str, Any]) -> Iterator[str]:
    plain = {k: v for k, v in entries.items() if not isinstance(v, Mapping)}
    if name and (plain or not entries):
        yield ""
        yield f"[{'.'.join(map(_key, name))}]"
    for key, value in sorted(plain.items(), key=lambda item: _has_lines(item[1])):
        items = "".join(f"    {toml_value(v)},\n" for v in value) if _has_lines(value) else ""
        yield f"{_key(key)} = " + (f"[\n{items}]" if items else toml_value(value))
    for key, value in entries.items():
        if isinstance(value, Mapping):
            yield from _table((*name, key), value)


def _has_lines(value: Any) -> bool:
    return isinstance(value, list) and any(isinstance(item, Mapping | str) for item in value)


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else toml_value(key)


def toml_value(value: Any) -> str:
    """Return a value in one line of TOML. Raises TypeError for anything but mappings, lists, texts and numbers."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(k)} = {toml_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, int | float):
        return repr(value if isinstance(value, int) else float(value))  # numpy's repr names its type
    raise TypeError(f"TOML has no {type(value).__name__}")
