"""The figures of one drive, from its estimates.parquet: one estimator in memory at a time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.metrics import NORMAL_95, signal_error
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.reasons import REASONS
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.reports.charts import Band, Charts, Cloud, Mark, Row, Series, Span
from pdhef_logtool.reports.colours import FAULT, NOTE, PLAIN, colour
from pdhef_logtool.reports.encoding import Grid, envelope, first_known, grid_of, largest, least
from pdhef_logtool.sinks.base import TRUTH
from pdhef_logtool.sinks.parquet import list_estimators, read_track

_DEG = float(np.degrees(1.0))
#: What nobody sees on a page, in degrees and as a share.
_DEGREES_SEEN, _SHARE_SEEN = 0.001, 0.001
#: Rows of the table of the largest errors; two of them are further apart than this, and than this share of the drive.
PEAKS, _APART_S, _APART_SHARE = 10, 1.0, 0.02
#: Stamps further apart are a gap, where they are also further apart than so many median steps.
_GAP_S, _GAP_STEPS = 0.25, 5.0
_MOST_POINTS = 12_000
#: NIS is shown as its mean over so long.
_NIS_S = 1.0
_DASHES: tuple[tuple[int, ...], ...] = ((6, 3), (2, 2), (8, 3, 2, 3), (4, 4), (10, 4))
_COLUMNS = (
    "vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2", "x_m", "y_m",
    "sideslip_std_rad", "network_trust", "r_scale", "nis", "valid", "diverged", "reason",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Peak:
    """One of the largest errors: a stamp of the file, in ns and in seconds from the log's start; angles in rad."""

    stamp_ns: int
    at_s: float
    estimate_rad: float
    other_rad: float
    error_rad: float
    during: str


@dataclass(frozen=True, slots=True, eq=False)
class DriveFigures:
    """What is drawn of a drive, and what the page says beside it.

    ``other``: what the answer is held against, the truth or, without one, another estimator; empty where there is none.
    ``scored``: whether any sideslip error is known. ``moves``: whether a sideslip is known at all above the low-speed
    blend. ``absent``: estimators that the report names and the file has not.
    """

    charts: Charts
    peaks: Sequence[Peak]
    other: str
    scored: bool
    moves: bool
    absent: Sequence[str]


@dataclass(frozen=True, slots=True)
class Roles:
    """Who is drawn how: the answer, the best physics (empty without), and the others that ran."""

    main: str
    rival: str
    others: tuple[str, ...]

    def group(self, name: str) -> str:
        """Return the box on the page that shows an estimator; empty for those that are always drawn."""
        return "" if name in (self.main, self.rival) else name


class _Tracks:
    """The tracks of a file, as they are drawn."""

    def __init__(self, path: Path, low_speed_m_s: float) -> None:
        self._path, self.low_speed_m_s = path, low_speed_m_s
        self.names = list_estimators(path)

    def read(self, name: str) -> StateTrack | None:
        """Return a track as the file has it, None where it has none."""
        return read_track(self._path, name, _COLUMNS) if name in self.names else None

    def drawn(self, track: StateTrack) -> StateTrack:
        """Return it with its sideslip unknown where it is not valid, or too slow for a direction."""
        slow = track.without_sideslip_below(self.low_speed_m_s)
        if track.name == TRUTH:
            return slow
        beta, std = (np.where(track.valid, c, np.nan) for c in (slow.sideslip_rad, slow.sideslip_std_rad))
        return replace(slow, sideslip_rad=beta, sideslip_std_rad=std)


