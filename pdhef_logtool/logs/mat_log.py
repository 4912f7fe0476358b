"""MAT files of version 5 and (extra ``formats``) 7.3: each struct is a topic.

Variables outside of structs are one topic for each length. A vector of times in the same struct, or in one around it,
is their clock. Sparse matrices, objects and, in HDF5, values in other files are refused.
"""

import math
import re
import struct
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs import table_columns
from pdhef_logtool.logs.constants import CONSTANTS, numbered
from pdhef_logtool.logs.container import describe_damage
from pdhef_logtool.logs.table_clocks import Clock, rate_clock
from pdhef_logtool.logs.table_columns import Sheet, clock_notes, field_name, find_clock, split_unit, tables_of, unique
from pdhef_logtool.logs.table_file import NUMBER_BYTES, TableFile, Tables, left_out
from pdhef_logtool.logs.table_log import Table
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.extras import required
from pdhef_logtool.records.signals import IntArray, Loss

_HDF5_MAT, _HDF5 = b"MATLAB 7.3", b"\x89HDF\r\n\x1a\n"
_MAT = CONSTANTS["mat"]
#: Tag of an element: type and size.
_TAG_BYTES = struct.calcsize("II")
#: NumPy types of elements, and of classes of numeric arrays.
_ELEMENTS, _NUMBERS = numbered(_MAT["elements"]), numbered(_MAT["numbers"])
_CELL, _STRUCT, _OBJECT, _CHARACTERS = range(1, 5)
_UNUSABLE, _ENCODINGS = numbered(_MAT["unusable"]), numbered(_MAT["encodings"])
#: Structs inside one another; columns of a matrix that become fields, without and with titles.
_DEEPEST, _MOST_COLUMNS, _MOST_TITLES = 8, 16, 1000
#: Letters of the name of a block in a data frame that is stored in HDF5.
_BLOCK = len("block0")
#: Filters of HDF5 that are a part of it: deflate, shuffle, checksum.
_FILTERS = frozenset({1, 2, 3})
#: Names of the values of a struct that has the name of the signal. What separates the parts of a path.
_DATA, _SLASH = frozenset({"data", "value", "values"}), "/"
#: Path of a struct, and length of some of its vectors.
_Place: TypeAlias = tuple[str, int]


@dataclass(frozen=True, slots=True)
class _Unusable:
    """A sound variable that contains no numbers."""

    why: str


def open_mat(file: TableFile) -> Tables:
    """Read a MAT file; a variable that cannot be read is a loss."""
    losses: list[Loss] = []
    head = file.stream.read(len(_HDF5_MAT))
    file.stream.seek(0)
    kind = {_HDF5_MAT: "mat-7.3", _HDF5 + head[len(_HDF5) :]: "hdf5"}.get(head, "mat")
    variables = (_mat5_variables if kind == "mat" else _hdf5_variables)(file, losses)
    return Tables(kind, tables_of_variables(variables, file, losses), losses)


def tables_of_variables(variables: Iterable[tuple[str, Any]], file: TableFile, losses: list[Loss]) -> list[Table]:
    """Return the tables of named variables: arrays, structs (dictionaries) and lists of structs.

    Raises
    ------
    LogError : no vector of times is as long as a signal.
    """
    arrays: dict[str, dict[str, NDArray[Any]]] = {}
    units: dict[str, dict[str, str]] = {}
    unusable = []
    leaves = [leaf for name, value in _with_titles(dict(variables)).items() for leaf in _leaves(name, value, 0)]
    pairs = _pairs({path: value for path, value, _ in leaves if isinstance(value, np.ndarray)})
    rate_hz = file.settings.rate_hz
    for path, value, unit in leaves:
        struct_, _, title = path.rpartition(_SLASH)
        if isinstance(value, float | int):
            rate_hz = rate_hz or float(value)
            continue
        name, given = split_unit(title)
        unit = unit or given
        if path in pairs:
            name = (struct_.rpartition(_SLASH)[2] or name) if name.lower() in _DATA else name
            arrays[path], units[path] = {"time": value[:, 0], field_name(name): value[:, 1]}, {field_name(name): unit}
            continue
        vectors = _vectors(name, value) if isinstance(value, np.ndarray) else {}
        if isinstance(value, _Unusable):
            unusable.append(f"{path}: {value.why}")
        elif not vectors and value.size > 1:
            unusable.append(f"{path} {value.shape}")
        arrays.setdefault(struct_, {}).update(vectors)
        units.setdefault(struct_, {}).update(dict.fromkeys(vectors, unit))
    losses += left_out("variables that are no vectors of numbers", unusable, file.name)
    tables = list(_mat_tables(arrays, units, file, losses, rate_hz))
    if not tables:
        expected = "a vector of times (t, time, ...) as long as the signals beside it"
        got = ", ".join(name for columns in arrays.values() for name in columns) or "no numeric variables"
        raise LogError(expected=expected, got=got, where=file.name, remedy=CONSTANTS["clocks"]["remedy"])
    return tables


