"""Byte layouts of CDR and ROS 1 messages with strings and sequences of known lengths; columns to CDR messages.

Such a message is one record of fixed size, so that N of them are one structured NumPy array: read and written
column by column instead of message by message. Alignment follows CDR version 1: every primitive is aligned to its
size counted from after the 4-byte encapsulation header. ROS 1 packs without alignment.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs import message_schema as schemas
from pdhef_logtool.logs.container import items_at_bytes
from pdhef_logtool.records.errors import MappingError
from pdhef_logtool.records.signals import NS_PER_S

#: Arrays of structs (or of texts) are unrolled up to this many elements.
UNROLLED_ELEMENTS = 64
#: Leaves and structs of one layout.
_MOST_PLACES = 1 << 16

_CDR_HEAD = np.dtype("<u2")
_LITTLE_ENDIAN_CDR = 0x0100  # the bytes 0, 1
_WORD = np.dtype("<u4")

Steps: TypeAlias = tuple[schemas.Step, ...]


class NoLayoutError(Exception):
    """The type, or this message, has no layout that can be handled as a record."""


@dataclass(frozen=True, slots=True)
class Leaf:
    """A primitive or an array of primitives at a byte offset; ``count`` is None for a single value."""

    offset: int
    dtype: np.dtype[Any]
    count: int | None


class WireLayout:
    """Offsets of all leaves of a message type in messages with the variable lengths of one message.

    Attributes
    ----------
    size : bytes of one message, encapsulation header included.
    leaves : by their steps; arrays of primitives as one leaf.
    lengths : (offset, uint32) in wire order: lengths of strings and sequences, which identify this layout.

    Raises
    ------
    NoLayoutError : the message has no layout, or ends early.
    """

    def __init__(self, root: schemas.Node, wire: str, message: bytes) -> None:
        self._aligned, self._message = wire == "cdr", message
        if self._aligned and message[:2] != b"\x00\x01":
            raise NoLayoutError("only little-endian CDR version 1 has a layout here")
        self._origin = 4 if self._aligned else 0
        self.size = self._origin
        self._places = 0
        self.leaves: dict[Steps, Leaf] = {}
        self.lengths: list[tuple[int, int]] = []
        self._place(root, ())
        if self.size > len(message):
            raise NoLayoutError("the message ends early")

    def _align(self, size: int) -> None:
        if self._aligned:
            self.size += -(self.size - self._origin) % size

    def _length_word(self) -> int:
        self._align(_WORD.itemsize)
        length = int.from_bytes(self._message[self.size : self.size + _WORD.itemsize], "little")
        if length > len(self._message):
            raise NoLayoutError("a length exceeds the message")
        self.lengths.append((self.size, length))
        self.size += _WORD.itemsize
        return length

    def _place(self, node: schemas.Node, steps: Steps) -> None:
        # Arrays in arrays multiply.
        self._places += 1
        if self.size > len(self._message) or self._places > _MOST_PLACES:
            raise NoLayoutError("the message ends early, or it has too many places")
        if isinstance(node, schemas.Struct):
            for name, member in node.members.items():
                self._place(member, (*steps, name))
        elif isinstance(node, schemas.Array):
            count = self._length_word() if node.length is None else node.length
            if isinstance(node.item, schemas.Scalar) and node.item.kind != "string":
                self._place_numbers(node.item, steps, count)
            elif count > UNROLLED_ELEMENTS:
                raise NoLayoutError("too many elements to unroll")
            else:
                for i in range(count):
                    self._place(node.item, (*steps, i))
        elif isinstance(node, schemas.Unknown) or (node.code and node.kind == "string"):
            raise NoLayoutError("open places and wide strings have no layout here")
        elif node.kind == "string":
            length = self._length_word()
            self.size += length
        else:
            self._place_numbers(node, steps, None)

    def _place_numbers(self, node: schemas.Scalar, steps: Steps, count: int | None) -> None:
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
        self._expected: dict[str, int] = {}
        places: dict[str, tuple[int, np.dtype[Any]]] = {}
        if wire == "cdr":
            places["head"], self._expected["head"] = (0, _CDR_HEAD), _LITTLE_ENDIAN_CDR
        for offset, length in layout.lengths:
            name = f"length{offset}"
            places[name], self._expected[name] = (offset, _WORD), length
        for steps in wanted:
            leaf = leaf_at(layout, steps)
            if leaf is not None:
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
        return records[self._names[steps]] if steps in self._names else None


def leaf_at(layout: WireLayout, steps: Steps) -> Leaf | None:
    """Return the leaf at these steps, be it an element of an array of primitives."""
    leaf = layout.leaves.get(steps)
    if leaf is not None or not steps or not isinstance(steps[-1], int):
        return leaf
    whole = layout.leaves.get(steps[:-1])
    if whole is None or whole.count is None or steps[-1] >= whole.count:
        return None
    return Leaf(whole.offset + steps[-1] * whole.dtype.itemsize, whole.dtype, None)


class CdrEncoder:
    """Encodes the messages of one topic.

    Parameters
    ----------
    topic, type_name : topic and ROS 2 type.
    definition : ros2msg text with all contained types.
    constants : constant fields of every message, by path: a text, a number, or an array. Unset texts and sequences
        are empty, unset numbers are zero.

    Raises
    ------
    MappingError : the definition does not parse.
    """

    def __init__(
        self, topic: str, type_name: str, definition: str, constants: Mapping[str, str | float | Sequence[float]]
    ) -> None:
        self.topic = topic
        try:
            self.schema: schemas.MessageSchema = schemas.ros_schema(type_name, "ros2msg", definition, "cdr")
        except schemas.SchemaError as error:
            raise MappingError(expected=f"a definition of {type_name}", got=str(error), where=topic) from error
        self._texts: dict[Steps, str] = {}
        self._numbers: dict[str, NDArray[np.float64]] = {}
        for path, value in constants.items():
            if isinstance(value, str):
                self._texts[schemas.parse_path(path)] = value
            else:
                self._numbers[path] = np.asarray(value, dtype=np.float64)
        self._layouts: dict[tuple[tuple[Steps, int], ...], tuple[WireLayout, bytes]] = {}

    def encode(self, n: int, fields: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
        """Return N messages as uint8 [N, size].

        Parameters
        ----------
        n : number of messages.
        fields : columns by path: [N] for a number, a bool or a time (int64 nanoseconds); [N, k] for an array or a
            vector struct (x, y, z; for a quaternion w, x, y, z).

        Raises
        ------
        MappingError : a path is not in the type.
        """
        columns = {path: np.broadcast_to(value, (n, *value.shape)) for path, value in self._numbers.items()}
        columns |= {path: np.asarray(values) for path, values in fields.items()}
        layout, template = self._layout({path: v.shape[1] for path, v in columns.items() if v.ndim == 2})
        rows = np.empty((n, layout.size), dtype=np.uint8)
        rows[:] = np.frombuffer(template, dtype=np.uint8)
        for path, values in columns.items():
            self._put(layout, rows, path, values)
        return rows

    def _layout(self, widths: Mapping[str, int]) -> tuple[WireLayout, bytes]:
        """Return the layout for these array widths and a message with only the constants."""
        lengths: dict[Steps, int] = {}
        for path, width in widths.items():
            selection = schemas.resolve(self.schema, self.topic, path)
            if selection.shape == "array" and selection.length is None:
                lengths[selection.components[0]] = width
        key = tuple(sorted(lengths.items(), key=repr))
        if key not in self._layouts:
            constant = self._constant(self.schema.root, (), lengths)
            message = bytes(self.schema.store.serialize_cdr(constant, self.schema.type_name))
            layout = WireLayout(self.schema.root, "cdr", message)
            self._layouts[key] = layout, message[: layout.size]
        return self._layouts[key]

    def _constant(self, node: schemas.Node, steps: Steps, lengths: Mapping[Steps, int]) -> Any:
        """Return a message, or a part of it, with constant texts, arrays of the given lengths, and zeros."""
        if isinstance(node, schemas.Struct):
            members = {name: self._constant(member, (*steps, name), lengths) for name, member in node.members.items()}
            return SimpleNamespace(**({schemas.NO_MEMBERS: 0} | members))
        if isinstance(node, schemas.Array):
            count = lengths.get(steps, 0) if node.length is None else node.length
            if isinstance(node.item, schemas.Scalar) and node.item.kind != "string":
                return np.zeros(count, node.item.code)
            return [self._constant(node.item, (*steps, i), lengths) for i in range(count)]
        return self._texts.get(steps, "") if isinstance(node, schemas.Scalar) and node.kind == "string" else 0

    def _put(self, layout: WireLayout, rows: NDArray[np.uint8], path: str, values: NDArray[Any]) -> None:
        selection = schemas.resolve(self.schema, self.topic, path)
        parts: Sequence[NDArray[Any]] = (values,)
        if selection.shape == "time":
            parts = np.divmod(values, NS_PER_S)
        elif selection.shape == "vector":
            parts = tuple(values.T)
        for steps, part in zip(selection.components, parts, strict=True):
            leaf = leaf_at(layout, steps)
            assert leaf is not None
            kind = np.dtype((leaf.dtype, () if leaf.count is None else (leaf.count,)))
            place = np.dtype({"names": ["leaf"], "formats": [kind], "offsets": [leaf.offset], "itemsize": layout.size})
            is_rounded = leaf.dtype.kind in "iu" and part.dtype.kind == "f"
            # Many times faster than byte by byte.
            rows.view(place)["leaf"][:, 0] = np.rint(part) if is_rounded else part
