"""Entries that the modules of a package register in a list, such as its checks or metrics."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import import_module
from types import MappingProxyType
from typing import Any


@cache
def load_entries(package: str, modules: tuple[str, ...], attribute: str) -> Mapping[str, Any]:
    """Return the entries in the list ``attribute`` of each module by name; modules are imported at the first call."""
    entries: dict[str, Any] = {}
    for module in modules:
        for entry in getattr(import_module(f"{package}.{module}"), attribute):
            if entry.name in entries:
                raise ValueError(f"{attribute}: {entry.name!r} of {module}.py is registered twice")
            entries[entry.name] = entry
    return MappingProxyType(entries)
