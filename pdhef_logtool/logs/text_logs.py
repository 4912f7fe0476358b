"""Logs of text: CSV files of any dialect, and Racelogic's VBO files.

CSV: the delimiter, the decimal comma, the header, a row of units and the encoding are found in the file. Columns with
values in other rows than the rest become a topic of their own. VBO: columns are named as in ``[header]``; latitude and
longitude stay in arc minutes, longitude positive to the west, as documented (``mapping/vendors.toml``).
"""

from __future__ import annotations

import codecs
import csv
import datetime as dt
import io
import re
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import chain, islice, takewhile
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.table_cells import EMPTY, read_cells
from pdhef_logtool.logs.table_columns import (
    NO_TIME,
    Sheet,
    is_unit,
    placed,
    read_head,
    tables_of,
    unwrapped,
    whole_days,
)
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import FloatArray, IntArray, Loss

if TYPE_CHECKING:
    from polars import Series

#: Lines at the start of a CSV file in which its header must be.
_HEAD_LINES = 200
#: Cells that are in memory as texts at the same time.
_CELLS_AT_ONCE = 1 << 24
_CELL_END = "\x1f"
#: Numbers, in any spelling, and times.
_VALUE = re.compile(
    r"\s*([-+−]?(0x[\da-f]+|[\d.,'’\s]*\d[.,]?(e[-+]?\d+)?)|true|false|"
    r"\d{1,4}[./-]\d\d?[./-]\d{2,4}([T ].*)?|(\d\d?:)?\d\d?:\d\d([.,]\d+)?Z?(\s?[AP]M)?)\s*",
    re.IGNORECASE,
)
_EMPTY = re.compile(rf"\s*({EMPTY})\s*", re.IGNORECASE)
codecs.register_error("latin-1", lambda e: (e.object[e.start : e.end].decode("latin-1"), e.end))  # type: ignore[attr-defined]

VBO_TYPE = "vbox/msg/Vbo"
#: Channels of the receiver itself, which ``[channel units]`` leaves out.
_RECEIVER = re.compile(
    r"(satellites|time|latitude|longitude|velocity.*|heading|height|vertical velocity.*|(trigger )?event.*|.*_raw|"
    r"glonass.*|gps.*|beidou.*|solution type.*|long accel.*|lat accel.*|.*distance m|date|avi.*)",
    re.IGNORECASE,
)
_CREATED = re.compile(r"(\d{1,2})/(\d{1,2})/(\d{4})")


def open_csv(file: TableFile) -> Tables:
    """Read a CSV file; raises LogError where it has no header or no column of times."""
    text = _text(file)
    separator = _separator([line for line in islice(text, _HEAD_LINES) if line.strip()][-20:])
    text.seek(0)
    rows = _rows(text, separator)
    head = [*islice(rows, _HEAD_LINES)]
    titles, units, first = _layout([row for _, row in head], file.name)
    fields, given = read_head(titles)
    given |= {name: unit.strip("[](){} ") for name, unit in zip(fields, units, strict=False) if unit.strip()}
    losses: list[Loss] = []
    columns = _columns(chain(head[first:], rows), fields, file, losses, "." if separator == "," else "")
    return Tables("csv", list(tables_of(Sheet("csv", columns, given), file.name, losses)), losses)


def open_vbo(file: TableFile) -> Tables:
    """Read a VBO file; raises LogError where a section is missing."""
    text = _text(file)
    head = "".join(takewhile(lambda line: line.strip().lower() != "[data]", text))
    created, *parts = re.split(r"^\[([^\]\n]*)\][ \t]*\n", head, flags=re.MULTILINE)
    sections = {n.lower(): b.strip("\n").split("\n") for n, b in zip(parts[::2], parts[1::2], strict=True)}
    titles = [t.strip() for t in sections.get("header", ()) if t.strip()]
    rows = [*islice(numbered := _rows(text, " "), 1)]
    if not rows or not titles:
        raise LogError(expected="a VBO file with [header] and [data]", got="none of them", where=file.name)
    fields, given = read_head(titles)
    losses: list[Loss] = []
    above = head.count("\n") + 1
    columns = _columns(((above + line, row) for line, row in chain(rows, numbered)), fields, file, losses)
    units = given | _vbo_units(titles, fields, sections.get("channel units", []))
    sheet = Sheet("vbox", {n: c for n, c in columns.items() if n != "time"}, units, VBO_TYPE)
    if not isinstance(columns.get("time"), np.ndarray):
        raise LogError(expected="a channel time in hhmmss.sss", got=", ".join(fields[:8]), where=file.name)
    stamps = _vbo_stamps(columns, _CREATED.search(created.partition("\n")[0]))
    return Tables("vbo", list(tables_of(sheet, file.name, losses, stamps)), losses)


