"""Undecoded messages of one channel to columns of the fields asked for.

ROS messages are read as fixed-layout records as long as their strings and sequences keep their lengths, and one by
one through the rosbags deserialiser where they do not; JSON and protobuf messages are read one by one. A path is
resolved once per channel, never per message.

A quaternion struct (members x, y, z, w) read as a whole gives the columns w, x, y, z; x, y, z structs keep that order.
"""

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial as bind
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs import message_schema as schemas
from pdhef_logtool.logs.container import Block, ChannelRecord
from pdhef_logtool.logs.definitions import SHIPPED, Definitions
from pdhef_logtool.logs.resource_limits import DEFAULT_LIMITS, MIB, LimitError, ResourceLimits
from pdhef_logtool.logs.wire_layout import LayoutReader, NoLayoutError, WireLayout
from pdhef_logtool.records.signals import NS_PER_S, IntArray

#: Value of a time column if the message has no time (NaN of int64).
NO_TIME_NS = int(np.iinfo(np.int64).min)
#: Messages that are decoded singly at the same time.
_BYTES_AT_ONCE = 4 * MIB
_LAYOUTS_PER_CHANNEL = 8
#: An array has as many columns as its longest value: at most this many cells, or columns if there are many values.
_CELLS = 1 << 26
_COLUMNS = 64
#: Rows of messages that are decoded, with their columns by path.
_Parts: TypeAlias = list[tuple[IntArray, dict[str, NDArray[Any]]]]


def channel_schema(
    channel: ChannelRecord,
    distro: str = "",
    examples: Iterable[bytes] = (),
    limits: ResourceLimits = DEFAULT_LIMITS,
    definitions: Definitions = SHIPPED,
) -> schemas.MessageSchema:
    """Parse the schema of a channel.

    Parameters
    ----------
    channel : channel to decode.
    distro : ROS distribution for types without a definition.
    examples : first messages, for JSON without a complete schema.
    limits : resource limits of the schema.
    definitions : of ROS types that neither the channel nor the distribution has.

    Raises
    ------
    NoSchemaError : the encoding is not one that is decoded, or there is no schema.
    SchemaError : the schema does not parse, or it costs too much.
    """
    if channel.encoding in ("cdr", "ros1"):
        if channel.schema_encoding not in ("ros2msg", "ros2idl", "ros1msg", ""):
            raise schemas.NoSchemaError(f"{channel.encoding} messages with a {channel.schema_encoding!r} schema")
        text = channel.schema_data.decode("utf-8", errors="replace")
        if not channel.type_name:
            raise schemas.NoSchemaError("no type name")
        return schemas.ros_schema(
            channel.type_name, channel.schema_encoding, text, channel.encoding, distro, limits, definitions
        )
    if channel.encoding == "json":
        data = channel.schema_data if channel.schema_encoding == "jsonschema" else b""
        return schemas.json_schema(channel.type_name, data, examples, limits)
    if channel.encoding == "protobuf":
        if channel.schema_encoding != "protobuf":
            raise schemas.NoSchemaError(f"protobuf messages with a {channel.schema_encoding!r} schema")
        from pdhef_logtool.logs.protobuf_schema import protobuf_schema

        return protobuf_schema(channel.schema_name, channel.schema_data, limits)
    raise schemas.NoSchemaError(f"messages encoded as {channel.encoding!r} are not decoded")


