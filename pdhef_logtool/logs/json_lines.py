"""JSON lines: an object a line, with a key for each column, or in long form with a name, a value and a time.

Keys of objects inside of objects are joined by dots.
"""

from __future__ import annotations

import json
from array import array
from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

import numpy as np

from pdhef_logtool.logs.constants import CONSTANTS
from pdhef_logtool.logs.table_cells import read_cells
from pdhef_logtool.logs.table_columns import Sheet, read_head, tables_of
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import Loss

_MOST_ELEMENTS, _LARGEST = CONSTANTS["json"]["elements"], CONSTANTS["json"]["largest"]
#: Values of a column and their rows.
_Cells: TypeAlias = "tuple[array[int], list[Any]]"


def open_json_lines(file: TableFile) -> Tables:
    """Read JSON lines; raises LogError if no line is an object, or no key contains times."""
    losses: list[Loss] = []
    lines, wrong = array("q"), array("q")
    cells: dict[str, _Cells] = {}
    for number, line in enumerate(file.stream, 1):
        try:
            record = json.loads(line) if line.strip() else {}
        except (ValueError, RecursionError):
            record = None
        if not isinstance(record, dict):
            wrong.append(number)
            continue
        for path, value in _leaves(record, "", file.limits.schema_depth):
            rows, values = cells.setdefault(path, (array("q"), []))
            rows.append(len(lines))
            values.append(value)
        file.limits.check("array_width", len(cells), file.name)
        lines.append(number)
    if not cells:
        remedy = "jq -c '.[]' FILE writes the objects of an array as lines"
        raise LogError(expected="a JSON object a line", got="none", where=file.name, remedy=remedy)
    if wrong:
        place = f"{file.name}, from line {wrong[0]} on"
        losses.append(Loss("bad-row", "line that is no JSON object", place, count=len(wrong)))
    file.limits.check_table(8 * len(lines) * len(cells), file.size, file.name)
    fields, units = read_head([*cells])
    columns = {name: _column(name, cells[path], lines, file, losses) for name, path in zip(fields, cells, strict=True)}
    sheet = Sheet("json", columns, units)
    return Tables("json-lines", list(tables_of(sheet, file.name, losses, rate_hz=file.settings.rate_hz)), losses)


def _leaves(value: Any, path: str, depth: int) -> Iterator[tuple[str, Any]]:
    """Yield paths and values of the texts and finite numbers in an object."""
    if isinstance(value, str) or (isinstance(value, int | float) and abs(value) < _LARGEST):
        yield path, value
    elif depth and isinstance(value, dict | list) and (isinstance(value, dict) or len(value) <= _MOST_ELEMENTS):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(inner, f"{path}.{key}" if path else str(key), depth - 1)


def _column(name: str, given: _Cells, lines: Sequence[int], file: TableFile, losses: list[Loss]) -> Any:
    """Return numbers [N] with NaN where a line has none, or texts [N]."""
    import polars as pl

    rows, values = given
    if any(isinstance(value, str) for value in values):
        texts: list[str | None] = [None] * len(lines)
        for row, value in zip(rows, values, strict=True):
            texts[row] = str(value)
        series = pl.Series(texts, dtype=pl.String)
        cells = read_cells(series, ".")
        losses += cells.losses(name, file.name, lines)
        return series if cells.is_text else cells.values
    # Integers stay exact: a double has 256 ns at a date.
    exact = len(set(rows)) == len(lines) and all(isinstance(value, int) and abs(value) < 1 << 63 for value in values)
    column = np.zeros(len(lines), np.int64) if exact else np.full(len(lines), np.nan)
    column[rows] = values
    return column
