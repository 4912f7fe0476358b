"""Shared parts of the table formats: names and units of columns, times, and tables of columns on one clock."""

import math
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs import table_clocks
from pdhef_logtool.logs.constants import CONSTANTS, LATIN, LETTERS
from pdhef_logtool.logs.table_clocks import NO_TIME, TIME_UNITS_NS, Clock
from pdhef_logtool.logs.table_file import left_out
from pdhef_logtool.logs.table_log import Table
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.geometry import DEGREE_M
from pdhef_logtool.records.signals import S_PER_NS, BoolArray, FloatArray, IntArray, Loss

if TYPE_CHECKING:
    from polars import Series

#: Steps of a column's own clock are at most this multiple of its usual step. A second clock is used if it has times in
#: fewer rows than this share of another one. Lengths of two clocks of a table differ by less than this share. Share of
#: steps that are not negative, of a column that may contain times. Rows of a device in a table of several, and devices.
_REGULAR, _ENOUGH_ROWS, _ALIKE, _ASCENDING_SHARE, _FEW_ROWS, _MOST_KINDS = 1.5, 0.9, 0.01, 0.99, 10, 50

#: Patterns of texts in tables.
PATTERNS: Mapping[str, re.Pattern[str]] = {name: re.compile(text) for name, text in CONSTANTS["patterns"].items()}
#: Evidence of motion on the unit of a clock.
_MOTION: Mapping[str, Any] = CONSTANTS["clocks"]["motion"]
#: Spellings of units that are separated from the name of a column, without spaces and in lower case.
_UNITS = frozenset(CONSTANTS["table_units"]["spellings"].split()) | {*TIME_UNITS_NS}
#: Products and quotients of units, with exponents; titles that are paths have | in place of the slash.
_SYMBOL = rf"(?:{'|'.join(map(re.escape, CONSTANTS['table_units']['symbols'].split()))})(?:\^?\**[-+]?\d|[⁻¹²³]+)?"
_COMPOUND = re.compile(rf"{_SYMBOL}(?:\s*(?:[*/|·.]|\bper\b|\s)\s*{_SYMBOL})+")
#: Words, and single letters as symbols, of the Greek alphabet; a dot above the symbol of a quantity.
_GREEK_WORD, _GREEK, _DOT = re.compile("[Ͱ-Ͽ]{3,}"), re.compile("[Ͱ-Ͽ]"), re.compile("(?<=[xyvψβ])\u0307")

#: Words of titles in other alphabets, and their English.
_TRANSLATIONS: dict[str, str] = CONSTANTS["translations"]
_OTHER_ALPHABET = re.compile("|".join(_TRANSLATIONS))

_TIME = re.compile(CONSTANTS["clocks"]["names"].format("|".join(TIME_UNITS_NS)))
_TIME_LIKE = re.compile(CONSTANTS["clocks"]["like"])
_SECOND_NS = TIME_UNITS_NS["seconds"]


def field_name(text: str) -> str:
    """Return the name of a column as every format of messages takes it: ASCII letters, digits and ``_``."""
    text = _OTHER_ALPHABET.sub(lambda match: f" {_TRANSLATIONS[match[0]]} ", text)
    text = _GREEK_WORD.sub(lambda match: match[0].translate(LETTERS), text.partition("\\")[0].translate(LATIN))
    text = _DOT.sub("_dot", unicodedata.normalize("NFKD", text))
    text = _GREEK.sub(lambda match: f"_{unicodedata.name(match[0]).split()[3].lower()}_", text).translate(LETTERS)
    text = text.encode("ascii", "ignore").decode()
    name = re.sub(r"[\W_]+", "_", text).strip("_") or "column"
    return f"n_{name}" if name[0].isdigit() else name


def unique(names: Iterable[str]) -> list[str]:
    """Return the names with a number at the end of each that repeats another."""
    seen: Counter[str] = Counter()
    results = []
    for name in names:
        seen[name] += 1
        results.append(name if seen[name] == 1 else f"{name}_{seen[name]}")
    return results


def is_unit(text: str) -> bool:
    """Return whether a text is a unit, with or without brackets."""
    text = re.sub(r"^\s*units?\s*:|[\[\](){}]", "", text, flags=re.IGNORECASE).strip().lower().translate(LETTERS)
    return text.replace(" ", "") in _UNITS or bool(_COMPOUND.fullmatch(text))


