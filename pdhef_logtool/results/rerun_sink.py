"""recording.rrd: plots, uncertainty confidence intervals, plan view, events and the text report, with a blueprint."""

from __future__ import annotations

import errno
import os
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
import pyarrow as pa
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from pdhef_logtool.evaluation.reasons import ReasonIntervals
from pdhef_logtool.evaluation.track_errors import NORMAL_95
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.geometry import DEGREES
from pdhef_logtool.records.reasons import REASONS
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.log_lines import LEVEL_NAMES, log_lines
from pdhef_logtool.results.palette import colour_rgb
from pdhef_logtool.results.plotted import ERRORS, errors
from pdhef_logtool.results.run_report import report_markdown
from pdhef_logtool.results.sink import (
    LONGEST_WHOLE_NS,
    TRUTH,
    Event,
    Shown,
    Sink,
    first_of_slots,
    is_finished_recording,
)
from pdhef_logtool.storage.files import PendingFile, cannot_write, open_new, writing

#: Estimators beside the selected estimate and the baseline that the blueprint has places for, hidden until asked for.
MOST_OTHERS = 12

#: A line is broken where nothing is known for longer than this.
LONGEST_BRIDGE_NS = 1_000_000_000

#: Points of one trajectory in the plan view; it is thinned when it would grow beyond.
MOST_TRAJECTORY_POINTS = 20_000

#: Steps of the moving dot in the plan view, and in that of a long drive.
DOT_STEP_NS, LONG_DOT_STEP_NS = 50_000_000, 500_000_000

#: Between the rows of a long drive: of what the recording opens on, and of the others.
LONG_STEP_NS, OTHERS_STEP_NS = 100_000_000, 200_000_000

#: How long Rerun may keep one call waiting before the recording is given up.
LONGEST_WAIT_S = 60.0


@dataclass(frozen=True, slots=True)
class _Plot:
    """One plotted quantity: component, its title, track column, factor to the plotted unit, its deviation's column."""

    name: str
    title: str
    column: str
    factor: float = 1.0
    std: str | None = None
    is_angle: bool = False
    sparse: bool = False
    from_low_speed: bool = True


_STATES = (
    _Plot("sideslip_deg", "sideslip [deg]", "sideslip_rad", DEGREES, "sideslip_std_rad", True, from_low_speed=False),
    _Plot("yaw_rate_deg_s", "yaw rate [deg/s]", "yaw_rate_rad_s", DEGREES, "yaw_rate_std_rad_s"),
    _Plot("vx_m_s", "longitudinal velocity [m/s]", "vx_m_s", std="vx_std_m_s"),
    _Plot("vy_m_s", "lateral velocity [m/s]", "vy_m_s", std="vy_std_m_s"),
    _Plot("ay_m_s2", "lateral acceleration [m/s²]", "ay_m_s2"),
)
_ERRORS = tuple(plot for plot in _STATES if plot.name in ERRORS)
_HEALTH = (
    _Plot("nis", "normalised innovation squared", "nis", sparse=True),
    _Plot("network_trust", "residual gain", "network_trust"),
    _Plot("r_scale", "factor on R", "r_scale"),
    _Plot("mixture_weight", "weight of the filters with a force scale or a bank", "mixture_weight"),
    _Plot("friction", "friction", "friction"),
)
_INPUTS = (
    _Plot("speed_m_s", "speed [m/s]", "speed_m_s"),
    _Plot("steer_deg", "road-wheel angle [deg]", "steer_rad", DEGREES),
    _Plot("ax_m_s2", "measured a_x [m/s²]", "ax_m_s2"),
    _Plot("ay_m_s2", "measured a_y [m/s²]", "ay_m_s2"),
    _Plot("yaw_rate_deg_s", "measured yaw rate [deg/s]", "yaw_rate_rad_s", DEGREES),
)
_INPUT_RGB = (0x56, 0xB4, 0xE9)
_TRACK, _SIGNALS = "track", "signals"
_REASON_TEXTS = {r.name: r.text for r in REASONS}


