"""Where in the drives of a run a condition is true: rows of drive, start, end and peak."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.evaluation.segments import SEGMENTS
from pdhef_logtool.evaluation.smoothing import runs
from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.records.errors import EXIT_FAILURE, EXIT_OK, EXIT_PARTIAL, OutputError, UsageError
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import TRACK_COLUMNS
from pdhef_logtool.results.condition import Condition, Reference, parse_condition
from pdhef_logtool.results.opened_run import ESTIMATES_FILE, OpenedLog, OpenedRun
from pdhef_logtool.results.parquet_sink import list_estimators
from pdhef_logtool.results.sink import TRUTH

if TYPE_CHECKING:
    import polars as pl

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
    left_out : drives that could not be looked at, with the reason; ``unreadable``: how many of them are damaged or
        failed; ``damaged``: a line a damaged one. failed : whether something of the run could not be read.
    clips : files that were written.
    """

    where: str
    searched: int
    events: tuple[FoundEvent, ...]
    left_out: Mapping[str, str]
    of: str = "the selected estimates"
    failed: bool = False
    unreadable: int = 0
    damaged: tuple[str, ...] = ()
    clips: tuple[str, ...] = ()

    @property
    def exit_code(self) -> int:
        """3 if a file could not be read, 1 if no drive could be read, otherwise 0."""
        if self.unreadable and not self.searched and self.unreadable == len(self.left_out):
            return EXIT_FAILURE
        return EXIT_PARTIAL if self.failed else EXIT_OK

    def to_dict(self) -> dict[str, Any]:
        """Return it as JSON-able values."""
        return {
            "format": "pdhef.events",
            "version": 1,
            "where": self.where,
            "searched": self.searched,
            "events": [asdict(e) for e in self.events],
            "left_out": dict(self.left_out),
            "clips": self.clips,
        }


def event_condition(text: str) -> Condition:
    """Read a condition on the columns of tracks; a segment is a column that is true within it. Raises UsageError."""
    condition = parse_condition(text, _NUMBERS, flags=(*sorted(FLAGS), *SEGMENTS))
    for name, reference in condition.references.items():
        if reference.track == TRUTH and reference.column in ERRORS:
            raise UsageError(expected="an estimator before an error", got=name, where="--where")
    return condition


def find_events(
    run: OpenedRun, condition: Condition, *, estimator: str | None = None, least_s: float = 0.0, pad_s: float = 0.0
) -> FoundEvents:
    """Search all drives of a run, one at a time, reading only the columns of the condition.

    Parameters
    ----------
    estimator : track of columns without a prefix; None: the selected estimate of each drive.
    least_s : minimum duration of an event.
    pad_s : events closer than twice this become one.

    Raises
    ------
    UsageError : No drive has an estimator of that name.
    """
    events: list[FoundEvent] = []
    left_out: dict[str, str] = {}
    damaged: dict[str, str] = {}
    drives = _drives(run)
    unreadable = searched = 0
    for log in run.logs:
        try:
            reason = _unfit(log, condition, estimator)
            if reason is None:
                events += _events_of(log, condition, estimator or log.main(), drives[log.label], least_s, pad_s)
                searched += 1
        except OutputError as error:
            reason = error.got
            damaged[log.label] = str(error)
        if reason is not None:
            left_out[log.label] = reason
            unreadable += log.label in damaged or log.outcome.startswith("failed")
    if not searched:
        _check_tracks([log for log in run.logs if log.label not in damaged], condition, estimator)
    lines = tuple(damaged.values())
    return FoundEvents(
        condition.text + (f" for {least_s:g} s" if least_s else ""),
        searched,
        tuple(events),
        left_out,
        estimator or "the selected estimates",
        unreadable > 0,
        unreadable,
        lines,
    )


@dataclass(frozen=True, slots=True)
class _Drive:
    """Start of a log, lowest speed of scores, and intervals of its segments by name."""

    start_ns: int
    low_speed_m_s: float
    spans: dict[str, list[tuple[int, int]]] = field(default_factory=dict)


def _drives(run: OpenedRun) -> dict[str, _Drive]:
    """Return the drives of a run by log."""
    rows = run.table("drives").select("log", "start_ns", "low_speed_m_s").collect().iter_rows()
    drives = {log: _Drive(start_ns or 0, slow or 0.0) for log, start_ns, slow in rows}
    events = run.table("events").select("log", "event", "start_ns", "end_ns").collect()
    for log, event, *span in events.iter_rows():
        drives[log].spans.setdefault(event, []).append((span[0], span[1]))
    return drives


def _unfit(log: OpenedLog, condition: Condition, estimator: str | None) -> str | None:
    """Return why a drive cannot be searched, otherwise None."""
    file = log.file(ESTIMATES_FILE)
    if file is None:
        return log.outcome if log.outcome.startswith("failed") else f"it has no {ESTIMATES_FILE}"
    there = list_estimators(file)
    for name in _needed(condition, estimator or log.main()):
        if name not in there:
            return "it has no ground truth" if name == TRUTH else f"it has no estimator {name}".strip()
    return None


def _check_tracks(logs: Sequence[OpenedLog], condition: Condition, estimator: str | None) -> None:
    """Raise UsageError for an estimator that none of the drives that can be read has."""
    estimators = {n for log in logs if (file := log.file(ESTIMATES_FILE)) is not None for n in list_estimators(file)}
    if not estimators:
        return
    expected = f"an estimator of this run: {', '.join(sorted(estimators))}"
    if estimator is None and not any(log.main() for log in logs):
        raise UsageError(expected=expected, got="none named, and none that is selected", where="--estimator")
    asked = {r.track for r in condition.references.values() if r.track is not None} | (
        {estimator} if estimator else set()
    )
    for name in sorted(asked - estimators - {TRUTH, None}, key=str):
        where = "--where" if name != estimator else "--estimator"
        raise UsageError(expected=expected, got=str(name), where=where)


