"""Logs of text: CSV files of any dialect, Racelogic's VBO files, and JSON lines.

CSV: the delimiter, the decimal mark, the header, a row of units and the encoding are detected. Each row is read, or it
is a loss with its line. VBO: columns are named as in ``[header]``; latitude and longitude stay in arc minutes with
longitude positive to the west, as documented (``mapping/vendors.toml``). A file with the other sign, which the heading
shows, is mirrored. JSON lines: an object a line, with a key for each column, or in long form with a name, a value and a
time; keys of objects inside of objects are joined by dots.
"""

import codecs
import csv
import datetime as dt
import io
import json
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import chain, islice
from typing import Any, Literal

import numpy as np
import polars as pl
from polars import Series

from pdhef_logtool.logs.constants import CONSTANTS
from pdhef_logtool.logs.mat_log import tables_of_variables
from pdhef_logtool.logs.table_cells import EMPTY, read_cells
from pdhef_logtool.logs.table_clocks import NO_TIME, TIME_UNITS_NS, of_digits, placed, to_ns, whole_days
from pdhef_logtool.logs.table_columns import PATTERNS, Sheet, by_times, field_name, is_unit, read_head, tables_of
from pdhef_logtool.logs.table_file import NUMBER_BYTES, TableFile, Tables
from pdhef_logtool.logs.table_log import Table
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import FloatArray, IntArray, Loss

#: Lines at the start of a CSV file in which its header must be; cells below it that show the decimal mark; lines that
#: show the structure of the rows; cells that are in memory as texts at the same time.
#: Least share of values in rows of long forms.
_HEAD_LINES, _CELLS_OF_HEAD, _SAMPLE_LINES, _CELLS_AT_ONCE, _LEAST_VALUES = 200, 10_000, 20, 1 << 23, 0.3
_CELL_END, _SPACES = "\x1f", r"\s{2,}"
codecs.register_error("as-latin-1", lambda e: (e.object[e.start : e.end].decode("latin-1"), e.end))  # type: ignore[attr-defined]

VBO_TYPE = "vbox/msg/Vbo"
#: Share of the path that is along the heading if the signs of the positions are right.
_ALONG_HEADING = 0.95

_MOST_ELEMENTS, _LARGEST, _DEEPEST = (CONSTANTS["json"][name] for name in ("elements", "largest", "deepest"))


def open_csv(file: TableFile) -> Tables:
    """Read a CSV file; raises LogError if the file has no header or no column of times."""
    losses: list[Loss] = []
    with _text(file) as text:
        lines = [line for line in islice(text, _HEAD_LINES) if line.strip()]
        if (records := _records_of_lines(lines, text, file)) is not None:
            return records
        given_separator = re.match(r"(?i)\ufeff?\"?sep=(.)", lines[0]) if lines else None
        separator = given_separator[1] if given_separator else _separator(lines)
        file.limits.check("array_width", max((line.count(separator) for line in lines), default=0), file.name)
        text.seek(0)
        rows = _rows(text, separator)
        head = [*islice(rows, _HEAD_LINES)]
        if titles_of := _titles_of_kinds([row for _, row in head]):
            return _tables_of_kinds(chain(head, rows), titles_of, file)
        titles, units, first = _layout([row for _, row in head], file.name)
        stated_hz = _stated_rate(row for _, row in head[:first])
        fields, given = read_head(titles)
        given |= {name: unit for name, unit in zip(fields, units, strict=False) if unit}
        cells = islice((cell for _, row in head[first:] for cell in row), _CELLS_OF_HEAD)
        decimal = read_cells(pl.Series(cells, dtype=pl.String)).decimal or ("." if separator == "," else "")
        tables: list[Table] = []
        rows, rate_hz = chain(head[first:], rows), file.settings.rate_hz or stated_hz
        while titles:
            following: list[str] = []
            columns = _columns(_until_titles(rows, titles, following), fields, file, losses, decimal, given)
            for sheet in by_times(f"csv_{len(tables) + 1}" if tables else "csv", columns, given):
                tables += tables_of(sheet, file.name, losses, rate_hz=rate_hz)
            titles, (fields, given) = following, read_head(following)
    return Tables("csv", tables, losses)