def split_unit(text: str) -> tuple[str, str]:
    """Return name and unit of a title (``Speed (km/h)``, ``"Speed"|"km/h"|0|250``); without a unit, it is empty."""
    if "|" in text and "[" not in text:
        text, unit, *_ = (part.strip('" ') for part in text.split("|"))
        return text, unit if is_unit(unit) else ""
    for name in ("unit_behind", "unit_in_brackets"):
        match = PATTERNS[name].match(text.strip())
        if match and match[1] and is_unit(match[2]) and not match[2].isdigit():  # [1] is an index
            return match[1].rstrip(" /"), match[2].strip(" ()")
    return text.strip(), ""


def snake(name: str) -> str:
    """Return a name in lower case with words joined by ``_``."""
    return re.sub(r"\W+", "_", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name)).lower()


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """Columns of a file, all of one length.

    Attributes
    ----------
    columns : by name, numbers [N] or, where a time may be a text, a series of texts. units : by name, where given.
    """

    name: str
    columns: "Mapping[str, NDArray[Any] | Series]"
    units: Mapping[str, str]
    type_name: str = ""


def find_clock(sheet: Sheet, where: str, others: Sequence[Clock] = (), rate_hz: float | None = None) -> Clock:
    """Return the clock of a sheet; ``others`` are certain clocks of the same recording.

    ``rate_hz`` applies where no column contains times, or their unit is not stated.

    Raises
    ------
    LogError : no column contains times, and the rate is unknown.
    """
    names = {snake(name): name for name in reversed([*sheet.columns])}
    if (in_parts := _in_parts(sheet, names)) is not None:
        return in_parts
    grades = {name: grade for name in sheet.columns if (grade := _grade(sheet, name)) is not None}
    clocks = {name: _read_clock(sheet, name, others, rate_hz) for name in grades}
    chosen, *rivals = _best_clocks(clocks, grades)
    if not chosen:
        if rate_hz:
            return table_clocks.rate_clock(max(map(len, sheet.columns.values()), default=0), rate_hz)
        expected = "a column of times (time, t, timestamp; s, ms, ISO 8601, or GPS week and seconds)"
        got = ", ".join([*sheet.columns][:8]) or "no columns"
        raise LogError(expected=expected, got=got, where=f"{where}, {sheet.name}", remedy=CONSTANTS["clocks"]["remedy"])
    certain = [clock for name, clock in clocks.items() if name != chosen and clock.is_certain]
    clock = _read_clock(sheet, chosen, (*others, *certain), rate_hz) if certain else clocks[chosen]
    clock = _in_two_columns(clock, sheet, chosen, names)
    if clock.notes and not (clock.is_certain or certain or others):
        clock = _as_motion_shows(clock, sheet, chosen)
    apart = [n for n in rivals if abs(clocks[n].length_s - clock.length_s) > _ALIKE * clock.length_s]
    note = f"{chosen} is the clock; the times of {', '.join(apart)} have another length"
    return replace(clock, notes=(*clock.notes, note)) if apart else clock


def _in_parts(sheet: Sheet, names: Mapping[str, str]) -> Clock | None:
    """Return the clock of GPS weeks and seconds, or of years, months and so on until the second; None without them."""
    import polars as pl

    of_gps = (PATTERNS[name] for name in ("week", "week_time"))
    week, seconds = (next((names[n] for n in names if p.fullmatch(n)), None) for p in of_gps)
    if week is not None and seconds is not None:
        clock = table_clocks.week_clock(_numbers(sheet.columns[week]), _numbers(sheet.columns[seconds]))
        return replace(clock, columns=frozenset({week, seconds}))
    places = {re.sub("^min$", "minute", re.sub("^(utc|gps)_", "", n)): name for n, name in names.items()}
    parts = [places.get(part, "") for part in ("year", "month", "day", "hour", "minute", "second")]
    if not all(parts):
        return None
    *whole, second = (pl.Series(_numbers(sheet.columns[part])) for part in parts)
    date = [part.cast(pl.Int64, strict=False) for part in whole]
    clock = table_clocks.text_clock(pl.select(pl.format("{}-{}-{} {}:{}:{}", *date, second)).to_series())
    return _in_two_columns(replace(clock, columns=frozenset(parts)), sheet, parts[-1], names)


