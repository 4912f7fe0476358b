"""MAT files of version 5 and (extra ``formats``) 7.3: each struct is a topic.

Variables outside of structs are one topic for each length. A vector of times in the same struct, or in one around it,
is their clock.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.mat_arrays import DEEPEST, HDF5_MAT, hdf5_variables, mat5_variables
from pdhef_logtool.logs.table_clocks import Clock, rate_clock
from pdhef_logtool.logs.table_columns import Sheet, clock_notes, field_name, find_clock, tables_of, unique
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.logs.table_log import Table
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import IntArray, Loss

#: Columns of a matrix that become fields.
_MOST_COLUMNS = 16
#: Separates the parts of a path.
_SLASH = "/"


def open_mat(file: TableFile) -> Tables:
    """Read a MAT file; a variable that cannot be read is a loss."""
    losses: list[Loss] = []
    hdf5 = file.stream.read(len(HDF5_MAT)) == HDF5_MAT
    file.stream.seek(0)
    read = hdf5_variables if hdf5 else mat5_variables
    arrays: dict[str, dict[str, NDArray[Any]]] = {}
    units: dict[str, dict[str, str]] = {}
    unusable = []
    leaves = (leaf for name, value in read(file, losses) for leaf in _leaves(name, value, 0))
    for path, array, unit in leaves:
        struct_, _, name = path.rpartition(_SLASH)
        vectors = _vectors(name, array)
        unusable += [f"{path} {array.shape}"] if array.size > 1 and not vectors else []
        arrays.setdefault(struct_, {}).update(vectors)
        units.setdefault(struct_, {}).update(dict.fromkeys(vectors, unit))
    if unusable:
        what = f"arrays that are no vectors are left out: {', '.join(unusable)}"
        losses.append(Loss("no-numbers", what, file.name, count=len(unusable), severity="note"))
    tables = list(_mat_tables(arrays, units, file, losses))
    if not tables:
        raise LogError(
            expected="a vector of times (t, time, ...) as long as the signals beside it",
            got=", ".join(name for columns in arrays.values() for name in columns) or "no numeric variables",
            where=file.name,
            remedy="name the vector of times so; without one, state the samples per second: --set rate_hz=100, "
            "or rate_hz in the mapping file",
        )
    return Tables("mat-7.3" if hdf5 else "mat", tables, losses)


def _mat_tables(
    arrays: Mapping[str, Mapping[str, NDArray[Any]]],
    units: Mapping[str, Mapping[str, str]],
    file: TableFile,
    losses: list[Loss],
) -> Iterator[Table]:
    """Yield the tables of the structs; vectors without a clock of their length are noted."""
    where = file.name
    sheets = []
    for struct_, variables in arrays.items():
        lengths = dict.fromkeys(len(v) for v in variables.values() if len(v) > 1)
        for length in sorted(lengths, reverse=True):
            columns = {n: v for n, v in variables.items() if len(v) == length}
            name = field_name(struct_) if struct_ else "mat"
            sheets.append((struct_, length, Sheet(name, columns, units[struct_])))
    clocks = _clocks(sheets, where, file.settings.rate_hz)
    rows: list[tuple[Sheet, IntArray]] = []
    for struct_, length, sheet in sheets:
        clock = _clock_of(struct_, length, clocks)
        if clock is None:
            text = f"{', '.join([*sheet.columns][:5])} ({length} values) have no times of their length, or several"
            losses.append(Loss("no-clock", text, where, severity="note"))
            continue
        is_own = clocks.get((struct_, length)) is clock
        if is_own:
            losses += clock_notes(clock, f"{where}, {sheet.name}")
        signals = {n: v for n, v in sheet.columns.items() if not is_own or n not in clock.columns}
        rows += [(Sheet(sheet.name, signals, sheet.units), clock.stamps_ns)] if signals else []
    for name, (sheet, stamps) in zip(unique(sheet.name for sheet, _ in rows), rows, strict=True):
        yield from tables_of(Sheet(name, sheet.columns, sheet.units), where, losses, stamps)


def _clocks(
    sheets: Sequence[tuple[str, int, Sheet]], where: str, rate_hz: float | None
) -> dict[tuple[str, int], Clock]:
    """Return the clocks of sheets; those without a unit are read beside certain ones, or the longest one.

    Without any clock, ``rate_hz`` applies to the length that most vectors have.
    """
    clocks: dict[tuple[str, int], Clock] = {}
    for struct_, length, sheet in sheets:
        with suppress(LogError):
            clocks[struct_, length] = find_clock(sheet, where)
    if not clocks and rate_hz:
        counts = Counter(length for _, length, sheet in sheets for _ in sheet.columns)
        return {(s, n): rate_clock(n, rate_hz) for s, n, _ in sheets if n == counts.most_common(1)[0][0]}
    certain = {key for key, clock in clocks.items() if clock.is_certain}
    certain = certain or set(sorted(clocks, key=lambda key: -key[1])[:1])
    others = [clocks[key] for key in clocks if key in certain]
    for struct_, length, sheet in sheets:
        if (struct_, length) in clocks and (struct_, length) not in certain:
            clocks[struct_, length] = find_clock(sheet, where, others, rate_hz)
    return clocks


def _clock_of(struct_: str, length: int, clocks: Mapping[tuple[str, int], Clock]) -> Clock | None:
    """Return the clock of a struct, or of the nearest struct around it or beside it, for vectors of a length."""
    while (struct_, length) not in clocks:
        if not struct_:
            return None
        struct_ = struct_.rpartition(_SLASH)[0]
        beside = [c for key, c in clocks.items() if key[1] == length and key[0].startswith(f"{struct_}{_SLASH}")]
        if struct_ and len({clock.stamps_ns.tobytes() for clock in beside}) == 1:
            return beside[0]
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


def _leaves(path: str, value: Any, depth: int, unit: str = "") -> Iterator[tuple[str, NDArray[Any], str]]:
    if isinstance(value, np.ndarray) and value.dtype != object:
        yield path, value, unit
    elif isinstance(value, dict) and depth < DEEPEST:
        for name, inner in value.items():
            yield from _leaves(f"{path}{_SLASH}{name}", inner, depth + 1, _text_of(value, "unit", "units"))
    elif isinstance(value, list | np.ndarray) and depth < DEEPEST:
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
