"""recording.rrd: plots, uncertainty confidence intervals, plan view, events and the text report, with a blueprint."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from pdhef_logtool.evaluation.reasons import reason_intervals
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.geometry import DEGREES
from pdhef_logtool.records.reasons import REASONS
from pdhef_logtool.records.signals import NS_PER_S, FloatArray, IntArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.plotted import ERRORS, LEVEL_NAMES, STATES, Plot, colour_rgb, drawn, errors, log_lines
from pdhef_logtool.results.run_report import report_markdown
from pdhef_logtool.results.selected_estimate import figures_of
from pdhef_logtool.results.sink import LONGEST_WHOLE_NS, TRUTH, Event, first_of_slots
from pdhef_logtool.storage.files import open_new, writing

#: Estimators beside the selected estimate and the baseline that the blueprint has places for, hidden until asked for.
MOST_OTHERS = 12

#: A line is broken at gaps longer than this.
LONGEST_BRIDGE_NS = NS_PER_S

#: Points of one trajectory in the plan view; it is thinned when it would grow beyond.
MOST_TRAJECTORY_POINTS = 20_000

#: Steps of the moving dot in the plan view, for short and long drives.
DOT_STEP_NS, LONG_DOT_STEP_NS = 50_000_000, 500_000_000

#: Steps between rows of a long drive, for tracks visible at first and for others.
LONG_STEP_NS, OTHERS_STEP_NS = 100_000_000, 200_000_000

#: Rows of a chunk, and width of a line.
_CHUNK_ROWS, _LINE_POINTS = 6000, 1.5


_HEALTH = (
    Plot("nis", "normalised innovation squared", "nis"),
    Plot("network_trust", "residual gain", "network_trust"),
    Plot("r_scale", "factor on R", "r_scale"),
    Plot("mixture_weight", "weight of the filters with a force scale or a bank", "mixture_weight"),
    Plot("friction", "friction", "friction"),
)
_INPUTS = (
    Plot("speed_m_s", "speed [m/s]", "speed_m_s"),
    Plot("steer_deg", "road-wheel angle [deg]", "steer_rad", DEGREES),
    Plot("ax_m_s2", "measured a_x [m/s²]", "ax_m_s2"),
    Plot("ay_m_s2", "measured a_y [m/s²]", "ay_m_s2"),
    Plot("yaw_rate_deg_s", "measured yaw rate [deg/s]", "yaw_rate_rad_s", DEGREES),
)
#: Components of a track that are known at few stamps only.
_SPARSE = frozenset({"nis"})
_TRACK, _SIGNALS = "track", "signals"
_REASON_TEXTS = {r.name: r.text for r in REASONS}


def write_recording(
    path: Path,
    signals: Signals | None,
    tracks: Sequence[StateTrack],
    report: Mapping[str, Any],
    events: Sequence[Event] = (),
    *,
    application_id: str,
    input_hash: str,
    shown: Sequence[str],
    colours: Mapping[str, int] | None = None,
) -> None:
    """Write recording.rrd.

    Each track is one entity with a row per stamp (above ten minutes 10 rows per second, 5 for other estimators) and a
    component per quantity, with value and confidence interval. Entities are named by the use of a track (``/truth``,
    ``/main``, ``/baseline``, ``/other/1``), so that one blueprint suits all drives of a run with any estimators; the
    lines have their names. Errors are where ground truth and estimate share a stamp. The recording's properties have
    RMSE, verdicts, car, faults and version.

    Parameters
    ----------
    path : the finished recording; an unfinished one is left to the caller.
    report : the document of report.json; its log names the recording, and begins the timeline ``elapsed``.
    application_id : the same for all logs of a run; the viewer shows them as one dataset with one blueprint.
    input_hash : hexadecimal hash of the log, which distinguishes the recordings of a run.
    shown : estimators of ``/main`` and ``/baseline``, on which the recording opens.
    colours : 0xRRGGBB by estimator.

    Raises
    ------
    OutputError : When the file cannot be written or Rerun is switched off by its environment variable.
    """
    recording = rr.RecordingStream(application_id, recording_id=input_hash[:32], send_properties=False)
    if not rr.is_enabled(recording):
        raise OutputError(
            expected="Rerun switched on",
            got="switched off by the environment variable RERUN",
            where=str(path),
            remedy="unset RERUN",
        )
    log, min_speed_m_s = report["log"], report["vehicle"]["low_speed_blend_m_s"]
    is_long = log["end_ns"] - log["start_ns"] > LONGEST_WHOLE_NS
    places = _places([t.name for t in tracks], shown)
    truth = next((t for t in tracks if t.name == TRUTH), None)
    # In memory, because Rerun's writer thread ends on an error of the disk, and other threads then wait for it forever.
    memory = recording.memory_recording()
    recording.send_blueprint(_blueprint(), make_active=False, make_default=True)
    recording.send_recording_name(log["name"])
    recording.send_recording_start_time_nanos(log["start_ns"])
    drawing = _Drawing(recording, log["start_ns"], is_long, min_speed_m_s)
    if signals is not None:
        inputs = {p.name: np.asarray(getattr(signals, p.column))[:, None] * p.factor for p in _INPUTS}
        drawing.send_sparse("/inputs", _SIGNALS, signals.stamps_ns, inputs)
    for track in tracks:
        drawing.draw_track(track, truth, places[track.name], colour_rgb(track.name, colours or {}))
        drawing.draw_reasons(track)
    drawing.draw_texts(report, events, tracks)
    for name, values in _properties(report).items():
        if values:
            recording.send_property(name, rr.AnyValues(**values))
    data = memory.drain_as_bytes()
    with writing(path), open_new(path) as file:
        file.write(data)


def _properties(report: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the properties by which a catalog of recordings can be filtered, None and empty lists if unknown."""
    errors = [(name, x) for (name, *of), x in figures_of(report).items() if of == ["sideslip_rad", "all", "rmse"]]
    plan = report.get("plan") or {}
    failed = [c["name"] for c in report.get("checks", ()) if c["verdict"] == "failed"]
    faults = [f"{f['kind']} {f['sensor']}" for f in report.get("faults") or ()]
    return {
        "sideslip_rmse_deg": {name: error * DEGREES for name, error in errors if error is not None},
        "verdicts": {r["id"]: r["outcome"] for r in plan.get("requirements", ())},
        "drive": {
            "car": report["vehicle"]["name"],
            "selected": report.get("selected_estimate"),
            "faults": faults,
            "failed_checks": failed,
            "version": report["versions"].get("pdhef-logtool"),
        },
    }


