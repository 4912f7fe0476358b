"""foxglove.json and plotjuggler.xml: what to plot of an annotated log, to be opened in Foxglove or PlotJuggler."""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.mcap_sink import MAP_FRAME, topic_of
from pdhef_logtool.results.palette import colour_rgb
from pdhef_logtool.results.run_report import json_bytes
from pdhef_logtool.results.sink import TRUTH, Event, Sink
from pdhef_logtool.storage.files import write_bytes


@dataclass(frozen=True, slots=True)
class _Plot:
    """One plot: its title and the field of ``state`` that it shows; not all fields exist for ground truth."""

    title: str
    field: str
    of_truth: bool = True


_PLOTS = (
    _Plot("Sideslip [rad]", "sideslip_rad"),
    _Plot("Yaw rate [rad/s]", "yaw_rate_rad_s"),
    _Plot("Lateral acceleration [m/s²]", "ay_m_s2"),
    _Plot("Longitudinal velocity [m/s]", "vx_m_s"),
    _Plot("Standard deviation of sideslip [rad]", "sideslip_std_rad", of_truth=False),
    _Plot("Normalised innovation squared", "nis", of_truth=False),
)


class LayoutsSink(Sink):
    """Writes the layouts for the topics that :class:`~.mcap.AnnotatedMcapSink` writes of the same tracks.

    Parameters
    ----------
    foxglove, plotjuggler : where the finished files are.
    names : of the tracks that are written; None: all.
    colours : 0xRRGGBB by estimator.
    """

    def __init__(
        self, foxglove: Path, plotjuggler: Path, names: Container[str] | None, colours: Mapping[str, int]
    ) -> None:
        self._foxglove, self._plotjuggler = foxglove, plotjuggler
        self._names, self._colours = names, colours
        self._tracks: dict[str, str] = {}

    def append(self, track: StateTrack) -> None:
        """Take note of a track."""
        if self._names is None or track.name in self._names:
            red, green, blue = colour_rgb(track.name, self._colours)
            self._tracks[track.name] = f"#{red:02x}{green:02x}{blue:02x}"

    def finish(self, report: Mapping[str, Any], events: Sequence[Event] = ()) -> None:  # noqa: ARG002
        """Write both files."""
        write_bytes(self._foxglove, json_bytes(foxglove_layout(self._tracks)))
        write_bytes(self._plotjuggler, plotjuggler_layout(self._tracks))

    def abort(self) -> None:
        """Remove nothing: nothing is written before :meth:`finish`."""


def foxglove_layout(tracks: Mapping[str, str]) -> dict[str, Any]:
    """Return a layout of Foxglove: a column of plots, and the way driven beside it. ``tracks``: colour by name."""
    panels: dict[str, Any] = {
        f"Plot!{plot.field}": {
            "foxglovePanelTitle": plot.title,
            "paths": [
                {
                    "value": f"{topic_of(name, 'state')}.{plot.field}",
                    "label": name,
                    "color": colour,
                    "enabled": True,
                    "timestampMethod": "receiveTime",
                }
                for name, colour in _of(plot, tracks)
            ],
            "xAxisVal": "timestamp",
            "isSynced": True,
            "showXAxisLabels": True,
            "showYAxisLabels": True,
            "showLegend": True,
            "legendDisplay": "floating",
            "showPlotValuesInLegend": False,
        }
        for plot in _PLOTS
    }
    panels["3D!way"] = {
        "foxglovePanelTitle": "Way driven",
        "followTf": MAP_FRAME,
        "topics": {topic_of(name, "odometry"): {"visible": True, "color": colour} for name, colour in tracks.items()},
    }
    plots = [f"Plot!{plot.field}" for plot in _PLOTS]
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "row", "first": _column(plots), "second": "3D!way", "splitPercentage": 65},
    }


def _column(panels: Sequence[str]) -> Any:
    """Return panels of the same height one below the other."""
    if len(panels) == 1:
        return panels[0]
    share = round(100 / len(panels), 3)
    return {"direction": "column", "first": panels[0], "second": _column(panels[1:]), "splitPercentage": share}


def plotjuggler_layout(tracks: Mapping[str, str]) -> bytes:
    """Return a layout of PlotJuggler: a column of plots. ``tracks``: colour by name."""
    root = ET.Element("root")
    tabs = ET.SubElement(root, "tabbed_widget", {"parent": "main_window", "name": "Main Window"})
    container = ET.SubElement(ET.SubElement(tabs, "Tab", containers="1", tab_name="pdhef"), "Container")
    sizes = ";".join([f"{1 / len(_PLOTS):.6f}"] * len(_PLOTS))
    column = ET.SubElement(container, "DockSplitter", orientation="-", sizes=sizes, count=str(len(_PLOTS)))
    for plot in _PLOTS:
        area = ET.SubElement(column, "DockArea", name=plot.title)
        drawn = ET.SubElement(area, "plot", mode="TimeSeries", style="Lines", flip_x="false", flip_y="false")
        for name, colour in _of(plot, tracks):
            ET.SubElement(drawn, "curve", name=f"{topic_of(name, 'state')}/{plot.field}", color=colour)
    ET.SubElement(tabs, "currentTabIndex", index="0")
    ET.SubElement(root, "use_relative_time_offset", enabled="1")
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"


def _of(plot: _Plot, tracks: Mapping[str, str]) -> list[tuple[str, str]]:
    return [(name, colour) for name, colour in tracks.items() if plot.of_truth or name != TRUTH]