def _records_of_lines(lines: Sequence[str], text: io.TextIOWrapper, file: TableFile) -> Tables | None:
    """Return the tables of a text whose first lines are objects, or numbers with names; None for another one."""
    file.stream.seek(0)
    if lines and lines[0].startswith("{"):
        return open_json_lines(file)
    text.seek(0)
    is_log = bool(lines) and all(map(_record_of_pairs, lines[-_SAMPLE_LINES:]))
    return _tables_of_records(map(_record_of_pairs, text), file, "csv", "csv") if is_log else None


def _until_titles(
    rows: Iterable[tuple[int, list[str]]], titles: Sequence[str], following: list[str]
) -> Iterator[tuple[int, list[str]]]:
    """Yield the rows of a block of columns; ``following`` gets the titles of the next block, which begins alike."""
    for number, row in rows:
        if row and row[0] == titles[0].strip() and row[1:] != [*titles[1:]] and not any(map(_is_value, row)):
            following += row
            return
        yield number, row


def _stated_rate(head: Iterable[Sequence[str]]) -> float | None:
    """Return the rows per second that a line above the columns states; None without one."""
    for label, *values in (row if len(row) > 1 else re.split("[:=]", row[0], maxsplit=1) for row in head if row):
        number = next((cell for cell in values if cell.strip()), "")
        value = re.match(r"\s*(\d+(?:[.,]\d*)?(?:e[-+]?\d+)?)\s*(\w*)", number, re.IGNORECASE)
        text = label.strip(" \t:#").lower()
        of = next((kind for kind in ("rate", "step") if PATTERNS[kind].fullmatch(text)), "")
        if value and of and (amount := float(value[1].replace(",", "."))) > 0.0:
            unit = (value[2] or re.sub(r".*\W(\w+)\W*", r"\1", label)).lower()
            seconds = TIME_UNITS_NS.get(unit, TIME_UNITS_NS["s"]) / TIME_UNITS_NS["s"]
            return amount * (1000.0 if unit == "khz" else 1.0) if of == "rate" else 1.0 / (amount * seconds)
    return None


def _titles_of_kinds(head: Sequence[Sequence[str]]) -> dict[str, list[str]]:
    """Return the titles of the columns of each kind of row, by the first cell of the rows; empty for other files.

    Remarks give the titles (``# Fix,Latitude,...``), or rows ``FMT`` of an autopilot (type, length, name, format, ...).
    """
    titles_of = {
        row[0].lstrip("#% "): [c.strip() for c in row[1:]] for row in head if row and row[0].startswith(("#", "%"))
    }
    titles_of |= {row[3].strip(): [c.strip() for c in row[5:]] for row in head if len(row) > 5 and row[0] == "FMT"}
    kinds = {row[0].strip() for row in head if len(row) > 1 and re.match("[$#A-Za-z]", row[0]) and row[0] != "FMT"}
    titles_of |= {kind: t.split() for kind in kinds for end, t in CONSTANTS["sentences"].items() if kind.endswith(end)}
    return {k: titles for k, titles in titles_of.items() if k in kinds and len(titles) > 1}


def _tables_of_kinds(
    rows: Iterable[tuple[int, Sequence[str]]], titles_of: Mapping[str, Sequence[str]], file: TableFile
) -> Tables:
    """Return a table for each kind of row with times."""
    lines: dict[str, list[tuple[int, list[str]]]] = {}
    for number, (kind, *cells) in ((n, row) for n, row in rows if row and row[0].strip() in titles_of):
        cells = [re.sub(r"\*[\dA-Fa-f]+\s*$", "", c).strip() for cell in cells for c in cell.split(";")]
        lines.setdefault(kind.strip(), []).append((number, cells[: len(titles_of[kind.strip()])]))
    losses: list[Loss] = []
    tables: list[Table] = []
    for kind, its in lines.items():
        fields, given = read_head(titles_of[kind])
        columns = _columns(its, fields, file, losses, ".", given)
        with suppress(LogError):  # parameters and messages have no times
            tables += tables_of(Sheet(field_name(kind), columns, given), file.name, losses)
    return Tables("csv", tables, losses)


