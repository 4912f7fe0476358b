"""The figures of one drive."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from pdhef_logtool.evaluation.dead_reckoned import aligned_path
from pdhef_logtool.evaluation.statistics import gathered
from pdhef_logtool.evaluation.track_errors import NORMAL_95, signal_error
from pdhef_logtool.records.geometry import DEGREES, wrap_angle
from pdhef_logtool.records.reasons import REASONS
from pdhef_logtool.records.signals import NS_PER_S, S_PER_NS, BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.reports import charts as draw
from pdhef_logtool.reports.encoding import Grid, envelope, first_known, grid_of
from pdhef_logtool.results.parquet_sink import list_estimators, read_track
from pdhef_logtool.results.sink import TRUTH

#: Columns to draw of every track, and further columns of the ground truth and the selected estimate.
_COLUMNS = ("vx_m_s", "vy_m_s", "sideslip_rad", "valid", "reason")
_MORE_COLUMNS = ("yaw_rate_rad_s", "ay_m_s2", "x_m", "y_m", "sideslip_std_rad", "steer_rad")
#: Columns that determine errors and gaps of the sideslip.
OF_SIDESLIP = ("vx_m_s", "vy_m_s", "sideslip_rad", "valid")


class Tracks:
    """The tracks of a file. Ground truth is used wherever it is finite, as in the metrics."""

    def __init__(self, path: Path, low_speed_m_s: float) -> None:
        self._path, self.low_speed_m_s = path, low_speed_m_s
        self.names = list_estimators(path)

    def read(self, name: str, columns: tuple[str, ...] = OF_SIDESLIP) -> StateTrack:
        """Read some columns of a track; the others are NaN."""
        track = read_track(self._path, name, columns)
        return replace(track, valid=np.ones(len(track), dtype=np.bool_)) if name == TRUTH else track

    def drawn(self, track: StateTrack) -> StateTrack:
        """Return the track with sideslip NaN at invalid stamps and below the low-speed limit."""
        slow = track.without_sideslip_below(self.low_speed_m_s)
        beta, std = (np.where(track.valid, c, np.nan) for c in (slow.sideslip_rad, slow.sideslip_std_rad))
        return replace(slow, sideslip_rad=beta, sideslip_std_rad=std)


#: Series of a track by name, of :func:`gather`.
DriveSeries: TypeAlias = dict[str, Any]
#: One of the largest errors of a report.
_Peak: TypeAlias = Mapping[str, Any]


def thinned(points: FloatArray | None, most: int) -> FloatArray:
    """Return points [3, K], thinned to at most ``most``."""
    return np.empty((3, 0)) if points is None else points[:, :: max(1, -(-points.shape[1] // most))]


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """Reference of errors: ground truth as in the metrics (``scored``), or another estimate as drawn."""

    track: StateTrack
    scored: bool
    tracks: Tracks

    def error(self, track: StateTrack) -> FloatArray:
        """Return track − reference [N] in rad; NaN if unknown or if the reference lacks the stamps of the track."""
        known_ns, stamps_ns = self.track.stamps_ns, track.stamps_ns
        rows = np.minimum(np.searchsorted(known_ns, stamps_ns), max(len(known_ns) - 1, 0))
        if not len(known_ns) or not np.array_equal(known_ns[rows], stamps_ns):
            return np.full(len(track), np.nan)
        columns = {c: getattr(self.track, c)[rows] for c in OF_SIDESLIP}
        other = make_track(self.track.name, stamps_ns, **columns)
        if self.scored:
            return signal_error(track, other, "sideslip_rad", self.tracks.low_speed_m_s)
        ours, theirs = (self.tracks.drawn(t).sideslip_rad for t in (track, other))
        return np.asarray(wrap_angle(ours - theirs), dtype=np.float64)


def gather(name: str, tracks: Tracks, grid: Grid, reference: Reference | None, *, whole: bool) -> DriveSeries:
    """Return the series of one track for the figures, by name; angles in degrees.

    Envelopes [cells, 2] of ``sideslip``, ``yaw_rate``, ``speed``, ``ay`` and ``steer``; largest values [cells] of the
    absolute ``error``; ``band``: the 95 % CI [cells]; points [3, K] in the planes ``path`` and ``ay_sideslip``: stamp,
    x and y. ``invalid``, ``reason`` at each stamp [N].

    Parameters
    ----------
    reference : reference of the errors; None for no errors.
    whole : also return confidence interval, motion and planes.
    """
    track = tracks.read(name, (*_COLUMNS, *_MORE_COLUMNS) if whole else _COLUMNS)
    drawn, stamps = tracks.drawn(track), track.stamps_ns
    beta = drawn.sideslip_rad * DEGREES
    in_cells = partial(envelope, grid, stamps)
    error = None if reference is None else in_cells(np.abs(reference.error(track)) * DEGREES).max(axis=1)
    made = {"sideslip": in_cells(beta), "error": error, "invalid": ~track.valid, "reason": track.reason}
    if not whole:
        return made
    half = NORMAL_95 * drawn.sideslip_std_rad * DEGREES

    def points(x: FloatArray, y: FloatArray) -> FloatArray:
        rows = first_known(grid, stamps, np.isfinite(x) & np.isfinite(y))
        return np.stack([stamps[rows].astype(np.float64), x[rows], y[rows]])

    return made | {
        "band": (in_cells(beta - half).min(axis=1), in_cells(beta + half).max(axis=1)),
        "yaw_rate": in_cells(track.yaw_rate_rad_s * DEGREES),
        "speed": in_cells(track.vx_m_s),
        "ay": in_cells(track.ay_m_s2),
        "path": points(track.x_m, track.y_m),
        "ay_sideslip": points(np.abs(track.ay_m_s2), beta),
        "steer": in_cells(track.steer_rad * DEGREES) if len(track.steer_rad) else None,
    }


#: Storage resolution of figures: in degrees, and in °/s, m/s or m/s².
_DEGREES_SEEN, _SEEN = 0.001, 0.002
#: Minimum size of a gap between stamps, in s and in median steps.
_GAP_S, _GAP_STEPS = 0.25, 5.0
_MOST_POINTS = 12_000
#: Half window around the largest error, and maximum number of points, in the figure of the first screen.
_AROUND_NS, _MOST_AROUND = 4_000_000_000, 1000
#: Colours for small, medium and large errors along the path: Okabe and Ito (2008), dark enough for white.
_ERROR_COLOURS = ("#0072b2", "#b07800", "#c8400a")
#: Minimum extent of a path to be drawn.
_LEAST_PATH_M = 1.0
_DASHES: tuple[tuple[int, ...], ...] = ((6, 3), (2, 2), (8, 3, 2, 3), (4, 4), (10, 4))


@dataclass(frozen=True, slots=True)
class Roles:
    """Names of the selected estimate, the best physics (each empty without), and the others that ran."""

    main: str
    rival: str
    others: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """All names, the selected estimate first."""
        return tuple(n for n in (self.main, self.rival, *self.others) if n)

    def series(self, name: str, values: FloatArray, width: float = 1.2) -> draw.Series:
        """Return the line of a track; lines of estimators other than ``main`` and ``rival`` can be hidden."""
        if name == self.main:
            return draw.Series(name, draw.colour(name), values, width + 1.0)
        if name not in self.others:
            return draw.Series(name, draw.colour(name), values, width, _DASHES[0] if name == self.rival else ())
        dash = _DASHES[self.others.index(name) % len(_DASHES)]
        return draw.Series(name, draw.colour(name), values, width, dash, group=name)


def drive_figures(path: Path, report: Mapping[str, Any], roles: Roles) -> dict[str, Any] | None:
    """Return the figures of a drive; None if the file contains no row of the selected estimate.

    ``charts``, and for the texts of the page: ``peaks`` (the largest errors), ``scored`` (whether any sideslip error is
    available), ``moves`` (any sideslip above the low-speed blend), and ``absent``
    (estimators of the report that the file does not contain).

    Parameters
    ----------
    path : estimates.parquet. The sideslip has gaps below the low-speed limit of the report.

    Raises
    ------
    OutputError
        The file is damaged.
    """
    tracks = Tracks(path, report["vehicle"]["low_speed_blend_m_s"])
    if roles.main not in tracks.names:
        return None
    answer = tracks.read(roles.main)
    stamps = answer.stamps_ns
    if not len(stamps):
        return None
    grid, origin_ns = grid_of(stamps), int(report["log"]["start_ns"])
    peaks = _peaks(report)
    reference = _reference(tracks, peaks)
    scored = reference is not None and reference.scored
    series = {}
    for name in dict.fromkeys([TRUTH, *roles.names]):
        if name in tracks.names:
            against = reference if scored else None if name == roles.main else Reference(answer, False, tracks)
            error_of = None if name == TRUTH else against
            series[name] = gather(name, tracks, grid, error_of, whole=name in (TRUTH, roles.main))
    charts = draw.Charts(grid, origin_ns)
    moves = bool(np.isfinite(series[roles.main]["sideslip"]).any())
    _add_over_time(charts, series, roles, peaks, scored=scored)
    rows = _rows(report, series, roles, stamps, origin_ns)
    charts.figures["strip"] = draw.StripFigure("Faults, gaps and segments", rows)
    if TRUTH in series:
        _add_path(charts, series, roles, _axes(report))
    in_plane = {n: thinned(series[n].get("ay_sideslip"), _MOST_POINTS) for n in (TRUTH, roles.main) if n in series}
    clouds = [
        draw.Cloud(n, draw.colour(n), x, y, _seconds(at_ns, charts))
        for n, (at_ns, x, y) in in_plane.items()
        if len(x) > 1
    ]
    if clouds:
        charts.figures["ay_sideslip"] = draw.PointsFigure(
            "|a_y| and sideslip", "|a_y| in m/s²", "sideslip in °", clouds
        )
    _add_worst(charts, answer, reference, peaks)
    return {
        "charts": charts,
        "peaks": peaks,
        "scored": scored,
        "moves": moves,
        "absent": [n for n in roles.names if n not in tracks.names],
    }


def _reference(tracks: Tracks, peaks: Sequence[_Peak]) -> Reference | None:
    """Return the reference of the report's largest errors; None if it is not available."""
    against = peaks[0]["against"] if peaks else ""
    return Reference(tracks.read(against), against == TRUTH, tracks) if against in tracks.names else None