class RerunSink(Sink):
    """Writes recording.rrd window by window; memory does not grow with the log but for the thinned trajectories.

    Each track is one entity with a row a stamp (of a drive above ten minutes 10 a second, of other estimators 5) and a
    component a quantity, with value and confidence interval. Entities are named by what a track is for (``/truth``,
    ``/main``, ``/baseline``, ``/other/1``), so that one blueprint suits all drives of a run with any estimators; the
    lines have their names. Errors are where ground truth and estimate share a stamp.

    Parameters
    ----------
    path : where the finished recording is.
    application_id : the same for all logs of a run; the viewer shows them as one dataset with one blueprint.
    log_name : shown as the recording's name.
    input_hash : hexadecimal hash of the log, by which the viewer shows the recordings of a run from one another.
    start_ns : zero of the timeline ``elapsed``. end_ns : of the drive, which shows whether it is long; None: it is not.
    shown : which estimators the recording opens on.
    min_speed_m_s : sideslip is not drawn below, where it has no meaning. colours : 0xRRGGBB by estimator.

    Raises
    ------
    OutputError : When the file cannot be written or Rerun is switched off by its environment variable.
    """

    def __init__(
        self,
        path: Path,
        *,
        application_id: str,
        log_name: str,
        input_hash: str,
        start_ns: int,
        end_ns: int | None = None,
        shown: Shown,
        min_speed_m_s: float = 1.0,
        colours: Mapping[str, int] | None = None,
    ) -> None:
        self._colours = colours or {}
        self._start_ns = start_ns
        self._is_long = end_ns is not None and end_ns - start_ns > LONGEST_WHOLE_NS
        self._min_speed_m_s = min_speed_m_s
        self._places = {TRUTH: "truth", shown.main: "main"}
        if shown.baseline is not None:
            self._places[shown.baseline] = "baseline"
        self._others = 0
        self._rows: dict[str, _Rows] = {}
        self._paths: dict[str, _Trajectory] = {}
        self._window: dict[str, StateTrack] = {}
        self._reasons: dict[str, ReasonIntervals] = {}
        self._pending = PendingFile(path)
        self._recording = rr.RecordingStream(application_id, recording_id=input_hash[:32], send_properties=False)
        if not rr.is_enabled(self._recording):
            raise OutputError(
                expected="Rerun switched on",
                got="switched off by the environment variable RERUN",
                where=str(path),
                remedy="unset RERUN",
            )
        self._path = path
        with writing(path):
            self._outlet = _Outlet(open_new(self._pending.path))
        try:
            with self._calling():
                self._recording.save(self._outlet.name, default_blueprint=_blueprint())
                self._outlet.opened()
                self._recording.send_recording_name(log_name)
                self._recording.send_recording_start_time_nanos(start_ns)
        except BaseException:
            self.abort()
            raise

    @contextmanager
    def _calling(self) -> Iterator[None]:
        """Call Rerun, for a limited time; raises OutputError for what could not be written since the last call."""
        limit = threading.Timer(LONGEST_WAIT_S, self._outlet.give_up)
        limit.daemon = True
        limit.start()
        try:
            yield
        except RuntimeError as error:
            if self._outlet.error is None:
                raise OutputError(
                    expected="a recording by Rerun", got=str(error), where=str(self._path), remedy="run the log again"
                ) from error
        finally:
            limit.cancel()
        if self._outlet.error is not None:
            raise cannot_write(self._path, self._outlet.error) from self._outlet.error

    def append_signals(self, signals: Signals) -> None:
        """Draw what the estimators saw in this window."""
        with self._calling():
            self._append_signals(signals)

    def _append_signals(self, signals: Signals) -> None:
        rows = self._rows.setdefault("inputs", _Rows())
        columns = {plot.name: np.asarray(getattr(signals, plot.column))[:, None] * plot.factor for plot in _INPUTS}
        self._send_rows("/inputs", rows, _SIGNALS, signals.stamps_ns, columns, frozenset(columns))

    def append(self, track: StateTrack) -> None:
        """Take one track of this window; it is drawn once the window is whole."""
        if track.name in self._window:
            with self._calling():
                self._draw_window()
        self._window[track.name] = track

    def _draw_window(self) -> None:
        truth = self._window.get(TRUTH)
        for track in self._window.values():
            self._draw_track(track, truth)
        self._window.clear()
        # Without this the file falls behind and the difference waits in memory: 380 MB more after one hour.
        self._recording.flush(timeout_sec=LONGEST_WAIT_S)

    def _place(self, name: str) -> str:
        if name not in self._places:
            self._others += 1
            self._places[name] = f"other/{self._others}"
        return self._places[name]

    def _draw_track(self, track: StateTrack, truth: StateTrack | None) -> None:
        place, rgb = self._place(track.name), colour_rgb(track.name, self._colours)
        if place not in self._rows:
            self._rows[place] = _Rows()
            band = [] if track.name == TRUTH else [f"{track.name} 95 %"] * 2
            widths = [2.0 if track.name == TRUTH else 1.5, 0.75, 0.75]
            colours = [rgb, *[(*rgb, 110)] * len(band)]
            style = rr.SeriesLines(names=[track.name, *band], colors=colours, widths=widths[: len(colours)])
            self._log_static(f"/{place}", style)
        is_shown = place in ("main", "baseline")
        columns = self._columns(track, _STATES + _HEALTH if is_shown else _STATES)
        if track.name != TRUTH:
            by_name = errors(track, truth, self._min_speed_m_s)
            columns |= {f"error_{name}": values[:, None] for name, values in by_name.items()}
        sparse = frozenset(p.name for p in _HEALTH if p.sparse)
        self._send_rows(f"/{place}", self._rows[place], _TRACK, track.stamps_ns, columns, sparse)
        if len(track.reason) == len(track):
            self._reasons.setdefault(track.name, ReasonIntervals()).append(track.stamps_ns, track.reason)
        self._draw_path(track, place, rgb)

    def _columns(self, track: StateTrack, plots: Sequence[_Plot]) -> dict[str, FloatArray]:
        """Return by component what is drawn of a track, [N, 1] or, with its 95 % interval, [N, 3]; NaN where unknown.

        The blueprint asks for all components: what a track lacks is there as NaN.
        """
        fast = np.hypot(track.vx_m_s, track.vy_m_s) >= self._min_speed_m_s
        columns = {}
        for plot in plots:
            values = np.asarray(getattr(track, plot.column), dtype=np.float64) * plot.factor
            if len(values) != len(track):
                values = np.full(len(track), np.nan)
            shown = track.valid if plot.from_low_speed else track.valid & fast
            drawn = [np.where(shown, values, np.nan)]
            if plot.std is not None and track.name != TRUTH:
                half = NORMAL_95 * plot.factor * np.asarray(getattr(track, plot.std))
                drawn += [drawn[0] - half, drawn[0] + half]
            columns[plot.name] = np.stack(drawn, axis=1)
        return columns

    def finish(self, report: Mapping[str, Any], events: Sequence[Event] = ()) -> None:
        """Add trajectories, events and the text report, and give the recording its name."""
        try:
            with self._calling():
                self._draw_window()
                self._draw_whole(report, events)
                self._recording.disconnect()
                self._outlet.close()
            if not is_finished_recording(self._pending.path):
                raise OutputError(
                    expected="a recording that Rerun has finished",
                    got="one without its end",
                    where=str(self._path),
                    remedy="run the log again",
                )
        except BaseException:
            self.abort()
            raise
        self._pending.commit()

    def _draw_whole(self, report: Mapping[str, Any], events: Sequence[Event]) -> None:
        for name, path in self._paths.items():
            self._log_static(
                f"/plan/{self._place(name)}",
                rr.LineStrips2D(
                    path.strips(), colors=[colour_rgb(name, self._colours)], radii=[rr.Radius.ui_points(1.5)]
                ),
            )
        self._draw_reasons()
        if lines := log_lines(report, events, self._reasons):
            text = rr.TextLog.columns(text=[x.text for x in lines], level=[LEVEL_NAMES[x.level] for x in lines])
            self._send("/events", np.array([x.stamp_ns for x in lines], dtype=np.int64), text)
        self._log_static("/report", rr.TextDocument(report_markdown(report), media_type=rr.MediaType.MARKDOWN))

    def abort(self) -> None:
        """Remove what was written."""
        with suppress(OutputError), self._calling():
            self._outlet.drop()
            self._recording.disconnect()
            self._outlet.close()
        self._pending.discard()

    def _send(self, entity: str, stamps_ns: IntArray, columns: Iterable[Any]) -> None:
        times = [
            rr.TimeColumn("time", timestamp=stamps_ns.astype("datetime64[ns]")),
            rr.TimeColumn("elapsed", duration=(stamps_ns - self._start_ns).astype("timedelta64[ns]")),
        ]
        rr.send_columns(entity, indexes=times, columns=columns, recording=self._recording, strict=True)

    def _log_static(self, entity: str, what: rr.AsComponents) -> None:
        self._recording.log(entity, what, static=True, strict=True)

    def _send_rows(
        self,
        entity: str,
        rows: _Rows,
        archetype: str,
        stamps_ns: IntArray,
        columns: Mapping[str, FloatArray],
        sparse: frozenset[str],
    ) -> None:
        """Send the rows of one entity: [N] stamps, and by component [N, k] values, NaN where unknown.

        Lines of ``sparse`` components go on over what is unknown for less than LONGEST_BRIDGE_NS. Of a long drive the
        first row of each step is sent, with the largest value that a sparse component has in the step.
        """
        if len(stamps_ns) and self._is_long:
            step_ns = OTHERS_STEP_NS if entity.startswith("/other/") else LONG_STEP_NS
            first = first_of_slots(stamps_ns, step_ns, rows.last_ns)
            columns = {
                name: np.fmax.reduceat(values, first) if name in sparse and len(first) else values[first]
                for name, values in columns.items()
            }
            stamps_ns = stamps_ns[first]
        if len(stamps_ns) == 0:
            return
        gaps = rows.gaps(stamps_ns)
        times_ns = np.insert(stamps_ns, gaps, rows.before(stamps_ns)[gaps] + 1)
        sent = []
        for name, values in columns.items():
            absent = rows.bridged(name, stamps_ns, ~np.isnan(values[:, 0])) if name in sparse else None
            absent = None if absent is None else np.insert(absent, gaps, False)
            sent.append(_Column(f"{archetype}:{name}", archetype, np.insert(values, gaps, np.nan, axis=0), absent))
        rows.last_ns = int(stamps_ns[-1])
        self._send(entity, times_ns, sent)

    def _draw_path(self, track: StateTrack, place: str, rgb: tuple[int, int, int]) -> None:
        # North is drawn up: the y axis of Rerun's 2D views points down.
        plan = np.stack([track.x_m, -track.y_m], axis=1)
        has_plan = np.isfinite(plan).all(axis=1) & track.valid
        if not has_plan.any():
            return
        if track.name not in self._paths:
            self._paths[track.name] = _Trajectory(MOST_TRAJECTORY_POINTS)
            style = rr.Points2D.from_fields(colors=[rgb], radii=[rr.Radius.ui_points(5.0)], labels=[track.name])
            self._log_static(f"/plan/{place}/now", style)
        self._paths[track.name].append(np.where(has_plan[:, None], plan, np.nan))
        slot = track.stamps_ns // (LONG_DOT_STEP_NS if self._is_long else DOT_STEP_NS)
        shown = has_plan & (np.diff(slot, prepend=slot[:1] - 1) != 0)
        if shown.any():
            points = rr.Points2D.columns(positions=plan[shown])
            self._send(f"/plan/{place}/now", track.stamps_ns[shown], points)

    def _draw_reasons(self) -> None:
        """Draw each reason as a state that is active in its intervals."""
        for name, intervals in self._reasons.items():
            for reason, spans in intervals.intervals().items():
                text = _REASON_TEXTS[reason]
                stamps = np.array([t for s in spans for t in (s.start_ns, s.end_ns)], dtype=np.int64)
                states = rr.StateChange.columns(state=[text, ""] * len(spans))  # the empty one ends the state
                self._send(f"/reasons/{name}/{reason}", stamps, states)


