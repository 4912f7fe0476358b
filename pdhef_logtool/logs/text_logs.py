"""Logs of text: CSV files of any dialect, and Racelogic's VBO files.

CSV: the delimiter, the decimal comma, the header, a row of units and the encoding are found in the file. Columns with
values in other rows than the rest become a topic of their own. VBO: columns are named as in ``[header]``; latitude and
longitude stay in arc minutes, longitude positive to the west, as documented (``mapping/vendors.toml``).
"""

from __future__ import annotations

import csv
import datetime as dt
import io
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.table_clocks import NO_TIME, placed, unwrapped, whole_days
from pdhef_logtool.logs.table_columns import Sheet, field_name, is_unit, read_head, tables_of, unique
from pdhef_logtool.logs.table_file import TableFile, Tables
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import FloatArray, IntArray, Loss

if TYPE_CHECKING:
    from polars import Series

#: Lines at the start of a CSV file in which its header must be.
_HEAD_LINES = 200
_NUMBER = re.compile(r"\s*[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?\s*")
_TIME_TEXT = re.compile(r"\s*(\d{1,4}[./-]\d\d?[./-]\d{2,4}([T ].*)?|(\d\d?:)?\d\d?:\d\d([.,]\d+)?Z?)\s*")
_EMPTY = frozenset({"", "nan", "null", "none", "na", "n/a", "-"})
_TRUTHS = {"true": 1.0, "false": 0.0}

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
    lines = _decoded(file.stream.read()).split("\n")
    separator, header, units, first = _layout(lines, file.name)
    fields, given = read_head(header)
    given |= {name: unit.strip("[](){} ") for name, unit in zip(fields, units, strict=False) if unit.strip()}
    losses: list[Loss] = []
    columns = _columns(lines[first:], separator, fields, file.name, losses)
    return Tables("csv", list(tables_of(Sheet("csv", columns, given), file.name, losses)), losses)


def open_vbo(file: TableFile) -> Tables:
    """Read a VBO file; raises LogError where a section is missing."""
    text = file.stream.read().decode("latin-1").replace("\r\n", "\n")
    head, mark, data = text.partition("[data]\n")
    sections = {n.lower(): b.strip("\n").split("\n") for n, b in re.findall(r"^\[([^\]\n]*)\]\n([^\[]*)", head, re.M)}
    titles = [t.strip() for t in sections.get("header", ()) if t.strip()]
    if not mark or not titles:
        raise LogError(expected="a VBO file with [header] and [data]", got="none of them", where=file.name)
    fields = unique(field_name(title) for title in titles)
    losses: list[Loss] = []
    columns = _columns(data.split("\n"), " ", fields, file.name, losses)
    units = _vbo_units(titles, fields, sections.get("channel units", []))
    sheet = Sheet("vbox", {n: c for n, c in columns.items() if n != "time"}, units, VBO_TYPE)
    if not isinstance(columns.get("time"), np.ndarray):
        raise LogError(expected="a channel time in hhmmss.sss", got=", ".join(fields[:8]), where=file.name)
    stamps = _vbo_stamps(columns, _CREATED.search(head.partition("\n")[0]))
    return Tables("vbo", list(tables_of(sheet, file.name, losses, stamps)), losses)