def _places(names: Sequence[str], shown: Sequence[str]) -> dict[str, str]:
    """Return the entity of each track."""
    places = {TRUTH: "truth", **dict(zip(shown, ("main", "baseline"), strict=False))}
    others = [name for name in names if name not in places]
    return places | {name: f"other/{number}" for number, name in enumerate(others, start=1)}


@dataclass(frozen=True, slots=True)
class _Drawing:
    """Draws signals, tracks and texts into a recording."""

    recording: rr.RecordingStream
    start_ns: int
    is_long: bool
    min_speed_m_s: float

    def _send(self, entity: str, stamps_ns: IntArray, columns: Iterable[Any]) -> None:
        """Send rows of an entity."""
        times = [
            rr.TimeColumn("time", timestamp=stamps_ns.astype("datetime64[ns]")),
            rr.TimeColumn("elapsed", duration=(stamps_ns - self.start_ns).astype("timedelta64[ns]")),
        ]
        rr.send_columns(entity, indexes=times, columns=columns, recording=self.recording, strict=True)

    def _log_static(self, entity: str, what: rr.AsComponents) -> None:
        """Send something without a time."""
        self.recording.log(entity, what, static=True, strict=True)

    def draw_track(self, track: StateTrack, truth: StateTrack | None, place: str, rgb: tuple[int, int, int]) -> None:
        """Draw a track with its errors and its way."""
        band = [] if track.name == TRUTH else [f"{track.name} 95 %"] * 2
        widths = [2.0 if track.name == TRUTH else _LINE_POINTS, *[0.75] * 2]
        colours = [rgb, *[(*rgb, 110)] * len(band)]
        style = rr.SeriesLines(names=[track.name, *band], colors=colours, widths=widths[: len(colours)])
        self._log_static(f"/{place}", style)
        # The blueprint needs all components: those that a track does not have are NaN.
        plots = STATES + _HEALTH if place in ("main", "baseline") else STATES
        columns = {p.name: drawn(track, p, self.min_speed_m_s) for p in plots}
        if track.name == TRUTH:
            columns = {name: values[:, :1] for name, values in columns.items()}
        else:
            by_name = errors(track, truth, self.min_speed_m_s)
            columns |= {f"error_{name}": values[:, None] for name, values in by_name.items()}
        self.send_sparse(f"/{place}", _TRACK, track.stamps_ns, {n: columns.pop(n) for n in _SPARSE & columns.keys()})
        self._send_rows(f"/{place}", _TRACK, track.stamps_ns, columns)
        self._draw_path(track, place, rgb)

    def send_sparse(self, entity: str, archetype: str, stamps_ns: IntArray, columns: Mapping[str, FloatArray]) -> None:
        """Send each component [N, k] where it is known, so that its line continues between; unknown at one stamp."""
        for name, values in columns.items():
            sent = ~np.isnan(values[:, 0])
            sent[:1] |= not sent.any()  # the blueprint needs the component
            self._send_rows(entity, archetype, stamps_ns[sent], {name: values[sent]})

    def _send_rows(self, entity: str, archetype: str, stamps_ns: IntArray, columns: Mapping[str, FloatArray]) -> None:
        """Send the rows of one entity: [N] stamps, and by component [N, k] values, NaN where unknown.

        Lines break where stamps are more than LONGEST_BRIDGE_NS apart. Of a long drive, the first row of each step is
        sent, of sparse components the largest value.
        """
        if len(stamps_ns) == 0:
            return
        if self.is_long:
            first = first_of_slots(stamps_ns, OTHERS_STEP_NS if entity.startswith("/other/") else LONG_STEP_NS)
            columns = {
                name: np.maximum.reduceat(values, first) if name in _SPARSE else values[first]
                for name, values in columns.items()
            }
            stamps_ns = stamps_ns[first]
        gaps = np.flatnonzero(np.diff(stamps_ns) > LONGEST_BRIDGE_NS) + 1
        times_ns = np.insert(stamps_ns, gaps, stamps_ns[gaps - 1] + 1)
        columns = {name: np.insert(values.astype(np.float32), gaps, np.nan, axis=0) for name, values in columns.items()}
        for first_row in range(0, len(times_ns), _CHUNK_ROWS):
            rows = slice(first_row, first_row + _CHUNK_ROWS)
            sent = [
                column.partition(np.full(len(values[rows]), values.shape[1]))
                for name, values in columns.items()
                for column in rr.DynamicArchetype.columns(archetype, components={name: values[rows].reshape(-1)})
            ]
            self._send(entity, times_ns[rows], sent)

    def _draw_path(self, track: StateTrack, place: str, rgb: tuple[int, int, int]) -> None:
        # North is drawn up: the y axis of Rerun's 2D views points down.
        plan = np.stack([track.x_m, -track.y_m], axis=1)
        has_plan = np.isfinite(plan).all(axis=1) & track.valid
        if not has_plan.any():
            return
        style = rr.Points2D.from_fields(colors=[rgb], radii=[rr.Radius.ui_points(5.0)], labels=[track.name])
        self._log_static(f"/plan/{place}/now", style)
        opens = first_of_slots(track.stamps_ns, LONG_DOT_STEP_NS if self.is_long else DOT_STEP_NS)
        shown = opens[has_plan[opens]]
        if len(shown):
            self._send(f"/plan/{place}/now", track.stamps_ns[shown], rr.Points2D.columns(positions=plan[shown]))
        lines = _strips(np.where(has_plan[:, None], plan, np.nan))
        self._log_static(
            f"/plan/{place}", rr.LineStrips2D(lines, colors=[rgb], radii=[rr.Radius.ui_points(_LINE_POINTS)])
        )

    def draw_reasons(self, track: StateTrack) -> None:
        """Draw each reason as a state that is active in its intervals."""
        for reason, spans in reason_intervals(track).items():
            stamps = np.array([t for s in spans for t in (s.start_ns, s.end_ns)], dtype=np.int64)
            # The empty state ends the one before.
            states = rr.StateChange.columns(state=[_REASON_TEXTS[reason], ""] * len(spans))
            self._send(f"/reasons/{track.name}/{reason}", stamps, states)

    def draw_texts(self, report: Mapping[str, Any], events: Sequence[Event], tracks: Sequence[StateTrack]) -> None:
        """Write the log and the report."""
        if lines := log_lines(report, events, tracks):
            text = rr.TextLog.columns(text=[x.text for x in lines], level=[LEVEL_NAMES[x.level] for x in lines])
            self._send("/events", np.array([x.stamp_ns for x in lines], dtype=np.int64), text)
        document = rr.TextDocument(report_markdown(report), media_type=rr.MediaType.MARKDOWN)
        self._log_static("/report", document)