def drive_figures(path: Path, report: dict[str, Any], roles: Roles, low_speed_m_s: float) -> DriveFigures | None:
    """Return the figures of a drive, None where the file holds no row of its answer.

    Parameters
    ----------
    path : estimates.parquet. low_speed_m_s : sideslip is a gap below it.

    Raises
    ------
    OutputError
        The file is damaged.
    """
    tracks = _Tracks(path, low_speed_m_s)
    main = tracks.read(roles.main)
    if main is None or not len(main):
        return None
    truth = tracks.read(TRUTH)
    drawing = _Drawing(tracks, report, roles, grid_of(main.stamps_ns), int(report["log"]["start_ns"]))
    return drawing.all(main, None if truth is None else replace(truth, valid=np.ones(len(truth), dtype=np.bool_)))


class _Drawing:
    """Gathers the series of all tracks, then makes the figures of them."""

    def __init__(self, tracks: _Tracks, report: dict[str, Any], roles: Roles, grid: Grid, origin_ns: int) -> None:
        self.tracks, self.report, self.roles, self.grid, self.origin_ns = tracks, report, roles, grid, origin_ns
        self.sideslip: list[Series] = []
        self.bands: list[Band] = []
        self.errors: list[Series] = []
        self.trust: list[Series] = []
        self.scales: list[Series] = []
        self.nis: list[Series] = []
        self.dof = {
            m["estimator"]: m["value"]
            for m in report["metrics"]
            if (m["signal"], m["segment"], m["metric"]) == ("state", "all", "nis_dof") and m["value"]
        }

    def all(self, main: StateTrack, truth: StateTrack | None) -> DriveFigures:
        """Return the figures."""
        roles, names = self.roles, (self.roles.main, self.roles.rival, *self.roles.others)
        drawn_truth = None if truth is None else self.tracks.drawn(truth)
        scored = truth is not None and bool(np.isfinite(self._error(main, truth)).any())
        absent = [n for n in names if n and n not in self.tracks.names]
        other = truth if scored else self._against(absent)
        compared = self.tracks.drawn(main)
        if drawn_truth is not None and np.isfinite(drawn_truth.sideslip_rad).any():
            self.sideslip.append(self._line(TRUTH, drawn_truth.stamps_ns, drawn_truth.sideslip_rad * _DEG, width=1.2))
        for name in names:
            track = main if name == roles.main else self.tracks.read(name) if name else None
            if track is not None:
                self._take(track, other, scored=scored)
        self._order()
        peaks = self._peaks(main, other, scored=scored)
        charts = Charts(self.grid, self.origin_ns)
        moves = bool(np.isfinite(compared.sideslip_rad).any())
        if moves or self.sideslip[0].label == TRUTH:
            charts.time(
                "sideslip", "Sideslip", "°", self.sideslip, bands=self.bands, level=0.0, resolution=_DEGREES_SEEN,
                height=260,
            )  # fmt: skip
        if other is not None and any(np.isfinite(s.values).any() for s in self.errors):
            title = "Absolute error of sideslip, largest of each cell" if scored else (
                f"Disagreement: sideslip of the others less that of {roles.main}, absolute"
            )  # fmt: skip
            marks = [Mark(str(i + 1), p.at_s, abs(p.error_rad) * _DEG) for i, p in enumerate(peaks)]
            charts.time("error", title, "°", self.errors, marks=marks, level=0.0, resolution=_DEGREES_SEEN)
        self._add_filter(charts)
        self._add_motion(charts, main, truth)
        charts.strip("strip", "Faults, gaps and segments", self._rows(main))
        self._add_planes(charts, main, drawn_truth)
        return DriveFigures(charts, peaks, "" if other is None else other.name, scored, moves, absent)

    def _against(self, absent: Sequence[str]) -> StateTrack | None:
        """Return what the answer is held against where there is no truth."""
        named = next((n for n in (self.roles.rival, *self.roles.others) if n and n not in absent), None)
        return None if named is None else self.tracks.read(named)

    def _error(self, track: StateTrack, other: StateTrack, *, scored: bool = True) -> FloatArray:
        """Return track − other [N] in rad at the track's stamps; against the truth as the figures have it."""
        at = _rows_at(other.stamps_ns, track.stamps_ns)
        if at is not None:
            other = _picked(other, at)
            if scored:
                return signal_error(track, other, "sideslip_rad", self.tracks.low_speed_m_s)
            a, b = (self.tracks.drawn(t).sideslip_rad for t in (track, other))
            return np.asarray(wrap_angle(a - b), dtype=np.float64)
        return np.full(len(track), np.nan)

    def _take(self, track: StateTrack, other: StateTrack | None, *, scored: bool) -> None:
        stamps, name, drawn = track.stamps_ns, track.name, self.tracks.drawn(track)
        beta = drawn.sideslip_rad * _DEG
        self.sideslip.append(self._line(name, stamps, beta))
        half = NORMAL_95 * drawn.sideslip_std_rad * _DEG
        if np.isfinite(half).any() and name == self.roles.main:
            low, high = least(self.grid, stamps, beta - half), largest(self.grid, stamps, beta + half)
            self.bands.append(Band(f"{name}, 95 % band", colour(name), low, high))
        if scored and other is not None:
            self._add(self.errors, name, largest(self.grid, stamps, np.abs(self._error(track, other)) * _DEG))
        elif other is not None and name != self.roles.main:
            main = self.tracks.read(self.roles.main)
            assert main is not None
            gap = np.abs(self._error(track, main, scored=False)) * _DEG
            self._add(self.errors, name, largest(self.grid, stamps, gap))
        self._add(self.trust, name, envelope(self.grid, stamps, track.network_trust))
        self._add(self.scales, name, largest(self.grid, stamps, track.r_scale))
        nis = _mean_over(stamps, track.nis / self.dof.get(name, np.nan), _NIS_S)
        self._add(self.nis, name, largest(self.grid, stamps, nis))

    def _add(self, lines: list[Series], name: str, values: FloatArray) -> None:
        if np.isfinite(values).any():
            lines.append(self._series(name, values))

    def _line(self, name: str, stamps: IntArray, values: FloatArray, **options: Any) -> Series:
        return self._series(name, envelope(self.grid, stamps, values), **options)

    def _series(self, name: str, values: FloatArray, **options: Any) -> Series:
        roles = self.roles
        if name == roles.main:
            return Series(name, colour(name), values, **{"width": 1.8, **options})
        if name in (TRUTH, roles.rival):
            return Series(name, colour(name), values, **{"width": 1.3, **options})
        dash = _DASHES[roles.others.index(name) % len(_DASHES)] if name in roles.others else ()
        return Series(name, colour(name), values, **{"width": 1.2, "dash": dash, "group": roles.group(name), **options})

    def _order(self) -> None:
        """Draw the answer over all others."""
        for lines in (self.sideslip, self.errors, self.trust, self.scales, self.nis):
            lines.sort(key=lambda s: (s.label != TRUTH, s.label == self.roles.main))

    def _peaks(self, main: StateTrack, other: StateTrack | None, *, scored: bool) -> tuple[Peak, ...]:
        if other is None:
            return ()
        error = self._error(main, other, scored=scored)
        at = _rows_at(other.stamps_ns, main.stamps_ns)
        if at is None:
            return ()
        found: list[Peak] = []
        size = np.abs(error)
        stamps = main.stamps_ns
        apart_ns = max(_APART_S * 1e9, _APART_SHARE * float(stamps[-1] - stamps[0]))
        while len(found) < PEAKS and np.isfinite(size).any():
            row = int(np.nanargmax(size))
            if size[row] == 0.0:
                break
            found.append(
                Peak(
                    int(stamps[row]),
                    self._seconds(stamps[row]),
                    float(main.sideslip_rad[row]),
                    float(other.sideslip_rad[at[row]]),
                    float(error[row]),
                    self._during(int(stamps[row])),
                )
            )
            size[np.abs(stamps - stamps[row]) <= apart_ns] = np.nan
        return tuple(found)

    def _during(self, stamp_ns: int) -> str:
        names = [s["name"] for s in self.report["segments"] if s["start_ns"] <= stamp_ns < s["end_ns"]]
        return ", ".join(dict.fromkeys(names))

    def _seconds(self, stamp_ns: int | np.int64) -> float:
        return (int(stamp_ns) - self.origin_ns) * 1e-9

    def _add_filter(self, charts: Charts) -> None:
        if self.trust:
            charts.time("trust", "Network trust", "", self.trust, resolution=_SHARE_SEEN, height=120)
        if self.scales:
            flat = all(np.nanmax(s.values) <= 1.0 + 1e-9 for s in self.scales)
            if not flat:
                charts.time(
                    "r_scale", "R scale: how much wider than usual the filter takes its sensors' noise", "×",
                    self.scales, level=1.0, log=True, height=130,
                )  # fmt: skip
        if self.nis:
            title = "NIS over its degrees of freedom, mean of a second: 1 where sensors surprise as much as expected"
            charts.time("nis", title, "", self.nis, level=1.0, height=130, resolution=0.002)

    def _add_motion(self, charts: Charts, main: StateTrack, truth: StateTrack | None) -> None:
        for key, title, unit, column in (
            ("speed", "Speed, longitudinal", "m/s", "vx_m_s"),
            ("ay", "Lateral acceleration", "m/s²", "ay_m_s2"),
        ):
            lines = [
                self._line(track.name, track.stamps_ns, values, width=1.2)
                for track in (truth, main)
                if track is not None and np.isfinite(values := getattr(track, column)).any()
            ]
            if lines:
                charts.time(key, title, unit, lines, resolution=0.002, height=120)

    def _rows(self, main: StateTrack) -> list[Row]:
        stamps = main.stamps_ns
        rows = [Row("no estimate", FAULT, self._spans(~main.valid, stamps, f"{main.name} is not valid"))]
        steps = np.diff(stamps)
        longest = max(_GAP_S * 1e9, _GAP_STEPS * float(np.median(steps)) if steps.size else 0.0)
        gaps = np.flatnonzero(steps > longest)
        rows.append(
            Row("gap in the log", FAULT, [
                Span(self._seconds(stamps[i]), self._seconds(stamps[i + 1]), "no stamp") for i in gaps.tolist()
            ])
        )  # fmt: skip
        rows += self._lost() + self._faults(main)
        by_name: dict[str, list[Span]] = {}
        for s in self.report["segments"]:
            span = Span(self._seconds(s["start_ns"]), self._seconds(s["end_ns"]), s["text"])
            by_name.setdefault(s["name"], []).append(span)
        wrong = {name for name in by_name if name.endswith(" diverged")}
        rows += [Row(name, FAULT, by_name[name]) for name in sorted(wrong)]
        rows += [Row(name, PLAIN, spans) for name, spans in sorted(by_name.items()) if name not in wrong]
        told = [row for row in rows if row.spans]
        return told or [Row("nothing", PLAIN, [])]

    def _lost(self) -> list[Row]:
        spans = [
            Span(self._seconds(x["start_ns"]), self._seconds(x["end_ns"] or x["start_ns"]), x["what"])
            for x in self.report["losses"]
            if x.get("start_ns") is not None
        ]
        return [Row("lost", FAULT, spans)]

    def _faults(self, main: StateTrack) -> list[Row]:
        """Return the reasons of the answer, or of the first estimator that looks for them."""
        names = (self.roles.rival, *self.roles.others)
        track = main
        while not len(track.reason) and names:
            track, names = self.tracks.read(names[0]) or track, names[1:]
        if not len(track.reason):
            return []
        stamps = track.stamps_ns
        return [
            Row(r.text, NOTE, self._spans((track.reason & r.bit) != 0, stamps, f"seen by {track.name}"))
            for r in REASONS
        ]

    def _spans(self, mask: BoolArray, stamps: IntArray, text: str) -> list[Span]:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
        return [
            Span(self._seconds(stamps[a]), self._seconds(stamps[min(b, len(stamps) - 1)]), text)
            for a, b in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True)
        ]

    def _add_planes(self, charts: Charts, main: StateTrack, truth: StateTrack | None) -> None:
        drawn = self.tracks.drawn(main)
        pair = [t for t in (truth, drawn) if t is not None]
        for key, title, x_label, y_label, columns, options in (
            ("path", "Path, north up", "m east", "m north", _path, {"equal": True}),
            ("ay_sideslip", "|a_y| and sideslip", "|a_y| in m/s²", "sideslip in °", _ay_sideslip, {}),
            ("phase", "Phase plane: sideslip rate is a_y/v_x − yaw rate", "sideslip in °", "sideslip rate in °/s",
             _phase, {}),
        ):  # fmt: skip
            line = key == "path"
            clouds = [c for t in pair if (c := self._cloud(t, columns(t), line=line)) is not None]
            if clouds:
                charts.points(key, title, x_label, y_label, clouds, **options)

    def _cloud(self, track: StateTrack, xy: tuple[FloatArray, FloatArray], *, line: bool) -> Cloud | None:
        rows = first_known(self.grid, track.stamps_ns, np.isfinite(xy[0]) & np.isfinite(xy[1]))
        rows = rows[:: -(-len(rows) // _MOST_POINTS) or 1]
        if len(rows) < 2:
            return None
        at = np.asarray((track.stamps_ns[rows] - self.origin_ns) * 1e-9, dtype=np.float64)
        return Cloud(track.name, colour(track.name), xy[0][rows], xy[1][rows], at, line=line)


def _path(track: StateTrack) -> tuple[FloatArray, FloatArray]:
    return track.x_m, track.y_m


def _ay_sideslip(track: StateTrack) -> tuple[FloatArray, FloatArray]:
    return np.abs(track.ay_m_s2), track.sideslip_rad * _DEG


def _phase(track: StateTrack) -> tuple[FloatArray, FloatArray]:
    with np.errstate(divide="ignore", invalid="ignore"):
        rate = track.ay_m_s2 / track.vx_m_s - track.yaw_rate_rad_s
    known = np.isfinite(track.sideslip_rad) & np.isfinite(rate)
    return np.where(known, track.sideslip_rad * _DEG, np.nan), rate * _DEG


def _rows_at(stamps: IntArray, wanted: IntArray) -> IntArray | None:
    """Return the row of ``stamps`` of each wanted stamp, None where they are not the same stamps."""
    if len(stamps) == 0:
        return None
    at = np.minimum(np.searchsorted(stamps, wanted), len(stamps) - 1)
    return at if np.array_equal(stamps[at], wanted) else None


def _picked(track: StateTrack, rows: IntArray) -> StateTrack:
    if len(rows) == len(track):
        return track
    names = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "sideslip_std_rad", "ay_m_s2", "valid")
    return replace(track, stamps_ns=track.stamps_ns[rows], **{n: getattr(track, n)[rows] for n in names})


def _mean_over(stamps: IntArray, values: FloatArray, span_s: float) -> FloatArray:
    """Return the mean of the known values [N] of each span, at each of its stamps."""
    known = np.isfinite(values)
    made = np.full(len(values), np.nan)
    if not known.any():
        return made
    number = (stamps - stamps[0]) // int(span_s * 1e9)
    _, place = np.unique(number, return_inverse=True)
    sums, counts = (np.bincount(place, weights=w) for w in (np.where(known, values, 0.0), known.astype(np.float64)))
    enough = counts > 0.5 * np.median(counts[counts > 0])  # a few samples at the end of a log are no mean
    means = np.divide(sums, counts, out=np.full(len(sums), np.nan), where=enough)
    return np.asarray(means[place], dtype=np.float64)