def _mat5_variables(file: TableFile, losses: list[Loss]) -> Iterator[tuple[str, Any]]:
    """Yield name and value of the variables of a MAT file of version 5; a damaged one is a loss."""
    data = memoryview(file.stream.read())
    order = ">" if bytes(data[: _MAT["head"]]).endswith(b"MI") else "<"
    reader = _Matrices(file, order)
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

    def __init__(self, file: TableFile, order: str) -> None:
        self._file, self._order = file, order
        self._claimed = self._matrices = 0

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
        if kind in _UNUSABLE or flags & _MAT["complex"] or path.count("/") > _DEEPEST:
            return name, _Unusable(_UNUSABLE.get(kind, "complex numbers, or too deep inside of structs"))
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
        self._claimed += NUMBER_BYTES * len(values)
        self._file.check(self._claimed)
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


def _hdf5_variables(file: TableFile, losses: list[Loss]) -> Iterator[tuple[str, Any]]:
    """Yield name and value of the variables of a MAT file of version 7.3; a dataset that cannot be read is a loss."""
    h5py = required("h5py", "formats", "reads MAT files of version 7.3", file.name)
    seen: set[Any] = set()
    claimed = 0

    def children(group: Any, path: str, depth: int) -> Iterator[tuple[str, Any]]:
        nonlocal claimed
        for name in group:
            place = f"{path}{name}"
            try:
                if name.startswith("#") or depth > _DEEPEST:
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
                    continue
                size = NUMBER_BYTES * math.prod(item.shape or ())
                file.check(claimed + size)
                claimed += size
                texts = (str(item.attrs[n]) for n in ("unit", "units", "Unit", "Units") if n in item.attrs)
                unit = next(texts, "").replace(_SLASH, " per ")
                yield f"{name} [{unit}]" if unit else name, _dataset(h5py, item, file)
            except Exception as error:  # noqa: BLE001  any error of a damaged object
                what = f"{place} cannot be read: {describe_damage(error)[1]}"
                losses.append(Loss("bad-variable", what, file.name))

    with h5py.File(file.stream, "r") as source:
        yield from children(source, "", 0)


def _dataset(h5py: Any, dataset: Any, file: TableFile) -> Any:
    """Return an array or a text, None for an empty array.

    Raises
    ------
    ValueError : it cannot be read, or is not in the file. LimitError : its chunks exceed the limits.
    """
    plan = dataset.id.get_create_plist()
    if plan.get_layout() == h5py.h5d.VIRTUAL or plan.get_external_count():
        raise ValueError("its values are in other files")
    if not {plan.get_filter(i)[0] for i in range(plan.get_nfilters())} <= _FILTERS:
        raise ValueError("it has a filter that MATLAB does not use")
    attributes = {n: dataset.attrs[n] for n in ("MATLAB_class", "MATLAB_empty") if n in dataset.attrs}
    if attributes.get("MATLAB_empty"):
        return None
    if h5py.check_string_dtype(dataset.dtype) and dataset.ndim == 1 and dataset.size <= _MOST_TITLES:
        return [str(text) for text in dataset.asstr(errors="replace")[()]]
    if dataset.dtype.kind not in "iufb":
        return _Unusable(f"texts, cells or complex numbers ({dataset.dtype})")
    file.limits.check_unpacked(dataset.dtype.itemsize * math.prod(dataset.chunks or ()), file.size, file.name)
    if dataset.size and not dataset.id.get_storage_size():
        raise ValueError("none of its values are stored")
    array = np.asarray(dataset[()])
    if attributes.get("MATLAB_class") == b"char":
        return array.ravel().astype("<u2").tobytes().decode("utf-16-le", errors="replace")
    return array


