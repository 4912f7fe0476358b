"""Logs of arrays: Parquet files, and MAT files of version 5 and (extra ``formats``) 7.3.

A table of a Parquet file, and each struct of a MAT file, becomes a topic. The variables of a MAT file that are in no
struct are one topic for each length. A vector of times in the same struct, or in one around it, is their clock.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.container import describe_damage
from pdhef_logtool.logs.resource_limits import ResourceLimits
from pdhef_logtool.logs.table_columns import Sheet, field_name, read_head, stamps_of, tables_of, unique
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.logs.table_log import Table
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.extras import required
from pdhef_logtool.records.signals import IntArray, Loss

_HDF5_MAT = b"MATLAB 7.3"
#: Head of a MAT file, and the types of its elements: a matrix, and a compressed element.
_MAT_HEAD, _MATRIX, _COMPRESSED = 128, 14, 15
#: Columns of a matrix that become fields.
_MOST_COLUMNS = 16
#: Structs inside one another.
_DEEPEST = 8
#: Separates the parts of a path.
_SLASH = "/"


def open_parquet(file: TableFile) -> Tables:
    """Read a Parquet file; a row group that cannot be read is a loss."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    losses: list[Loss] = []
    with pq.ParquetFile(file.stream) as source:
        groups = [source.metadata.row_group(i) for i in range(source.num_row_groups)]
        ratio = sum(g.total_byte_size for g in groups) / max(1, file.size)
        file.limits.check("chunk_ratio", ratio, file.name)
        parts = []
        for number, group in enumerate(groups):
            try:
                parts.append(source.read_row_group(number))
            except Exception as error:  # noqa: BLE001  any error of a damaged page
                what = f"row group {number} cannot be read: {describe_damage(error)[1]}"
                losses.append(Loss("bad-rows", what, file.name, count=group.num_rows))
    if not parts:
        raise LogError(expected="a row group that can be read", got="none", where=file.name)
    table = pa.concat_tables(parts)
    while any(pa.types.is_struct(column.type) for column in table.columns):
        table = table.flatten()
    fields, units = read_head(table.column_names)
    units |= {n: unit for n, f in zip(fields, table.schema, strict=True) if (unit := _unit_of(f.metadata))}
    columns = {name: _arrow_column(column) for name, column in zip(fields, table.columns, strict=True)}
    return Tables("parquet", list(tables_of(Sheet("parquet", columns, units), file.name, losses)), losses)


def _unit_of(metadata: Mapping[bytes, bytes] | None) -> str:
    values = {key.lower(): value for key, value in (metadata or {}).items()}
    return next((values[key].decode(errors="replace") for key in (b"unit", b"units") if key in values), "")


def _arrow_column(column: Any) -> Any:
    """Return a column as an array [N] with NaN (NaT) for null, or as texts."""
    import polars as pl
    import pyarrow as pa

    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    if pa.types.is_timestamp(column.type):
        return column.cast(pa.timestamp("ns")).to_numpy()
    if pa.types.is_duration(column.type) or pa.types.is_time(column.type):
        kind = pa.duration if pa.types.is_duration(column.type) else pa.time64
        return column.cast(kind("ns")).cast(pa.int64()).to_numpy() / 1e9
    if pa.types.is_string(column.type) or pa.types.is_large_string(column.type):
        return pl.Series(column.to_pylist(), dtype=pl.String)
    if pa.types.is_boolean(column.type) or (column.null_count and pa.types.is_integer(column.type)):
        return column.cast(pa.float64()).to_numpy()
    return column.to_numpy()


