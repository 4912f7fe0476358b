"""recording.rrd: plots, uncertainty bands, plan view, events and the text report, with a blueprint."""

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
import rerun as rr
import rerun.blueprint as rrb

from pdhef_logtool.evaluation.reasons import ReasonIntervals
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.files import PendingFile, cannot_write, open_new, writing
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.reasons import REASONS
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.sinks.base import TRUTH, Event, Sink
from pdhef_logtool.sinks.palette import colour_rgb
from pdhef_logtool.sinks.report import report_markdown

APPLICATION_ID = "pdhef-logtool"

#: Half width of the 95 % interval of a normal distribution, in standard deviations.
STD_OF_95_PERCENT = 1.959963985

#: A line is broken where nothing is known for longer than this.
LONGEST_BRIDGE_NS = 1_000_000_000

#: Points of one trajectory in the plan view; it is thinned when it would grow beyond.
MOST_TRAJECTORY_POINTS = 20_000

#: Steps of the moving dot in the plan view.
DOT_STEP_NS = 50_000_000

#: How long Rerun may keep one call waiting before the recording is given up.
LONGEST_WAIT_S = 60.0

#: Stands near the end of a recording that was finished.
_FOOTER = b"RRF2FOOT"

_DEG = float(np.rad2deg(1.0))


@dataclass(frozen=True, slots=True)
class _Plot:
    """One plotted quantity: entity, track column, factor to the plotted unit, and its standard deviation's column."""

    entity: str
    column: str
    factor: float
    std: str | None = None
    is_angle: bool = False
    sparse: bool = False
    from_low_speed: bool = True


_STATES = (
    _Plot("sideslip_deg", "sideslip_rad", _DEG, "sideslip_std_rad", is_angle=True, from_low_speed=False),
    _Plot("yaw_rate_deg_s", "yaw_rate_rad_s", _DEG, "yaw_rate_std_rad_s"),
    _Plot("vx_m_s", "vx_m_s", 1.0, "vx_std_m_s"),
    _Plot("vy_m_s", "vy_m_s", 1.0, "vy_std_m_s"),
    _Plot("ay_m_s2", "ay_m_s2", 1.0),
)
_HEALTH = (
    _Plot("nis", "nis", 1.0, sparse=True),
    _Plot("network_trust", "network_trust", 1.0),
    _Plot("r_scale", "r_scale", 1.0),
    _Plot("mixture_weight", "mixture_weight", 1.0),
    _Plot("friction", "friction", 1.0),
)
_INPUTS = (
    ("steer_deg", "steer_rad", _DEG),
    ("speed_m_s", "speed_m_s", 1.0),
    ("ax_m_s2", "ax_m_s2", 1.0),
    ("ay_m_s2", "ay_m_s2", 1.0),
    ("yaw_rate_deg_s", "yaw_rate_rad_s", _DEG),
)
_INPUT_RGB = (0x56, 0xB4, 0xE9)
_REASON_TEXTS = {r.name: r.text for r in REASONS}


