"""Shared parts of the table formats: names and units of columns, times, and tables of columns on one clock."""

from __future__ import annotations

import datetime as dt
import re
import unicodedata
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.table_log import Table
from pdhef_logtool.records.errors import LogError
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Loss

if TYPE_CHECKING:
    from polars import Series

#: Stamp of a row without a time.
NO_TIME = np.iinfo(np.int64).min
#: Times that count from the start of a recording follow this instant, 1970-01-02, so that none is negative.
RELATIVE_NS = 86_400_000_000_000
#: 1973; earlier times count from the start of a recording.
_FIRST_DATE_NS = 10**17
#: A column with more missing cells than this has a clock of its own: the rows where it has a value.
_MISSING_SHARE = 0.01

#: Spellings of units that are separated from the name of a column, without spaces and in lower case.
_UNITS = frozenset(
    re.split(
        ",",
        "g,mg,m/s²,m/s^2,m/s2,m/s**2,m/s/s,mps2,m/s,m/sec,mps,km/h,kmh,kph,kmph,mph,kn,kt,kts,knots,deg,°,degree,degrees,"
        "rad,radians,mrad,deg/s,°/s,dps,deg/sec,degps,rad/s,rad/sec,radps,mdps,rpm,1/min,u/min,/min,min-1,grad,grad/s,min,',s,sec,seconds,ms,us,"
        "µs,ns,m,cm,mm,km,%,bar,pa,kpa,n,nm,v,mv,a,°c,degc,c,hz,kg,-,1",
    )
)
_BRACKETED = re.compile(r"^(.*?)[\s_]*[\[({<]([^\[\](){}<>]*)[\])}>]$")
_LATIN = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "Ä": "Ae", "Ö": "Oe", "Ü": "Ue", "ß": "ss"})

_TIME = re.compile(
    r"(?:(?:time|t|timestamp|time_?stamps?|stamp|utc|utc_time|gps_time|date_?time|datetime|zeit|log_time|rel(?:ative)?_time|"
    r"elapsed(?:_time)?|time_of_day)(?:_(?:s|sec|secs|seconds|ms|us|ns))?|seconds|milli(?:s|seconds)|micros|time_utc|epoch)"
)
_TIME_LIKE = re.compile(r"time|zeit|clock|stamp")
_WEEK = re.compile(r"(?:gps|gnss)?_?week(?:_?(?:number|no|nr))?")
_WEEK_TIME = re.compile(
    r"(?:(?:gps|gnss)_)?(?:i?tow|sow|time_of_week|seconds_of_week|week_seconds|seconds|time)(?:_m?s)?"
)
#: Columns of a table in long form, with a row for each value.
_SIGNAL = re.compile(
    r"(?:signal|channel|variable|parameter|sensor|tag|key|telemetry|metric|pid|name)(?:_?(?:name|id))?"
)
_VALUE = re.compile(r"(?:physical_|signal_|phys_|telemetry_|metric_)?(?:value|val|wert)")
_DATE = re.compile(r"(?:utc_|gps_)?(?:date|datum)")
_FACTORS_NS = {
    **dict.fromkeys(("s", "sec", "secs", "seconds"), 10**9), **dict.fromkeys(("ms", "millis"), 10**6),
    **dict.fromkeys(("us", "µs", "micros"), 10**3), "ns": 1,
}  # fmt: skip
_GPS_EPOCH_NS = 315_964_800 * 10**9
_WEEK_S = 604_800
#: GPS time minus UTC in s, from a time in s since 1970 on.
_LEAP_SECONDS = ((1136073600, 14), (1230768000, 15), (1341100800, 16), (1435708800, 17), (1483228800, 18))


def field_name(text: str) -> str:
    """Return the name of a column as every format of messages takes it: ASCII letters, digits and ``_``."""
    text = unicodedata.normalize("NFKD", text.partition("\\")[0].translate(_LATIN)).encode("ascii", "ignore").decode()
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
    return re.sub(r"[\s*\[\](){}]", "", text).lower() in _UNITS


def split_unit(text: str) -> tuple[str, str]:
    """Return name and unit of a title (``Speed (km/h)``, ``"Speed"|"km/h"|0|250``); empty where it has none."""
    if "|" in text:
        text, unit, *_ = (part.strip('" ') for part in text.split("|"))
        return text, unit if is_unit(unit) else ""
    match = _BRACKETED.match(text.strip())
    return (match[1], match[2].strip()) if match and match[1] and is_unit(match[2]) else (text.strip(), "")