def _peaks(report: Mapping[str, Any]) -> list[_Peak]:
    """Return the largest errors of a report, with seconds from the log's start and the segments that contain them."""
    peaks = list[_Peak]()
    for place in report.get("largest_errors") or ():
        stamp = int(place["stamp_ns"])
        names = [s["name"] for s in report["segments"] if s["start_ns"] <= stamp < s["end_ns"]]
        at_s, during = (stamp - int(report["log"]["start_ns"])) * S_PER_NS, ", ".join(dict.fromkeys(names))
        peaks.append({**place, "at_s": at_s, "during": during})
    return peaks


def _lines(series: Mapping[str, DriveSeries], roles: Roles, values: str, names: Sequence[str]) -> list[draw.Series]:
    """Return a line for each track with any finite value; the selected estimate is the widest and lowest."""
    lines = []
    for name in sorted(names, key=lambda n: n != roles.main):
        if name in series:
            drawn = series[name].get(values)
            if drawn is not None and np.isfinite(drawn).any():
                lines.append(roles.series(name, drawn))
    return lines


def _add_over_time(
    charts: draw.Charts, series: Mapping[str, DriveSeries], roles: Roles, peaks: Sequence[_Peak], *, scored: bool
) -> None:
    """Add sideslip, its error or the estimators' disagreement, steering, yaw rate, lateral acceleration and speed."""
    figures, main = charts.figures, series[roles.main]
    band, steer = main.get("band"), main.get("steer")
    if lines := _lines(series, roles, "sideslip", (TRUTH, *roles.names)):
        bands = []
        if band is not None and np.isfinite(band[0]).any():
            bands = [draw.Band(f"{roles.main}, 95 % confidence interval", draw.colour(roles.main), *band)]
        figures["sideslip"] = draw.TimeFigure(
            "Sideslip", "°", lines, bands, level=0.0, resolution=_DEGREES_SEEN, height=260
        )
    if lines := _lines(series, roles, "error", roles.names):
        apart = f"Disagreement: sideslip difference from {roles.main}, absolute"
        title = "Absolute error of sideslip, largest of each cell" if scored else apart
        marks = [draw.Mark(str(i + 1), p["at_s"], abs(p["error_rad"]) * DEGREES) for i, p in enumerate(peaks)]
        figures["error"] = draw.TimeFigure(title, "°", lines, marks=marks, level=0.0, resolution=_DEGREES_SEEN)
    if steer is not None and np.isfinite(steer).any():
        lines = [draw.Series("measured", draw.INK, steer)]
        figures["steer"] = draw.TimeFigure("Steering, road-wheel angle", "°", lines, resolution=_SEEN, height=120)
    for key, title, unit in (
        ("yaw_rate", "Yaw rate", "°/s"),
        ("ay", "Lateral acceleration, specific force", "m/s²"),
        ("speed", "Speed, longitudinal", "m/s"),
    ):
        if lines := _lines(series, roles, key, (TRUTH, roles.main)):
            figures[key] = draw.TimeFigure(title, unit, lines, resolution=_SEEN, height=120)


