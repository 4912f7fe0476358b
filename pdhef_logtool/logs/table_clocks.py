"""Clocks of tables: unit, epoch and order of the dates are decided once for a whole column, from all evidence.

Evidence, in this order: the unit that the file states; the magnitude, since only a date is of the size of a date; the
other clocks of the file; rates and durations of usual recordings.
"""

import datetime as dt
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.logs.constants import CONSTANTS, numbered
from pdhef_logtool.logs.recording_span import NOTED_SHARE, survey_rows
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Loss, is_dated

if TYPE_CHECKING:
    from polars import Series

#: Stamp of a row without a time.
NO_TIME = np.iinfo(np.int64).min
_CLOCKS, _GPS = CONSTANTS["clocks"], CONSTANTS["gps"]
#: Spellings of units by their nanoseconds; nanoseconds by spelling, in lower case.
_UNITS: dict[int, list[str]] = {ns: spellings.split() for ns, spellings in numbered(_CLOCKS["units"]).items()}
TIME_UNITS_NS = {spelling: ns for ns, spellings in _UNITS.items() for spelling in spellings}
_DAY_NS, _HOUR_NS, _MINUTE_NS, _SECONDS = (TIME_UNITS_NS[name] for name in ("days", "hours", "minutes", "seconds"))
_DAY_S, _HOUR_S, _MINUTE_S = (ns / _SECONDS for ns in (_DAY_NS, _HOUR_NS, _MINUTE_NS))
_DAY_H, _HALF_DAY_H, _HOUR_MIN = 24, 12, 60
#: Units of columns with published names; the first of each explains no other column.
_NAMED_UNITS: dict[str, list[str]] = {name: units.split() for name, units in _CLOCKS["columns"].items()}
_SUBUNITS = tuple(
    ns for ns in _UNITS if ns <= _SECONDS and ns not in {TIME_UNITS_NS[u[0]] for u in _NAMED_UNITS.values()}
)
#: Times that count from the start of a recording follow this instant, 1970-01-02, so that none is negative.
RELATIVE_NS = _DAY_NS
#: 1970-01-01 in the days of Excel, and of MATLAB's ``datenum``.
_DAYS_TO_1970: dict[int, str] = numbered(_CLOCKS["days_to_1970"])
#: Names of other epochs by the ns of a unit, and the units from the epoch to 1970.
_EPOCHS = {(ns, units): name for name, (ns, units) in _CLOCKS["epochs"].items()}
_GPS_EPOCH_NS, _WEEK_S = _GPS["epoch_s"] * _SECONDS, _GPS["week_s"]


@dataclass(frozen=True, slots=True, eq=False)
class Clock:
    """Times of the rows of a table.

    Attributes
    ----------
    stamps_ns : int64 [N], since 1970, or after :data:`RELATIVE_NS` if they count from the start of a recording;
        :data:`NO_TIME` in rows without a time.
    notes : assumptions. is_certain : the file states the unit, or the times are dates.
    columns : names of the columns that the times come from.
    """

    stamps_ns: IntArray
    notes: tuple[str, ...] = ()
    is_certain: bool = True
    columns: frozenset[str] = frozenset()

    @property
    def length_s(self) -> float:
        """Duration in s by the usual step; 0 without times."""
        step, count = _steps(self.stamps_ns[self.stamps_ns != NO_TIME])
        return step / _SECONDS * count

    @property
    def is_dated(self) -> bool:
        """Whether the times are dates."""
        return _is_dated(self.stamps_ns)

    @property
    def middle_ns(self) -> float:
        """Median of the times; NaN without times."""
        stamps = self.stamps_ns[self.stamps_ns != NO_TIME]
        return float(np.median(stamps)) if len(stamps) else math.nan


# ---- numbers ----


def rate_clock(rows: int, rate_hz: float) -> Clock:
    """Return the clock of a table without times."""
    note = f"the table has no times: its rows are 1/{rate_hz:g} s apart, as rate_hz states"
    return Clock(placed(np.round(np.arange(rows) * (_SECONDS / rate_hz)).astype(np.int64)), (note,))


def rescaled(clock: Clock, decades: int, note: str) -> Clock:
    """Return a clock of times since a start that last 10**decades as long."""
    has_time = clock.stamps_ns != NO_TIME
    since = scaled((clock.stamps_ns - RELATIVE_NS) * 10.0**decades, 1, 0, has_time)
    return replace(clock, stamps_ns=placed(since), notes=(*clock.notes, note))