def _in_two_columns(clock: Clock, sheet: Sheet, name: str, names: Mapping[str, str]) -> Clock:
    """Return a clock of seconds with the fractions of another column, ``stamp.sec`` and ``stamp.nanosec``."""
    rest = re.fullmatch(r"(.*?)_?(?:s|secs?|seconds?)", snake(name))
    if rest is None:
        return clock
    for unit, ns in TIME_UNITS_NS.items():
        within = names.get(f"{rest[1]}_{unit}".strip("_"))
        if within is not None and ns < _SECOND_NS:
            return table_clocks.with_fractions(clock, _numbers(sheet.columns[within]), ns, within)
    return clock


def _as_motion_shows(clock: Clock, sheet: Sheet, name: str) -> Clock:
    """Return a clock with the power of ten for which speed (in any usual unit) and path (in degrees) agree.

    Units of speed, from m/s to km/h, shorten the ratio of the path to the integral by up to 0.56 decades.
    """
    columns = {snake(n): c for n, c in sheet.columns.items() if isinstance(c, np.ndarray)}
    latitude, longitude, speed = (
        next((c for n, c in columns.items() if re.fullmatch(_MOTION[quantity], n)), None)
        for quantity in ("latitude", "longitude", "speed")
    )
    if latitude is None or longitude is None or speed is None:
        return clock
    has_place = np.isfinite(latitude) & np.isfinite(longitude) & (latitude != 0.0)
    rows = np.flatnonzero(has_place & (clock.stamps_ns != NO_TIME))
    # Long steps average the noise of the positions.
    corners = rows[:: max(1, len(rows) // _MOTION["steps"])]
    north, east = np.diff(latitude[corners]), np.diff(longitude[corners]) * np.cos(np.radians(latitude[corners[1:]]))
    path_m = DEGREE_M * float(np.hypot(north, east).sum())
    length = float(np.nansum(np.abs(speed[rows[1:]]) * np.diff(clock.stamps_ns[rows]) * S_PER_NS))
    if not (_MOTION["shortest_path_m"] < path_m < _MOTION["longest_path_m"] and length > 0.0):
        return clock
    decades = math.ceil(math.log10(path_m / length) - _MOTION["noise_decades"])
    note = f"{name}: speed and positions show times that are 10^{decades} as long: corrected"
    return table_clocks.rescaled(clock, decades, note) if decades else clock


def _best_clocks(clocks: Mapping[str, Clock], grades: Mapping[str, int]) -> list[str]:
    """Return the columns of the best grade with enough times, dates first unless their names decide; "" if none."""
    rows = {n: np.count_nonzero(clocks[n].stamps_ns != NO_TIME) for n in grades if grades[n] == min(grades.values())}
    enough = [n for n in rows if rows[n] >= _ENOUGH_ROWS * max(rows.values()) > 0.0]
    return sorted(enough, key=lambda n: not (grades[n] and clocks[n].is_dated)) or [""]


def _grade(sheet: Sheet, name: str) -> int | None:
    """Return the confidence that a column contains times, 0 by its name alone; None if it contains none."""
    column, text = sheet.columns[name], snake(name)
    is_time = _TIME.fullmatch(text) is not None
    if not isinstance(column, np.ndarray):
        given = column.drop_nulls().head(20)
        named = _TIME_LIKE.search(text) or PATTERNS["date"].fullmatch(text)
        grade, others = (0, 0) if is_time else (1, 1) if named else (2, max(1, len(given) // 2 - 1))
        return grade if len({*table_clocks.text_clock(given).stamps_ns.tolist()} - {NO_TIME}) > others else None
    if column.dtype.kind not in "iufM":
        return None
    given = column[~np.isnat(column)].view(np.int64) if column.dtype.kind == "M" else column[np.isfinite(column)]
    if not len(given) or (len(column) > 1 and (given == given[0]).all()):
        return None
    if is_time:
        return 0
    return _grade_of_numbers(sheet, name, given)


def _grade_of_numbers(sheet: Sheet, name: str, given: NDArray[Any]) -> int | None:
    """Return :func:`_grade` of finite numbers or dates by their order, name, unit and steps."""
    text, is_date = snake(name), sheet.columns[name].dtype.kind == "M"  # type: ignore[union-attr]
    if (given[1:] >= given[:-1]).sum() < _ASCENDING_SHARE * (len(given) - 1) or len(sheet.columns[name]) == 1:
        return 2 if is_date else None
    is_unit_of_time = sheet.units.get(name, "").lower() in TIME_UNITS_NS or text.startswith("t_")
    if _TIME_LIKE.search(text) or is_date or is_unit_of_time:
        return 1 if _TIME_LIKE.search(text) else 2 if is_date else 3
    steps = np.diff(given)
    is_count = bool((steps == steps[0]).all()) and steps[0] == 1
    are_few = len(sheet.columns) < CONSTANTS["clocks"]["fewest_columns"]
    is_alone = are_few or name != next(iter(sheet.columns)) or name in sheet.units
    return 4 if is_regular(steps) and not (is_count or is_alone) else None


def is_regular(steps: FloatArray) -> bool:
    """Return whether most steps [N] are alike, as those of times."""
    usual = float(np.median(steps))
    return bool(np.quantile(np.abs(steps - usual), _ENOUGH_ROWS) <= _ALIKE * usual)


def _read_clock(sheet: Sheet, name: str, others: Sequence[Clock], rate_hz: float | None) -> Clock:
    column, columns = sheet.columns[name], {name}
    if isinstance(column, np.ndarray):
        text = snake(name)
        unit = sheet.units.get(name, "") or table_clocks.named_unit(text, column) or text.rpartition("_")[2]
        clock = table_clocks.number_clock(column, unit, name, others, rate_hz)
    else:
        date = next((n for n in sheet.columns if n != name and PATTERNS["date"].fullmatch(snake(n))), name)
        dates = sheet.columns[date]
        clock = table_clocks.text_clock(column, None if date == name or isinstance(dates, np.ndarray) else dates)
        columns = {name, date}
    return replace(clock, columns=frozenset(columns))


def _numbers(column: "NDArray[Any] | Series") -> FloatArray:
    if isinstance(column, np.ndarray):
        return column.astype(np.float64)
    return np.full(len(column), np.nan)


def tables_of(
    sheet: Sheet, where: str, losses: list[Loss], stamps: IntArray | None = None, rate_hz: float | None = None
) -> Iterator[Table]:
    """Yield the tables of a sheet: one for all columns, and one for each slower clock that some of them have.

    A row without a time, a row that steps back in time and a column without numbers are losses.
    """
    used: frozenset[str] = frozenset()
    if stamps is None:
        named_values = _named_values(sheet)
        clock = find_clock(sheet, where, rate_hz=None if named_values else rate_hz)
        stamps, used = clock.stamps_ns, clock.columns
        losses.extend(clock_notes(clock.notes, where))
        parts = list(_of_long_form(sheet, stamps, *named_values) if named_values else _of_kinds(sheet, stamps, used))
        for name, (part, its) in zip(unique(part.name for part, _ in parts), parts, strict=True):
            yield from tables_of(Sheet(name, part.columns, part.units), where, losses, its)
        if parts:
            return
    rows, lost = table_clocks.ascending_rows(stamps, f"{where}, {sheet.name}")
    losses.extend(lost)
    times, note = table_clocks.spread(stamps[rows]) if used else (stamps[rows], "")
    losses.extend(clock_notes([note] if note else (), where))
    groups: dict[bytes, tuple[BoolArray, dict[str, NDArray[Any]]]] = {}
    unusable = []
    for name, column in sheet.columns.items():
        if name in used:
            continue
        if not isinstance(column, np.ndarray) or column.dtype.kind not in "iufb":
            unusable.append(name)
            continue
        if not np.isfinite(column).any():  # its cells are empty
            continue
        values = column[rows]
        there = _own_rows(np.isfinite(values), times)
        groups.setdefault(np.packbits(there).tobytes(), (there, {}))[1][name] = values[there]
    losses.extend(left_out("columns without numbers", unusable, f"{where}, {sheet.name}"))
    ordered = sorted(groups.values(), key=lambda group: -np.count_nonzero(group[0]))
    for number, (there, columns) in enumerate(ordered, 1):
        name = sheet.name if number == 1 else f"{sheet.name}_{number}"
        yield Table.of_arrays(name, times[there], columns, sheet.units, sheet.type_name)


def by_times(name: str, columns: dict[str, Any], units: dict[str, str]) -> Iterator[Sheet]:
    """Yield a sheet for each ascending column of times titled as the first column, with the columns that follow it."""
    titles = [*columns]
    named = re.compile(rf"{re.escape(titles[0])}(_\d+)?" if _TIME.fullmatch(snake(titles[0])) else "(?!)")
    starts = [i for i, t in enumerate(titles) if named.fullmatch(t) and _ascends(columns[t])]
    if len(starts) < 2:
        yield Sheet(name, columns, units)
        return
    for number, (begin, end) in enumerate(pairwise([*starts, len(titles)]), 1):
        there = np.flatnonzero(np.isfinite(columns[titles[begin]]))
        yield Sheet(f"{name}_{number}", {t: columns[t][there] for t in titles[begin:end]}, units)


def _ascends(column: "NDArray[Any] | Series") -> bool:
    return isinstance(column, np.ndarray) and bool((np.diff(column[np.isfinite(column)]) > 0).all())


def clock_notes(notes: Iterable[str], where: str) -> list[Loss]:
    """Return the assumptions of a clock as notes."""
    return [Loss("clock", note, where, severity="note") for note in notes]


def _own_rows(there: BoolArray, stamps: IntArray) -> BoolArray:
    """Return the rows of a column with values in some rows [N]: all, with NaN, unless it has a slower clock.

    Of a slower clock most steps that skip rows are no longer than the usual step of the column.
    """
    rows = np.flatnonzero(there)
    if len(rows) < 3 or len(rows) == len(there):
        return np.ones(len(there), np.bool_)
    steps = np.diff(stamps[rows])
    is_usual = (steps <= _REGULAR * np.median(steps))[np.diff(rows) > 1]
    has_clock = is_usual.any() and is_usual.sum() >= 3 * (~is_usual).sum()
    return there if has_clock else np.ones(len(there), np.bool_)


def _named_values(sheet: Sheet) -> tuple[Any, Any, Any] | None:
    """Return names, values and units of a table in long form, None for another table."""
    named = {snake(name): column for name, column in sheet.columns.items()}
    of_long = (PATTERNS[name] for name in ("signal", "long_value", "unit_column"))
    signal, value, unit = (next((c for n, c in named.items() if p.fullmatch(n)), None) for p in of_long)
    is_long = signal is not None and not isinstance(signal, np.ndarray) and isinstance(value, np.ndarray)
    return (signal, value, unit) if is_long else None


def _rows_by(texts: "Series") -> dict[str, IntArray]:
    """Return the rows of each text of a column."""
    import polars as pl

    rows = (
        pl.DataFrame({"text": texts}).with_row_index().drop_nulls().group_by("text", maintain_order=True).agg("index")
    )
    return {text: numbers.to_numpy() for text, numbers in zip(rows["text"], rows["index"], strict=True)}


def _of_kinds(sheet: Sheet, stamps: IntArray, used: frozenset[str]) -> Iterator[tuple[Sheet, IntArray]]:
    """Yield the parts of a table whose rows are samples of several devices, which a column names."""
    for name in (n for n, c in sheet.columns.items() if PATTERNS["kind"].fullmatch(snake(n))):
        texts, columns = sheet.columns[name], {n: c for n, c in sheet.columns.items() if n not in {name, *used}}
        rows_of = {} if isinstance(texts, np.ndarray) else _rows_by(texts)
        if len(rows_of) <= _MOST_KINDS and sum(len(rows) >= _FEW_ROWS for rows in rows_of.values()) > 1:
            for kind, rows in rows_of.items():
                yield Sheet(field_name(kind), {n: c[rows] for n, c in columns.items()}, sheet.units), stamps[rows]
            return


def _of_long_form(
    sheet: Sheet, stamps: IntArray, signal: "Series", value: NDArray[Any], units: Any
) -> Iterator[tuple[Sheet, IntArray]]:
    """Yield the signals of a table with a row for each value; signals with equal times are one sheet."""
    rows_of = _rows_by(signal)
    if len(rows_of) ** 2 > 100 * len(signal):  # texts of another kind
        return
    clocks: dict[bytes, tuple[Sheet, IntArray]] = {}
    for title, rows in rows_of.items():
        part, _ = clocks.setdefault(stamps[rows].tobytes(), (Sheet(sheet.name, {}, {}), stamps[rows]))
        (field,), given = read_head([title])
        cell = None if units is None or isinstance(units, np.ndarray) else units[int(rows[0])]
        part.columns[field] = value[rows]  # type: ignore[index]
        part.units[field] = cell or given.get(field, "")  # type: ignore[index]
    yield from clocks.values()


def read_head(names: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Return the field names of titles, and the units that the titles contain, by field name."""
    split = [split_unit(name) for name in names]
    fields = unique(field_name(name) for name, _ in split)
    return fields, {field: unit for field, (_, unit) in zip(fields, split, strict=True) if unit}