def _strips(points: FloatArray) -> list[FloatArray]:
    """Return the strips of at least two finite points [N, 2] of a path, thinned to every k-th point."""
    points = points[:: max(1, -(-len(points) // MOST_TRAJECTORY_POINTS))]
    is_finite = np.isfinite(points).all(axis=1)
    pieces = np.split(points, np.flatnonzero(np.diff(is_finite)) + 1)
    return [p for p in pieces if len(p) > 1 and np.isfinite(p[0]).all()]


def _blueprint() -> rrb.Blueprint:
    """Open on the drive: sideslip with intervals, yaw rate, a_y, inputs, the plan; errors, filter and report as tabs.

    It refers to main, baseline and others, not to estimators, so that it suits every drive.
    """
    states = ("truth", "baseline", "main", *(f"other/{number}" for number in range(1, MOST_OTHERS + 1)))
    drive = rrb.Horizontal(
        rrb.Vertical(
            *(_track_view(plot.name, plot.title, states, legend=plot is STATES[0]) for plot in STATES[:3]),
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
        *(_track_view(f"error_{plot.name}", plot.error_title, states[1:]) for plot in ERRORS), name="Errors"
    )
    filters = rrb.Vertical(
        *(_track_view(plot.name, plot.title, ("baseline", "main"), legend=plot is _HEALTH[0]) for plot in _HEALTH[:-1]),
        rrb.StateTimelineView(origin="/reasons", name="Why samples were not used as usual"),
        *(_track_view(plot.name, plot.title, states) for plot in STATES[3:]),
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


def _input_view(plot: Plot) -> rrb.TimeSeriesView:
    style = rr.SeriesLines(names=[plot.title], colors=[colour_rgb(plot.name, {})], widths=[_LINE_POINTS])
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
    """Draw a component as lines; without a style, names and colours are the entity's."""
    source = ComponentSourceKind.SourceComponent
    mapping = VisualizerComponentMapping("Scalars:scalars", source, source_component=component)
    return (style or rr.SeriesLines()).visualizer(mappings=[mapping])
