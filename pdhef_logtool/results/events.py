"""Where in the drives of a run a condition is true: rows of drive, start, end and peak."""

import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import polars as pl

from pdhef_logtool.evaluation.segments import SEGMENTS
from pdhef_logtool.evaluation.smoothing import runs
from pdhef_logtool.evaluation.statistics import gathered
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.records.errors import EXIT_FAILURE, EXIT_OK, EXIT_PARTIAL, OutputError, UsageError
from pdhef_logtool.records.signals import S_PER_NS, BoolArray, IntArray
from pdhef_logtool.records.tracks import TRACK_COLUMNS
from pdhef_logtool.results.condition import Condition, Reference, parse_condition
from pdhef_logtool.results.opened_run import ESTIMATES_FILE, OpenedLog, OpenedRun
from pdhef_logtool.results.parquet_sink import list_estimators
from pdhef_logtool.results.sink import TRUTH
from pdhef_logtool.storage.documents import jsonable

SPEED = "speed_m_s"
#: Stored columns that are true or false.
FLAGS = frozenset({"valid", "diverged"})
#: Errors against ground truth: the signal of each.
ERRORS = {re.sub(r"_(rad|rad_s|m_s|m_s2)$", r"_error_\1", s): s for s in SCORED_SIGNALS}
_NUMBERS = (*(c for c in TRACK_COLUMNS if c != "stamp_ns" and c not in FLAGS), SPEED, *ERRORS)


@dataclass(frozen=True, slots=True)
class FoundEvent:
    """An interval [start_ns, end_ns) in which a condition is true; ``*_s``: seconds from the start of the log.

    ``peak``: largest value of the left side of the first comparison, or smallest value if the comparison is < or <=;
    None without a comparison. ``peak_ns``: time of the peak.
    """

    drive: str
    start_ns: int
    end_ns: int
    start_s: float
    end_s: float
    peak: float | None
    peak_ns: int | None


