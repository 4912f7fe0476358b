"""What recordings draw: values of a track, limits of the 95 % interval, errors, colours, and events as log lines."""

import struct
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.reasons import reason_intervals
from pdhef_logtool.evaluation.track_errors import NORMAL_95, signal_error
from pdhef_logtool.records.geometry import DEGREES
from pdhef_logtool.records.reasons import REASONS
from pdhef_logtool.records.signals import NS_PER_S, FloatArray
from pdhef_logtool.records.tracks import REFERENCE, StateTrack
from pdhef_logtool.results.run_report import lines_of
from pdhef_logtool.results.sink import Event

_SIDESLIP, _RATE = "sideslip_rad", "yaw_rate_rad_s"


@dataclass(frozen=True, slots=True)
class Plot:
    """One plotted quantity: component, title, column of the track, factor to the plotted unit, its deviation's column.

    ``limits``, ``error``: fields of ``pdhef_msgs/msg/PlottedEstimate`` with the ends of its interval, and its error.
    """

    name: str
    title: str
    column: str
    factor: float = 1.0
    std: str = ""
    limits: tuple[str, ...] = ()
    error: str = ""

    @property
    def error_title(self) -> str:
        """Title of the plot of its error."""
        return f"Error of {self.title[0].lower()}{self.title[1:]}"


_SLIP_LIMITS, _RATE_LIMITS = ("sideslip_low_deg", "sideslip_high_deg"), ("yaw_rate_low_deg_s", "yaw_rate_high_deg_s")
#: Quantities that recordings and layouts draw of each track.
STATES = (
    Plot("sideslip_deg", "Sideslip [deg]", _SIDESLIP, DEGREES, "sideslip_std_rad", _SLIP_LIMITS, "sideslip_error_deg"),
    Plot(
        "yaw_rate_deg_s", "Yaw rate [deg/s]", _RATE, DEGREES, "yaw_rate_std_rad_s", _RATE_LIMITS, "yaw_rate_error_deg_s"
    ),
    Plot("ay_m_s2", "Lateral acceleration [m/s²]", "ay_m_s2"),
    Plot("vx_m_s", "Longitudinal velocity [m/s]", "vx_m_s", std="vx_std_m_s"),
    Plot("vy_m_s", "Lateral velocity [m/s]", "vy_m_s", std="vy_std_m_s", error="vy_error_m_s"),
)
#: Whose error is drawn; the other two errors show the same once more.
ERRORS = tuple(plot for plot in STATES if plot.error)


def drawn(track: StateTrack, plot: Plot, min_speed_m_s: float) -> FloatArray:
    """Return the drawn values of a track, [N, 1] or, with the ends of the 95 % interval, [N, 3]; NaN if unknown.

    ``min_speed_m_s``: sideslip is not drawn below.
    """
    values = np.asarray(getattr(track, plot.column), dtype=np.float64) * plot.factor
    if len(values) != len(track):
        return np.full((len(track), 1), np.nan)
    shown = track.valid
    if plot.column == _SIDESLIP:
        shown = shown & (np.hypot(track.vx_m_s, track.vy_m_s) >= min_speed_m_s)
    values = np.where(shown, values, np.nan)
    if not plot.std:
        return values[:, None]
    half = NORMAL_95 * plot.factor * np.asarray(getattr(track, plot.std))
    return np.stack([values, values - half, values + half], axis=1)


def errors(track: StateTrack, truth: StateTrack | None, min_speed_m_s: float) -> dict[str, FloatArray]:
    """Return the scored errors [N] by the names of :data:`ERRORS`; NaN without ground truth at the same stamps.

    ``min_speed_m_s``: of the ground truth, below which there is no error of sideslip.
    """
    if truth is None or not np.array_equal(track.stamps_ns, truth.stamps_ns):
        return {plot.name: np.full(len(track), np.nan) for plot in ERRORS}
    return {plot.name: signal_error(track, truth, plot.column, min_speed_m_s) * plot.factor for plot in ERRORS}


def plotted_fields(track: StateTrack, truth: StateTrack | None, min_speed_m_s: float) -> dict[str, FloatArray]:
    """Return the fields [N] of ``pdhef_msgs/msg/PlottedEstimate`` but the header; no errors of ground truth."""
    fields: dict[str, FloatArray] = {}
    for plot in STATES:
        fields |= zip((plot.name, *plot.limits), drawn(track, plot, min_speed_m_s).T, strict=False)
    of_track = errors(track, None if truth is None or truth.name == track.name else truth, min_speed_m_s)
    return fields | {plot.error: of_track[plot.name] for plot in ERRORS}


#: Of ground truth, and of the sideslip reference, which no estimator has.
_NO_ESTIMATORS = {"truth": 0x8A8A8A, REFERENCE: 0xBBCC33}
#: For other names, such as recorded estimates: Okabe and Ito (2008) without black and yellow.
_OTHERS = (0xD55E00, 0x0072B2, 0xE69F00, 0x009E73, 0xCC79A7, 0x56B4E9)


def colour_rgb(name: str, colours: Mapping[str, int]) -> tuple[int, int, int]:
    """Return red, green, blue (0 to 255) of a track; ``colours`` are 0xRRGGBB by estimator.

    A name that is not there always gets the same colour of the palette.
    """
    packed = {**_NO_ESTIMATORS, **colours}.get(name, _OTHERS[zlib.crc32(name.encode()) % len(_OTHERS)])
    red, green, blue = packed.to_bytes(3)
    return red, green, blue


#: Levels of rcl_interfaces/msg/Log.
LEVEL_NAMES = {10: "DEBUG", 20: "INFO", 30: "WARN", 40: "ERROR"}
_REASON_TEXTS = {r.name: r.text for r in REASONS}


@dataclass(frozen=True, slots=True)
class LogLine:
    """A line of the log: time, severity, subject and text."""

    stamp_ns: int
    level: int
    source: str
    text: str


def log_lines(report: Mapping[str, Any], events: Sequence[Event], tracks: Iterable[StateTrack]) -> list[LogLine]:
    """Return the lines in order of time: failed checks, losses, events and manoeuvres, and faults by estimator."""
    reasons = [(t.name, _REASON_TEXTS[reason], spans) for t in tracks for reason, spans in reason_intervals(t).items()]
    cells = (line.split("\t", 3) for line in lines_of("log", report, report["log"], events, reasons))
    lines = [LogLine(int(stamp_ns), int(level), *texts) for stamp_ns, level, *texts in cells]
    return sorted(lines, key=lambda line: (line.stamp_ns, -line.level, line.text))


def log_message(line: LogLine) -> bytes:
    """Return a line as ``rcl_interfaces/msg/Log`` in little-endian CDR."""
    seconds, rest_ns = divmod(line.stamp_ns, NS_PER_S)
    data = bytearray(struct.pack("<iIB", seconds, rest_ns, line.level))
    for text in (line.source, line.text, "", ""):
        raw = text.encode() + b"\0"
        data += b"\0" * (-len(data) % 4) + struct.pack("<I", len(raw)) + raw
    data += b"\0" * (-len(data) % 4) + struct.pack("<I", 0)
    return b"\0\1\0\0" + bytes(data)
