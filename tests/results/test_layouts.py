import dataclasses
import functools
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from foxglove import layouts as fl
from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic.alias_generators import to_camel
from rosbags.typesys import get_types_from_msg

from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.layouts import write_layouts
from pdhef_logtool.results.mcap_sink import AnnotatedMcap
from pdhef_logtool.results.sink import Event
from tests.logs.recorded import summary_of
from tests.run_report import report


def write(folder: Path, tracks: Sequence[StateTrack]) -> Path:
    """Write a sidecar and the layouts of tracks."""
    event = Event("slalom", 1_700_000_000_000_000_123, 1_700_000_001_000_000_123, "")
    with AnnotatedMcap(folder / "annotated.mcap", None) as annotated:
        annotated.write(tracks)
        annotated.finish(report(None), tracks, [event])
    layouts = folder / "foxglove.json", folder / "plotjuggler.xml"
    write_layouts(*layouts, tracks, {"pd-hef": 0x123456}, shown={"truth", "pd-hef"}, fixes=["/gnss/fix"])
    return folder


@pytest.fixture
def written(tmp_path, circle):
    """Write a sidecar and the layouts of three tracks."""
    return write(tmp_path, [circle(name, 0, 200) for name in ("truth", "pd-hef", "2nd try")])


def fields_by_topic(path: Path) -> dict[str, set[str]]:
    """Return the fields of the messages of every topic that has messages, by the schemas in the file."""
    topics = {}
    summary = summary_of(path)
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        _, fields = get_types_from_msg(schema.data.decode(), schema.name)[schema.name]
        if summary.statistics.channel_message_counts.get(channel.id):
            topics[channel.topic] = {name for name, _ in fields}
    return topics


def panels_of(node: Any) -> list[str]:
    """Return the panels of a layout's tree; each inner node splits its area in two."""
    if isinstance(node, str):
        return [node]
    assert node.keys() == {"direction", "first", "second", "splitPercentage"}
    assert node["direction"] in ("row", "column") and 0 < node["splitPercentage"] < 100
    return panels_of(node["first"]) + panels_of(node["second"])


def test_every_path_of_foxglove_is_in_the_log(written):
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


for published in filter(dataclasses.is_dataclass, vars(fl).values()):
    published.__pydantic_config__ = ConfigDict(alias_generator=to_camel, extra="forbid", strict=True)
adapter = functools.cache(TypeAdapter)


def conforms(value: Any, kind: Any) -> bool:
    """Return whether a value of JSON is of a type of ``foxglove.layouts``; objects have no further keys."""
    try:
        adapter(kind).validate_json(json.dumps(value))
    except ValidationError:
        return False
    return True


def test_panels_have_the_settings_that_foxglove_publishes(written):
    layout = json.loads((written / "foxglove.json").read_text())
    published = {"Plot": fl.PlotConfig, "StateTransitions": fl.StateTransitionsConfig, "RosOut": fl.LogConfig}
    published |= {"map": fl.MapConfig, "3D": fl.ThreeDeeConfig}
    seen = set()
    for name, panel in layout["configById"].items():
        kind = name.partition("!")[0]
        seen.add(kind)
        config = {key: value for key, value in panel.items() if key != "foxglovePanelTitle"}
        assert conforms(config, published[kind]), name
        assert not conforms({**config, "further": 1}, published[kind])
        if kind == "3D":
            by_kind = {"path": fl.BaseRendererPosesTopicSettings, "odometry": fl.BaseRendererPoseTopicSettings}
            assert all(conforms(s, by_kind[topic.rpartition("/")[2]]) for topic, s in config["topics"].items())
    assert seen == set(published)
    assert not conforms({"paths": [{"value": "/a.b", "lineSize": "1"}]}, fl.PlotConfig)


#: Elements that PlotJuggler reads: attributes and children of each (MainWindow, TabbedPlotWidget, PlotDocker and
#: PlotWidget, xmlLoadState; it asks for each attribute by name).
PLOTJUGGLER = {
    "root": (set(), {"tabbed_widget", "use_relative_time_offset"}),
    "use_relative_time_offset": ({"enabled"}, set()),
    "tabbed_widget": ({"name", "parent"}, {"Tab", "currentTabIndex"}),
    "currentTabIndex": ({"index"}, set()),
    "Tab": ({"containers", "tab_name"}, {"Container"}),
    "Container": (set(), {"DockSplitter"}),
    "DockSplitter": ({"orientation", "count", "sizes"}, {"DockArea", "DockSplitter"}),
    "DockArea": ({"name"}, {"plot"}),
    "plot": ({"mode", "style", "flip_x", "flip_y"}, {"curve"}),
    "curve": ({"name", "color"}, set()),
}


def test_elements_are_those_that_plotjuggler_reads(written):
    root = ET.fromstring((written / "plotjuggler.xml").read_bytes())
    assert root.tag == "root"
    for element in root.iter():
        attributes, children = PLOTJUGGLER[element.tag]
        assert set(element.attrib) == attributes and {child.tag for child in element} <= children
    assert {"|", "-"} >= {s.attrib["orientation"] for s in root.iter("DockSplitter")}
    assert all(p.attrib["mode"] == "TimeSeries" and p.attrib["style"] == "Lines" for p in root.iter("plot"))
    assert all(re.fullmatch("#[0-9a-f]{6}", c.attrib["color"]) for c in root.iter("curve"))


def test_every_curve_of_plotjuggler_is_in_the_log(written):
    topics = fields_by_topic(written / "annotated.mcap")
    root = ET.fromstring((written / "plotjuggler.xml").read_bytes())
    curves = [curve.attrib["name"].rpartition("/") for curve in root.iter("curve")]
    assert curves and all(field in topics[topic] for topic, _, field in curves)
    plotted = {t for t in topics if t.endswith(("/state", "/plot"))} - {"/pdhef/truth/state"}
    assert {topic for topic, *_ in curves} == plotted
    assert [tab.attrib["tab_name"] for tab in root.iter("Tab")] == ["Estimates", "Errors", "Filter"]
    for splitter in root.iter("DockSplitter"):
        assert int(splitter.attrib["count"]) == len(splitter) == len(splitter.attrib["sizes"].split(";"))