@dataclass(frozen=True, slots=True)
class FoundEvents:
    """The events of a run.

    Attributes
    ----------
    where : the condition. of : estimator of its columns. searched : drives that were looked at. events : in the order
        of the run's drives.
    left_out : drives that could not be looked at, with the reason; ``unreadable``: number of damaged and failed ones,
        and of logs that clips could not be cut from completely.
    clips : files that were written.
    """

    where: str
    searched: int
    events: tuple[FoundEvent, ...]
    left_out: Mapping[str, str]
    of: str = "the selected estimates"
    unreadable: int = 0
    clips: tuple[str, ...] = ()

    @property
    def exit_code(self) -> int:
        """3 if a file could not be read, 1 if no drive could be read, otherwise 0."""
        if self.unreadable and not self.searched and self.unreadable == len(self.left_out):
            return EXIT_FAILURE
        return EXIT_PARTIAL if self.unreadable else EXIT_OK

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON-able values."""
        shown = ("where", "searched", "events", "left_out", "clips")
        return {"format": "pdhef.events", "version": 1, **{key: jsonable(getattr(self, key)) for key in shown}}


def event_condition(text: str) -> Condition:
    """Read a condition on the columns of tracks; a segment is a column that is true within it. Raises UsageError."""
    condition = parse_condition(text, _NUMBERS, flags=(*sorted(FLAGS), *SEGMENTS))
    for name, reference in condition.references.items():
        if reference.track == TRUTH and reference.column in ERRORS:
            raise UsageError(expected="an estimator before an error", got=name, where="--where")
    return condition


def find_events(
    run: OpenedRun,
    condition: Condition,
    *,
    estimator: str | None = None,
    least_s: float = 0.0,
    pad_s: float = 0.0,
    tell: Callable[[str], None] = lambda _text: None,
) -> FoundEvents:
    """Search all drives of a run, one at a time, reading only the columns of the condition.

    Parameters
    ----------
    estimator : track of columns without a prefix; None: the selected estimate of each drive.
    least_s : minimum duration of an event.
    pad_s : events closer than twice this become one.
    tell : called with a line for people on each damaged drive.

    Raises
    ------
    UsageError : No drive has an estimator of that name.
    """
    events: list[FoundEvent] = []
    left_out: dict[str, str] = {}
    estimators: set[str] = set()
    drives = _drives(run)
    unreadable = sum(log.outcome.startswith("failed") for log in run.logs)
    for log in run.logs:
        main = estimator or log.main()
        try:
            file = log.file(ESTIMATES_FILE)
            there = [] if file is None else list_estimators(file)
            estimators |= {*there}
            reason = _unfit(log, there, _needed(condition, main))
            if not reason:
                events += _events_of(log, condition, main, drives[log.label], least_s, pad_s)
        except OutputError as error:
            reason = error.got
            unreadable += not log.outcome.startswith("failed")
            tell(str(error))
        if reason:
            left_out[log.label] = reason
    searched = len(run.logs) - len(left_out)
    if not searched and estimators:
        _check_tracks(estimators, condition, estimator, selected=any(log.main() for log in run.logs))
    where = condition.text + (f" for {least_s:g} s" if least_s else "")
    of = estimator or "the selected estimates"
    return FoundEvents(where, searched, tuple(events), left_out, of, unreadable)


@dataclass(frozen=True, slots=True)
class _Drive:
    """Start of a log, lowest speed of scores, and intervals of its segments by name."""

    start_ns: int
    low_speed_m_s: float
    spans: Mapping[str, Sequence[tuple[int, int]]]


def _drives(run: OpenedRun) -> dict[str, _Drive]:
    """Return the drives of a run by log."""
    events = run.table("events").select("log", "event", "start_ns", "end_ns").collect().iter_rows()
    spans = gathered((log, (event, (start_ns, end_ns))) for log, event, start_ns, end_ns in events)
    rows = run.table("drives").select("log", "start_ns", "low_speed_m_s").collect().iter_rows()
    return {log: _Drive(start_ns or 0, slow or 0.0, gathered(spans.get(log, ()))) for log, start_ns, slow in rows}


def _needed(condition: Condition, main: str) -> set[str]:
    """Return the tracks that a condition reads."""
    columns = condition.references.values()
    return {main, *(r.track or main for r in columns), *(TRUTH for r in columns if r.column in ERRORS)}


def _unfit(log: OpenedLog, there: Collection[str], needed: Collection[str]) -> str:
    """Return why a drive with the tracks ``there`` cannot be searched; empty if it can."""
    if not there:
        return log.outcome if log.outcome.startswith("failed") else f"it has no {ESTIMATES_FILE}"
    missing = next((name for name in needed if name not in there), None)
    return "" if missing is None else "it has no ground truth" if missing == TRUTH else f"it has no estimator {missing}"


def _check_tracks(estimators: set[str], condition: Condition, estimator: str | None, *, selected: bool) -> None:
    """Raise UsageError for an estimator that none of the drives has."""
    expected = f"an estimator of this run: {', '.join(sorted(estimators))}"
    if estimator is None and not selected:
        raise UsageError(expected=expected, got="none named, and none that is selected", where="--estimator")
    asked = {estimator, *(r.track for r in condition.references.values())} - {None, TRUTH, *estimators}
    for name in sorted(map(str, asked)):
        raise UsageError(expected=expected, got=name, where="--estimator" if name == estimator else "--where")


def _events_of(
    log: OpenedLog, condition: Condition, main: str, drive: _Drive, least_s: float, pad_s: float
) -> list[FoundEvent]:
    """Return the events of one drive."""
    frame = log.estimates()
    assert frame is not None
    named = [_column(reference, main, drive).alias(name) for name, reference in condition.references.items()]
    peak = pl.lit(None) if condition.peak is None else condition.peak
    holds = condition.expression.fill_null(value=False)
    columns = _joined(frame, [main, *sorted(_needed(condition, main) - {main})]).select("stamp_ns", *named)
    rows = columns.select("stamp_ns", holds=holds, peak=peak.cast(pl.Float64).fill_null(math.nan)).collect()
    stamps, mask, values = (rows[name].to_numpy() for name in ("stamp_ns", "holds", "peak"))
    events = []
    for first, last in _spans(stamps, mask, least_s, pad_s):
        inside, peak_at = values[first:last], None
        if not np.isnan(inside).all():
            peak_at = first + int(np.nanargmin(inside) if condition.falls else np.nanargmax(inside))
        start_ns, end_ns = int(stamps[first]), int(stamps[last - 1]) + 1
        start_s, end_s = ((ns - drive.start_ns) * S_PER_NS for ns in (start_ns, end_ns))
        of_peak = (None, None) if peak_at is None else (float(values[peak_at]), int(stamps[peak_at]))
        events.append(FoundEvent(log.label, start_ns, end_ns, start_s, end_s, *of_peak))
    return events


def _spans(stamps_ns: IntArray, mask: BoolArray, least_s: float, pad_s: float) -> list[tuple[int, int]]:
    """Return the rows [first, last) of the runs in a mask [N] that last long enough, joined where their pads touch."""
    joined: list[tuple[int, int]] = []
    for first, last in runs(stamps_ns, mask):
        if (stamps_ns[last - 1] - stamps_ns[first]) * S_PER_NS < least_s - S_PER_NS:
            continue
        if joined and (stamps_ns[first] - stamps_ns[joined[-1][1] - 1]) * S_PER_NS <= 2.0 * pad_s:
            joined[-1] = (joined[-1][0], last)
        else:
            joined.append((first, last))
    return joined


def _joined(frame: pl.LazyFrame, tracks: Sequence[str]) -> pl.LazyFrame:
    """Return the columns of tracks at the stamps of the first one, named ``track.column``; NaN is null.

    Polars reads only those that are used later.
    """

    def of(track: str) -> pl.LazyFrame:
        numbers = pl.col(sorted({*TRACK_COLUMNS} - {"stamp_ns", *FLAGS})).cast(pl.Float64).fill_nan(None)
        columns = [c.name.prefix(f"{track}.") for c in (numbers, pl.col(sorted(FLAGS)))]
        return frame.filter(pl.col("estimator").cast(pl.String) == track).select("stamp_ns", *columns)

    rows = of(tracks[0])
    for track in tracks[1:]:
        rows = rows.join(of(track), on="stamp_ns", how="left")
    return rows.sort("stamp_ns")


def _column(reference: Reference, main: str, drive: _Drive) -> pl.Expr:
    """Return a column of a condition, of the columns of :func:`_joined`."""

    def of(column: str, track: str = reference.track or main) -> pl.Expr:
        return pl.col(f"{track}.{column}")

    def speed(track: str) -> pl.Expr:
        return (of("vx_m_s", track) ** 2 + of("vy_m_s", track).fill_null(0.0) ** 2).sqrt()

    name = reference.column
    if name in SEGMENTS:
        return _within(drive.spans.get(name, ()))
    if name in ERRORS:  # at scored stamps: both valid, and for sideslip above the lowest speed
        signal = ERRORS[name]
        error = of(signal) - of(signal, TRUTH)
        scored = of("valid") & of("valid", TRUTH)
        if signal == "sideslip_rad":
            error = pl.arctan2(error.sin(), error.cos())
            scored &= speed(TRUTH) > drive.low_speed_m_s
        column: pl.Expr = pl.when(scored).then(error)
    else:
        column = speed(reference.track or main) if name == SPEED else of(name)
    return column if reference.factor == 1.0 else column * reference.factor


def _within(spans: Sequence[tuple[int, int]]) -> pl.Expr:
    """Return where a stamp lies in a segment's intervals, which do not overlap."""
    starts, ends = np.array(sorted(spans), dtype=np.int64).reshape(-1, 2).T

    def inside(stamps: pl.Series) -> pl.Series:
        ns = stamps.to_numpy()
        return pl.Series(np.searchsorted(starts, ns, side="right") > np.searchsorted(ends, ns, side="right"))

    return pl.col("stamp_ns").map_batches(inside, return_dtype=pl.Boolean)
