"""Parquet files: one table of all row groups. Structs become columns of their fields."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray
from pyarrow import types as of

from pdhef_logtool.logs.container import describe_damage
from pdhef_logtool.logs.table_cells import read_cells
from pdhef_logtool.logs.table_clocks import unwrapped
from pdhef_logtool.logs.table_columns import Sheet, read_head, tables_of
from pdhef_logtool.logs.table_file import NUMBER_BYTES, TableFile, Tables, left_out
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import NS_PER_S, Loss


def open_parquet(file: TableFile) -> Tables:
    """Read a Parquet file; a column that cannot be read is a loss, in its row group."""
    losses: list[Loss] = []
    schema = pq.read_schema(file.stream)
    leaves = dict(_leaves(schema, ""))
    file.limits.check("channels", len(leaves), file.name)
    kinds = {path: _kind(field.type) for path, field in leaves.items()}
    paths = [path for path, kind in kinds.items() if kind]
    unusable = [f"{path} ({leaves[path].type})" for path, kind in kinds.items() if not kind]
    losses += left_out("columns of types without numbers", unusable, file.name)
    file.stream.seek(0)
    with pq.ParquetFile(file.stream, read_dictionary=[p for p in paths if kinds[p] == "text"]) as source:
        parts = _groups(source, paths, file, losses)
    fields, units = read_head(paths)
    columns = {}
    for name, path in zip(fields, paths, strict=True):
        if unit := _unit_of(leaves[path].metadata):
            units[name] = unit
        if kinds[path] == "duration":
            units[name] = "s"
        try:
            chunks = [chunk for part in parts for chunk in part[path].chunks]
            columns[name] = _column(pa.chunked_array(chunks), kinds[path], name, file, losses)
        except Exception as error:  # noqa: BLE001  any error of a conversion
            losses.append(Loss("bad-column", f"{path} cannot be read: {describe_damage(error)[1]}", file.name))
    sheet = Sheet("parquet", columns, units)
    return Tables("parquet", list(tables_of(sheet, file.name, losses, rate_hz=file.settings.rate_hz)), losses)


def _leaves(fields: Any, prefix: str) -> Iterator[tuple[str, Any]]:
    """Yield the paths of columns, inside of structs too, and their fields."""
    for field in fields:
        if pa.types.is_struct(field.type):
            yield from _leaves(field.type, f"{prefix}{field.name}.")
        else:
            yield f"{prefix}{field.name}", field


def _kind(type_: Any) -> str:
    """Return how a column of a type is read; empty if it cannot contain numbers or times."""
    if of.is_dictionary(type_):
        type_ = type_.value_type
    kinds = (
        ("text", of.is_string, of.is_large_string),
        ("date", of.is_timestamp, of.is_date),
        ("duration", of.is_duration, of.is_time),
        ("number", of.is_integer, of.is_floating, of.is_decimal, of.is_boolean),
    )
    return next((kind for kind, *tests in kinds if any(test(type_) for test in tests)), "")


def _unit_of(metadata: Mapping[bytes, bytes] | None) -> str:
    values = {key.lower(): value for key, value in (metadata or {}).items()}
    return next((values[key].decode(errors="replace") for key in (b"unit", b"units") if key in values), "")


def _groups(source: Any, paths: Sequence[str], file: TableFile, losses: list[Loss]) -> list[dict[str, Any]]:
    """Return the columns of row groups by path, null where they cannot be read; no group exceeds the limits."""
    parts: list[dict[str, Any]] = []
    types = {path: field.type for path, field in _leaves(source.schema_arrow, "")}
    claimed = 0
    for number in range(source.num_row_groups):
        group = source.metadata.row_group(number)
        where, rows = f"{file.name}, row group {number}", group.num_rows
        part: dict[str, Any] = {}
        errors: dict[str, str] = {}
        try:
            claimed += max(NUMBER_BYTES * rows * max(1, len(paths)), group.total_byte_size)
            file.check(claimed, where)
        except LogError as error:
            losses.append(Loss("bad-rows", str(error), where, count=rows))
            continue
        for path in paths:
            try:
                part[path] = _column_of_group(source, number, path, rows)
            except Exception as error:  # noqa: BLE001  any error of a damaged page
                errors[path] = describe_damage(error)[1]
        if errors:
            bad = ", ".join(errors) if part else "all columns"
            losses.append(Loss("bad-rows", f"{bad}: cannot be read: {next(iter(errors.values()))}", where, count=rows))
        if part:
            parts.append(part | {path: pa.chunked_array([pa.nulls(rows, types[path])]) for path in errors})
    if not parts:
        got = losses[-1].what if losses else "none"
        raise LogError(expected="a row group that can be read", got=got, where=file.name)
    return parts


def _column_of_group(source: Any, number: int, path: str, rows: int) -> Any:
    """Return a column of a row group, out of the structs around it; ValueError if it has another length."""
    table = source.read_row_group(number, columns=[path], use_threads=False)
    while pa.types.is_struct(table.schema.types[0]):
        table = table.flatten()
    if table.num_rows != rows or table.column_names != [path]:
        raise ValueError(f"{table.num_rows} of {rows} rows")
    return table[path]


def _column(column: Any, kind: str, name: str, file: TableFile, losses: list[Loss]) -> Any:
    """Return a column as an array [N] with NaN (NaT) for null, or as texts."""
    if kind == "text":
        return _texts(column, name, file, losses)
    if pa.types.is_dictionary(column.type):
        column = column.cast(column.type.value_type)
    series = pl.Series(pl.from_arrow(column))
    if kind == "date":
        return series.to_numpy()
    if kind == "duration":
        is_of_day = series.dtype == pl.Time
        nanoseconds = series if is_of_day else series.cast(pl.Duration("ns"))
        values = nanoseconds.cast(pl.Int64).cast(pl.Float64).to_numpy() / NS_PER_S
        return unwrapped(values) if is_of_day else values
    if series.dtype.is_float() or (series.dtype.is_integer() and not series.null_count()):
        return series.to_numpy()
    return series.cast(pl.Float64).to_numpy()


def _texts(column: Any, name: str, file: TableFile, losses: list[Loss]) -> NDArray[Any] | Any:
    """Return texts as numbers if most of them are numbers; a text that repeats counts each time for the limits."""
    column.validate(full=True)  # texts that are not UTF-8 would end the process
    dictionaries = [chunk for chunk in column.chunks if pa.types.is_dictionary(chunk.type)]
    sizes = (pc.sum(pc.take(pc.binary_length(c.dictionary), c.indices)).as_py() or 0 for c in dictionaries)
    file.check(sum(sizes), f"{file.name}, {name}")
    texts = pl.Series(pl.from_arrow(column.cast(pa.large_string())))
    cells = read_cells(texts)
    if cells.is_text:
        return texts
    losses.extend(cells.losses(name, file.name))
    return cells.values