def open_vbo(file: TableFile) -> Tables:
    """Read a VBO file; raises LogError if a section is missing."""
    with _text(file) as text:
        head, mark, data = text.read().partition("[data]\n")
    parts = re.split(r"^\[([^\]\n]*)\]\n", head, flags=re.MULTILINE)
    sections = {n.lower(): b.strip("\n").split("\n") for n, b in zip(parts[1::2], parts[2::2], strict=True)}
    titles = [t.strip() for t in sections.get("header", ()) if t.strip()]
    if not mark or not titles:
        raise LogError(expected="a VBO file with [header] and [data]", got="none of them", where=file.name)
    fields, given = read_head(titles)
    losses: list[Loss] = []
    above = [""] * (head.count("\n") + 1)
    columns = _columns(_rows(chain(above, data.split("\n")), " "), fields, file, losses, ".", given)
    if _is_mirrored(columns):
        what = "longitude is positive to the east, against the format, as the heading shows: its sign is changed"
        losses.append(Loss("mirrored", what, file.name, severity="note"))
        columns["longitude"] = -columns["longitude"]
    modules = [f for f, title in zip(fields, titles, strict=True) if not PATTERNS["receiver"].fullmatch(title)]
    units = {f: "min" for f in fields if f.startswith(("latitude", "longitude"))}
    units |= _channel_units(sections.get("channel units", []), modules, fields, file.name, losses) | given
    sheet = Sheet("vbox", {n: c for n, c in columns.items() if n != "time"}, units, VBO_TYPE)
    if not isinstance(columns.get("time"), np.ndarray):
        raise LogError(expected="a channel time in hhmmss.sss", got=", ".join(fields[:8]), where=file.name)
    stamps = _vbo_stamps(columns, PATTERNS["created"].findall(head.partition("\n")[0]))
    return Tables("vbo", list(tables_of(sheet, file.name, losses, stamps)), losses)


def _text(file: TableFile) -> io.TextIOWrapper:
    """Return the text of a file in the encoding that its first bytes show; bytes without a meaning are Latin-1."""
    start = file.stream.read(io.DEFAULT_BUFFER_SIZE)
    file.stream.seek(0)
    shown = (name for name, pattern in CONSTANTS["encodings"].items() if re.match(pattern.encode(), start))
    return io.TextIOWrapper(file.stream, next(shown, "utf-8-sig"), "as-latin-1")


def _rows(lines: Iterable[str], separator: str) -> Iterator[tuple[int, list[str]]]:
    """Yield the number of the last line and the cells of each row; a row with an endless cell has one cell."""
    if separator == _SPACES:
        yield from ((i, re.split(separator, line.strip())) for i, line in enumerate(lines, 1))
        return
    reader = csv.reader((" ".join(n.split()) for n in lines) if separator == " " else lines, delimiter=separator)
    while True:
        try:
            yield from ((reader.line_num, row) for row in reader)
            return
        except csv.Error as error:
            yield reader.line_num, [str(error)]


def _separator(lines: Sequence[str]) -> str:
    """Return the delimiter that every line contains equally often, otherwise the most frequent one, or spaces.

    Several spaces are the delimiter if one of them is in a title.
    """
    every = [re.sub(r'"[^"]*"', "", line) for line in lines]
    lines = every[-_SAMPLE_LINES:]
    if all(re.match(r"[$#%][A-Z\d]{3,},", line) for line in lines):  # sentences of a receiver
        return ","
    counts = {s: [line.count(s) for line in lines] for s in (";", "\t", "|", ",", ":")}
    regular = next((s for s, n in counts.items() if n and min(n) > 2 * (s == ":") and max(n) == min(n)), "")
    frequent = max([*counts][:-1], key=lambda s: sum(counts[s]))
    widths = [len(re.split(_SPACES, line.strip())) for line in every]
    titles = (line for line, n in zip(every, widths, strict=True) if n == widths[-1] > 1)
    is_aligned = len({*widths[-_SAMPLE_LINES:]}) == 1 and any(
        re.search(r"[a-z.] [a-z(]", t, re.IGNORECASE) for t in titles
    )
    return regular or (frequent if any(counts[frequent]) else _SPACES if is_aligned else " ")