def _decoded(data: bytes) -> str:
    for mark, encoding in ((b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16"), (b"", "utf-8-sig"), (b"", "latin-1")):
        if data.startswith(mark):
            try:
                return data.decode(encoding).replace("\r\n", "\n").replace("\r", "\n")
            except UnicodeDecodeError:
                continue
    return ""


def _layout(lines: Sequence[str], where: str) -> tuple[str, list[str], list[str], int]:
    """Return delimiter, titles, units and the number of the first row of values."""
    head = lines[:_HEAD_LINES]
    separator = _separator([line for line in head if line.strip()][-20:])
    rows = [_cells(line, separator) for line in head]
    width = max((len(row) for row in rows[-20:]), default=0)
    first = next((i for i, row in enumerate(rows) if len(row) == width > 1 and _is_values(row)), 0)
    widths = {width, width - 1} if first and not rows[first][-1].strip() else {width}  # rows may end with a separator
    above = [row for row in rows[:first] if len(row) in widths and not _is_values(row)]
    if not above:
        got = "none" if first else "no row of numbers below it"
        raise LogError(expected="a CSV file with a row of column names", got=got, where=where)
    below = above[-3:]  # titles, and below them units and sources
    names = max(reversed(range(len(below))), key=lambda i: len({c.strip() for c in below[i] if not is_unit(c)} - {""}))
    units = next((row for row in below[names + 1 :] if _are_units(row)), [])
    return separator, below[names], units, first


def _are_units(cells: Sequence[str]) -> bool:
    """Return whether half of the cells that are not empty, or more, are units."""
    given = [cell for cell in cells if cell.strip().lower() not in _EMPTY]
    return 0 < len(given) <= 2 * sum(map(is_unit, given))


def _separator(lines: Sequence[str]) -> str:
    """Return the delimiter that every line contains equally often, otherwise the most frequent one, or a space."""
    counts = {s: [line.count(s) for line in lines] for s in (";", "\t", "|", ",")}
    regular = next((s for s, n in counts.items() if n and min(n) > 0 and max(n) == min(n)), "")
    frequent = max(counts, key=lambda s: sum(counts[s]))
    return regular or (frequent if any(counts[frequent]) else " ")


def _cells(line: str, separator: str) -> list[str]:
    line = line.strip().lstrip("#").strip() if separator == " " else line.strip("\r ").lstrip("#")
    if separator == " ":
        return line.split()
    return next(csv.reader([line], delimiter=separator), [])


def _is_values(cells: Sequence[str]) -> bool:
    given = [c for c in cells if c.strip().lower() not in _EMPTY]
    values = [c for c in given if _NUMBER.fullmatch(c) or _TIME_TEXT.fullmatch(c) or c.strip().lower() in _TRUTHS]
    return len(values) > 0 and 2 * len(values) >= len(given)


def _columns(
    lines: Sequence[str], separator: str, names: Sequence[str], where: str, losses: list[Loss]
) -> Mapping[str, NDArray[Any] | Series]:
    """Return the columns of rows of text; rows with another number of cells are a loss."""
    import polars as pl

    lines = [line.strip("\r ") for line in lines]
    ended = not lines or not lines[-1]
    if separator == " ":
        lines = [" ".join(line.split()) for line in lines]
    rows = [line for line in lines if line and not line.startswith("#")]
    if not any('"' in row for row in rows[:_HEAD_LINES]):
        more = len(names) - 1  # and maybe one at the end of a row
        fits = [more in (n := row.count(separator), n - row.endswith(separator)) for row in rows]
        kept = [row for row, fit in zip(rows, fits, strict=True) if fit]
        wrong = len(rows) - len(kept)
        if wrong and not ended and not fits[-1]:
            losses.append(Loss("truncated", "the last row is incomplete", where, count=1))
            wrong -= 1
        if wrong:
            losses.append(Loss("bad-row", f"row without {len(names)} cells", where, count=wrong))
        rows = kept
    if not rows:
        raise LogError(expected=f"rows of {len(names)} cells", got="none", where=where)
    schema = dict.fromkeys(names, pl.String)
    data = io.BytesIO("\n".join(rows).encode())
    frame = pl.read_csv(data, has_header=False, separator=separator, schema=schema, truncate_ragged_lines=True)
    return {name: _column(frame[name]) for name in names}


def _column(texts: Series) -> NDArray[Any] | Series:
    """Return a column as numbers float64 [N], NaN where a cell has none; as it is where it contains texts."""
    import polars as pl

    texts = points = texts.str.strip_chars()
    if texts.head(1000).str.contains(",", literal=True).any():
        plain = texts.str.replace_all(".", "", literal=True).str.replace(",", ".", literal=True)
        points = pl.select(pl.when(texts.str.contains(",", literal=True)).then(plain).otherwise(texts)).to_series()
    numbers = points.cast(pl.Float64, strict=False)
    given = texts.filter(~texts.str.to_lowercase().is_in(list(_EMPTY)))
    if given.len() == 0:
        return np.full(len(texts), np.nan)
    if given.str.to_lowercase().is_in(list(_TRUTHS)).all():
        return texts.str.to_lowercase().replace_strict(_TRUTHS, default=None, return_dtype=pl.Float64).to_numpy()
    if 2 * numbers.is_not_null().sum() < given.len():
        return texts
    return numbers.fill_null(float("nan")).to_numpy()


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
