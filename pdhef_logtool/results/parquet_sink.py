"""estimates.parquet (wide, a row per stamp and estimator), and Arrow schemas from the schema files of the package."""

import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pdhef_logtool.logs.definitions import schema_file
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.signals import BoolArray
from pdhef_logtool.records.tracks import OPTIONAL_COLUMNS, TRACK_COLUMNS, StateTrack, diagonal_covariance, make_track
from pdhef_logtool.results.sink import TRUTH, rounded
from pdhef_logtool.storage.files import PendingFile, open_new, writing


def load_schema(name: str) -> dict[str, Any]:
    """Return one of the JSON documents of ``schemas/`` by file name."""
    document: dict[str, Any] = json.loads(schema_file(name).read_text(encoding="utf-8"))
    return document


@cache
def arrow_schema(name: str) -> pa.Schema:
    """Return the Arrow schema that ``schemas/<name>`` describes.

    Each field carries its unit; the schema's own metadata carry format, version and all units once more, because
    only Arrow readers see metadata of fields.
    """
    document, fields = load_schema(name), []
    for c in document["columns"]:
        is_dictionary = c["type"] == "dictionary<int32, string>"
        kind = pa.dictionary(pa.int32(), pa.string()) if is_dictionary else pa.type_for_alias(c["type"])
        fields.append(pa.field(c["name"], kind, nullable=c["nullable"], metadata={"unit": c["unit"]}))
    units = {c["name"]: c["unit"] for c in document["columns"]}
    stated = document | {"version": str(document["version"]), "units": json.dumps(units)}
    return pa.schema(fields, metadata={key: stated[key] for key in ("format", "version", "units", "missing")})


def arrow_array(values: Any, kind: pa.DataType) -> pa.Array:
    """Return numbers or strings [N], null for NaN and None; ``pa.array`` would import an installed pandas."""
    if isinstance(values, np.ndarray) and values.dtype.kind != "U":
        is_there = ~np.isnan(values)
    else:
        is_there = np.array([v is not None and v == v for v in values], dtype=np.bool_)  # NaN differs from itself
        filler = "" if pa.types.is_string(kind) else 0
        values = [v if there else filler for v, there in zip(values, is_there, strict=True)]
    validity = None if is_there.all() else pa.py_buffer(np.packbits(is_there, bitorder="little"))
    if pa.types.is_string(kind):
        texts = [str(v).encode("utf-8", "backslashreplace") for v in values]
        offsets = np.cumsum([0, *map(len, texts)], dtype=np.int32)
        return pa.Array.from_buffers(kind, len(texts), [validity, pa.py_buffer(offsets), pa.py_buffer(b"".join(texts))])
    values = np.ascontiguousarray(values, dtype=kind.to_pandas_dtype())
    data = np.packbits(values, bitorder="little") if values.dtype == np.bool_ else values
    return pa.Array.from_buffers(kind, len(values), [validity, pa.py_buffer(data)])


#: Rows of a row group: 10 h at 100 Hz make 110 row groups an estimator.
ROWS_A_GROUP = 32768

#: Of zstd, of estimates: less work than the lowest level, and 4 % fewer bytes.
_LEVEL = 3
#: Name of the copy of the selected estimate in estimates.parquet.
SELECTED = "selected"
_AGAIN = "run the log again"
_FLAGS = ("valid", "diverged")
_STD_COLUMNS = ("vx_std_m_s", "vy_std_m_s", "yaw_rate_std_rad_s")


@contextmanager
def parquet_writer(path: Path, schema: pa.Schema, **options: Any) -> Iterator[pq.ParquetWriter]:
    """Yield the writer of a Parquet file with zstd, which gets its name when it is complete; ``options`` of Arrow's.

    Raises
    ------
    OutputError
        When the file cannot be written.
    """
    with (
        PendingFile(path) as pending,
        writing(path),
        open_new(pending.path) as file,
        pq.ParquetWriter(file, schema, compression="zstd", **options) as writer,
    ):
        yield writer


def write_estimates(
    path: Path,
    tracks: Sequence[StateTrack],
    *,
    selected: str | None = None,
    causal_from_ns: Mapping[str, int] | None = None,
) -> None:
    """Write estimates.parquet; a row group contains one estimator, so that one can be read without the others.

    Numbers are :func:`~pdhef_logtool.results.sink.rounded` and stored byte by byte: a sixth of the file.

    Parameters
    ----------
    path : the finished file.
    selected : estimator; its track is also written as :data:`SELECTED`.
    causal_from_ns : first stamp from which the rows of an estimator depend on no later sample; an estimator without one
        is causal nowhere. None: unknown, and ``causal`` is null.

    Raises
    ------
    OutputError : When the file cannot be written.
    """
    schema = arrow_schema("estimates.parquet.json")
    split = {f.name: "BYTE_STREAM_SPLIT" for f in schema if pa.types.is_floating(f.type)}
    options = {"column_encoding": {**split, "stamp_ns": "DELTA_BINARY_PACKED"}, "compression_level": _LEVEL}
    with parquet_writer(path, schema, use_dictionary=["estimator"], write_page_checksum=True, **options) as writer:
        for first in range(0, max(map(len, tracks), default=0), ROWS_A_GROUP):
            group = [track.rows(first, first + ROWS_A_GROUP) for track in tracks]
            for track in group:
                if not len(track):
                    continue
                causal = None
                if causal_from_ns is not None and track.name != TRUTH:
                    first_ns = causal_from_ns.get(track.name)
                    causal = np.zeros(len(track), np.bool_) if first_ns is None else track.stamps_ns >= first_ns
                for name in (track.name, SELECTED) if track.name == selected else (track.name,):
                    writer.write_table(track_table(replace(track, name=name), as_written=True, causal=causal))


