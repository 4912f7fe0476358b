"""The files of ``schemas/``: message definitions and JSON documents that are shipped with the package."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from functools import cache
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Any

_MESSAGE_SEPARATOR = "=" * 80
#: A type name in ROS 2 form: it may come from a log, and becomes a path.
_TYPE_NAME = re.compile(r"[A-Za-z]\w*/(msg|srv|action)/[A-Za-z]\w*", re.ASCII)


def schema_file(name: str) -> Traversable:
    """Return a file of ``schemas/`` by its relative name, in an installed package or in a source tree."""
    shipped = files("pdhef_logtool").joinpath("schemas", name)
    return shipped if shipped.is_file() else Path(__file__).parents[2] / "schemas" / name


@cache
def shipped_definition(type_name: str) -> str:
    """Return the text of a shipped type without the types it contains, or an empty string."""
    if not _TYPE_NAME.fullmatch(type_name):
        return ""
    file = schema_file(f"{type_name}.msg")
    return file.read_text(encoding="utf-8") if file.is_file() else ""


@cache
def message_definition(type_name: str) -> str:
    """Return the ros2msg text of a message type with all types it contains.

    Own types (``pdhef_msgs``) come from ``schemas/``, common ROS 2 types from the latest distribution.

    Parameters
    ----------
    type_name : in ROS 2 form, for example ``sensor_msgs/msg/Imu``.

    Raises
    ------
    KeyError : the type is in neither, or the name is invalid.
    """
    if not _TYPE_NAME.fullmatch(type_name):
        raise KeyError(type_name)
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.LATEST)
    shipped = schema_file(f"{type_name}.msg")
    if shipped.is_file():
        text = shipped.read_text(encoding="utf-8")
        types = get_types_from_msg(text, type_name)
        store.register(with_contained_types(types, store.fielddefs, shipped_definition))
        generated = store.generate_msgdef(type_name, ros_version=2)[0]
        # Keep the comments of the shipped text: they contain the units.
        _, separator, rest = generated.partition(_MESSAGE_SEPARATOR)
        return text.rstrip("\n") + "\n" + separator + rest
    if type_name not in store.fielddefs:
        raise KeyError(type_name)
    return store.generate_msgdef(type_name, ros_version=2)[0]


def with_contained_types(
    types: Mapping[str, Any], distributed: Mapping[str, Any], text_of: Callable[[str], str], wanted: str = ""
) -> dict[str, Any]:
    """Return types with all types that they contain, at any depth.

    Parameters
    ----------
    distributed : types of a distribution. text_of : returns the definition of any other type.
    wanted : name of a further type.
    """
    from rosbags.typesys import get_types_from_msg

    completed = dict(types)
    todo = ({wanted} if wanted else set()) | (referenced(types) - set(types))
    while todo:
        name = todo.pop()
        if name in distributed:
            completed[name] = distributed[name]
        else:
            completed |= get_types_from_msg(text_of(name), name)
        todo |= referenced({name: completed[name]}) - set(completed)
    return completed


def referenced(types: Mapping[str, Any]) -> set[str]:
    """Return the names of the types that types contain directly."""
    from rosbags.interfaces import Nodetype

    names: set[str] = set()
    for _, members in types.values():
        for _, (kind, args) in members:
            inner_kind, inner = (kind, args) if kind in (Nodetype.BASE, Nodetype.NAME) else args[0]
            if inner_kind == Nodetype.NAME:
                names.add(inner)
    return names