class _Outlet:
    """Writes to a file what Rerun sends into a pipe, so that Rerun itself never meets a disk that is full or hangs.

    Rerun writes from a thread of its own that ends on an error, and others may then wait for it without end. Here
    what cannot be written is read and dropped, and the error kept.

    Attributes
    ----------
    name : where Rerun is to write. error : the first one of writing, None so far.
    """

    def __init__(self, file: IO[bytes]) -> None:
        self.error: OSError | None = None
        self._file, self._dropped = file, False
        self._thread: threading.Thread | None = None
        if Path("/dev/fd").exists():
            self._from, self._to = os.pipe()
            self.name = f"/dev/fd/{self._to}"
            self._start_thread()
        else:  # pipes have no names on Windows: Rerun writes the file itself
            file.close()
            self.name, self._to = file.name, -1

    def _start_thread(self) -> None:
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def opened(self) -> None:
        """Close our own writing end: Rerun has its own now."""
        if self._to >= 0:
            os.close(self._to)
            self._to = -1

    def drop(self) -> None:
        """Write no more of what comes."""
        self._dropped = True

    def give_up(self) -> None:
        """Wait no longer for the disk: the thread that does is left alone, and another one drops what comes."""
        if self.error is None:
            self.error = TimeoutError(errno.ETIMEDOUT, f"nothing could be written for {LONGEST_WAIT_S:g} s")
            self._dropped = True
            if self._thread is not None:
                self._start_thread()

    def close(self) -> None:
        """Wait until all is written that Rerun has sent, whose own end must be closed by then."""
        self.opened()
        if self._thread is not None:
            self._thread.join(LONGEST_WAIT_S)
            if self._thread.is_alive():
                self.give_up()
                self._thread.join(LONGEST_WAIT_S)

    def _carry(self) -> None:
        while data := os.read(self._from, 1 << 20):
            if not self._dropped:
                self._write(data)
            if self._thread is not threading.current_thread():
                return  # given up while it was writing: another one reads on
        self._write(None)
        if self._thread is threading.current_thread():
            os.close(self._from)

    def _write(self, data: bytes | None) -> None:
        """Write, or at the end (None) close the file; what cannot be written is dropped from then on."""
        try:
            if data is not None:
                self._file.write(data)
            elif not isinstance(self.error, TimeoutError):  # else it would hang as well
                self._file.close()
        except OSError as error:
            self.error, self._dropped = self.error or error, True