def snake(name: str) -> str:
    """Return a name in lower case with words joined by ``_``."""
    return re.sub(r"\W+", "_", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name)).lower()


def number_stamps(values: FloatArray, unit: str = "") -> IntArray:
    """Return times [N] in ns since 1970, or after :data:`RELATIVE_NS` where they count from the start of a recording.

    Without a unit the usual step decides it: seconds below 1, milliseconds below 1000, and so on.
    """
    factor = _FACTORS_NS.get(unit.strip("[]() ").lower())
    finite = np.isfinite(values)
    if factor is None:
        steps = np.diff(values[finite])
        step = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
        factor = next((f for most, f in ((1.0, 10**9), (1e3, 10**6), (1e6, 10**3)) if step < most), 1)
    stamps = np.full(values.shape, NO_TIME, np.int64)
    finite &= np.abs(np.where(finite, values, 0.0)) < 9e18 / factor
    whole = np.floor(values[finite])  # the fraction apart: a product would lose the last digits of a date
    stamps[finite] = whole.astype(np.int64) * factor + np.round((values[finite] - whole) * factor).astype(np.int64)
    return placed(stamps)


def placed(stamps: IntArray) -> IntArray:
    """Return stamps [N], moved to :data:`RELATIVE_NS` where they are no dates."""
    has = stamps != NO_TIME
    if has.any() and int(np.median(stamps[has])) < _FIRST_DATE_NS:
        return np.where(has, stamps + RELATIVE_NS, NO_TIME)
    return stamps


