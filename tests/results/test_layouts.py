from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from mcap.reader import make_reader
from rosbags.typesys import get_types_from_msg

from pdhef_logtool.results.layouts import LayoutsSink, foxglove_layout, plotjuggler_layout
from pdhef_logtool.results.mcap_sink import AnnotatedMcapSink
from pdhef_logtool.results.sink import Event

REPORT = {
    "format": "pdhef.report",
    "log": {"name": "drive", "end_ns": 1_700_000_006_000_000_123},
    "truth": {"available": True},
    "estimators": [],
    "metrics": [],
}


@pytest.fixture
def written(tmp_path: Path, circle: Any) -> Path:
    """Write a sidecar and the layouts of three tracks, of which one is not asked for."""
    names = {"truth", "pd-hef", "2nd try"}
    layouts = tmp_path / "foxglove.json", tmp_path / "plotjuggler.xml"
    sinks = (
        AnnotatedMcapSink(tmp_path / "annotated.mcap", None, names),
        LayoutsSink(*layouts, names, {"pd-hef": 0x123456}, shown={"truth", "pd-hef"}, fixes=["/gnss/fix"]),
    )
    event = Event("slalom", 1_700_000_000_000_000_123, 1_700_000_001_000_000_123, "")
    for sink in sinks:
        for first in (0, 100):
            for name in ("truth", "pd-hef", "zero", "2nd try"):
                sink.append(circle(name, first, 100))
        sink.finish(REPORT, [event])
    return tmp_path


def fields_by_topic(path: Path) -> dict[str, set[str]]:
    """Return the fields of the messages of every topic that has messages, by the schemas in the file."""
    topics = {}
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        _, fields = get_types_from_msg(schema.data.decode(), schema.name)[schema.name]
        assert summary.statistics.channel_message_counts[channel.id]
        topics[channel.topic] = {name for name, _ in fields}
    return topics


def panels_of(node: Any) -> list[str]:
    """Return the panels of a layout's tree; each inner node splits its area in two."""
    if isinstance(node, str):
        return [node]
    assert node.keys() == {"direction", "first", "second", "splitPercentage"}
    assert node["direction"] in ("row", "column") and 0 < node["splitPercentage"] < 100
    return panels_of(node["first"]) + panels_of(node["second"])


def test_every_path_of_foxglove_is_in_the_log(written: Path) -> None:
    layout = json.loads((written / "foxglove.json").read_text())
    assert layout.keys() == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    topics = fields_by_topic(written / "annotated.mcap")
    seen = set()
    for name, panel in layout["configById"].items():
        kind = name.partition("!")[0]
        assert kind in ("Plot", "StateTransitions", "RosOut", "3D", "map") and panel["foxglovePanelTitle"]
        for path in panel.get("paths", ()):
            topic, _, field = path["value"].partition(".")
            assert field in topics[topic], path
            assert path["enabled"] is ("2nd" not in path["label"])
            seen.add(topic)
        if kind == "3D":
            seen |= {*panel["topics"]}
        if kind == "RosOut":
            seen.add(panel["topicToRender"])
    assert seen == set(topics) - {"/pdhef/truth/state"}
    assert layout["configById"]["map!fixes"]["followTopic"] == "/gnss/fix"
    assert sorted(panels_of(layout["layout"])) == sorted(layout["configById"])
    slip = layout["configById"]["Plot!sideslip_deg"]["paths"]
    assert {p["color"] for p in slip if p["label"] == "pd-hef"} == {"#123456"}
    limits = [p["value"].rpartition(".")[2] for p in slip if p["label"] == "pd-hef 95 %"]
    assert limits == ["sideslip_low_deg", "sideslip_high_deg"]
    assert not any("truth" in p["label"] for p in layout["configById"]["Plot!sideslip_error_deg"]["paths"])


def test_every_curve_of_plotjuggler_is_in_the_log(written: Path) -> None:
    topics = fields_by_topic(written / "annotated.mcap")
    root = ET.fromstring((written / "plotjuggler.xml").read_bytes())
    curves = [curve.attrib["name"].rpartition("/") for curve in root.iter("curve")]
    assert curves and all(field in topics[topic] for topic, _, field in curves)
    plotted = {t for t in topics if t.endswith(("/state", "/plot"))} - {"/pdhef/truth/state"}
    assert {topic for topic, *_ in curves} == plotted
    assert [tab.attrib["tab_name"] for tab in root.iter("Tab")] == ["Estimates", "Errors", "Filter"]
    for splitter in root.iter("DockSplitter"):
        assert int(splitter.attrib["count"]) == len(splitter) == len(splitter.attrib["sizes"].split(";"))


def test_without_ground_truth_there_are_no_plots_of_errors() -> None:
    tracks = {"pd-hef": "#123456"}
    layout = foxglove_layout(tracks, tracks)
    assert not [name for name in layout["configById"] if "error" in name or name.startswith("map!")]
    tabs = [tab.attrib["tab_name"] for tab in ET.fromstring(plotjuggler_layout(tracks, tracks)).iter("Tab")]
    assert tabs == ["Estimates", "Filter"]