class _Column:
    """A component [N, k] as single precision floats; rows that are ``absent`` contain neither value nor gap."""

    def __init__(self, component: str, archetype: str, values: FloatArray, absent: BoolArray | None) -> None:
        self._descriptor = rr.ComponentDescriptor(component, archetype=archetype)
        kept = values if absent is None else values[~absent]
        lengths = np.full(len(values), values.shape[1]) if absent is None else np.where(absent, 0, values.shape[1])
        offsets = pa.array(np.concatenate([[0], np.cumsum(lengths)]), pa.int32())
        mask = None if absent is None else pa.array(absent)
        flat = pa.array(kept.astype(np.float32).reshape(-1))
        self._array = pa.ListArray.from_arrays(offsets, flat, mask=mask)

    def component_descriptor(self) -> rr.ComponentDescriptor:
        """Return its name and archetype."""
        return self._descriptor

    def as_arrow_array(self) -> pa.Array:
        """Return its rows."""
        return self._array


@dataclass(slots=True)
class _Rows:
    """Where an entity is between windows: its last stamp, and when each sparse component was last known."""

    last_ns: int | None = None
    known_ns: dict[str, int] = field(default_factory=dict)

    def before(self, stamps_ns: IntArray) -> IntArray:
        """Return the stamp before each one; the first of all has itself."""
        first = stamps_ns[0] if self.last_ns is None else self.last_ns
        return np.concatenate([[first], stamps_ns[:-1]])

    def gaps(self, stamps_ns: IntArray) -> IntArray:
        """Return the rows after more than LONGEST_BRIDGE_NS: lines must break there."""
        return np.flatnonzero(stamps_ns - self.before(stamps_ns) > LONGEST_BRIDGE_NS)

    def bridged(self, name: str, stamps_ns: IntArray, is_known: BoolArray) -> BoolArray:
        """Return the unknown rows that a line goes on over: all but one that is too long after the last known one."""
        never = np.iinfo(np.int64).min
        latest = np.maximum.accumulate(np.where(is_known, stamps_ns, self.known_ns.get(name, never)))
        self.known_ns[name] = int(latest[-1])
        since = np.where(latest == never, 0, stamps_ns - latest)
        ends = ~is_known & (since > LONGEST_BRIDGE_NS)
        return np.asarray(~is_known & ~ends, dtype=np.bool_)