def _layout(rows: Sequence[Sequence[str]], where: str) -> tuple[Sequence[str], Sequence[str], int]:
    """Return titles, units and the number of the first row of values."""
    lengths = Counter(len(row) for row in rows[-_SAMPLE_LINES:])
    width = max(lengths, key=lambda n: (n > 1, lengths[n], n), default=0)
    rows = [_uncommented(row, width) for row in rows]
    header = max((i for i, row in enumerate(rows) if row and PATTERNS["end_of_header"].fullmatch(row[0])), default=-1)
    data = _data_rows(rows, width)
    shares = {i: _share(rows[i], _is_value) for i in data if i > header and len(rows[i]) == width > 1}
    # Rows of a value with its name, its unit and its device.
    numbers = [i for i in shares if shares[i] >= 0.5] or [i for i in shares if shares[i] >= _LEAST_VALUES]
    # Above the titles there may be a row with the numbers of the channels.
    full, above = next(((n, above) for n in numbers[:2] if (above := _titles(rows[: n + 1], width, header))), (0, []))
    listed = [m[1] for row in rows if (m := PATTERNS["listed"].fullmatch(", ".join(row))) is not None]
    if not above and numbers and width - len(listed) in (0, 1):
        return ["Time", *listed][-width:], [], numbers[0]
    if not above:
        got = "none" if numbers else "no row of numbers below it"
        raise LogError(expected="a CSV file with a row of column names", got=got, where=where)
    return _head(rows, above, [i for i in above if i > header][-3:], full, data)


def _head(
    rows: Sequence[Sequence[str]], above: Sequence[int], last: Sequence[int], full: int, data: Sequence[int]
) -> tuple[Sequence[str], Sequence[str], int]:
    """Return :func:`_layout` by the rows of texts ``above`` the first row of numbers ``full``; ``last`` has titles."""
    width = len(rows[full])
    is_labelled = not any(row[0].strip() for row in rows[full : full + 3])
    names = _names_row(rows, last, above if is_labelled or len(above) > len(last) else [])
    below = (i for i in range(names + 1, full) if i in data)
    first = next((i for i in below if any(PATTERNS["value"].fullmatch(c) and not is_unit(c) for c in rows[i])), full)
    of_units = next((i for i in above if i != names and _share(rows[i], is_unit) >= 0.5), -1)
    has_groups = names - 1 in above and not is_labelled and of_units != names - 1
    under = [rows[i] for i in above if names < i < first]
    named = _filled(rows[names][:width], [rows[i] for i in reversed(last) if i != names])
    titles = _joined(named, rows[names - 1] if has_groups else [], under)
    if len(titles) < width and rows[full][-1].strip():  # names of the rows without a title, as R writes them
        titles = ["row", *titles]
    return titles, _units(rows[of_units]) if of_units >= 0 else [], first


def _units(row: Sequence[str]) -> list[str]:
    """Return the units of a row, without its label."""
    units = ["" if (not i or re.search("(?i)unit|einheit", c)) and not is_unit(c) else c for i, c in enumerate(row)]
    return [PATTERNS["unit_label"].sub("", c).strip("[](){} ") for c in units]


def _filled(titles: Sequence[str], others: Sequence[Sequence[str]]) -> list[str]:
    """Return titles, an empty one by the other rows: ``TIME`` above ``STAMP``."""
    columns = ((row[i].strip() for row in others if i < len(row)) for i in range(len(titles)))
    texts = (next((cell for cell in column if cell and not is_unit(cell)), "") for column in columns)
    return [title or text for title, text in zip(titles, texts, strict=True)]


def _data_rows(rows: Sequence[Sequence[str]], width: int) -> list[int]:
    """Return the rows without a label: below a text in a first column of numbers is a sample rate, or a block size."""
    starts = [row[0].strip() for row in rows[-_SAMPLE_LINES:] if len(row) == width]
    has_labels = _share(starts, _is_value) >= 0.9 or not any(starts)
    return [i for i, row in enumerate(rows) if row and not (has_labels and row[0].strip() and not _is_value(row[0]))]


def _names_row(rows: Sequence[Sequence[str]], last: Sequence[int], labelled: Sequence[int]) -> int:
    """Return the row of titles: labelled so, or with most texts that are no units."""
    names = max(reversed(last), key=lambda i: len({c.strip() for c in rows[i] if not is_unit(c)} - {""}))
    return next((i for i in labelled if PATTERNS["label"].fullmatch(rows[i][0].strip())), names)


def _titles(rows: Sequence[Sequence[str]], width: int, header: int) -> list[int]:
    """Return the rows of texts above the last row.

    Rows may end with a separator; titles behind a header may have one for a comment.
    """
    widths = {width, width - 1} if not rows[-1][-1].strip() else {width}
    texts = [i for i, row in enumerate(rows[:-1]) if _share(row, _is_value) < 0.5]
    exact = [i for i in texts if len(rows[i]) in widths]
    return exact if any(i > header for i in exact) else [i for i in texts if abs(len(rows[i]) - width) <= 1 < width]