def _rows(
    report: Mapping[str, Any], series: Mapping[str, DriveSeries], roles: Roles, stamps: IntArray, origin_ns: int
) -> list[draw.Row]:
    """Return the rows of the strip: missing or faulty signals first, then the driving segments."""

    def span(start_ns: int, end_ns: int, text: str) -> draw.Span:
        return draw.Span((int(start_ns) - origin_ns) * S_PER_NS, (int(end_ns) - origin_ns) * S_PER_NS, text)

    def spans(mask: BoolArray, text: str) -> list[draw.Span]:
        edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
        ends = np.minimum(edges[1::2], len(stamps) - 1)
        return [span(a, b, text) for a, b in zip(stamps[edges[::2]], stamps[ends], strict=True)]

    steps = np.diff(stamps)
    longest = max(_GAP_S * NS_PER_S, _GAP_STEPS * float(np.median(steps)) if steps.size else 0.0)
    losses = [x for x in report["losses"] if x.get("start_ns") is not None]
    rows = [
        draw.Row("no estimate", draw.FAULT, spans(series[roles.main]["invalid"], f"{roles.main} is not valid")),
        draw.Row(
            "gap in the log", draw.FAULT, [span(stamps[i], stamps[i + 1], "") for i in np.flatnonzero(steps > longest)]
        ),
        draw.Row(
            "lost", draw.FAULT, [span(x["start_ns"], x.get("end_ns") or x["start_ns"], x["what"]) for x in losses]
        ),
    ]
    seer = next((n for n in roles.names if n in series and len(series[n]["reason"])), None)
    if seer is not None and len(reason := series[seer]["reason"]) == len(stamps):
        rows += [draw.Row(r.text, draw.NOTE, spans((reason & r.bit) != 0, f"seen by {seer}")) for r in REASONS]
    by_name = gathered((s["name"], span(s["start_ns"], s["end_ns"], s["text"])) for s in report["segments"])
    for name in sorted(by_name, key=lambda n: (not n.endswith(" diverged"), n)):
        rows.append(draw.Row(name, draw.FAULT if name.endswith(" diverged") else draw.PLAIN, by_name[name]))
    rows = [replace(row, spans=draw.joined(row.spans)) for row in rows if row.spans]
    return rows or [draw.Row("nothing", draw.PLAIN, [])]