def gps_stamps(week: FloatArray, seconds: FloatArray) -> IntArray:
    """Return UTC in ns [N] from GPS weeks [N] and their seconds (or milliseconds) [N]."""
    finite = np.isfinite(week) & np.isfinite(seconds)
    seconds = seconds / 1e3 if finite.any() and float(np.nanmax(seconds[finite])) > _WEEK_S else seconds
    stamps = np.full(week.shape, NO_TIME, np.int64)
    stamps[finite] = (
        _GPS_EPOCH_NS
        + week[finite].astype(np.int64) * (_WEEK_S * 10**9)
        + np.round(seconds[finite] * 1e9).astype(np.int64)
    )
    leap = [0] + [s for _, s in _LEAP_SECONDS]
    after = np.searchsorted([since for since, _ in _LEAP_SECONDS], stamps // 10**9, side="right")
    return np.where(finite, stamps - np.asarray(leap, np.int64)[after] * 10**9, NO_TIME)


def text_stamps(texts: Series) -> IntArray:
    """Return times of ISO 8601 texts, or of texts ``hh:mm:ss`` [N] in ns."""
    import polars as pl

    texts = texts.str.strip_chars().str.replace(",", ".").str.replace(" ", "T")
    texts = texts.str.replace(r"^(\d\d)\.(\d\d)\.(\d{4})", "$3-$2-$1")
    # With a slash the month comes first, where it can be one.
    texts = texts.str.replace(r"^(1[3-9]|2\d|3[01])/(\d\d?)/(\d{4})", "$2/$1/$3")
    texts = texts.str.replace(r"^(\d\d?)/(\d\d?)/(\d{4})", "$3-$1-$2")
    for _ in range(2):
        texts = texts.str.replace(r"-(\d)([T-])", "-0$1$2")
    first = next((t for t in texts.drop_nulls().head(100) if t), "")
    if "-" not in first and "/" not in first:
        texts = pl.select(pl.when(texts.str.count_matches(":") == 1).then("0:" + texts).otherwise(texts)).to_series()
        parts = texts.str.split_exact(":", 2).struct.unnest()
        hours, minutes, seconds = (parts[c].cast(pl.Float64, strict=False).to_numpy() for c in parts.columns)
        return number_stamps(unwrapped(3600.0 * hours + 60.0 * minutes + seconds), "s")
    times = texts.str.to_datetime(time_unit="ns", time_zone="UTC", strict=False)
    return times.dt.epoch("ns").fill_null(NO_TIME).to_numpy()


def unwrapped(seconds: FloatArray) -> FloatArray:
    """Return seconds since midnight [N] that continue behind midnight."""
    steps = np.diff(seconds, prepend=seconds[:1])
    return np.asarray(seconds + 86_400.0 * np.cumsum(steps < -43_200.0))


@dataclass(frozen=True, slots=True, eq=False)
class Sheet:
    """Columns of a file, all of one length.

    Attributes
    ----------
    columns : by name, numbers [N] or, where a time may be a text, a series of texts. units : by name, where given.
    """

    name: str
    columns: Mapping[str, NDArray[Any] | Series]
    units: Mapping[str, str]
    type_name: str = ""


def stamps_of(sheet: Sheet, where: str) -> tuple[IntArray, frozenset[str]]:
    """Return the times [N] of a sheet, and the names of the columns that they are from.

    Raises
    ------
    LogError : no column contains times.
    """
    names = {snake(name): name for name in reversed([*sheet.columns])}
    week, seconds = (next((names[n] for n in names if p.fullmatch(n)), None) for p in (_WEEK, _WEEK_TIME))
    if week is not None and seconds is not None:
        return gps_stamps(_numbers(sheet.columns[week]), _numbers(sheet.columns[seconds])), frozenset({week, seconds})
    clocks = _clocks(sheet, names)
    if not clocks:
        raise LogError(
            expected="a column of times (time, t, timestamp; s, ms, ISO 8601, or GPS week and seconds)",
            got=", ".join([*sheet.columns][:8]) or "no columns",
            where=f"{where}, {sheet.name}",
            remedy="name the column of times so",
        )
    column = sheet.columns[clocks[0]]
    date = next((names[n] for n in names if _DATE.fullmatch(n)), "")
    dates = sheet.columns.get(date)
    if not isinstance(column, np.ndarray):
        if dates is None or isinstance(dates, np.ndarray) or "-" in str(column[0]):
            return text_stamps(column), frozenset(clocks[:1])
        return text_stamps(dates + "T" + column), frozenset({clocks[0], date})
    if column.dtype.kind == "M":
        return placed(column.astype("datetime64[ns]").astype(np.int64)), frozenset(clocks[:1])
    unit = sheet.units.get(clocks[0], "") or snake(clocks[0]).rpartition("_")[2]
    return number_stamps(column.astype(np.float64), unit), frozenset(clocks[:1])


def _clocks(sheet: Sheet, names: Mapping[str, str]) -> list[str]:
    """Return the columns with times, the best first; ``names`` are all columns by their names in lower case."""
    clocks = [name for n, name in names.items() if _TIME.fullmatch(n)]
    clocks = [n for n in reversed(clocks) if _is_clock(sheet.columns[n])]
    ascending = [(n, name) for n, name in reversed([*names.items()]) if not clocks and _ascends(sheet.columns[name])]
    like = [name for n, name in ascending if _TIME_LIKE.search(n)]
    clocks = clocks or sorted(like, key=lambda n: not _dates(sheet, n))
    dates = [name for _, name in ascending if sheet.columns[name].dtype.kind == "M"]  # type: ignore[union-attr]
    return clocks or dates or [name for _, name in ascending if sheet.units.get(name, "").lower() in _FACTORS_NS]


def _dates(sheet: Sheet, name: str) -> bool:
    """Return whether a column contains dates, not times since the start of a recording or of a device."""
    column = np.asarray(sheet.columns[name])
    unit = sheet.units.get(name, "")
    return column.dtype.kind == "M" or int(np.median(number_stamps(column.astype(np.float64), unit))) >= _FIRST_DATE_NS


def _is_clock(column: NDArray[Any] | Series) -> bool:
    if isinstance(column, np.ndarray):
        return column.dtype.kind in "iufM" and (len(column) == 1 or bool((column != column[:1]).any()))
    return bool((text_stamps(column.head(20)) != NO_TIME).any())


def _ascends(column: NDArray[Any] | Series) -> bool:
    """Return whether a column contains dates, or numbers that never step back."""
    if not isinstance(column, np.ndarray) or column.dtype.kind not in "iufM":
        return False
    return column.dtype.kind == "M" or (len(column) > 1 and bool((np.diff(column.astype(np.float64)) >= 0.0).all()))


def _numbers(column: NDArray[Any] | Series) -> FloatArray:
    if isinstance(column, np.ndarray):
        return column.astype(np.float64)
    return np.full(len(column), np.nan)


def tables_of(sheet: Sheet, where: str, losses: list[Loss], stamps: IntArray | None = None) -> Iterator[Table]:
    """Yield the tables of a sheet: one for all columns with values in the same rows.

    Rows without a time are a loss, rows of a step back in time are sorted, with a note.
    """
    used: frozenset[str] = frozenset()
    if stamps is None:
        stamps, used = stamps_of(sheet, where)
        if long := list(_of_long_form(sheet, stamps)):
            for name, (part, its) in zip(unique(part.name for part, _ in long), long, strict=True):
                yield from tables_of(Sheet(name, part.columns, part.units), where, losses, its)
            return
    has_time = stamps != NO_TIME
    if not has_time.all():
        losses.append(Loss("bad-stamp", "row without a time", f"{where}, {sheet.name}", count=int((~has_time).sum())))
    back = int((np.diff(stamps[has_time]) < 0).sum())
    if back:
        what = "step back in time: the rows are sorted"
        losses.append(Loss("out-of-order", what, f"{where}, {sheet.name}", count=back, severity="note"))
    order = np.flatnonzero(has_time)[np.argsort(stamps[has_time], kind="stable")]
    groups: dict[bytes, tuple[BoolArray, dict[str, NDArray[Any]]]] = {}
    for name, column in sheet.columns.items():
        if name in used or not isinstance(column, np.ndarray) or column.dtype.kind not in "iufb":
            continue
        values = column[order]
        there = np.isfinite(values) if values.dtype.kind == "f" else np.ones(len(values), np.bool_)
        if not there.any():
            continue
        if np.count_nonzero(~there) <= _MISSING_SHARE * len(there):
            there = np.ones(len(values), np.bool_)
        groups.setdefault(np.packbits(there).tobytes(), (there, {}))[1][name] = values[there]
    ordered = sorted(groups.values(), key=lambda group: -np.count_nonzero(group[0]))
    for number, (there, columns) in enumerate(ordered, 1):
        name = sheet.name if number == 1 else f"{sheet.name}_{number}"
        yield Table.of_arrays(name, stamps[order][there], columns, sheet.units, sheet.type_name)


def _of_long_form(sheet: Sheet, stamps: IntArray) -> Iterator[tuple[Sheet, IntArray]]:
    """Yield the signals of a table with a row for each value, those with the same times together; of others nothing."""
    named = {snake(name): column for name, column in sheet.columns.items()}
    signal, value = (next((c for n, c in named.items() if p.fullmatch(n)), None) for p in (_SIGNAL, _VALUE))
    if signal is None or isinstance(signal, np.ndarray) or not isinstance(value, np.ndarray):
        return
    import polars as pl

    rows_of = pl.DataFrame({"signal": signal}).with_row_index().drop_nulls().group_by("signal", maintain_order=True)
    grouped, units = rows_of.agg("index"), named.get("unit", named.get("units"))
    if grouped.height**2 > 100 * len(signal):  # texts of another kind
        return
    clocks: dict[bytes, tuple[Sheet, IntArray]] = {}
    for title, numbers in zip(grouped["signal"], grouped["index"], strict=True):
        rows = numbers.to_numpy()
        part, _ = clocks.setdefault(stamps[rows].tobytes(), (Sheet(sheet.name, {}, {}), stamps[rows]))
        (field,), given = read_head([title])
        cell = None if units is None or isinstance(units, np.ndarray) else units[int(rows[0])]
        part.columns[field] = value[rows]  # type: ignore[index]
        part.units[field] = cell or given.get(field, "")  # type: ignore[index]
    yield from clocks.values()


def whole_days(date: dt.date) -> int:
    """Return the ns of a date's midnight."""
    return (date - dt.date(1970, 1, 1)).days * 86_400 * 10**9


def read_head(names: Sequence[str]) -> tuple[list[str], dict[str, str]]:
    """Return the field names of titles, and the units that the titles contain, by field name."""
    split = [split_unit(name) for name in names]
    fields = unique(field_name(name) for name, _ in split)
    return fields, {field: unit for field, (_, unit) in zip(fields, split, strict=True) if unit}
