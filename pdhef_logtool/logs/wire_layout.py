"""Byte layouts of CDR and ROS 1 messages whose strings and sequences have known lengths.

Such a message is one record of fixed size, so that N of them are one structured NumPy array: read and written
column by column instead of message by message. Alignment follows CDR version 1: every primitive is aligned to its
size counted from after the 4-byte encapsulation header. ROS 1 packs without alignment.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.message_schema import Array, Node, Scalar, Step, Struct, Unknown

#: Arrays of structs (or of texts) are unrolled up to this many elements.
UNROLLED_ELEMENTS = 64

_CDR_HEAD = np.dtype("<u2")
_LITTLE_ENDIAN_CDR = 0x0100  # the bytes 0, 1
_WORD = np.dtype("<u4")

Steps: TypeAlias = tuple[Step, ...]


class NoLayoutError(Exception):
    """The type, or this message, has no layout that can be handled as a record."""


@dataclass(frozen=True, slots=True)
class Leaf:
    """A primitive or an array of primitives at a byte offset; ``count`` is None for a single value."""

    offset: int
    dtype: np.dtype[Any]
    count: int | None


@dataclass(frozen=True, slots=True)
class WireLayout:
    """Where every leaf of a message lies.

    Attributes
    ----------
    size : bytes of one message, encapsulation header included.
    leaves : by their steps; arrays of primitives as one leaf.
    guards : (offset, uint32) in wire order: lengths of strings and sequences, which hold for this layout only.
    texts : (offset, length without terminator) of every string, by its steps.
    """

    size: int
    leaves: Mapping[Steps, Leaf]
    guards: tuple[tuple[int, int], ...]
    texts: Mapping[Steps, tuple[int, int]]


#: Tells the length word of the string or sequence at these steps, whose length word lies at this offset.
LengthOf: TypeAlias = Callable[[Steps, int, bool], int]


def layout_of_message(root: Node, wire: str, message: bytes) -> WireLayout:
    """Build the layout that one received message has; raises :class:`NoLayoutError`."""
    if wire == "cdr" and message[:2] != b"\x00\x01":
        raise NoLayoutError("only little-endian CDR version 1 has a layout here")

    def length_of(steps: Steps, offset: int, is_text: bool) -> int:
        del steps, is_text
        try:
            (length,) = struct.unpack_from("<I", message, offset)
        except struct.error as error:
            raise NoLayoutError("the message ends early") from error
        if length > len(message):
            raise NoLayoutError("a length exceeds the message")
        return int(length)

    layout = build_layout(root, wire, length_of)
    if layout.size > len(message):
        raise NoLayoutError("the message ends early")
    return layout


def build_layout(root: Node, wire: str, length_of: LengthOf) -> WireLayout:
    """Lay out a message type whose variable lengths ``length_of`` tells; raises :class:`NoLayoutError`."""
    builder = _Builder(wire, length_of)
    builder.place(root, ())
    return WireLayout(builder.at, builder.leaves, tuple(builder.guards), builder.texts)


class _Builder:
    def __init__(self, wire: str, length_of: LengthOf) -> None:
        self.aligned = wire == "cdr"
        self.origin = 4 if self.aligned else 0
        self.at = self.origin
        self.length_of = length_of
        self.leaves: dict[Steps, Leaf] = {}
        self.guards: list[tuple[int, int]] = []
        self.texts: dict[Steps, tuple[int, int]] = {}

    def align(self, size: int) -> None:
        if self.aligned:
            self.at += -(self.at - self.origin) % size

    def length_word(self, steps: Steps, is_text: bool) -> int:
        self.align(4)
        length = self.length_of(steps, self.at, is_text)
        self.guards.append((self.at, length))
        self.at += 4
        return length

    def place(self, node: Node, steps: Steps) -> None:
        if isinstance(node, Struct):
            for name, member in node.members.items():
                self.place(member, (*steps, name))
        elif isinstance(node, Array):
            count = node.length if node.length is not None else self.length_word(steps, False)
            self.place_items(node.item, steps, count)
        elif isinstance(node, Unknown):
            raise NoLayoutError("the type is not known in full")
        elif node.kind == "string":
            self.place_text(node, steps)
        else:
            self.place_numbers(node, steps, None)

    def place_text(self, node: Scalar, steps: Steps) -> None:
        if node.code:
            raise NoLayoutError("wide strings have no layout here")
        length = self.length_word(steps, True)
        self.texts[steps] = (self.at, max(length - 1, 0) if self.aligned else length)
        self.at += length

    def place_items(self, item: Node, steps: Steps, count: int) -> None:
        if isinstance(item, Scalar) and item.kind != "string":
            self.place_numbers(item, steps, count)
            return
        if count > UNROLLED_ELEMENTS:
            raise NoLayoutError("too many elements to unroll")
        for i in range(count):
            self.place(item, (*steps, i))

    def place_numbers(self, node: Scalar, steps: Steps, count: int | None) -> None:
        dtype = np.dtype("<" + node.code)
        if count != 0:
            self.align(dtype.itemsize)
        self.leaves[steps] = Leaf(self.at, dtype, count)
        self.at += dtype.itemsize * (1 if count is None else count)


def matches(layout: WireLayout, buffer: bytes | memoryview, offset: NDArray[np.int64], wire: str) -> NDArray[np.bool_]:
    """Tell which messages at these offsets [N] have this layout; all of them hold ``layout.size`` bytes."""
    fits = np.ones(len(offset), dtype=np.bool_)
    if wire == "cdr":
        fits &= _gather(buffer, offset, 0, _CDR_HEAD) == _LITTLE_ENDIAN_CDR
    for at, expected in layout.guards:
        fits &= _gather(buffer, offset, at, _WORD) == expected
    return fits


def leaf_values(
    layout: WireLayout, buffer: bytes | memoryview, offset: NDArray[np.int64], steps: Sequence[Step]
) -> NDArray[Any] | None:
    """Return the values [N] or [N, k] at these steps, in their own type; None where this layout has no such place."""
    key = tuple(steps)
    leaf = layout.leaves.get(key)
    if leaf is None and key and isinstance(key[-1], int):
        whole, index = layout.leaves.get(key[:-1]), key[-1]
        if whole is None or whole.count is None or index >= whole.count:
            return None
        return _gather(buffer, offset, whole.offset + index * whole.dtype.itemsize, whole.dtype)
    if leaf is None:
        return None
    if leaf.count is None:
        return _gather(buffer, offset, leaf.offset, leaf.dtype)
    if leaf.count == 0:
        return np.empty((len(offset), 0), dtype=leaf.dtype)
    row = np.dtype((np.void, leaf.dtype.itemsize * leaf.count))
    return _gather(buffer, offset, leaf.offset, row).view(leaf.dtype).reshape(len(offset), leaf.count)


def _gather(buffer: bytes | memoryview, offset: NDArray[np.int64], at: int, dtype: np.dtype[Any]) -> NDArray[Any]:
    """Copy what lies ``at`` bytes behind each offset, as an array [N]."""
    if offset.size == 0:
        return np.empty(0, dtype=dtype)
    # An overlapping item at every byte: indexing then copies items. As plain bytes, which need no alignment.
    item = np.dtype((np.void, dtype.itemsize))
    places = len(buffer) - at - dtype.itemsize + 1
    return np.ndarray((places,), dtype=item, buffer=buffer, offset=at, strides=(1,))[offset].view(dtype)
