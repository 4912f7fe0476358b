"""Columns to ROS 2 CDR messages: one byte matrix a batch, no loop over messages."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.message_schema import (
    MessageSchema,
    Node,
    Scalar,
    SchemaError,
    Selection,
    Step,
    Struct,
    parse_path,
    resolve,
    ros_schema,
)
from pdhef_logtool.logs.wire_layout import NoLayoutError, Steps, WireLayout, leaf_at
from pdhef_logtool.records.errors import MappingError


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
    MappingError : the definition does not parse, or a constant's path or value does not fit it.
    """

    def __init__(
        self, topic: str, type_name: str, definition: str, constants: Mapping[str, str | float | Sequence[float]]
    ) -> None:
        self.topic = topic
        try:
            self.schema: MessageSchema = ros_schema(type_name, "ros2msg", definition, "cdr")
        except SchemaError as error:
            raise MappingError(expected=f"a definition of {type_name}", got=str(error), where=topic) from error
        self._texts: dict[Steps, bytes] = {}
        self._numbers: dict[str, NDArray[np.float64]] = {}
        self._selections: dict[str, Selection] = {}
        for path, value in constants.items():
            if isinstance(value, str):
                self._texts[self._text_steps(path)] = value.encode()
            else:
                self._numbers[path] = np.asarray(value, dtype=np.float64)
        self._layouts: dict[tuple[tuple[Steps, int], ...], tuple[WireLayout, bytes]] = {}
        self.encode(1, {})  # the constants must fit the definition

    def encode(self, n: int, fields: Mapping[str, NDArray[Any]]) -> NDArray[np.uint8]:
        """Return N messages as uint8 [N, size].

        Parameters
        ----------
        n : number of messages.
        fields : columns by path: [N] for a number, a bool or a time (int64 nanoseconds); [N, k] for an array or a
            vector struct (x, y, z; for a quaternion w, x, y, z).

        Raises
        ------
        MappingError : a path is not in the type, or a column does not fit it.
        """
        columns = {path: np.broadcast_to(value, (n, *value.shape)) for path, value in self._numbers.items()}
        columns |= {path: np.asarray(values) for path, values in fields.items()}
        for path, values in columns.items():
            if values.shape[:1] != (n,) or values.ndim > 2:
                raise self._misfit(path, f"{n} rows", f"shape {values.shape}")
        layout, template = self._layout({path: v.shape[1] for path, v in columns.items() if v.ndim == 2})
        rows = np.tile(np.frombuffer(template, dtype=np.uint8), (n, 1))
        for path, values in columns.items():
            self._put(layout, rows, path, values)
        return rows

    def _select(self, path: str) -> Selection:
        if path not in self._selections:
            self._selections[path] = resolve(self.schema, self.topic, path)
        return self._selections[path]

    def _text_steps(self, path: str) -> Steps:
        steps = parse_path(path)
        node: Node | object = self.schema.root
        for step in steps:
            node = node.members.get(str(step)) if isinstance(node, Struct) else None
        if not (isinstance(node, Scalar) and node.kind == "string"):
            raise self._misfit(path, "a text field", "another or no field")
        return steps

    def _misfit(self, path: str, expected: str, got: str) -> MappingError:
        return MappingError(expected=expected, got=got, where=f"{self.topic}.{path}")

    def _layout(self, widths: Mapping[str, int]) -> tuple[WireLayout, bytes]:
        """Return the layout for these array widths and a message with only the constants."""
        lengths: dict[Steps, int] = {}
        for path, width in widths.items():
            selection = self._select(path)
            if selection.shape == "array" and selection.length is None:
                lengths[selection.components[0]] = width
        key = tuple(sorted(lengths.items(), key=repr))
        if key not in self._layouts:

            def length_of(steps: Sequence[Step], offset: int, is_text: bool) -> int:
                del offset
                place = tuple(steps)
                return len(self._texts.get(place, b"")) + 1 if is_text else lengths.get(place, 0)

            try:
                layout = WireLayout(self.schema.root, "cdr", length_of)
            except NoLayoutError as error:
                raise MappingError(expected="a type with a fixed layout", got=str(error), where=self.topic) from error
            self._layouts[key] = (layout, self._template(layout))
        return self._layouts[key]

    def _template(self, layout: WireLayout) -> bytes:
        message = bytearray(layout.size)
        message[1] = 1  # little-endian CDR
        for offset, length in layout.lengths:
            struct.pack_into("<I", message, offset, length)
        for steps, (offset, _) in layout.texts.items():
            text = self._texts.get(steps, b"")
            message[offset : offset + len(text)] = text
        return bytes(message)

    def _put(self, layout: WireLayout, rows: NDArray[np.uint8], path: str, values: NDArray[Any]) -> None:
        selection = self._select(path)
        if selection.shape == "time":
            if values.dtype.kind not in "iu" or values.ndim != 1:
                raise self._misfit(path, "int64 nanoseconds [N]", f"{values.dtype} {values.shape}")
            parts: Sequence[NDArray[Any]] = np.divmod(values.astype(np.int64), 1_000_000_000)
        elif selection.shape == "vector":
            if values.ndim != 2 or values.shape[1] != len(selection.components):
                raise self._misfit(path, f"[N, {len(selection.components)}]", f"shape {values.shape}")
            parts = tuple(values.T)
        else:
            parts = (values,)
        for steps, part in zip(selection.components, parts, strict=False):
            self._put_leaf(layout, rows, steps, part, path)

    def _put_leaf(
        self, layout: WireLayout, rows: NDArray[np.uint8], steps: Steps, values: NDArray[Any], path: str
    ) -> None:
        leaf = leaf_at(layout, steps)
        if leaf is None:
            raise self._misfit(path, "an element of the message", "an index outside its sequence")
        inner = () if leaf.count is None else (leaf.count,)
        if values.shape[1:] != inner:
            expected = "[N]" if leaf.count is None else f"[N, {leaf.count}]"
            raise self._misfit(path, expected, f"shape {values.shape}")
        if leaf.dtype.kind in "iu" and values.dtype.kind == "f":
            if not np.all(np.isfinite(values)):
                raise self._misfit(path, "finite values for an integer field", "NaN or infinity")
            values = np.rint(values)
        kind = np.dtype((leaf.dtype, inner))
        place = np.dtype({"names": ["leaf"], "formats": [kind], "offsets": [leaf.offset], "itemsize": layout.size})
        rows.view(place)["leaf"][:, 0] = values  # many times faster than byte by byte