def _is_value(cell: str) -> bool:
    """Return whether a cell is a number, a time, or a number with its unit."""
    with_unit = PATTERNS["quantity"].fullmatch(cell)
    return bool(PATTERNS["value"].fullmatch(cell) or (with_unit and is_unit(with_unit[1])))


def _joined(titles: Sequence[str], groups: Sequence[str], below: Sequence[Sequence[str]]) -> Sequence[str]:
    """Return titles with the repeated titles of their groups in front, and the title of an index column below them."""
    if groups and len({c.strip() for c in groups}) < len(titles) and all(groups) and not any(map(_is_value, groups)):
        titles = [*titles[:1], *(f"{group}_{n}" for group, n in zip(groups[1:], titles[1:], strict=False))]
    return [next((row[0] for row in below if row[0] and not any(row[1:])), titles[0]), *titles[1:]]


def _uncommented(row: Sequence[str], width: int) -> Sequence[str]:
    """Return a row of ``width`` cells, without the mark of a comment and an empty cell at its end."""
    if row and (mark := PATTERNS["comment"].match(row[0])):
        listed = " ".join(row)[mark.end() :].lstrip("# ").split(",")
        if len(listed) == width:  # as NumPy writes titles above columns with another separator
            return listed
        title = row[0][mark.end() :].lstrip("# ")
        row = [title, *row[1:]] if title or len(row) <= width else row[1:]
    return row[:-1] if len(row) == width + 1 and not row[-1].strip() else row


def _share(cells: Sequence[str], matches: Callable[[str], object]) -> float:
    """Return the share of cells that match, of those that are not empty; 0 if all are empty."""
    given = [bool(matches(cell)) for cell in cells if not EMPTY.fullmatch(cell)]
    return sum(given) / max(1, len(given))