def open_mat(file: TableFile) -> Tables:
    """Read a MAT file; a variable that cannot be read is a loss."""
    losses: list[Loss] = []
    hdf5 = file.stream.read(len(_HDF5_MAT)) == _HDF5_MAT
    file.stream.seek(0)
    read = _hdf5_variables if hdf5 else _variables
    arrays: dict[str, dict[str, NDArray[Any]]] = {}
    units: dict[str, dict[str, str]] = {}
    for path, array, unit in read(file, losses):
        struct_, _, name = path.rpartition(_SLASH)
        vectors = _vectors(name, array)
        arrays.setdefault(struct_, {}).update(vectors)
        units.setdefault(struct_, {}).update(dict.fromkeys(vectors, unit))
    tables = list(_mat_tables(arrays, units, file.name, losses))
    if not tables:
        raise LogError(
            expected="a vector of times (t, time, ...) as long as the signals beside it",
            got=", ".join(name for columns in arrays.values() for name in columns) or "no numeric variables",
            where=file.name,
            remedy="name the vector of times so",
        )
    return Tables("mat-7.3" if hdf5 else "mat", tables, losses)


def _mat_tables(
    arrays: Mapping[str, Mapping[str, NDArray[Any]]],
    units: Mapping[str, Mapping[str, str]],
    where: str,
    losses: list[Loss],
) -> Iterator[Table]:
    """Yield the tables of the structs; vectors without a clock of their length are noted."""
    sheets = []
    for struct_, variables in arrays.items():
        lengths = dict.fromkeys(len(v) for v in variables.values() if len(v) > 1)
        for length in sorted(lengths, reverse=True):
            columns = {n: v for n, v in variables.items() if len(v) == length}
            name = field_name(struct_) if struct_ else "mat"
            sheets.append((struct_, length, Sheet(name, columns, units[struct_])))
    clocks = {}
    for struct_, length, sheet in sheets:
        with suppress(LogError):
            clocks[struct_, length] = stamps_of(sheet, where)
    rows: list[tuple[Sheet, IntArray]] = []
    for struct_, length, sheet in sheets:
        clock = _clock_of(struct_, length, clocks)
        if clock is None:
            text = f"{', '.join([*sheet.columns][:5])} ({length} values) have no times of their length"
            losses.append(Loss("no-clock", text, where, severity="note"))
            continue
        signals = {n: v for n, v in sheet.columns.items() if (struct_, length) not in clocks or n not in clock[1]}
        rows += [(Sheet(sheet.name, signals, sheet.units), clock[0])] if signals else []
    for name, (sheet, stamps) in zip(unique(sheet.name for sheet, _ in rows), rows, strict=True):
        yield from tables_of(Sheet(name, sheet.columns, sheet.units), where, losses, stamps)


def _clock_of(struct_: str, length: int, clocks: Mapping[tuple[str, int], Any]) -> Any:
    """Return the clock of a struct, or of the nearest struct around it or beside it, for vectors of a length."""
    while (struct_, length) not in clocks:
        if not struct_:
            return None
        struct_ = struct_.rpartition(_SLASH)[0]
        beside = [key for key in clocks if struct_ and key[1] == length and key[0].startswith(f"{struct_}{_SLASH}")]
        if len(beside) == 1:
            return clocks[beside[0]]
    return clocks[struct_, length]


