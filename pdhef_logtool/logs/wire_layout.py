"""Byte layouts of CDR and ROS 1 messages with strings and sequences of known lengths.

Such a message is one record of fixed size, so that N of them are one structured NumPy array: read and written
column by column instead of message by message. Alignment follows CDR version 1: every primitive is aligned to its
size counted from after the 4-byte encapsulation header. ROS 1 packs without alignment.
"""

from __future__ import annotations

import struct
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.container import items_at_bytes
from pdhef_logtool.logs.message_schema import Array, Node, Scalar, Step, Struct, Unknown

#: Arrays of structs (or of texts) are unrolled up to this many elements.
UNROLLED_ELEMENTS = 64
#: Leaves and structs of one layout.
_MOST_PLACES = 1 << 16

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


#: Returns the length of the string or sequence at these steps, with its length word at this offset.
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

    return WireLayout(root, wire, length_of, len(message))


class WireLayout:
    """Offsets of all leaves of a message type with the variable lengths of ``length_of``.

    Attributes
    ----------
    size : bytes of one message, encapsulation header included.
    leaves : by their steps; arrays of primitives as one leaf.
    lengths : (offset, uint32) in wire order: lengths of strings and sequences, which identify this layout.
    texts : (offset, length without terminator) of every string, by its steps.

    Raises
    ------
    NoLayoutError : it has none, or is longer than ``end`` bytes.
    """

    def __init__(self, root: Node, wire: str, length_of: LengthOf, end: int = sys.maxsize) -> None:
        self._aligned = wire == "cdr"
        self._origin = 4 if self._aligned else 0
        self.size = self._origin
        self._length_of = length_of
        self._end = end
        self._places = 0
        self.leaves: dict[Steps, Leaf] = {}
        self.lengths: list[tuple[int, int]] = []
        self.texts: dict[Steps, tuple[int, int]] = {}
        self._place(root, ())
        if self.size > self._end:
            raise NoLayoutError("the message ends early")

    def _align(self, size: int) -> None:
        if self._aligned:
            self.size += -(self.size - self._origin) % size

    def _length_word(self, steps: Steps, is_text: bool) -> int:
        self._align(4)
        length = self._length_of(steps, self.size, is_text)
        self.lengths.append((self.size, length))
        self.size += 4
        return length

    def _place(self, node: Node, steps: Steps) -> None:
        # Arrays in arrays multiply.
        self._places += 1
        if self.size > self._end or self._places > _MOST_PLACES:
            raise NoLayoutError("the message ends early" if self.size > self._end else "too many places")
        if isinstance(node, Struct):
            for name, member in node.members.items():
                self._place(member, (*steps, name))
        elif isinstance(node, Array):
            count = node.length if node.length is not None else self._length_word(steps, False)
            self._place_items(node.item, steps, count)
        elif isinstance(node, Unknown):
            raise NoLayoutError("the type is not known in full")
        elif node.kind == "string":
            self._place_text(node, steps)
        else:
            self._place_numbers(node, steps, None)

    def _place_text(self, node: Scalar, steps: Steps) -> None:
        if node.code:
            raise NoLayoutError("wide strings have no layout here")
        length = self._length_word(steps, True)
        self.texts[steps] = (self.size, max(length - 1, 0) if self._aligned else length)
        self.size += length

    def _place_items(self, item: Node, steps: Steps, count: int) -> None:
        if isinstance(item, Scalar) and item.kind != "string":
            self._place_numbers(item, steps, count)
            return
        if count > UNROLLED_ELEMENTS:
            raise NoLayoutError("too many elements to unroll")
        for i in range(count):
            self._place(item, (*steps, i))

    def _place_numbers(self, node: Scalar, steps: Steps, count: int | None) -> None:
        dtype = np.dtype("<" + node.code)
        if count != 0:
            self._align(dtype.itemsize)
        self.leaves[steps] = Leaf(self.size, dtype, count)
        self.size += dtype.itemsize * (1 if count is None else count)


class LayoutReader:
    """Reads chosen leaves of the messages that have one layout.

    The places needed (leaves, and the lengths that identify the layout) are gathered by one copy per message.

    Parameters
    ----------
    layout : the layout. wire : ``cdr`` or ``ros1``.
    wanted : steps of the leaves to read; those absent from the layout are left out.
    """

    def __init__(self, layout: WireLayout, wire: str, wanted: Iterable[Steps]) -> None:
        self.size = layout.size
        self._names: dict[Steps, str] = {}
        self._empty: dict[Steps, np.dtype[Any]] = {}
        self._expected: dict[str, int] = {}
        places: dict[str, tuple[int, np.dtype[Any]]] = {}
        if wire == "cdr":
            places["head"], self._expected["head"] = (0, _CDR_HEAD), _LITTLE_ENDIAN_CDR
        for offset, length in layout.lengths:
            name = f"length{offset}"
            places[name], self._expected[name] = (offset, _WORD), length
        for steps in wanted:
            leaf = leaf_at(layout, steps)
            if leaf is not None and leaf.count == 0:
                self._empty[steps] = leaf.dtype
            elif leaf is not None:
                name = self._names[steps] = f"leaf{len(self._names)}"
                places[name] = leaf.offset, leaf.dtype if leaf.count is None else np.dtype((leaf.dtype, (leaf.count,)))
        offsets, formats = zip(*places.values(), strict=True) if places else ((), ())
        self._start = min(offsets, default=0)
        end = max((offset + dtype.itemsize for offset, dtype in places.values()), default=0)
        self._record = np.dtype(
            {
                "names": [*places],
                "formats": [*formats],
                "offsets": [offset - self._start for offset in offsets],
                "itemsize": end - self._start,
            }
        )

    def gather(
        self, buffer: bytes | memoryview, offset: NDArray[np.int64]
    ) -> tuple[NDArray[np.bool_] | None, NDArray[Any]]:
        """Gather the messages of ``size`` bytes at these offsets [N].

        Returns
        -------
        fits : which of them have the layout [N]; None: all. records : those that have it, for :meth:`values`.
        """
        if not self._record.itemsize:
            return None, np.empty(len(offset), self._record)
        records = items_at_bytes(buffer, self._record.itemsize, self._start)[offset].view(self._record)
        fits = np.ones(len(offset), np.bool_)
        for name, expected in self._expected.items():
            fits &= records[name] == expected
        return (None, records) if fits.all() else (fits, records[fits])

    def values(self, records: NDArray[Any], steps: Steps) -> NDArray[Any] | None:
        """Return a leaf of N gathered messages, [N] or [N, k] in its own type; None if the layout lacks it."""
        if steps in self._names:
            values: NDArray[Any] = records[self._names[steps]]
            return values
        return np.empty((len(records), 0), dtype=self._empty[steps]) if steps in self._empty else None


def leaf_at(layout: WireLayout, steps: Steps) -> Leaf | None:
    """Return the leaf at these steps, be it an element of an array of primitives."""
    leaf = layout.leaves.get(steps)
    if leaf is not None or not steps or not isinstance(steps[-1], int):
        return leaf
    whole = layout.leaves.get(steps[:-1])
    if whole is None or whole.count is None or steps[-1] >= whole.count:
        return None
    return Leaf(whole.offset + steps[-1] * whole.dtype.itemsize, whole.dtype, None)