def _mat_tables(
    arrays: Mapping[str, Mapping[str, NDArray[Any]]],
    units: Mapping[str, Mapping[str, str]],
    file: TableFile,
    losses: list[Loss],
    rate_hz: float | None,
) -> Iterator[Table]:
    """Yield the tables of the structs; vectors without a clock of their length are noted."""
    where = file.name
    sheets: dict[_Place, Sheet] = {}
    for struct_, variables in arrays.items():
        name = field_name(struct_) if struct_ else "mat"
        for length in sorted({len(v) for v in variables.values() if len(v) > 1}, reverse=True):
            columns = {n: v for n, v in variables.items() if len(v) == length}
            sheets[struct_, length] = Sheet(name, columns, units[struct_])
    clocks = _clocks(sheets, where, rate_hz)
    rows: list[tuple[Sheet, IntArray]] = []
    for place, sheet in sheets.items():
        clock = _clock_of(place, clocks)
        if clock is None:
            text = f"{', '.join([*sheet.columns][:5])} ({place[1]} values) have no times of their length, or several"
            losses.append(Loss("no-clock", text, where, severity="note"))
            continue
        is_own = clocks.get(place) is clock
        if is_own:
            losses += clock_notes(clock.notes, f"{where}, {sheet.name}")
        signals = {n: v for n, v in sheet.columns.items() if not is_own or n not in clock.columns}
        rows += [(Sheet(sheet.name, signals, sheet.units), clock.stamps_ns)] if signals else []
    for name, (sheet, stamps) in zip(unique(sheet.name for sheet, _ in rows), rows, strict=True):
        yield from tables_of(Sheet(name, sheet.columns, sheet.units), where, losses, stamps)


def _clocks(sheets: Mapping[_Place, Sheet], where: str, rate_hz: float | None) -> dict[_Place, Clock]:
    """Return the clocks of sheets; those without a unit are read beside certain ones, or the longest one.

    Without any clock, ``rate_hz`` applies to the length that most vectors have.
    """
    clocks: dict[_Place, Clock] = {}
    for place, sheet in sheets.items():
        with suppress(LogError):
            clocks[place] = find_clock(sheet, where)
    if not clocks and rate_hz:
        counts = Counter(length for (_, length), sheet in sheets.items() for _ in sheet.columns)
        return {p: rate_clock(p[1], rate_hz) for p in sheets if p[1] == counts.most_common(1)[0][0]}
    certain = {place: clock for place, clock in clocks.items() if clock.is_certain}
    certain = certain or dict(sorted(clocks.items(), key=lambda item: -item[0][1])[:1])
    beside = [*certain.values()]
    return {p: certain.get(p) or find_clock(sheets[p], where, beside, rate_hz) for p in clocks}


def _clock_of(place: _Place, clocks: Mapping[_Place, Clock]) -> Clock | None:
    """Return the clock of a struct, or of the nearest struct around it or beside it, for vectors of a length."""
    struct_, length = place
    while (struct_, length) not in clocks:
        if not struct_:
            return None
        struct_ = struct_.rpartition(_SLASH)[0]
        beside = [c for key, c in clocks.items() if key[1] == length and key[0].startswith(f"{struct_}{_SLASH}")]
        if struct_ and len({clock.stamps_ns.tobytes() for clock in beside}) == 1:
            return beside[0]
    return clocks[struct_, length]