def _columns(
    rows: Iterable[tuple[int, list[str]]],
    names: Sequence[str],
    file: TableFile,
    losses: list[Loss],
    decimal: str,
    units: dict[str, str],
) -> dict[str, Any]:
    """Return the columns of numbered rows: numbers float64 [N] with NaN, or texts [N]; add units of cells to ``units``.

    ``decimal`` is the decimal mark of columns that do not show theirs.
    """
    lines, data = _fitting(rows, len(names), file, losses)
    columns = {}
    step = max(1, _CELLS_AT_ONCE // len(lines))
    for start in range(0, len(names), step):
        places = [*range(len(names))[start : start + step]]
        part = pl.read_csv(
            data, has_header=False, separator=_CELL_END, quote_char=None, infer_schema=False, columns=places
        )
        for name, column in zip(names[start:], part.iter_columns(), strict=False):
            cells = read_cells(column, decimal)
            if cells.is_text and (unit := _unit_of_cells(column)):
                cells, units[name] = read_cells(column.str.strip_suffix(unit), decimal), unit
            columns[name] = column.str.strip_chars() if cells.is_text else cells.values
            losses += cells.losses(name, file.name, lines)
    return _with_hemispheres(columns)


def _with_hemispheres(columns: dict[str, Any]) -> dict[str, Any]:
    """Return columns with positions in degrees, negative in the south and west if letters beside them name these.

    Receivers write degrees and minutes as ``4807.038``.
    """
    texts = [(c, {*c.drop_nulls().unique()} - {""}) for c in columns.values() if not isinstance(c, np.ndarray)]
    for letters, place in (("NS", "(?i)(^|_)lat"), ("EW", "(?i)(^|_)(lon|lng)")):
        sides = [c for c, values in texts if values and values <= {*letters}]
        named = ((n, c) for n, c in columns.items() if re.search(place, n) and isinstance(c, np.ndarray))
        names = [n for n, c in named if not (c < 0.0).any()]  # others are signed
        for name in names[:1] if sides else ():
            size = columns[name]
            if np.nanmax(size, initial=0.0) > 180.0:
                degrees, minutes = np.divmod(size, 100.0)
                size = degrees + minutes / 60.0
            columns[name] = np.where((sides[0] == letters[1]).fill_null(value=False).to_numpy(), -size, size)
    return columns


def _unit_of_cells(texts: Series) -> str:
    """Return the unit behind the number in every cell of a column (``0.01 sec``); empty without one."""
    given = texts.str.extract(r"\d\s*([^\d\s.,:;-][^\d\s]*)\s*$")
    unit = given[0] or ""
    return unit if is_unit(unit) and (given == unit).all() and not given.null_count() else ""


def _fitting(
    rows: Iterable[tuple[int, list[str]]], width: int, file: TableFile, losses: list[Loss]
) -> tuple[Sequence[int], bytes]:
    """Return the rows of ``width`` cells: the number of the line of each, and their texts without quotes."""
    file.limits.check("array_width", width, file.name)
    lines, wrong, comments = array("q"), array("q"), array("q")
    data, line = io.BytesIO(), 0
    for line, row in rows:
        if len(row) == width + 1 and not row[-1].strip():
            row.pop()
        text = _CELL_END.join(row)
        if len(row) == width and text.count(_CELL_END) == width - 1:
            lines.append(line)
            data.write((text.replace("\n", " ") + "\n").encode())
        elif text.replace(_CELL_END, " ").strip():
            (comments if text.startswith(("#", "{", "[")) else wrong).append(line)
    cut = [wrong.pop()] if wrong[-1:] == array("q", [line]) and len(row) < width else []
    for kind, what, numbers in (
        ("truncated", "the last row is incomplete", cut),
        ("bad-row", f"row without {width} cells", wrong),
        ("comment", "row that begins with #, { or [", comments),
    ):
        if numbers:
            place = f"{file.name}, from line {numbers[0]} on"
            severity: Literal["note", "lost"] = "note" if numbers is comments else "lost"
            losses.append(Loss(kind, what, place, count=len(numbers), severity=severity))
    if not lines:
        raise LogError(expected=f"rows of {width} cells", got="none", where=file.name)
    file.check(NUMBER_BYTES * width * len(lines))
    return lines, data.getvalue()


def _is_mirrored(columns: Mapping[str, Any]) -> bool:
    """Return whether the path agrees with the heading only if longitude (arc minutes) is positive to the east."""
    names = ("latitude", "longitude", "heading")
    if not all(isinstance(columns.get(name), np.ndarray) for name in names):
        return False
    latitude, longitude, heading = (columns[name] for name in names)
    path = np.diff(latitude) + 1j * np.diff(longitude) * np.cos(np.radians(latitude[1:] / 60.0))
    direction = np.exp(-1j * np.radians(heading[1:]))
    east, west = (np.nansum((p * direction).real) for p in (path, path.conj()))
    length = np.nansum(np.abs(path))
    return bool(east > max(_ALONG_HEADING * length, west + (1.0 - _ALONG_HEADING) * length))


def _channel_units(
    units: Sequence[str], modules: Sequence[str], fields: Sequence[str], where: str, losses: list[Loss]
) -> dict[str, str]:
    """Return the units of the channels of input modules, or of all channels, by the lines of ``[channel units]``.

    Of lines that are more or fewer than the channels, a quantity has its unit if each of its channels has the same one.
    """
    units = [unit.strip() for unit in units]
    for owners in (modules, fields):
        if len(units) == len(owners):
            return {f: unit for f, unit in zip(owners, units, strict=True) if unit}
    named: dict[str, str] = {}
    for quantity in CONSTANTS["vbo"]["quantities"].values():
        its = [unit for unit in units if unit.lower() in quantity["units"]]
        owners = [f for f in modules if re.search(quantity["names"], f.lower())]
        named |= dict.fromkeys(owners, its[0]) if len(its) == len(owners) and len(set(its)) == 1 else {}
    if any(units):
        rest = [f for f in modules if f not in named]
        what = (
            f"[channel units] has {len(units)} lines for {len(modules)} channels: used for {', '.join(named) or 'none'}"
        )
        what += f", no unit is known of {', '.join(rest)}"
        losses.append(Loss("units", what, where, count=len(rest), severity="note"))
    return named


def _vbo_stamps(columns: Mapping[str, Any], created: Iterable[tuple[str, str, str]]) -> IntArray:
    """Return the times [N] of ``hhmmss.sss`` on the day that the file was created."""
    clock: FloatArray = columns["time"]
    finite = np.isfinite(clock) & (clock >= 0.0) & (clock < 240_000.0)
    stamps = np.full(len(clock), NO_TIME, np.int64)
    stamps[finite] = to_ns(of_digits(clock[finite])[0])
    with suppress(ValueError):
        for day, month, year in created:
            return np.where(finite, stamps + whole_days(dt.date(int(year), int(month), int(day))), NO_TIME)
    return placed(stamps)


def open_json_lines(file: TableFile) -> Tables:
    """Read JSON lines, or one document; raises LogError if there is no object, or no key contains times."""
    head, following = file.stream.readline(), file.stream.readline()
    file.stream.seek(0)
    document: Any = None
    if not following or _record_of_json(head) is None:
        with suppress(ValueError, RecursionError):
            document = json.load(file.stream)
        file.stream.seek(0)
    if records := sorted(_lists_of_records(document, _DEEPEST), key=lambda named: -len(named[1])):
        tables = _tables_of_records(records[0][1], file, "json", records[0][0] if records[1:] else "json")
        for name, its in records[1:]:
            with suppress(LogError):  # a list without times
                others = _tables_of_records(its, file, "json", name)
                tables = Tables("json", [*tables.tables, *others.tables], [*tables.losses, *others.losses])
        return tables
    if not isinstance(document, dict) or not any(isinstance(value, dict | list) for value in document.values()):
        return _tables_of_records(map(_record_of_json, file.stream), file, "json-lines")
    losses: list[Loss] = []
    variables = ((name, _array_of(value, _DEEPEST)) for name, value in document.items())
    return Tables("json", tables_of_variables(variables, file, losses), losses)


def open_line_protocol(file: TableFile) -> Tables:
    """Read lines of a measurement, its tags, its fields and a time in ns, as databases of time series take them."""
    return _tables_of_records(map(_record_of_line, file.stream), file, "lines", "lines")


def _record_of_pairs(line: str) -> dict[str, Any] | None:
    """Return the numbers of a line of a program's log, ``2025-11-24 14:05:12 [imu] ax=0.1``, by device and name."""
    time, pairs = PATTERNS["log_time"].match(line), PATTERNS["pair"].findall(line)
    if time is None or not pairs:
        return None if line.strip() else {}
    device = re.search(r"\[([A-Za-z]\w*)\]", line)
    values: dict[str, Any] = {name: float(value) for name, value in pairs}
    return {"time": time[1].replace(",", "."), **({device[1]: values} if device else values)}


def _record_of_json(line: bytes) -> dict[str, Any] | None:
    """Return the object of a line: empty for an empty line, None for a line without one."""
    try:
        record = json.loads(line) if line.strip() else {}
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) else None