def _vectors(name: str, array: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Return a vector, or the columns of a matrix, by field names."""
    array = np.asarray(array)
    if array.dtype.kind not in "iufb" or array.size < 2 or array.ndim > 2:
        return {}
    if array.ndim == 2 and min(array.shape) == 1:
        array = array.ravel()
    if array.ndim == 1:
        return {field_name(name): array}
    array = array if array.shape[0] >= array.shape[1] else array.T
    columns = range(array.shape[1] if array.shape[1] <= _MOST_COLUMNS else 0)
    return {f"{field_name(name)}_{i}": array[:, i] for i in columns}


def _variables(file: TableFile, losses: list[Loss]) -> Iterator[tuple[str, NDArray[Any], str]]:
    """Yield the arrays of a MAT file of version 5 by path and their units, by element: a damaged one is a loss."""
    from scipy.io import loadmat

    data = file.stream.read()
    order = ">" if data[126:128] == b"MI" else "<"
    offset = _MAT_HEAD
    while offset + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, offset)
        element = data[offset : offset + 8 + size]
        offset += 8 + size + (0 if kind == _COMPRESSED else -size % 8)
        try:
            if len(element) < 8 + size:
                raise ValueError("the file ends inside of it")
            if kind == _COMPRESSED:
                element = _inflated(element[8:], file.limits)
            _check_tags(element, 0, len(element), order)
            values = loadmat(io.BytesIO(data[:_MAT_HEAD] + element), simplify_cells=True)
        except Exception as error:  # noqa: BLE001  any error of a damaged element
            what = f"a variable cannot be read: {describe_damage(error)[1]}"
            losses.append(Loss("bad-variable", what, file.name))
            continue
        for name, value in values.items():
            if not name.startswith("__"):
                yield from _leaves(name, value, 0)


def _check_tags(data: bytes, start: int, end: int, order: str) -> None:
    """Raise ValueError for an element that no writer makes: SciPy ends the process for some of these."""
    while start + 8 <= end:
        kind, size = struct.unpack_from(f"{order}II", data, start)
        small = kind >> 16  # size of an element inside of its tag
        if not 1 <= kind & 0xFFFF <= 18 or small > 4 or (not small and start + 8 + size > end):
            raise ValueError("an element of it has no valid type or size")
        if kind == _MATRIX:
            _check_tags(data, start + 8, start + 8 + size, order)
        start += 8 if small else 8 + size + -size % 8


def _inflated(stored: bytes, limits: ResourceLimits) -> bytes:
    inflater = zlib.decompressobj()
    data = inflater.decompress(stored, limits.chunk_bytes)
    limits.check_unpacked(len(data) + (1 << 30) * bool(inflater.unconsumed_tail), len(stored), "a variable")
    return data


def _leaves(path: str, value: Any, depth: int, unit: str = "") -> Iterator[tuple[str, NDArray[Any], str]]:
    if isinstance(value, np.ndarray) and value.dtype != object:
        yield path, value, unit
    elif isinstance(value, dict) and depth < _DEEPEST:
        for name, inner in value.items():
            yield from _leaves(f"{path}{_SLASH}{name}", inner, depth + 1, _text_of(value, "unit", "units"))
    elif isinstance(value, list | np.ndarray) and depth < _DEEPEST:
        structs = [v for v in value if isinstance(v, dict)][:_MOST_COLUMNS]
        for number, inner in enumerate(structs):
            data = [v for v in inner.values() if isinstance(v, np.ndarray)]
            label = _text_of(inner, "label", "name") or str(number)
            named = data[0] if len(data) == 1 else inner
            yield from _leaves(f"{path}{_SLASH}{label}", named, depth + 1, _text_of(inner, "unit", "units"))


def _text_of(struct_: Mapping[str, Any], *names: str) -> str:
    """Return the first text of these names in a struct, or in the description of its data."""
    info = struct_.get("DataInfo")
    lower = {n.lower(): v for n, v in {**(info if isinstance(info, dict) else {}), **struct_}.items()}
    return next((lower[n] for n in names if isinstance(lower.get(n), str)), "")


def _hdf5_variables(file: TableFile, losses: list[Loss]) -> Iterator[tuple[str, NDArray[Any], str]]:
    """Yield the arrays of a MAT file of version 7.3 by path; a dataset that cannot be read is a loss."""
    h5py = required("h5py", "formats", "reads MAT files of version 7.3", file.name)
    datasets: list[tuple[str, Callable[[], NDArray[Any]]]] = []

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset) and not name.startswith("#") and item.dtype.kind in "iufb":
            datasets.append((name, lambda: item[()]))

    with h5py.File(file.stream, "r") as source:
        source.visititems(visit)
        for name, load in datasets:
            try:
                yield name, np.asarray(load()), ""
            except Exception as error:  # noqa: BLE001  any error of a damaged chunk
                losses.append(Loss("bad-variable", f"{name} cannot be read: {describe_damage(error)[1]}", file.name))