def _with_titles(variables: Mapping[str, Any]) -> dict[str, Any]:
    """Return variables with the columns of a matrix apart if as many texts are beside it: titles, and perhaps units."""
    lists = {n: v for n, v in variables.items() if isinstance(v, list) and v and all(isinstance(t, str) for t in v)}
    results: dict[str, Any] = {}
    for name, value in variables.items():
        shape = value.shape if isinstance(value, np.ndarray) and value.ndim == 2 else ()
        # Units last, and those of another block.
        its = sorted((n for n in lists if len(lists[n]) in shape), key=lambda n: n[:_BLOCK] != name[:_BLOCK])
        its.sort(key=lambda n: "unit" in n.lower())
        titles = lists[its[0]] if its else []
        units = lists[its[-1]] if its[1:] and "unit" in its[-1].lower() else [""] * len(titles)
        named = (f"{t} [{unit.replace(_SLASH, ' per ')}]" for t, unit in zip(titles, units, strict=True))
        columns = value.T if titles and len(titles) != len(value) else value
        results |= zip(named, columns, strict=True) if titles else {name: value}
    return results


def _pairs(arrays: Mapping[str, NDArray[Any]]) -> set[str]:
    """Return the names of matrices of rising times and of values.

    If the values rise, too, the times are regular or within those of another matrix; otherwise they may be positions.
    """
    two = (n for n, a in arrays.items() if a.ndim == 2 and a.shape[1] == 2 and a.dtype.kind in "iuf")
    # As floats, because differences of unsigned numbers wrap.
    steps = {n: np.diff(arrays[n].astype(np.float64), axis=0).T for n in two if len(arrays[n]) >= _MAT["fewest"]}
    pairs = {name: arrays[name][:, 0] for name, (of_times, _) in steps.items() if (of_times > 0.0).all()}
    certain = [t for n, t in pairs.items() if (steps[n][1] <= 0.0).any() or table_columns.is_regular(steps[n][0])]
    return {n for n, t in pairs.items() if any(c[0] <= t[0] and t[-1] <= c[-1] for c in certain)}


def _vectors(name: str, array: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Return a vector, or the columns of a matrix, by field names."""
    if array.dtype.kind not in "iufbM" or array.size < 2 or array.ndim > 2:
        return {}
    if array.ndim == 2 and min(array.shape) == 1:
        array = array.ravel()
    if array.ndim == 1:
        return {field_name(name): array}
    array = array if array.shape[0] >= array.shape[1] else array.T
    columns = range(array.shape[1] if array.shape[1] <= _MOST_COLUMNS else 0)
    return {f"{field_name(name)}_{i}": array[:, i] for i in columns}


def _leaves(path: str, value: Any, depth: int, unit: str = "") -> Iterator[tuple[str, Any, str]]:
    is_rate = re.fullmatch(CONSTANTS["patterns"]["rate"], path.rpartition(_SLASH)[2].lower())
    if (is_rate and isinstance(value, float | int) and value > 0) or isinstance(value, np.ndarray | _Unusable):
        yield path, value, unit
    elif isinstance(value, dict | list) and depth >= _DEEPEST:
        yield path, _Unusable("too deep inside of structs"), unit
    elif isinstance(value, dict):
        for name, inner in _with_titles(value).items():
            yield from _leaves(f"{path}{_SLASH}{name}", inner, depth + 1, _text_of(value, "unit", "units"))
    elif isinstance(value, list):
        structs = [v for v in value if isinstance(v, dict)][:_MOST_COLUMNS]
        for number, inner in enumerate(structs):
            data = [v for v in inner.values() if isinstance(v, np.ndarray)]
            label, unit = split_unit(_text_of(inner, "label", "name") or str(number))
            named = data[0] if len(data) == 1 else inner
            place = f"{path}{_SLASH}{field_name(label)}"
            yield from _leaves(place, {n: v for n, v in inner.items() if isinstance(v, float | int)}, depth + 1)
            yield from _leaves(place, named, depth + 1, _text_of(inner, "unit", "units") or unit)


def _text_of(struct_: Mapping[str, Any], *names: str) -> str:
    """Return the first text of these names in a struct, or in the description of its data."""
    info = struct_.get("DataInfo")
    lower = {n.lower(): v for n, v in {**(info if isinstance(info, dict) else {}), **struct_}.items()}
    return next((lower[n] for n in names if isinstance(lower.get(n), str)), "")
