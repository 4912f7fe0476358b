"""foxglove.json and plotjuggler.xml: what to plot of an annotated log, to be opened in Foxglove or PlotJuggler."""

from __future__ import annotations

from collections.abc import Collection, Container, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.mcap_sink import LOG_TOPIC, MAP_FRAME, has_pose, topic_of
from pdhef_logtool.results.palette import colour_rgb
from pdhef_logtool.results.run_report import json_bytes
from pdhef_logtool.results.sink import TRUTH
from pdhef_logtool.storage.files import write_bytes


@dataclass(frozen=True, slots=True)
class _Plot:
    """One plot: title, topic and field of a track, fields of the limits of its interval.

    ``of_truth``: not all fields mean something for the ground truth; an error needs one.
    """

    title: str
    field: str
    topic: str = "plot"
    limits: tuple[str, ...] = ()
    of_truth: bool = True


#: By tab of PlotJuggler.
_TABS = {
    "Estimates": (
        _Plot("Sideslip [deg]", "sideslip_deg", limits=("sideslip_low_deg", "sideslip_high_deg")),
        _Plot("Yaw rate [deg/s]", "yaw_rate_deg_s", limits=("yaw_rate_low_deg_s", "yaw_rate_high_deg_s")),
        _Plot("Lateral acceleration [m/s²]", "ay_m_s2"),
        _Plot("Longitudinal velocity [m/s]", "vx_m_s"),
        _Plot("Lateral velocity [m/s]", "vy_m_s"),
    ),
    "Errors": (
        _Plot("Error of sideslip [deg]", "sideslip_error_deg", of_truth=False),
        _Plot("Error of yaw rate [deg/s]", "yaw_rate_error_deg_s", of_truth=False),
        _Plot("Error of lateral velocity [m/s]", "vy_error_m_s", of_truth=False),
    ),
    "Filter": (
        _Plot("Normalised innovation squared", "nis", "state", of_truth=False),
        _Plot("Valid", "valid", "state", of_truth=False),
        _Plot("Diverged", "diverged", "state", of_truth=False),
        _Plot("Reason (sum of bits)", "reason", "state", of_truth=False),
    ),
}
_STATES = ("valid", "diverged", "reason")
#: Of Foxglove's log panel: from INFO on.
_PANEL_LEVEL = 2


def write_layouts(
    foxglove: Path,
    plotjuggler: Path,
    tracks: Sequence[StateTrack],
    colours: Mapping[str, int],
    *,
    shown: Collection[str],
    fixes: Sequence[str] = (),
) -> None:
    """Write the layouts for the topics that :class:`~.mcap_sink.AnnotatedMcap` writes of the same tracks.

    Parameters
    ----------
    foxglove, plotjuggler : the finished files.
    colours : 0xRRGGBB by estimator. shown : tracks with lines and intervals that are visible at first.
    fixes : topics of satellite fixes in the log, for a map.
    """
    drawn = {t.name: "#{:02x}{:02x}{:02x}".format(*colour_rgb(t.name, colours)) for t in tracks}
    on_map = {t.name for t in tracks if has_pose(t).any()}
    write_bytes(foxglove, json_bytes(foxglove_layout(drawn, shown, on_map, fixes)))
    write_bytes(plotjuggler, plotjuggler_layout(drawn, shown))