@dataclass(slots=True)
class ChannelDecoder:
    """Decodes the messages of one channel for one set of paths.

    ``undecodable`` are the rows of the last block with a payload that does not fit their type (their fields are NaN).
    """

    schema: schemas.MessageSchema
    selections: tuple[schemas.Selection, ...]
    undecodable: list[int] = field(default_factory=list)
    _layouts: list[LayoutReader] = field(default_factory=list)

    def columns(self, block: Block, rows: IntArray) -> dict[str, NDArray[Any]]:
        """Decode the messages ``rows`` of a block: float64 [N] or [N, k], or int64 nanoseconds [N], by path."""
        self.undecodable = []
        partial: _Parts = []
        left = np.arange(len(rows))
        if self.schema.wire in ("cdr", "ros1"):
            left = self._read_records(block, rows, left, partial)
        if left.size or not partial:
            partial.append((left, self._read_singly(block, rows[left])))
        joined = {s.path: concatenate_columns([part[s.path] for _, part in partial]) for s in self.selections}
        order = np.concatenate([part_rows for part_rows, _ in partial])
        if np.all(order[1:] >= order[:-1]):
            return joined
        back = np.argsort(order, kind="stable")
        return {path: column[back] for path, column in joined.items()}

    def _read_records(self, block: Block, rows: IntArray, left: IntArray, partial: _Parts) -> IntArray:
        """Read messages of the first few layouts of the channel; return the other rows."""
        for number in range(_LAYOUTS_PER_CHANNEL):
            if not left.size:
                break
            if number == len(self._layouts):
                message = block.message(rows[left[0]])
                try:
                    layout = WireLayout(self.schema.root, self.schema.wire, message)
                    self._check_widths(layout, len(rows))
                except NoLayoutError:
                    break
                wanted = [steps for s in self.selections for steps in s.components]
                self._layouts.append(LayoutReader(layout, self.schema.wire, wanted))
            left = self._read_layout(self._layouts[number], block, rows, left, partial)
        return left

    def _check_widths(self, layout: WireLayout, n: int) -> None:
        """Refuse a layout with an array that has too many elements for N rows of columns."""
        most = min(self.schema.limits.array_width, _most_columns(n))
        selected = (layout.leaves.get(s.components[0]) for s in self.selections if s.shape == "array")
        if any((leaf.count or 0) > most for leaf in selected if leaf is not None):
            raise NoLayoutError("an array is too wide for columns")

    def _read_layout(
        self, layout: LayoutReader, block: Block, rows: IntArray, left: IntArray, partial: _Parts
    ) -> IntArray:
        """Read messages of this layout; return the other rows."""
        offset, length = block.offset[rows[left]], block.length[rows[left]]
        candidates = left
        if not (length == layout.size).all():
            # Up to three bytes of padding may follow a CDR message.
            surplus = length - layout.size
            sized = (surplus >= 0) & (surplus <= (3 if self.schema.wire == "cdr" else 0))
            candidates, offset = left[sized], offset[sized]
            if not candidates.size:
                return left
        fits, records = layout.gather(block.buffer, offset)
        read = candidates if fits is None else candidates[fits]
        if not read.size:
            return left
        leaves = {s.path: [layout.values(records, steps) for steps in s.components] for s in self.selections}
        partial.append((read, {s.path: _column(s, leaves[s.path], len(records)) for s in self.selections}))
        return left[:0] if len(read) == len(left) else np.setdiff1d(left, read, assume_unique=True)

    def _read_singly(self, block: Block, rows: IntArray) -> dict[str, NDArray[Any]]:
        decode = self.single_decoder()
        most = min(self.schema.limits.array_width, _most_columns(len(rows)))
        batch = np.cumsum(block.length[rows]) // _BYTES_AT_ONCE
        parts = []
        for its in np.split(rows, np.flatnonzero(np.diff(batch)) + 1):
            messages = [decode(block.message(row)) for row in its.tolist()]
            self.undecodable += [row for row, message in zip(its.tolist(), messages, strict=True) if message is None]
            parts.append({s.path: self._single_column(s, messages, its, most) for s in self.selections})
        return {s.path: concatenate_columns([part[s.path] for part in parts]) for s in self.selections}

    def _single_column(
        self, selection: schemas.Selection, messages: list[Any], rows: IntArray, most: int
    ) -> NDArray[Any]:
        """Return a column of decoded messages, the ``rows`` of a block; arrays have at most this many elements."""
        parts = [schemas.values_at(messages, steps) for steps in selection.components]
        if selection.shape == "array":
            arrays = [self._bounded(selection, *item, most) for item in zip(rows.tolist(), parts[0], strict=True)]
            return _padded(arrays, selection.length)
        columns = [np.array([_number(value) for value in part], np.float64) for part in parts]
        return _column(selection, columns, len(messages))

    def _bounded(self, selection: schemas.Selection, row: int, value: Any, most: int) -> NDArray[Any]:
        """Return the elements of an array; none if too wide."""
        elements = _numbers(schemas.bytes_of_text(value, selection.text) if selection.text else value)
        if len(elements) <= most:
            return elements
        self.undecodable.append(row)
        return elements[:0]

    def single_decoder(self) -> Callable[[bytes], object]:
        """Return a decoder of one message; it returns None if the payload does not fit the type or is too large."""
        schema, most = self.schema, _affordable_bytes(self.schema)
        decode: Callable[[bytes], object] = json.loads
        if schema.wire == "protobuf":
            decode = schema.message_class.FromString
        elif schema.wire != "json":
            decode = bind(getattr(schema.store, f"deserialize_{schema.wire}"), typename=schema.type_name)

        def tolerant(data: bytes) -> object:
            try:
                return decode(data) if len(data) <= most else None
            except Exception:  # noqa: BLE001 (third-party data and decoder)
                return None

        return tolerant


