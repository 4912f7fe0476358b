"""The IDL text of a ROS type, parsed in time that grows with its length."""

from __future__ import annotations

import functools
import inspect
from typing import Any

from rosbags.typesys.base import make_typesdict
from rosbags.typesys.idl import IDLParser


class _QuickParser(IDLParser):
    """Parses every rule once a place, where the plain one takes a hundred times as long for each bracket.

    Products and shifts are refused: a few nested ones give a number that fills the memory, and the texts that ROS
    generates contain none.
    """

    def __init__(self, text: str) -> None:
        super().__init__(text)
        for name, rule in inspect.getmembers(self, inspect.ismethod):
            if list(inspect.signature(rule).parameters) == ["pos"]:
                setattr(self, name, functools.cache(rule))

    def shift_expr(self, pos: int) -> Any:
        return self.add_expr(pos)

    def mult_expr(self, pos: int) -> Any:
        return self.unary_expr(pos)


def idl_types(text: str) -> Any:
    """Return the types of an IDL text as rosbags has them; raises the errors of its parser."""
    return make_typesdict(_QuickParser(text).specification())