def foxglove_layout(
    tracks: Mapping[str, str], shown: Collection[str], on_map: Container[str] = (), fixes: Sequence[str] = ()
) -> dict[str, Any]:
    """Return a layout of Foxglove: plots in degrees, errors, maps, states and the log.

    ``tracks``: colour by name; ``shown``: those that are on at first, with their intervals; ``on_map``: those that
    have poses; ``fixes``: topics. The settings are as ``foxglove.layouts`` in Foxglove's SDK, under the names
    of panels that exported layouts have.
    """
    plots = [plot for tab in _TABS.values() for plot in tab if plot.field not in _STATES and _of(plot, tracks)]
    panels: dict[str, Any] = {f"Plot!{plot.field}": _plot_panel(plot, tracks, shown) for plot in plots}
    panels["StateTransitions!states"] = {
        "foxglovePanelTitle": "States of the estimators",
        "paths": [
            {
                "value": f"{topic_of(name, 'state')}.{field}",
                "label": f"{name} {field}",
                "enabled": name in shown,
                "timestampMethod": "receiveTime",
            }
            for name in tracks
            if name != TRUTH
            for field in _STATES
        ],
        "isSynced": True,
    }
    panels["RosOut!log"] = {
        "foxglovePanelTitle": "Faults, failed checks, events and manoeuvres",
        "topicToRender": LOG_TOPIC,
        "minLogLevel": _PANEL_LEVEL,
        "searchTerms": [],
    }
    topics: dict[str, dict[str, Any]] = {}
    for name, colour in tracks.items():
        if name in on_map:
            visible = {"visible": name in shown}
            topics[topic_of(name, "path")] = visible | {"type": "line", "lineWidth": 0.2, "gradient": [colour, colour]}
            topics[topic_of(name, "odometry")] = visible | {"type": "arrow", "color": colour}
    beside = ["StateTransitions!states", "RosOut!log"]
    if fixes:
        panels["map!fixes"] = {"foxglovePanelTitle": "Map", "followTopic": fixes[0], "layer": "map"}
        beside.insert(0, "map!fixes")
    if topics:
        panels["3D!path"] = {"foxglovePanelTitle": "Path driven", "followTf": MAP_FRAME, "topics": topics}
        beside.insert(0, "3D!path")
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {
            "direction": "row",
            "first": _column([f"Plot!{plot.field}" for plot in plots]),
            "second": _column(beside),
            "splitPercentage": 65,
        },
    }


def _plot_panel(plot: _Plot, tracks: Mapping[str, str], shown: Collection[str]) -> dict[str, Any]:
    paths = []
    for name, colour in _of(plot, tracks):
        fields = (plot.field, *(plot.limits if name != TRUTH else ()))
        paths += [
            {
                "value": f"{topic_of(name, plot.topic)}.{field}",
                "label": name if field == plot.field else f"{name} 95 %",
                "color": colour if field == plot.field else f"{colour}80",
                "enabled": name in shown,
                "timestampMethod": "receiveTime",
                "lineSize": 1.5 if field == plot.field else 0.75,
            }
            for field in fields
        ]
    return {
        "foxglovePanelTitle": plot.title,
        "paths": paths,
        "xAxisVal": "timestamp",
        "isSynced": True,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": False,
    }


def _column(panels: Sequence[str]) -> Any:
    """Return panels of the same height one below the other."""
    if len(panels) == 1:
        return panels[0]
    share = round(100 / len(panels), 3)
    return {"direction": "column", "first": panels[0], "second": _column(panels[1:]), "splitPercentage": share}


def plotjuggler_layout(tracks: Mapping[str, str], shown: Collection[str]) -> bytes:
    """Return a layout of PlotJuggler: tabs of plots in a column; arguments as for :func:`foxglove_layout`."""
    root = ET.Element("root")
    tabs = ET.SubElement(root, "tabbed_widget", {"parent": "main_window", "name": "Main Window"})
    for title, of_tab in _TABS.items():
        plots = [plot for plot in of_tab if _of(plot, tracks)]
        if not plots:
            continue
        container = ET.SubElement(ET.SubElement(tabs, "Tab", containers="1", tab_name=title), "Container")
        sizes = ";".join([f"{1 / len(plots):.6f}"] * len(plots))
        column = ET.SubElement(container, "DockSplitter", orientation="-", sizes=sizes, count=str(len(plots)))
        for plot in plots:
            area = ET.SubElement(column, "DockArea", name=plot.title)
            drawn = ET.SubElement(area, "plot", mode="TimeSeries", style="Lines", flip_x="false", flip_y="false")
            for name, colour in _of(plot, tracks):
                fields = (plot.field, *(plot.limits if name != TRUTH and name in shown else ()))
                for field in fields:
                    ET.SubElement(drawn, "curve", name=f"{topic_of(name, plot.topic)}/{field}", color=colour)
    ET.SubElement(tabs, "currentTabIndex", index="0")
    ET.SubElement(root, "use_relative_time_offset", enabled="1")
    ET.indent(root)
    return bytes(ET.tostring(root, encoding="utf-8", xml_declaration=True)) + b"\n"


def _of(plot: _Plot, tracks: Mapping[str, str]) -> list[tuple[str, str]]:
    """Return the tracks of a plot; errors only where there is a ground truth."""
    if "_error_" in plot.field and TRUTH not in tracks:
        return []
    return [(name, colour) for name, colour in tracks.items() if plot.of_truth or name != TRUTH]