def _affordable_bytes(schema: schemas.MessageSchema) -> float:
    """Return the largest message for which decoded objects fit the memory: 100 bytes per field of a byte or two."""
    if schema.wire in ("cdr", "ros1") and not _contains_objects(schema.root):
        return math.inf
    return schema.limits.chunk_bytes / {"protobuf": 4, "json": 16}.get(schema.wire, 128)


def _contains_objects(node: schemas.Node) -> bool:
    """Return whether a type has arrays of objects."""
    if isinstance(node, schemas.Struct):
        return any(map(_contains_objects, node.members.values()))
    item = node.item if isinstance(node, schemas.Array) else None
    return (
        isinstance(item, schemas.Struct)
        or item == schemas.Scalar("string")
        or (item is not None and _contains_objects(item))
    )


def _most_columns(rows: int) -> int:
    """Return the largest number of columns for a number of rows."""
    return max(_COLUMNS, _CELLS // max(rows, 1))


def concatenate_columns(parts: Sequence[NDArray[Any]]) -> NDArray[Any]:
    """Join parts of one column; arrays of unequal width are filled up with NaN on the right.

    Raises
    ------
    LimitError : the arrays are too wide and too many for the memory.
    """
    filled = [p for p in parts if p.shape[0]] or list(parts[:1])
    if len(filled) == 1:
        return filled[0]
    width = max((p.shape[1] for p in filled if p.ndim == 2), default=None)
    if width is None:
        return np.concatenate(filled)
    rows = sum(p.shape[0] for p in filled)
    if width > _most_columns(rows):
        raise LimitError(
            expected=f"at most {_most_columns(rows)} elements in an array of {rows} messages",
            got=str(width),
            where="an array as columns",
            remedy="map single elements of it, such as data[0]",
        )
    joined, first = np.full((rows, width), np.nan), 0
    for part in filled:
        columns = part if part.ndim == 2 else part[:, None]
        joined[first : first + len(part), : columns.shape[1]] = columns
        first += len(part)
    return joined


def missing_column(selection: schemas.Selection, n: int) -> NDArray[Any]:
    """Return the column of a path that none of N messages has."""
    if selection.shape == "time":
        return np.full(n, NO_TIME_NS, dtype=np.int64)
    width = {"vector": len(selection.components), "array": selection.length or 0}.get(selection.shape)
    return np.full(n if width is None else (n, width), np.nan)


def _column(selection: schemas.Selection, parts: Sequence[NDArray[Any] | None], n: int) -> NDArray[Any]:
    """Return a column of N messages from its components, None for one that they lack."""
    if all(part is None for part in parts):
        return missing_column(selection, n)
    given = [np.full(n, np.nan) if part is None else part for part in parts]
    if selection.shape == "vector":
        return np.column_stack([part.astype(np.float64) for part in given])
    if selection.shape != "time":
        return given[0].astype(np.float64)
    seconds, nanoseconds = given
    is_time = np.abs(seconds * float(NS_PER_S) + nanoseconds) < -float(NO_TIME_NS)
    with np.errstate(invalid="ignore"):
        total = seconds.astype(np.int64) * NS_PER_S + nanoseconds.astype(np.int64)
    return np.where(is_time, total, NO_TIME_NS)


def _number(value: object) -> float:
    if isinstance(value, (bool, int, float, np.number, np.bool_)):
        try:
            return float(value)
        except OverflowError:
            return math.inf
    return math.nan


def _numbers(value: object) -> NDArray[Any]:
    """Return the elements of an array, none of anything else."""
    if isinstance(value, np.ndarray):
        return value
    elements = value if isinstance(value, Iterable) and not isinstance(value, str) else ()
    return np.array([_number(element) for element in elements], np.float64)


def _padded(rows: Sequence[NDArray[Any]], width: int | None) -> NDArray[np.float64]:
    """Return arrays as [N, k], filled up with NaN; k is the width of a fixed array, or that of the longest one."""
    k = max(map(len, rows), default=0) if width is None else width
    filled = np.full((len(rows), k), np.nan)
    for i, row in enumerate(rows):
        filled[i, : len(row)] = row[:k]
    return filled