class RerunSink(Sink):
    """Writes recording.rrd window by window; memory does not grow with the log but for the thinned trajectories.

    Errors are drawn at stamps that truth and estimate share.

    Parameters
    ----------
    path : where the finished recording stands.
    log_name : shown as the recording's name.
    input_hash : hexadecimal hash of all that went into the run; names the recording, so that the viewer takes two
        recordings of the same run as one and of different runs as two.
    start_ns : zero of the timeline ``elapsed``.
    min_speed_m_s : sideslip is not drawn below, where it has no meaning. colours : 0xRRGGBB by estimator.

    Raises
    ------
    OutputError : When the file cannot be written or Rerun is switched off by its environment variable.
    """

    def __init__(
        self,
        path: Path,
        *,
        log_name: str,
        input_hash: str,
        start_ns: int,
        min_speed_m_s: float = 1.0,
        colours: Mapping[str, int] | None = None,
    ) -> None:
        self._colours = colours or {}
        self._start_ns = start_ns
        self._min_speed_m_s = min_speed_m_s
        self._lines: dict[str, _Line] = {}
        self._paths: dict[str, _Trajectory] = {}
        self._window: dict[str, StateTrack] = {}
        self._compared: set[str] = set()
        self._reasons: dict[str, ReasonIntervals] = {}
        self._pending = PendingFile(path)
        self._recording = rr.RecordingStream(APPLICATION_ID, recording_id=input_hash[:32], send_properties=False)
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
        for entity, column, factor in _INPUTS:
            values = np.asarray(getattr(signals, column)) * factor
            self._draw(f"/inputs/{entity}", entity, _INPUT_RGB, signals.stamps_ns, values, sparse=True)

    def append(self, track: StateTrack) -> None:
        """Draw one track of this window."""
        with self._calling():
            self._append(track)

    def _append(self, track: StateTrack) -> None:
        if track.name in self._window:
            self._window.clear()
            self._compared.clear()
            # Without this the file falls behind and the difference waits in memory: 380 MB more after one hour.
            self._recording.flush(timeout_sec=LONGEST_WAIT_S)
        self._window[track.name] = track
        rgb = colour_rgb(track.name, self._colours)
        fast = np.hypot(track.vx_m_s, track.vy_m_s) >= self._min_speed_m_s
        for plot in _STATES + _HEALTH:
            values = np.asarray(getattr(track, plot.column)) * plot.factor
            if len(values) != len(track):
                continue  # a column that this track has not
            known = track.valid if plot.from_low_speed else track.valid & fast
            values = np.where(known, values, np.nan)
            entity = f"/{plot.entity}/{track.name}"
            self._draw(entity, track.name, rgb, track.stamps_ns, values, sparse=plot.sparse)
            if plot.std is not None:
                half = STD_OF_95_PERCENT * plot.factor * np.asarray(getattr(track, plot.std))
                labels = [f"{track.name} 95 % low", f"{track.name} 95 % high"]
                style = rr.SeriesLines(names=labels, colors=[(*rgb, 110)] * 2, widths=[0.75] * 2)
                edges = np.stack([values - half, values + half], axis=1)
                self._draw_lines(f"{entity}/band95", style, track.stamps_ns, edges)
        if len(track.reason) == len(track):
            self._reasons.setdefault(track.name, ReasonIntervals()).append(track.stamps_ns, track.reason)
        self._draw_path(track, rgb)
        self._draw_errors()

    def finish(self, report: Mapping[str, Any], events: Sequence[Event] = ()) -> None:
        """Add trajectories, events and the text report, and give the recording its name."""
        try:
            with self._calling():
                self._draw_whole(report, events)
                self._recording.disconnect()
                self._outlet.close()
            if _FOOTER not in _tail(self._pending.path):
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
                f"/plan/{name}",
                rr.LineStrips2D(
                    path.strips(), colors=[colour_rgb(name, self._colours)], radii=[rr.Radius.ui_points(1.5)]
                ),
            )
        found = self._draw_reasons()
        if events or found:
            ordered = sorted([*events, *found], key=lambda e: (e.start_ns, e.end_ns, e.name))
            text = rr.TextLog.columns(text=[_event_text(e) for e in ordered], level=["INFO"] * len(ordered))
            self._send("/events", np.array([e.start_ns for e in ordered], dtype=np.int64), text)
        self._log_static("/report", rr.TextDocument(report_markdown(report), media_type=rr.MediaType.MARKDOWN))

    def abort(self) -> None:
        """Remove what was written."""
        with suppress(OutputError), self._calling():
            self._outlet.drop()
            self._recording.disconnect()
            self._outlet.close()
        self._pending.discard()

    def _send(self, entity: str, stamps_ns: IntArray, columns: Iterable[rr.ComponentColumn]) -> None:
        times = [
            rr.TimeColumn("time", timestamp=stamps_ns.astype("datetime64[ns]")),
            rr.TimeColumn("elapsed", duration=(stamps_ns - self._start_ns).astype("timedelta64[ns]")),
        ]
        rr.send_columns(entity, indexes=times, columns=columns, recording=self._recording, strict=True)

    def _log_static(self, entity: str, what: rr.AsComponents) -> None:
        self._recording.log(entity, what, static=True, strict=True)

    def _draw(
        self,
        entity: str,
        label: str,
        rgb: tuple[int, int, int],
        stamps_ns: IntArray,
        values: FloatArray,
        *,
        sparse: bool = False,
    ) -> None:
        """Send one line; [N] stamps and values, NaN where unknown."""
        style = rr.SeriesLines(names=[label], colors=[rgb], widths=[2.0 if label == TRUTH else 1.5])
        self._draw_lines(entity, style, stamps_ns, values[:, None], sparse=sparse)

    def _draw_lines(
        self, entity: str, style: rr.SeriesLines, stamps_ns: IntArray, values: FloatArray, *, sparse: bool = False
    ) -> None:
        """Send the known rows of ``values`` [N, k]; an empty row, which breaks the line, stands for missing ones."""
        line = self._lines.get(entity)
        known: BoolArray = np.all(np.isfinite(values), axis=1)
        if line is None:
            if not known.any():
                return
            self._log_static(entity, style)
            line = self._lines[entity] = _Line(LONGEST_BRIDGE_NS if sparse else 0)
        stamps, rows, is_break = line.rows(stamps_ns, known)
        if len(stamps) == 0:
            return
        lengths = np.where(is_break, 0, values.shape[1])
        self._send(entity, stamps, rr.Scalars.columns(scalars=values[rows].reshape(-1)).partition(lengths))

    def _draw_path(self, track: StateTrack, rgb: tuple[int, int, int]) -> None:
        # North is drawn up: the y axis of Rerun's 2D views points down.
        plan = np.stack([track.x_m, -track.y_m], axis=1)
        known = np.isfinite(plan).all(axis=1) & track.valid
        if not known.any():
            return
        if track.name not in self._paths:
            self._paths[track.name] = _Trajectory(MOST_TRAJECTORY_POINTS)
            style = rr.Points2D.from_fields(colors=[rgb], radii=[rr.Radius.ui_points(5.0)], labels=[track.name])
            self._log_static(f"/plan/{track.name}/now", style)
        self._paths[track.name].append(np.where(known[:, None], plan, np.nan))
        slot = track.stamps_ns // DOT_STEP_NS
        shown = known & (np.diff(slot, prepend=slot[:1] - 1) != 0)
        if shown.any():
            points = rr.Points2D.columns(positions=plan[shown])
            self._send(f"/plan/{track.name}/now", track.stamps_ns[shown], points)

    def _draw_reasons(self) -> list[Event]:
        """Draw each reason as a state that holds in its intervals; return the intervals as events."""
        events = []
        for name, intervals in self._reasons.items():
            for reason, spans in intervals.intervals().items():
                text = _REASON_TEXTS[reason]
                stamps = np.array([t for s in spans for t in (s.start_ns, s.end_ns)], dtype=np.int64)
                states = rr.StateChange.columns(state=[text, ""] * len(spans))  # the empty one ends the state
                self._send(f"/reasons/{name}/{reason}", stamps, states)
                events += [Event(f"{name}: {text}", s.start_ns, s.end_ns, "") for s in spans]
        return events

    def _draw_errors(self) -> None:
        truth = self._window.get(TRUTH)
        if truth is None:
            return
        for name, track in self._window.items():
            if name == TRUTH or name in self._compared:
                continue
            self._compared.add(name)
            _, of_track, of_truth = np.intersect1d(
                track.stamps_ns, truth.stamps_ns, assume_unique=True, return_indices=True
            )
            valid = track.valid[of_track] & truth.valid[of_truth]
            fast = np.hypot(truth.vx_m_s, truth.vy_m_s)[of_truth] >= self._min_speed_m_s
            for plot in _STATES:
                error = np.asarray(getattr(track, plot.column))[of_track] - getattr(truth, plot.column)[of_truth]
                error = plot.factor * (wrap_angle(error) if plot.is_angle else error)
                known = valid if plot.from_low_speed else valid & fast
                self._draw(
                    f"/error/{plot.entity}/{name}",
                    name,
                    colour_rgb(name, self._colours),
                    track.stamps_ns[of_track],
                    np.where(known, error, np.nan),
                )


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
        self._from, self._to = os.pipe()
        self.name = f"/dev/fd/{self._to}"
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
            self._thread = threading.Thread(target=self._carry, daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Wait until all is written that Rerun has sent, whose own end must be closed by then."""
        self.opened()
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


@dataclass(slots=True)
class _Line:
    """Where a line stands between windows: its last known stamp, and whether unknown rows followed it."""

    bridge_ns: int
    last_ns: int | None = None
    unknown_since: bool = False

    def rows(self, stamps_ns: IntArray, known: BoolArray) -> tuple[IntArray, IntArray, BoolArray]:
        """Choose the rows to send: stamps [M], indices of known rows, and which of the M are breaks.

        A break stands 1 ns behind the last known stamp before a gap: where unknown rows lie between two known ones
        that are further apart than ``bridge_ns``, or where they are further apart than LONGEST_BRIDGE_NS.
        """
        at = np.flatnonzero(known)
        if len(at) == 0:
            self.unknown_since |= len(known) > 0
            return np.empty(0, dtype=np.int64), at, np.empty(0, dtype=np.bool_)
        stamps = stamps_ns[at]
        before = np.concatenate([[stamps[0] if self.last_ns is None else self.last_ns], stamps[:-1]])
        unknown_between = np.diff(at, prepend=-1) > 1
        unknown_between[0] |= self.unknown_since
        step = stamps - before
        gap = (unknown_between & (step > self.bridge_ns)) | (step > LONGEST_BRIDGE_NS)
        if self.last_ns is None:
            gap[0] = False
        self.last_ns = int(stamps[-1])
        self.unknown_since = bool(at[-1] < len(known) - 1)
        places = np.flatnonzero(gap)
        all_stamps = np.insert(stamps, places, before[places] + 1)
        is_break = np.insert(np.zeros(len(stamps), dtype=np.bool_), places, True)
        return all_stamps, at, is_break


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
        known = np.isfinite(points).all(axis=1)
        pieces = np.split(points, np.flatnonzero(np.diff(known)) + 1)
        return [p for p in pieces if len(p) > 1 and np.isfinite(p[0]).all()]


def _tail(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(-min(64, path.stat().st_size), os.SEEK_END)
        return file.read()


def _event_text(event: Event) -> str:
    head = f"{event.name}, {(event.end_ns - event.start_ns) * 1e-9:.2f} s"
    return f"{head}: {event.text}" if event.text else head


def _blueprint() -> rrb.Blueprint:
    """Open on the drive: sideslip with bands, yaw rate, a_y, inputs and the plan; errors, filter and report as tabs."""

    def plot(origin: str, name: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(origin=origin, name=name)

    drive = rrb.Horizontal(
        rrb.Vertical(
            plot("/sideslip_deg", "Sideslip [deg]"),
            plot("/yaw_rate_deg_s", "Yaw rate [deg/s]"),
            plot("/ay_m_s2", "Lateral acceleration [m/s²]"),
            rrb.TimeSeriesView(
                origin="/inputs",
                contents=["$origin/speed_m_s", "$origin/steer_deg"],
                name="Speed [m/s], road-wheel angle [deg]",
            ),
            row_shares=[3, 2, 2, 2],
        ),
        rrb.Vertical(
            rrb.Spatial2DView(origin="/plan", name="Plan, north up [m]"),
            rrb.TextLogView(origin="/events", name="Events"),
            row_shares=[3, 1],
        ),
        column_shares=[3, 2],
        name="Drive",
    )
    errors = rrb.Vertical(
        *(plot(f"/error/{entity}", f"Error of {name}") for entity, name in _ERROR_NAMES), name="Errors"
    )
    filters = rrb.Vertical(
        plot("/nis", "Normalised innovation squared"),
        plot("/network_trust", "Network trust"),
        plot("/r_scale", "Factor on R"),
        plot("/mixture_weight", "Weight of the filters with a force scale or a bank"),
        rrb.StateTimelineView(origin="/reasons", name="Why samples were not used as usual"),
        plot("/vx_m_s", "Longitudinal velocity [m/s]"),
        plot("/vy_m_s", "Lateral velocity [m/s]"),
        name="Filter",
    )
    report = rrb.TextDocumentView(origin="/report", name="Report")
    return rrb.Blueprint(
        rrb.Tabs(drive, errors, filters, report, active_tab=0),
        rrb.TimePanel(state="collapsed", timeline="time"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_layout=False,
        auto_views=False,
    )


_ERROR_NAMES = (
    ("sideslip_deg", "sideslip [deg]"),
    ("yaw_rate_deg_s", "yaw rate [deg/s]"),
    ("vx_m_s", "longitudinal velocity [m/s]"),
    ("vy_m_s", "lateral velocity [m/s]"),
    ("ay_m_s2", "lateral acceleration [m/s²]"),
)