def _text(file: TableFile) -> io.TextIOWrapper:
    """Return the text of a file: UTF-16 with a byte order mark, otherwise UTF-8; other bytes are read as Latin-1."""
    mark = file.stream.read(2)
    file.stream.seek(0)
    if mark in (b"\xff\xfe", b"\xfe\xff"):
        return io.TextIOWrapper(file.stream, "utf-16", "replace")
    return io.TextIOWrapper(file.stream, "utf-8-sig", "latin-1")


def _rows(lines: Iterable[str], separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of the first line and the cells of each row, one cell where it has no end."""
    if separator == " ":
        lines = (" ".join(line.split()) for line in lines)
    reader = csv.reader(lines, delimiter=separator)
    while True:
        line = reader.line_num + 1
        try:
            row = next(reader, None)
        except csv.Error as error:
            row = [str(error)]
        if row is None:
            return
        yield line, row


def _separator(lines: Sequence[str]) -> str:
    """Return the delimiter that every line contains equally often, otherwise the most frequent one, or a space."""
    lines = [re.sub(r'"[^"]*"', "", line) for line in lines]
    counts = {s: [line.count(s) for line in lines] for s in (";", "\t", "|", ",")}
    regular = next((s for s, n in counts.items() if n and min(n) > 0 and max(n) == min(n)), "")
    frequent = max(counts, key=lambda s: sum(counts[s]))
    return regular or (frequent if any(counts[frequent]) else " ")


def _layout(rows: Sequence[Sequence[str]], where: str) -> tuple[Sequence[str], Sequence[str], int]:
    """Return titles, units and the number of the first row of values."""
    lengths = Counter(len(row) for row in rows[-20:])
    width = max(lengths, key=lambda n: (n > 1, lengths[n], n), default=0)
    rows = [_uncommented(row, width) for row in rows]
    full = next((i for i, row in enumerate(rows) if len(row) == width > 1 and _is_values(row)), 0)
    widths = {width, width - 1} if full and not rows[full][-1].strip() else {width}  # rows may end with a separator
    above = [i for i in range(full) if len(rows[i]) in widths and not _is_values(rows[i])]
    if not above:
        got = "none" if full else "no row of numbers below it"
        raise LogError(expected="a CSV file with a row of column names", got=got, where=where)
    # Titles, and below them units and sources.
    names = max(reversed(above[-3:]), key=lambda i: len({c.strip() for c in rows[i] if not is_unit(c)} - {""}))
    first = next(i for i in range(names + 1, full + 1) if i == full or any(map(_is_number, rows[i])))
    units = next((rows[i] for i in above if names < i < first and _are_units(rows[i])), [])
    return rows[names], units, first


def _uncommented(row: Sequence[str], width: int) -> Sequence[str]:
    """Return a row of ``width`` cells, without the mark of a comment and an empty cell at its end."""
    if row and row[0].startswith("#"):
        first = row[0].lstrip("# ")
        row = [first, *row[1:]] if first or len(row) <= width else row[1:]
    return row[:-1] if len(row) == width + 1 and not row[-1].strip() else row


def _is_number(cell: str) -> bool:
    return _VALUE.fullmatch(cell) is not None and not is_unit(cell)


def _are_units(cells: Sequence[str]) -> bool:
    """Return whether half of the cells that are not empty, or more, are units."""
    given = [cell for cell in cells if not _EMPTY.fullmatch(cell)]
    return 0 < len(given) <= 2 * sum(map(is_unit, given))


def _is_values(cells: Sequence[str]) -> bool:
    given = [c for c in cells if not _EMPTY.fullmatch(c)]
    values = [c for c in given if _VALUE.fullmatch(c)]
    return len(values) > 0 and 2 * len(values) >= len(given)


def _columns(
    rows: Iterable[tuple[int, Sequence[str]]],
    names: Sequence[str],
    file: TableFile,
    losses: list[Loss],
    decimal: str = "",
) -> Mapping[str, NDArray[Any] | Series]:
    """Return the columns of numbered rows: numbers float64 [N] with NaN, or texts [N].

    Rows with another number of cells and cells that are no numbers are losses. ``decimal`` is the decimal mark of
    columns that do not show theirs, if no column of the file does.
    """
    import polars as pl

    lines, data = _fitting(rows, len(names), file, losses)
    columns: dict[str, NDArray[Any] | Series] = dict.fromkeys(names, np.empty(0))
    undecided: dict[str, Series] = {}
    marks: Counter[str] = Counter()
    step = max(1, _CELLS_AT_ONCE // len(lines))
    for start in range(0, len(names), step):
        part = pl.read_csv(
            data,
            has_header=False,
            separator=_CELL_END,
            quote_char=None,
            infer_schema=False,
            columns=[*range(start, min(start + step, len(names)))],
        )
        for name, column in zip(names[start:], part.iter_columns(), strict=False):
            cells = read_cells(column)
            if cells.is_text:
                columns[name] = column.str.strip_chars()
            elif cells.ambiguous:
                undecided[name] = column
            else:
                columns[name] = cells.values
                losses += cells.losses(name, file.name, lines)
                marks[cells.decimal] += 1
    del marks[""]
    for name, column in undecided.items():
        cells = read_cells(column, max(marks, key=lambda m: marks[m], default=decimal))
        columns[name] = cells.values
        losses += cells.losses(name, file.name, lines)
    return columns


def _fitting(
    rows: Iterable[tuple[int, Sequence[str]]], width: int, file: TableFile, losses: list[Loss]
) -> tuple[Sequence[int], bytes]:
    """Return the rows of ``width`` cells: the number of the line of each, and a text without quotes."""
    lines, wrong, comments = array("q"), array("q"), array("q")
    data, line = io.BytesIO(), 0
    for line, row in rows:
        if len(row) == width + 1 and not row[-1].strip():
            row = row[:-1]
        text = _CELL_END.join(row)
        if len(row) == width and text.count(_CELL_END) == width - 1:
            lines.append(line)
            data.write((text.replace("\n", " ") + "\n").encode())
        elif text.strip(_CELL_END + " "):
            (comments if text.startswith("#") else wrong).append(line)
    file.stream.seek(-min(2, file.size), io.SEEK_END)
    cut = file.stream.read().strip(b"\0")[-1:] not in (b"\n", b"\r")
    if cut and wrong[-1:] == array("q", [line]):
        losses.append(Loss("truncated", "the last row is incomplete", file.name, count=1))
        wrong.pop()
    if wrong:
        what = f"row without {width} cells, the first in line {wrong[0]}"
        losses.append(Loss("bad-row", what, file.name, count=len(wrong)))
    if comments:
        what = f"row that begins with #, the first in line {comments[0]}"
        losses.append(Loss("comment", what, file.name, count=len(comments), severity="note"))
    if not lines:
        raise LogError(expected=f"rows of {width} cells", got="none", where=file.name)
    file.limits.check_table(8 * width * len(lines), file.size, file.name)
    return lines, data.getvalue()


def _vbo_units(titles: Sequence[str], fields: Sequence[str], units: Sequence[str]) -> dict[str, str]:
    """Return the units of the channels of input modules; latitude and longitude are in minutes by definition."""
    modules = [f for f, title in zip(fields, titles, strict=True) if not _RECEIVER.fullmatch(title)]
    named = {f: "min" for f in fields if f.startswith(("latitude", "longitude"))}
    for owners in (modules, fields):
        if len(units) == len(owners):
            return named | {f: unit.strip() for f, unit in zip(owners, units, strict=True) if unit.strip()}
    return named


def _vbo_stamps(columns: Mapping[str, Any], created: re.Match[str] | None) -> IntArray:
    """Return the times [N] of ``hhmmss.sss`` on the day that the file was created."""
    clock: FloatArray = columns["time"]
    finite = np.isfinite(clock) & (clock >= 0.0) & (clock < 240_000.0)
    hours, rest = np.divmod(np.where(finite, clock, 0.0), 1e4)
    minutes, seconds = np.divmod(rest, 1e2)
    stamps = np.full(len(clock), NO_TIME, np.int64)
    of_day = unwrapped((3600.0 * hours + 60.0 * minutes + seconds)[finite])
    stamps[finite] = np.round(of_day * 1e6).astype(np.int64) * 1000
    if created is None:
        return placed(stamps)
    try:
        midnight_ns = whole_days(dt.date(int(created[3]), int(created[2]), int(created[1])))
    except ValueError:
        return placed(stamps)
    return np.where(finite, stamps + midnight_ns, NO_TIME)