def named_unit(name: str, values: NDArray[Any]) -> str:
    """Return the unit of a column with a published name by its usual step; empty for another column."""
    steps = ((u, _steps(values)[0] * TIME_UNITS_NS[u] / _SECONDS) for u in _NAMED_UNITS.get(name, ()))
    return next((unit for unit, step_s in steps if _is_within(step_s, _CLOCKS["usual_step_s"])), "")


def number_clock(
    values: NDArray[Any],
    unit: str = "",
    name: str = "times",
    others: Sequence[Clock] = (),
    rate_hz: float | None = None,
) -> Clock:
    """Return the clock of numbers or NumPy dates [N]; ``others`` are certain clocks of the same recording.

    ``rate_hz``, rows per second, decides a unit that is not stated.
    """
    if values.dtype.kind == "M":
        factor = TIME_UNITS_NS[np.datetime_data(values.dtype)[0].lower()]
        return Clock(placed(scaled(values.astype(np.int64), factor, 0, ~np.isnat(values))))
    finite = np.isfinite(values)
    if (of_day := seconds_of_day(values[finite])) is not None:
        stamps = np.full(len(values), NO_TIME, np.int64)
        stamps[finite] = to_ns(of_day)
        return Clock(placed(stamps))
    stated = TIME_UNITS_NS.get(re.sub(r"[\s\[\](){}.]", "", unit).lower(), 0)
    factor, epoch, note = _reading(values[finite], stated, others, rate_hz)
    stamps = placed(scaled(values, factor, epoch, finite))
    clock = Clock(stamps, (f"{name}: {note}",) if note else (), bool(stated or epoch or rate_hz) or _is_dated(stamps))
    return clock if epoch else _of_gps(clock, name, others)