def _record_of_line(line: bytes) -> dict[str, Any] | None:
    """Return the fields of a line by measurement and name; empty for a comment, None for another text."""
    text = line.decode("utf-8", errors="replace").strip()
    if not text or text.startswith("#"):
        return {}
    parts = re.fullmatch(r"((?:[^\s,\\]|\\.)+)(?:,(?:[^\s\\]|\\.)*)?\s+(\S.*?)\s+(\d+)", text)
    fields = {} if parts is None else dict(re.findall(r"((?:[^,=\\]|\\.)+)=([-+.\deE]+)[iu]?(?:,|$)", parts[2]))
    return {"time": int(parts[3]), parts[1]: {n: float(v) for n, v in fields.items()}} if parts and fields else None


def _lists_of_records(value: Any, depth: int, name: str = "json") -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yield the names and lists of objects in a document, and tables of their columns' names and rows."""
    if isinstance(value, dict) and depth:
        if table := _named_rows(value):
            yield name, table
            return
        if value and all(key.isdigit() and isinstance(inner, dict) for key, inner in value.items()):
            value = {name: [*value.values()]}
        for key, inner in value.items():
            yield from _lists_of_records(inner, depth - 1, key)
    elif isinstance(value, list) and depth:
        if len(value) > _MOST_ELEMENTS and all(isinstance(inner, dict | None) for inner in value):
            yield name, [inner for inner in value if inner is not None]
        else:
            for inner in value[:_MOST_ELEMENTS]:
                yield from _lists_of_records(inner, depth - 1, name)