@dataclass(slots=True)
class _Trajectory:
    """Points of a path, thinned to every 2^k-th as it grows; NaN rows part its strips."""

    most_points: int
    stride: int = 1
    seen: int = 0
    parts: list[FloatArray] = field(default_factory=list)

    def append(self, points: FloatArray) -> None:
        """Add [N, 2] points."""
        first = -self.seen % self.stride
        self.parts.append(np.array(points[first :: self.stride]))
        self.seen += len(points)
        while sum(map(len, self.parts)) > self.most_points:
            self.parts = [np.concatenate(self.parts)[::2]]
            self.stride *= 2

    def strips(self) -> list[FloatArray]:
        """Return the strips of at least two points, each [N, 2]."""
        points = np.concatenate(self.parts)
        is_finite = np.isfinite(points).all(axis=1)
        pieces = np.split(points, np.flatnonzero(np.diff(is_finite)) + 1)
        return [p for p in pieces if len(p) > 1 and np.isfinite(p[0]).all()]


def _blueprint() -> rrb.Blueprint:
    """Open on the drive: sideslip with intervals, yaw rate, a_y, inputs, the plan; errors, filter and report as tabs.

    It names what tracks are for and no estimator, so that it suits every drive.
    """
    states = ("truth", "baseline", "main", *(f"other/{number}" for number in range(1, MOST_OTHERS + 1)))
    drive = rrb.Horizontal(
        rrb.Vertical(
            *(_track_view(_STATES[i].name, _STATES[i].title, states, legend=i == 0) for i in (0, 1, 4)),
            *(_input_view(plot) for plot in _INPUTS[:2]),
            row_shares=[4, 2, 2, 1.5, 1.5],
        ),
        rrb.Vertical(
            rrb.Spatial2DView(origin="/plan", name="Plan, north up [m]", overrides={"/plan/other": _HIDDEN}),
            rrb.TextLogView(origin="/events", name="Events"),
            row_shares=[3, 1],
        ),
        column_shares=[3, 2],
        name="Drive",
    )
    errors = rrb.Vertical(
        *(_track_view(f"error_{plot.name}", f"error of {plot.title}", states[1:]) for plot in _ERRORS),
        name="Errors",
    )
    filters = rrb.Vertical(
        *(_track_view(plot.name, plot.title, ("baseline", "main"), legend=plot is _HEALTH[0]) for plot in _HEALTH[:-1]),
        rrb.StateTimelineView(origin="/reasons", name="Why samples were not used as usual"),
        *(_track_view(plot.name, plot.title, states) for plot in _STATES[2:4]),
        name="Filter",
    )
    report = rrb.TextDocumentView(origin="/report", name="Report")
    return rrb.Blueprint(
        rrb.Tabs(drive, errors, filters, report, active_tab=0),
        rrb.TimePanel(state="collapsed", timeline="elapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


_HIDDEN = rrb.EntityBehavior(visible=False)


def _track_view(component: str, title: str, places: Sequence[str], *, legend: bool = False) -> rrb.TimeSeriesView:
    """Plot one component of tracks; those that the recording does not open on are hidden."""
    line = [_line_of(f"{_TRACK}:{component}")]
    overrides = {f"/{place}": [*line, _HIDDEN] if "/" in place else line for place in places}
    return _plot_view(title, overrides, legend=legend)


def _input_view(plot: _Plot) -> rrb.TimeSeriesView:
    style = rr.SeriesLines(names=[plot.title], colors=[_INPUT_RGB], widths=[1.5])
    return _plot_view(plot.title, {"/inputs": [_line_of(f"{_SIGNALS}:{plot.name}", style)]}, legend=False)


def _plot_view(title: str, overrides: dict[str, list[Any]], *, legend: bool) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        origin="/",
        contents=list(overrides),
        name=title[0].upper() + title[1:],
        overrides=overrides,
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        plot_legend=rrb.PlotLegend(corner="RightTop", visible=legend),
    )


def _line_of(component: str, style: rr.SeriesLines | None = None) -> rrb.Visualizer:
    """Draw a component as lines; names and colours are those of the entity where no style is given."""
    source = ComponentSourceKind.SourceComponent
    mapping = VisualizerComponentMapping("Scalars:scalars", source, source_component=component)
    return (style or rr.SeriesLines()).visualizer(mappings=[mapping])