def to_ns(seconds: Any) -> Any:
    """Return seconds, a number or [N], as whole microseconds in ns: a double of a date has no more digits."""
    us = TIME_UNITS_NS["microseconds"]
    return np.round(np.asarray(seconds) * (_SECONDS // us)).astype(np.int64) * us


def seconds_of_day(values: FloatArray) -> FloatArray | None:
    """Return the seconds since midnight of numbers ``hhmmss.sss`` [N]; None of other numbers.

    They step by 40 more at a full minute.
    """
    of_day, is_time = of_digits(values)
    if not is_time.all():
        return None
    jumps = np.diff(values) - np.diff(of_day)
    return of_day if (jumps > 39.0).any() and np.diff(of_day).max() < _MINUTE_S else None


def of_digits(values: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return the seconds since midnight of ``hhmmss.sss`` [N], going on behind midnight, and where they are a time."""
    hours, rest = np.divmod(values, 1e4)
    minutes, seconds = np.divmod(rest, 1e2)
    is_time = (values >= 0.0) & (hours < _DAY_H) & (minutes < _HOUR_MIN) & (seconds < _MINUTE_S)
    return unwrapped(_HOUR_S * hours + _MINUTE_S * minutes + seconds), is_time


def _reading(values: NDArray[Any], stated: int, others: Sequence[Clock], rate_hz: float | None) -> tuple[int, int, str]:
    """Return ns of a unit, the units from an epoch to 1970, and the assumption, from finite values and the unit."""
    middle = float(np.median(values)) if len(values) else 0.0
    step, count = _steps(values)
    lengths = [length for clock in others if (length := clock.length_s) > 0.0]

    def fits(factor: int) -> bool:
        return step == 0.0 or _is_within(step * factor / _SECONDS, _CLOCKS["date_steps_s"])

    def decades_off(reading: tuple[int, int]) -> float:
        step_s = step * reading[0] / _SECONDS
        length_s = step_s * count
        if length_s <= 0.0:
            return 0.0
        apart = min((abs(math.log10(length_s / length)) for length in lengths), default=0.0)
        slow = _CLOCKS["weight_of_steps"] * _outside(step_s, _CLOCKS["usual_step_s"])
        return float(slow + _outside(length_s, _CLOCKS["usual_length_s"]) + apart)

    dates = _dates_of(middle)
    days = [(_DAY_NS, epoch) for epoch in _DAYS_TO_1970 if _is_date((middle - epoch) * _DAY_S)]
    if stated:
        as_stated = next((r for r in (*dates, *days) if r[0] == stated), (stated, 0))
        is_sound = fits(stated) and abs(middle) * stated < _CLOCKS["last_ns"]
        better = as_stated if is_sound else next((r for r in (*dates, *days) if fits(r[0])), as_stated)
        changed = better[0] != stated
        return *better, f"the unit makes no plausible times, read as {_named(*better)}" if changed else ""
    dates = [reading for reading in dates if fits(reading[0])]
    if dates:
        return *dates[0], f"read as {_named(*dates[0])}" if dates[0] in _EPOCHS else ""
    if rate_hz and step:
        return _as_rate_states(rate_hz, step)
    factor, epoch = min((*((f, 0) for f in _SUBUNITS), *days), key=decades_off)
    return factor, epoch, _assumption(values, factor, epoch, others)


def _dates_of(middle: float) -> list[tuple[int, int]]:
    """Return the units and epochs in which a number is a date, since 1970 if there are such ones."""
    dates = [(factor, 0) for factor in _SUBUNITS if _is_date(middle * factor / _SECONDS)]
    elsewhere = ((f, epoch) for f, epoch in _EPOCHS if middle > _CLOCKS["least_of_epochs"])
    return dates or [(f, epoch) for f, epoch in elsewhere if _is_date((middle - epoch) * f / _SECONDS)]


def _assumption(values: NDArray[Any], factor: int, epoch: int, others: Sequence[Clock]) -> str:
    """Return the note on a unit that is not stated; empty for seconds with fractions, or beside other clocks."""
    are_seconds = factor == _SECONDS and (others or (values != np.round(values)).any())
    return "" if are_seconds else f"no unit, read as {_named(factor, epoch)}; rate_hz states another one"


def _as_rate_states(rate_hz: float, step: float) -> tuple[int, int, str]:
    """Return, as :func:`_reading`, the unit (a power of ten in ns) in which a usual step agrees with the rate."""
    factor = int(10 ** max(0, round(math.log10(_SECONDS / (rate_hz * step)))))
    return factor, 0, f"no unit, read as {factor / _SECONDS:g} s, as rate_hz states"


def _of_gps(clock: Clock, name: str, others: Sequence[Clock]) -> Clock:
    """Return a clock of Unix time, or of GPS time if another clock of the file or the name shows this."""
    unix_s = clock.middle_ns / _SECONDS
    if not _is_within(unix_s, _GPS["as_unix_s"]):
        return clock
    gps_ns = clock.middle_ns + _GPS_EPOCH_NS
    dated = next((other.middle_ns for other in others if other.is_dated), None)
    named = re.search(r"gps|gnss", name, re.IGNORECASE) and not re.search("utc|unix|epoch", name, re.IGNORECASE)
    if abs(gps_ns - dated) < abs(clock.middle_ns - dated) if dated is not None else named:
        stamps = _to_utc(clock.stamps_ns + _GPS_EPOCH_NS, clock.stamps_ns != NO_TIME)
        return replace(clock, stamps_ns=stamps, notes=(*clock.notes, f"{name}: read as GPS time (seconds since 1980)"))
    if dated is not None:
        return clock
    years = [dt.datetime.fromtimestamp(s, dt.UTC).year for s in (unix_s, gps_ns / _SECONDS)]
    note = f"{name}: read as Unix time, {years[0]}; as GPS time it would be {years[1]}"
    return replace(clock, notes=(*clock.notes, note))


def _named(factor: int, epoch: int) -> str:
    return _EPOCHS.get((factor, epoch)) or _DAYS_TO_1970.get(epoch, _UNITS[factor][-1])


def _is_date(unix_s: float) -> bool:
    return _is_within(unix_s, _CLOCKS["dates_s"])


def _is_within(value: float, limits: Sequence[float]) -> bool:
    return limits[0] <= value <= limits[1]


def _is_dated(stamps: IntArray) -> bool:
    has = stamps != NO_TIME
    return bool(has.any()) and is_dated(float(np.median(stamps[has])))


def _outside(value: float, usual: Sequence[float]) -> float:
    """Return the decades by which a value is outside of a range."""
    return max(0.0, math.log10(usual[0] / value), math.log10(value / usual[1]))


def _steps(values: NDArray[Any]) -> tuple[float, int]:
    """Return the usual step of finite values, 0 if none is positive, and the number of positive ones."""
    steps = np.diff(values if values.dtype.kind == "i" else values.astype(np.float64))
    steps = steps[steps > 0]
    return (float(np.median(steps)), len(steps)) if len(steps) else (0.0, 0)


def scaled(values: NDArray[Any], factor: int, epoch: int, has_time: BoolArray) -> IntArray:
    """Return values [N] since an epoch in ns; those that do not fit into int64 have no time."""
    stamps = np.full(values.shape, NO_TIME, np.int64)
    size = np.abs(np.where(has_time, values, 0).astype(np.float64) - epoch)
    has_time = has_time & (size < _CLOCKS["last_ns"] / factor)
    given = values[has_time]
    given = given if given.dtype.kind in "iu" else given.astype(np.float64)
    # The fraction apart: a product would lose the last digits of a date.
    whole = given if given.dtype.kind in "iu" else np.floor(given)
    fraction = np.round((given - whole) * float(factor)).astype(np.int64)
    stamps[has_time] = (whole.astype(np.int64) - epoch) * factor + fraction
    return stamps


def placed(stamps: IntArray) -> IntArray:
    """Return stamps [N], moved to :data:`RELATIVE_NS` unless they are dates."""
    return stamps if _is_dated(stamps) else np.where(stamps != NO_TIME, stamps + RELATIVE_NS, NO_TIME)


def with_fractions(clock: Clock, fractions: FloatArray, unit_ns: int, name: str) -> Clock:
    """Return a clock of whole seconds [N] and the rest of each in the column ``name``, in units of ``unit_ns``."""
    has_time = (clock.stamps_ns != NO_TIME) & (fractions >= 0.0) & (fractions * unit_ns < _SECONDS)
    rest = np.where(has_time, fractions, 0.0).astype(np.int64) * unit_ns
    return replace(clock, stamps_ns=np.where(has_time, clock.stamps_ns + rest, NO_TIME), columns=clock.columns | {name})


def spread(stamps: IntArray) -> tuple[IntArray, str]:
    """Return ascending times [N], spread evenly where several rows share one, as in exports in whole seconds; a note.

    Without shared times they stay as they are, and the note is empty.
    """
    times, first, count = np.unique(stamps, return_index=True, return_counts=True)
    if len(times) < _CLOCKS["few_rows"] or (usual := int(np.median(count))) < 2:
        return stamps, ""
    step = float(np.median(np.diff(times))) / usual
    # The first and last time may have fewer rows than the others.
    ends = np.array([first[1] - usual, *first[1:], first[-1] + usual])
    given = np.array([times[1] - usual * step, *times[1:], times[-1] + usual * step])
    between = np.interp(np.arange(len(stamps)), ends, given - times[0])
    note = f"{usual} rows share each time: they are spread over {usual * step / _SECONDS:g} s"
    return np.round(between).astype(np.int64) + times[0], note


# ---- GPS weeks ----


def week_clock(week: FloatArray, seconds: FloatArray) -> Clock:
    """Return the clock of GPS weeks [N] and their seconds (or milliseconds) [N]; 10-bit weeks are of 2015 to 2034."""
    per_second = TIME_UNITS_NS["seconds"] // TIME_UNITS_NS["milliseconds"]
    has_time = np.isfinite(week) & np.isfinite(seconds)
    has_time &= (week >= 0.0) & (week <= _GPS["most_weeks"]) & (np.abs(seconds) <= 2 * per_second * _WEEK_S)
    given, within = week[has_time].astype(np.int64), seconds[has_time]
    notes: tuple[str, ...] = ()
    if given.size and given.max() < (period := _GPS["weeks_of_10_bits"]):
        added = period * math.ceil((_GPS["first_week"] - float(np.median(given))) / period)
        notes = (f"GPS weeks have 10 bits: {added} weeks are added, so that they are of 2015 to 2034",)
        given = given + added
    within = within / per_second if within.max(initial=0.0) > _WEEK_S else within
    stamps = np.full(week.shape, NO_TIME, np.int64)
    of_week = np.round(within * float(_SECONDS)).astype(np.int64)
    stamps[has_time] = _GPS_EPOCH_NS + given * (_WEEK_S * _SECONDS) + of_week
    return Clock(_to_utc(stamps, has_time), notes)


def _to_utc(stamps: IntArray, has_time: BoolArray) -> IntArray:
    """Return UTC of GPS times [N], both in ns since 1970."""
    since, leap = np.array(_GPS["leap_seconds"], np.int64).T
    after = np.maximum(np.searchsorted(since, stamps // _SECONDS, side="right") - 1, 0)
    return np.where(has_time, stamps - leap[after] * _SECONDS, NO_TIME)


# ---- texts ----


def text_clock(texts: "Series", dates: "Series | None" = None) -> Clock:
    """Return the clock of texts [N]: ISO 8601, other dates with a time, or times of day; ``dates``: of their days.

    Day and month have one order in the whole column. Numbers above 12 decide it; then the shorter recording; otherwise
    the month is first, with a note.
    """
    texts = _numbered_months(texts.str.strip_chars())
    parts = texts.str.extract_groups(CONSTANTS["patterns"]["time_text"]).struct.unnest()
    if dates is not None and parts["a"].null_count() == len(parts):
        return text_clock(dates.str.strip_chars() + " " + texts)
    number = {n: parts[n].cast(int, strict=False).fill_null(-1).to_numpy() for n in parts.columns if n not in _WORDS}
    is_dated = number["a"] >= 0
    hour, minute, second = number["hour"], number["minute"], number["second"]
    short = hour < 0
    if is_dated.any():  # hh:mm behind a date
        hour, minute, second = (np.where(short, *pair) for pair in ((minute, hour), (second, minute), (0, second)))
    hour, minute, second = (np.maximum(part, 0) for part in (hour, minute, second))
    half = parts["half"].str.to_lowercase().fill_null("").to_numpy()
    hour = np.where(half == "", hour, hour % _HALF_DAY_H + _HALF_DAY_H * (half == "p"))
    has_time = (second <= _MINUTE_S) & ((minute < _HOUR_MIN) | short & ~is_dated) & ((hour < _DAY_H) | ~is_dated)
    fraction = parts["fraction"].fill_null("").str.pad_end(9, "0").cast(int).to_numpy()
    of_day = hour * _HOUR_NS + minute * _MINUTE_NS + second * _SECONDS + fraction
    if not is_dated.any():
        has_time &= number["second"] >= 0
        period = _HOUR_NS if short[has_time].all() else _DAY_NS
        stamps = np.full(len(texts), NO_TIME, np.int64)
        stamps[has_time] = unwrapped(of_day[has_time], period)
        return Clock(placed(stamps))
    days, is_day, note = _days(number["a"], number["b"], number["c"], parts["mark"].fill_null("").to_numpy())
    zone = np.maximum(number["zone_hour"], 0) * _HOUR_NS + np.maximum(number["zone_minute"], 0) * _MINUTE_NS
    zone = np.where(parts["sign"].fill_null("").to_numpy() == "-", -zone, zone)
    stamps = days * _DAY_NS + of_day - zone
    return Clock(np.where(has_time & is_dated & is_day, stamps, NO_TIME), (note,) if note else ())


_WORDS = frozenset({"mark", "half", "sign", "fraction"})
_MONTHS = [names.replace(" ", "|") for names in _CLOCKS["months"]]


def _numbered_months(texts: "Series") -> "Series":
    """Return texts [N] in which a named month is a number between day and year, and dates of digits have marks."""
    compact, *named = (CONSTANTS["patterns"][name] for name in ("compact_date", "named_month", "month_first"))
    if texts.drop_nulls().head(1).str.contains(compact).any():
        return texts.str.replace(compact, "${1}-${2}-${3} ${4}:${5}:${6}")
    every = "|".join(_MONTHS)
    for form, result in zip(named, ("${{1}}.{}.${{2}}", "${{1}}.{}.${{2}}${{4}} ${{3}}"), strict=True):
        if texts.drop_nulls().head(1).str.contains(form.replace("MONTH", every)).any():
            for number, names in enumerate(_MONTHS, 1):
                texts = texts.str.replace(form.replace("MONTH", names), result.format(number))
    return texts


def _days(a: IntArray, b: IntArray, c: IntArray, mark: NDArray[Any]) -> tuple[IntArray, BoolArray, str]:
    """Return days since 1970 of dates a-b-c [N], a mask of valid days, and the assumption."""
    year_first = a > 31
    is_short = (c < 100) & (mark != "-")
    year = np.where(year_first, a, np.where(is_short, c + 2000, c))
    days, is_day = _civil(year, b, np.where(year_first, c, a))
    other, is_other = _civil(year, np.where(year_first, b, a), np.where(year_first, c, b))
    orders = ((days, is_day), (other, is_other))
    day_first, month_first = ((-int(is_.sum()), int(np.ptp(of[is_])) if is_.any() else 0) for of, is_ in orders)
    if (mark == ".").any() or year_first.any() or day_first < month_first:
        return days, is_day, ""
    is_open = day_first == month_first and bool((days != other)[is_day].any())
    return other, is_other, "no date shows whether day or month is first: read as month/day" if is_open else ""


def _civil(year: IntArray, month: IntArray, day: IntArray) -> tuple[IntArray, BoolArray]:
    """Return days since 1970 [N], and whether these are days of the calendar from 1900 to 2261."""
    first, last = _CLOCKS["years"]
    is_day = (year >= first) & (year <= last) & (month >= 1) & (month <= len(_MONTHS)) & (day >= 1)
    years = np.where(is_day, year - 1970, 0).astype("datetime64[Y]")
    months = years.astype("datetime64[M]") + np.where(is_day, month - 1, 0)
    days = months.astype("datetime64[D]") + np.where(is_day, day - 1, 0)
    is_day &= days.astype("datetime64[M]") == months
    return days.astype(np.int64), is_day


def unwrapped(times: NDArray[Any], period: float = _DAY_S) -> NDArray[Any]:
    """Return times since midnight [N] that continue behind midnight; ``period`` is a day in their unit."""
    steps = np.diff(times, prepend=times[:1])
    wraps = np.cumsum((steps < -period / 2).astype(np.int64) - (steps > period / 2))
    return np.asarray(times + period * np.maximum(wraps, 0))


def whole_days(date: dt.date) -> int:
    """Return the ns of a date's midnight."""
    return int(np.datetime64(date).astype(int)) * _DAY_NS


# ---- rows in the order of time ----


def ascending_rows(stamps: IntArray, where: str) -> tuple[IntArray, list[Loss]]:
    """Return the rows that are kept of stamps [N], in file order, and losses.

    As in logs of messages, rows of another time and times that were recorded before are left out
    (:mod:`~pdhef_logtool.logs.recording_span`), where they disturb the order. Single rows out of order are left out. No
    row is moved.
    """
    rows: IntArray = np.flatnonzero(stamps != NO_TIME)
    losses: list[Loss] = []
    if len(rows) < len(stamps):
        losses.append(Loss("bad-stamp", "row without a time", where, count=len(stamps) - len(rows)))
    if (np.diff(stamps[rows]) >= 0).all():
        return rows, losses
    used, left_out = survey_rows(stamps[rows], where)
    losses += left_out
    rows = rows[used]
    times = stamps[rows]
    behind, ahead = times >= np.maximum.accumulate(times), times <= np.minimum.accumulate(times[::-1])[::-1]
    kept = max(behind, ahead, key=np.count_nonzero)
    if not kept.all():
        n = int((~kept).sum())
        severity: Literal["lost", "note"] = "lost" if n > NOTED_SHARE * len(stamps) else "note"
        what = f"{n} rows are left out: their times are not in order"
        losses.append(Loss("out-of-order", what, where, count=n, severity=severity))
    return rows[kept], losses


def unlike_lengths(stamps: Mapping[str, IntArray], where: str) -> list[Loss]:
    """Return a loss if the lengths of the clocks [N] of a file, by table, contradict each other."""
    compared = [
        (int(s[-1] - s[0]) / _SECONDS, n) for n, s in stamps.items() if len(s) >= _CLOCKS["few_rows"] and s[-1] > s[0]
    ]
    (short_s, short), (long_s, long) = (min(compared), max(compared)) if compared else ((1.0, ""), (1.0, ""))
    what = f"clocks of one recording differ: {short} lasts {short_s:.4g} s, {long} {long_s:.4g} s"
    return [Loss("clock-lengths", what, where)] if long_s >= _CLOCKS["unlike"] * short_s else []