def _named_rows(value: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of an object with the names of columns and a list for each row; empty for another one."""
    names, rows = (
        next((value[key] for key in keys if isinstance(value.get(key), list)), list[Any]())
        for keys in (("columns", "fields", "header"), ("data", "values", "rows"))
    )
    if not names or not all(isinstance(row, list) and len(row) == len(names) for row in rows):
        return []
    titles = [str(name.get("name", name) if isinstance(name, dict) else name) for name in names]
    return [dict(zip(titles, row, strict=True)) for row in rows]


def _array_of(value: Any, depth: int) -> Any:
    """Return a JSON value with its lists of numbers or dates as arrays; an object with numbers as keys is a list."""
    if isinstance(value, dict) and depth:
        if len(value) > 1 and all(key.isdigit() for key in value):
            return _array_of([*value.values()], depth)
        return {name: _array_of(inner, depth - 1) for name, inner in value.items()}
    if isinstance(value, list) and value and isinstance(value[0], dict) and depth:
        return [_array_of(inner, depth - 1) for inner in value]
    if isinstance(value, list):
        with suppress(ValueError, TypeError):
            is_text = any(isinstance(v, str) for v in value[:2])
            return (
                np.array([v.rstrip("Z") for v in value], "datetime64[ns]") if is_text else np.array(value, np.float64)
            )
    return value if isinstance(value, str | float | int) else None


def _tables_of_records(records: Iterable[Any], file: TableFile, kind: str, name: str = "json") -> Tables:
    """Return the tables of objects in the order of time; None counts as a damaged line."""
    losses: list[Loss] = []
    lines, wrong = array("q"), array("q")
    rows: list[dict[str, Any]] = []
    paths: dict[str, None] = {}
    for number, record in enumerate(records, 1):
        if not isinstance(record, dict):
            wrong.append(number)
            continue
        rows.append(dict(_leaves(record, "", file.limits.schema_depth)))
        paths |= dict.fromkeys(rows[-1])
        file.limits.check("array_width", len(paths), file.name)
        lines.append(number)
    if not paths:
        remedy = "each line, or each element of an array, is one object with a time"
        raise LogError(expected="a JSON object a line", got="none", where=file.name, remedy=remedy)
    if wrong:
        place = f"{file.name}, from line {wrong[0]} on"
        losses.append(Loss("bad-row", "line without an object", place, count=len(wrong)))
    file.check(NUMBER_BYTES * len(rows) * len(paths))
    fields, units = read_head([*paths])
    cells = ([row.get(path) for row in rows] for path in paths)
    columns = {f: _json_column(f, its, lines, file, losses) for f, its in zip(fields, cells, strict=True)}
    sheet = Sheet(field_name(name), columns, units)
    return Tables(kind, list(tables_of(sheet, file.name, losses, rate_hz=file.settings.rate_hz)), losses)


def _leaves(value: Any, path: str, depth: int) -> Iterator[tuple[str, Any]]:
    """Yield paths and values of the texts and finite numbers in an object."""
    if isinstance(value, str) or (isinstance(value, int | float) and abs(value) < _LARGEST):
        yield path, value
    elif isinstance(value, list) and value and depth and all(map(_name_of, value)):
        for inner in value:
            values = (v for _, v in _leaves(inner, "", depth - 1) if v != _name_of(inner))
            yield from ((f"{path}.{_name_of(inner)}", v) for v in islice(values, 1))
    elif depth and isinstance(value, dict | list) and (isinstance(value, dict) or len(value) <= _MOST_ELEMENTS):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _leaves(inner, f"{path}.{key}" if path else str(key), depth - 1)


def _name_of(value: Any) -> str:
    """Return the name in an object with a name and a value; empty without one."""
    named = value.items() if isinstance(value, dict) else ()
    return next((v for k, v in named if isinstance(v, str) and PATTERNS["signal"].fullmatch(k.lower())), "")


def _json_column(name: str, values: Sequence[Any], lines: Sequence[int], file: TableFile, losses: list[Loss]) -> Any:
    """Return numbers [N] with NaN for lines without one, or texts [N]."""
    if any(isinstance(value, str) for value in values):
        series = pl.Series([None if value is None else str(value) for value in values], dtype=pl.String)
        cells = read_cells(series, ".")
        losses += cells.losses(name, file.name, lines)
        return series if cells.is_text else cells.values
    # Integers stay exact: a double has 256 ns at a date.
    exact = all(isinstance(value, int) and abs(value) < 1 << 63 for value in values)
    return np.array(values, np.int64 if exact else np.float64)