def track_table(track: StateTrack, *, as_written: bool = False, causal: BoolArray | None = None) -> pa.Table:
    """Return a track [N] as rows of estimates.parquet, rounded as they are in the file if ``as_written``.

    ``causal`` [N]: whether a row depends on no later sample; None: unknown.
    """
    schema = arrow_schema("estimates.parquet.json")
    columns: dict[str, Any] = dict(track.columns())
    if as_written:
        columns = {n: rounded(n, values) if values.dtype.kind == "f" else values for n, values in columns.items()}
    if causal is not None:
        columns["causal"] = causal
    estimator = (arrow_array(np.zeros(len(track)), pa.int32()), arrow_array([track.name], pa.string()))
    arrays = [
        arrow_array(columns[f.name], f.type) if f.name in columns else pa.nulls(len(track), f.type) for f in schema
    ]
    arrays[schema.get_field_index("estimator")] = pa.DictionaryArray.from_arrays(*estimator)
    return pa.Table.from_arrays(arrays, schema=schema)


def list_estimators(path: Path) -> tuple[str, ...]:
    """Return the names of the tracks in an estimates.parquet, by their row groups; the selected one is a copy."""
    with reading(path), pq.ParquetFile(path) as file:
        return tuple(dict.fromkeys(name for name in _names(file) if name != SELECTED))


def read_track(path: Path, estimator: str, columns: Iterable[str] | None = None) -> StateTrack:
    """Read one track of an estimates.parquet; the row groups of other estimators are not touched.

    Parameters
    ----------
    path : an estimates.parquet.
    estimator : name of the track.
    columns : of :data:`pdhef_logtool.records.tracks.TRACK_COLUMNS`; the others stay NaN (``valid`` True,
        ``diverged`` False). All when None.

    Returns
    -------
    StateTrack
        In order of time. The file contains standard deviations only: ``covariance`` has them on its diagonal, NaN
        elsewhere, and length 0 if none was read or known. ``nis_dof`` is NaN. Optional columns that were not read, or
        that are null throughout, have length 0.

    Raises
    ------
    OutputError : When the file is no estimates.parquet or contains no such track.
    """
    asked = None if columns is None else {"stamp_ns", *columns}
    wanted = [c for c in TRACK_COLUMNS if asked is None or c in asked]
    with reading(path), pq.ParquetFile(path) as file:
        names = _names(file)
        tables = [file.read_row_group(i, columns=wanted) for i, name in enumerate(names) if name == estimator]
    if not tables:
        names = [*dict.fromkeys(name for name in names if name != SELECTED)]
        raise OutputError(expected=f"one of {', '.join(names)}", got=estimator, where=path)
    return _track_from_table(estimator, pa.concat_tables(tables))


def _track_from_table(name: str, table: pa.Table) -> StateTrack:
    unknown = np.broadcast_to(np.nan, table.num_rows)
    columns: dict[str, Any] = {"sideslip_rad": unknown}
    for column in [c for c in table.column_names if c != "stamp_ns"]:
        values, is_reason = table[column], column == "reason"
        if column not in OPTIONAL_COLUMNS or values.null_count < table.num_rows:
            kind = np.bool_ if column in _FLAGS else np.int64 if is_reason else np.float64
            columns[column] = np.asarray((values.fill_null(0) if is_reason else values).to_numpy(), dtype=kind)
    columns["covariance"] = diagonal_covariance([columns.pop(c, unknown) for c in _STD_COLUMNS])
    return make_track(name, np.asarray(table["stamp_ns"].to_numpy(), dtype=np.int64), **columns)


def _names(file: pq.ParquetFile) -> list[str]:
    """Return the estimator of each row group, which the statistics of its column state."""
    column, metadata = file.schema_arrow.get_field_index("estimator"), file.metadata
    return [str(metadata.row_group(i).column(column).statistics.min) for i in range(metadata.num_row_groups)]


def read_rows(path: Path, columns: list[str], wanted: Mapping[str, Collection[str]]) -> Iterator[tuple[Any, ...]]:
    """Yield columns of the rows of a table, of those with a wanted text in each of some columns; null numbers are NaN.

    Neither Polars nor the functions of Arrow are imported, which takes longer than to read the table of a few drives.

    Raises
    ------
    OutputError : When the file cannot be read.
    """
    with reading(path), pq.ParquetFile(path, read_dictionary=columns) as file:
        for batch in file.iter_batches(columns=columns):
            use = np.ones(len(batch), np.bool_)
            for name, texts in wanted.items():
                is_wanted = np.array([text in texts for text in batch[name].dictionary.to_pylist()], np.bool_)
                use &= is_wanted[_values(batch[name].indices)]
            yield from zip(*(_values(column)[use].tolist() for column in batch.select(columns)), strict=True)


def _values(array: pa.Array) -> Any:
    """Return numbers or texts [N], NaN for null; ``Array.to_numpy`` would import an installed pandas."""
    if pa.types.is_dictionary(array.type):
        return np.array(array.dictionary.to_pylist(), dtype=object)[_values(array.indices)]
    if array.null_count:
        return np.array(array.to_pylist(), dtype=np.float64)
    return np.frombuffer(array.buffers()[1], array.type.to_pandas_dtype())[array.offset : array.offset + len(array)]


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn the errors of Arrow into an OutputError."""
    try:
        yield
    except (OSError, ValueError, LookupError, pa.ArrowException) as error:
        got = f"one that cannot be read: {' '.join(str(error).split())[:200]}"
        raise OutputError(expected="a readable Parquet file", got=got, where=path, remedy=_AGAIN) from error
