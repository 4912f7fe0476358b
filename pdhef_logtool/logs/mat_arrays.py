"""Variables of MAT files, of version 5 and (extra ``formats``) 7.3, as arrays, texts, and structs of these.

Both readers refuse sparse matrices, objects and, in HDF5, values in other files. Dimensions
are compared with the stored bytes and the limits before anything is allocated.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np

from pdhef_logtool.logs.constants import CONSTANTS, numbered
from pdhef_logtool.logs.container import describe_damage
from pdhef_logtool.logs.table_file import TableFile
from pdhef_logtool.records.extras import required
from pdhef_logtool.records.signals import Loss

HDF5_MAT = b"MATLAB 7.3"
#: Structs inside one another.
DEEPEST = 8

_MAT = CONSTANTS["mat"]
#: Tag of an element: type and size.
_TAG_BYTES = struct.calcsize("II")
#: NumPy types of elements, and of classes of numeric arrays.
_ELEMENTS, _NUMBERS = numbered(_MAT["elements"]), numbered(_MAT["numbers"])
_CELL, _STRUCT, _OBJECT, _CHARACTERS = range(1, 5)
_UNUSABLE, _ENCODINGS = numbered(_MAT["unusable"]), numbered(_MAT["encodings"])
#: Filters of HDF5 that are a part of it: deflate, shuffle, checksum.
_FILTERS = frozenset({1, 2, 3})


class _UnusableError(Exception):
    """A variable contains no numbers; the file is not damaged."""


def mat5_variables(file: TableFile, losses: list[Loss]) -> Iterator[tuple[str, Any]]:
    """Yield name and value of the variables of a MAT file of version 5; a damaged one is a loss."""
    data = memoryview(file.stream.read())
    order = ">" if bytes(data[: _MAT["head"]]).endswith(b"MI") else "<"
    reader = _Matrices(file, order, losses)
    offset = _MAT["head"]
    while offset + _TAG_BYTES <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, offset)
        is_compressed = kind == _MAT["compressed"]
        element = data[offset : offset + _TAG_BYTES + size]
        offset += _TAG_BYTES + size + (0 if is_compressed else -size % _TAG_BYTES)
        try:
            if len(element) < _TAG_BYTES + size:
                raise ValueError("the file ends inside of it")
            ((_, matrix),) = reader.elements(reader.inflated(element[_TAG_BYTES:]) if is_compressed else element)
            name, value = reader.matrix(matrix, "")
        except Exception as error:  # noqa: BLE001  any error of a damaged element
            what = f"a variable cannot be read: {describe_damage(error)[1]}"
            losses.append(Loss("bad-variable", what, file.name))
            continue
        if name:
            yield name, value


class _Matrices:
    """Reader of the matrices of a MAT file of version 5."""

    def __init__(self, file: TableFile, order: str, losses: list[Loss]) -> None:
        self._file, self._order, self._losses = file, order, losses
        self._budget, self._matrices = _Budget(file), 0

    def inflated(self, stored: memoryview) -> memoryview:
        """Return the contents of a compressed element."""
        inflater, limits = zlib.decompressobj(), self._file.limits
        data = inflater.decompress(stored, limits.chunk_bytes)
        limits.check_unpacked(len(data) + (1 << 30) * bool(inflater.unconsumed_tail), len(stored), "a variable")
        return memoryview(data)

    def elements(self, data: memoryview) -> Iterator[tuple[int, memoryview]]:
        """Yield type and contents of the elements in data."""
        offset = 0
        while offset + _TAG_BYTES <= len(data):
            kind, size = struct.unpack_from(f"{self._order}II", data, offset)
            start = offset + _TAG_BYTES
            size_in_tag, kind_in_tag = divmod(kind, 1 << 16)
            if size_in_tag:  # the element is in the second half of its tag
                kind, size, start = kind_in_tag, size_in_tag, offset + _TAG_BYTES // 2
            end = start + size
            following = offset + _TAG_BYTES if size_in_tag else end + -size % _TAG_BYTES
            if end > len(data) or (size_in_tag and end > following):
                raise ValueError("an element of it has no valid type or size")
            yield kind, data[start:end]
            offset = following

    def matrix(self, data: memoryview, path: str) -> tuple[str, Any]:
        """Return name and value of a matrix; None for one without usable values."""
        self._matrices += 1
        self._file.limits.check("schema_leaves", self._matrices, self._file.name)
        parts = self.elements(data)
        first = next(parts, None)
        flags = 0 if first is None else int(self._numbers(first)[0])
        kind = flags % 256
        if not kind:
            return "", None
        shape = [] if _UNUSABLE.get(kind) == "an object" else self._numbers(next(parts)).tolist()
        name = bytes(next(parts)[1]).decode("latin-1")
        path = path or name
        if kind in _UNUSABLE or flags & _MAT["complex"] or path.count("/") > DEEPEST:
            what = f"{path} is not used: {_UNUSABLE.get(kind, 'complex numbers, or too deep inside of structs')}"
            self._losses.append(Loss("bad-variable", what, self._file.name, severity="note"))
            return name, None
        if kind in (_STRUCT, _OBJECT):
            return name, self._structs(parts, kind, path)
        if kind == _CELL:
            return name, [self.matrix(part, f"{path}/{{}}")[1] for _, part in parts]
        element, contents = next(parts)
        if kind == _CHARACTERS:
            encoding = _ENCODINGS[element].format({"<": "le", ">": "be"}[self._order])
            return name, bytes(contents).decode(encoding, errors="replace")
        values = self._numbers((element, contents))
        if min(shape, default=0) < 0 or math.prod(shape) != len(values):
            raise ValueError(f"{path} has {len(values)} values for the dimensions {shape}")
        self._budget.claim(len(values))
        values = values.astype(np.bool_ if flags & _MAT["logical"] else _NUMBERS[kind])
        return name, values.item() if len(values) == 1 else values.reshape(shape, order="F").squeeze()

    def _structs(self, parts: Iterator[tuple[int, memoryview]], kind: int, path: str) -> Any:
        """Return a struct, or a list of the structs of an array."""
        if kind == _OBJECT:
            next(parts)  # name of its class
        width = max(1, int(self._numbers(next(parts))[0]))
        text = bytes(next(parts)[1])
        fields = [text[i : i + width].partition(b"\0")[0].decode("latin-1") for i in range(0, len(text), width)]
        values = [self.matrix(part, f"{path}/{fields[i % len(fields)]}")[1] for i, (_, part) in enumerate(parts)]
        rows = range(0, len(values), max(1, len(fields)))
        structs = [dict(zip(fields, values[row : row + len(fields)], strict=True)) for row in rows]
        return structs[0] if len(structs) == 1 else structs

    def _numbers(self, element: tuple[int, memoryview]) -> Any:
        if element[0] not in _ELEMENTS:
            raise ValueError("an element of it has no valid type or size")
        return np.frombuffer(element[1], f"{self._order}{_ELEMENTS[element[0]]}")


class _Budget:
    """Bytes that the arrays of a file claim."""

    def __init__(self, file: TableFile) -> None:
        self._file, self._claimed = file, 0

    def claim(self, count: int) -> None:
        """Raise LimitError if an array of ``count`` numbers exceeds the limit."""
        self._file.limits.check_table(self._claimed + 8 * count, self._file.size, self._file.name)
        self._claimed += 8 * count


def hdf5_variables(file: TableFile, losses: list[Loss]) -> Iterator[tuple[str, Any]]:
    """Yield name and value of the variables of a MAT file of version 7.3; a dataset that cannot be read is a loss."""
    h5py = required("h5py", "formats", "reads MAT files of version 7.3", file.name)
    seen: set[Any] = set()
    budget = _Budget(file)

    def children(group: Any, path: str, depth: int) -> Iterator[tuple[str, Any]]:
        for name in group:
            place = f"{path}{name}"
            try:
                if name.startswith("#") or depth > DEEPEST:
                    continue
                if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                    raise ValueError("it is a link to another place or file")
                item = group[name]
                address = h5py.h5o.get_info(item.id).addr
                if address in seen:
                    continue
                seen.add(address)
                file.limits.check("channels", len(seen), file.name)
                if isinstance(item, h5py.Group):
                    yield name, dict(children(item, f"{place}/", depth + 1))
                elif (value := _dataset(h5py, item, file, budget)) is not None:
                    yield name, value
            except _UnusableError as error:
                losses.append(Loss("bad-variable", f"{place} is not used: {error}", file.name, severity="note"))
            except Exception as error:  # noqa: BLE001  any error of a damaged object
                what = f"{place} cannot be read: {describe_damage(error)[1]}"
                losses.append(Loss("bad-variable", what, file.name))

    with h5py.File(file.stream, "r") as source:
        yield from children(source, "", 0)


def _dataset(h5py: Any, dataset: Any, file: TableFile, budget: _Budget) -> Any:
    """Return an array or a text, None for an empty array.

    Raises
    ------
    _UnusableError : it contains no numbers. ValueError : it cannot be read, or is not in the file.
    """
    plan = dataset.id.get_create_plist()
    if plan.get_layout() == h5py.h5d.VIRTUAL or plan.get_external_count():
        raise ValueError("its values are in other files")
    if not {plan.get_filter(i)[0] for i in range(plan.get_nfilters())} <= _FILTERS:
        raise ValueError("it has a filter that MATLAB does not use")
    attributes = {n: dataset.attrs[n] for n in ("MATLAB_class", "MATLAB_empty") if n in dataset.attrs}
    if attributes.get("MATLAB_empty"):
        return None
    if dataset.dtype.kind not in "iufb":
        raise _UnusableError(f"texts, cells or complex numbers ({dataset.dtype})")
    budget.claim(math.prod(dataset.shape))
    file.limits.check_unpacked(dataset.dtype.itemsize * math.prod(dataset.chunks or ()), file.size, file.name)
    if dataset.size and not dataset.id.get_storage_size():
        raise ValueError("none of its values are stored")
    array = np.asarray(dataset[()])
    if attributes.get("MATLAB_class") == b"char":
        return array.ravel().astype("<u2").tobytes().decode("utf-16-le", errors="replace")
    return array