def _needed(condition: Condition, main: str) -> set[str]:
    """Return the tracks that a condition reads."""
    columns = condition.references.values()
    errors = {TRUTH for r in columns if r.column in ERRORS}
    return {main} | {r.track or main for r in columns} | errors


def _events_of(
    log: OpenedLog, condition: Condition, main: str, drive: _Drive, least_s: float, pad_s: float
) -> list[FoundEvent]:
    """Return the events of one drive."""
    import polars as pl

    frame = log.estimates()
    assert frame is not None
    builder = _Builder(main, drive)
    named = [builder.column(reference).alias(name) for name, reference in condition.references.items()]
    peak = pl.lit(None) if condition.peak is None else condition.peak
    holds = condition.expression.fill_null(value=False)
    columns = _joined(frame, builder.columns, main).select("stamp_ns", *named)
    rows = columns.select("stamp_ns", holds=holds, peak=peak.cast(pl.Float64)).collect()
    stamps, mask = rows["stamp_ns"].to_numpy(), rows["holds"].to_numpy()
    values = rows["peak"].fill_null(math.nan).to_numpy()
    events = []
    for first, last in _spans(stamps, mask, least_s, pad_s):
        peak_row = _peak_at(values[first:last], condition.falls)
        start_ns, end_ns = int(stamps[first]), int(stamps[last - 1]) + 1
        events.append(
            FoundEvent(
                log.label,
                start_ns,
                end_ns,
                (start_ns - drive.start_ns) * 1e-9,
                (end_ns - drive.start_ns) * 1e-9,
                None if peak_row is None else float(values[first + peak_row]),
                None if peak_row is None else int(stamps[first + peak_row]),
            )
        )
    return events


def _spans(stamps_ns: IntArray, mask: BoolArray, least_s: float, pad_s: float) -> list[tuple[int, int]]:
    """Return the rows [first, last) of the runs in a mask [N] that last long enough, joined where their pads touch."""
    joined: list[tuple[int, int]] = []
    for first, last in runs(stamps_ns, mask):
        if (stamps_ns[last - 1] - stamps_ns[first]) * 1e-9 < least_s - 1e-9:
            continue
        if joined and (stamps_ns[first] - stamps_ns[joined[-1][1] - 1]) * 1e-9 <= 2.0 * pad_s:
            joined[-1] = (joined[-1][0], last)
        else:
            joined.append((first, last))
    return joined


def _peak_at(values: FloatArray, falls: bool) -> int | None:
    if np.isnan(values).all():
        return None
    return int(np.nanargmin(values) if falls else np.nanargmax(values))


def _joined(frame: pl.LazyFrame, columns: Mapping[str, set[str]], main: str) -> pl.LazyFrame:
    """Return the columns by track at the stamps of the selected estimate, named ``track.column``; NaN is null."""
    import polars as pl

    def of(track: str) -> pl.LazyFrame:
        typed = [pl.col(c) if c in FLAGS else pl.col(c).cast(pl.Float64).fill_nan(None) for c in sorted(columns[track])]
        named = [c.alias(f"{track}.{c.meta.output_name()}") for c in typed]
        return frame.filter(pl.col("estimator").cast(pl.String) == track).select("stamp_ns", *named)

    rows = of(main)
    for track in sorted(columns.keys() - {main}):
        rows = rows.join(of(track), on="stamp_ns", how="left")
    return rows.sort("stamp_ns")


class _Builder:
    """Makes the columns of a condition; ``columns`` collects the stored columns that they need, by track."""

    def __init__(self, main: str, drive: _Drive) -> None:
        self._main, self._drive = main, drive
        self.columns: dict[str, set[str]] = {main: set()}

    def column(self, reference: Reference) -> pl.Expr:
        track, name = reference.track or self._main, reference.column
        if name in SEGMENTS:
            return self._within(name)
        if name in ERRORS:
            column = self._error(track, ERRORS[name])
        else:
            column = self._speed(track) if name == SPEED else self._read(track, name)
        return column if reference.factor == 1.0 else column * reference.factor

    def _within(self, segment: str) -> pl.Expr:
        """Return where a stamp lies in a segment's intervals, which do not overlap."""
        import polars as pl

        spans = sorted(self._drive.spans.get(segment, ()))
        starts, ends = np.array(spans, dtype=np.int64).reshape(-1, 2).T

        def inside(stamps: pl.Series) -> pl.Series:
            ns = stamps.to_numpy()
            return pl.Series(np.searchsorted(starts, ns, side="right") > np.searchsorted(ends, ns, side="right"))

        return pl.col("stamp_ns").map_batches(inside, return_dtype=pl.Boolean)

    def _read(self, track: str, name: str) -> pl.Expr:
        import polars as pl

        self.columns.setdefault(track, set()).add(name)
        return pl.col(f"{track}.{name}")

    def _speed(self, track: str) -> pl.Expr:
        vx, vy = self._read(track, "vx_m_s"), self._read(track, "vy_m_s")
        return (vx * vx + vy.fill_null(0.0) * vy.fill_null(0.0)).sqrt()

    def _error(self, track: str, signal: str) -> pl.Expr:
        """Return estimate − ground truth at scored stamps: both valid, and for sideslip above the lowest speed."""
        import polars as pl

        error = self._read(track, signal) - self._read(TRUTH, signal)
        scored = self._read(track, "valid") & self._read(TRUTH, "valid")
        if signal == "sideslip_rad":
            error = pl.arctan2(error.sin(), error.cos())
            scored &= self._speed(TRUTH) > self._drive.low_speed_m_s
        return pl.when(scored).then(error)