def _add_worst(charts: draw.Charts, answer: StateTrack, reference: Reference | None, peaks: Sequence[_Peak]) -> None:
    """Add the sideslip around the largest error, the only figure of the first screen."""
    if reference is None or not peaks:
        return
    worst = peaks[0]
    clouds = []
    for track in (answer, reference.track):
        near = track.between(worst["stamp_ns"] - _AROUND_NS, worst["stamp_ns"] + _AROUND_NS + 1)
        stamps, beta = near.stamps_ns, near.sideslip_rad * DEGREES
        step = max(1, len(stamps) // _MOST_AROUND)
        clouds.append(
            draw.Cloud(track.name, draw.colour(track.name), _seconds(stamps[::step], charts), beta[::step], line=True)
        )
    kind = "error" if reference.scored else "difference"
    here = np.array([worst["at_s"]]), np.array([worst["estimate_rad"] * DEGREES])
    clouds.append(draw.Cloud(f"largest {kind}", draw.FAULT, *here))
    title = f"Largest {kind} after the first 2 s: {abs(worst['error_rad']) * DEGREES:.2f}° at {worst['at_s']:.1f} s"
    title += f" during {worst['during']}" if worst["during"] else ""
    charts.figures["worst"] = draw.PointsFigure(title, "s from the log's start", "sideslip in °", clouds)


def _axes(report: Mapping[str, Any]) -> tuple[str, str]:
    """Return the names of the axes of the drawn ground truth: of the Earth, of the log, or of the start."""
    named = {s["name"] for s in report["ledger"]["samples"] if s["role"] == "truth"}
    if not {"position_m", "yaw_rad"} <= {*report["truth"]["quantities"]}:
        return "m, along the heading at the start", "m, to its left"
    return ("x of the log in m", "y of the log in m") if {"x_m", "y_m"} <= named else ("m east", "m north")


def _add_path(charts: draw.Charts, series: Mapping[str, DriveSeries], roles: Roles, axes: tuple[str, str]) -> None:
    """Add the dead-reckoned path, aligned with the ground truth's at the start."""
    truth, estimate = (thinned(series[n].get("path"), _MOST_POINTS) for n in (TRUTH, roles.main))
    if truth.shape[1] < 2 or max(np.ptp(truth[1]), np.ptp(truth[2])) < _LEAST_PATH_M:
        return
    common, at_truth, at_own = np.intersect1d(truth[0], estimate[0], return_indices=True)
    clouds = [draw.Cloud(TRUTH, draw.colour(TRUTH), truth[1], truth[2], _seconds(truth[0], charts), line=True)]
    title = "Path of the ground truth"
    if len(common) > 1:
        title = "Path, aligned with the ground truth at the start"
        aligned = aligned_path(estimate[1:, at_own], truth[1:, at_truth])
        clouds += _by_error(aligned, common, roles.main, series[roles.main]["error"], charts)
    charts.figures["path"] = draw.PointsFigure(title, *axes, clouds, equal=True)


def _by_error(
    aligned: FloatArray, at_ns: FloatArray, name: str, largest: FloatArray | None, charts: draw.Charts
) -> list[draw.Cloud]:
    """Return the path [2, K] of a track in three classes of its ``largest`` absolute sideslip error in each cell."""
    assert charts.grid is not None
    largest = np.zeros(charts.grid.cells) if largest is None else largest
    cell = np.clip((at_ns - charts.grid.start_ns) // charts.grid.cell_ns, 0, len(largest) - 1).astype(np.int64)
    error = np.nan_to_num(largest[cell], nan=0.0)
    if not (error > 0.0).any():
        return [draw.Cloud(name, draw.colour(name), aligned[0], aligned[1], _seconds(at_ns, charts))]
    first, second = (float(f"{q:.1g}") for q in np.quantile(error[error > 0.0], (0.5, 0.9)))
    edges = (0.0, first, second, np.inf)
    names = (f"error below {first:g}°", f"{first:g} to {second:g}°", f"above {second:g}°")
    clouds = []
    for low, high, name, paint in zip(edges[:-1], edges[1:], names, _ERROR_COLOURS, strict=True):
        use = (error >= low) & (error < high)
        if use.sum() > 1:
            clouds.append(draw.Cloud(name, paint, aligned[0, use], aligned[1, use], _seconds(at_ns[use], charts)))
    return clouds


def _seconds(at_ns: FloatArray | IntArray, charts: draw.Charts) -> FloatArray:
    return np.asarray((at_ns - charts.origin_ns) * S_PER_NS, dtype=np.float64)
