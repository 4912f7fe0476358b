from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import pytest
from mcap.reader import make_reader
from rosbags.typesys import get_types_from_msg

from pdhef_logtool.results.layouts import LayoutsSink
from pdhef_logtool.results.mcap_sink import AnnotatedMcapSink

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
    sinks = (
        AnnotatedMcapSink(tmp_path / "annotated.mcap", None, names),
        LayoutsSink(tmp_path / "foxglove.json", tmp_path / "plotjuggler.xml", names, {"pd-hef": 0x123456}),
    )
    for sink in sinks:
        for first in (0, 100):
            for name in ("truth", "pd-hef", "zero", "2nd try"):
                sink.append(circle(name, first, 100))
        sink.finish(REPORT)
    return tmp_path


def fields_by_topic(path: Path) -> dict[str, set[str]]:
    """Return the fields of the messages of every topic that has messages, by the schemas in the file."""
    found = {}
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]
        _, fields = get_types_from_msg(schema.data.decode(), schema.name)[schema.name]
        assert summary.statistics.channel_message_counts[channel.id]
        found[channel.topic] = {name for name, _ in fields}
    return found


def test_every_path_of_foxglove_is_in_the_log(written: Path) -> None:
    layout = json.loads((written / "foxglove.json").read_text())
    held = fields_by_topic(written / "annotated.mcap")
    seen = set()
    for name, panel in layout["configById"].items():
        for path in panel.get("paths", ()):
            topic, _, field = path["value"].partition(".")
            assert field in held[topic], path
            seen.add(topic)
        if name.startswith("3D!"):
            assert {*panel["topics"]} == {t for t in held if t.endswith("/odometry")}
            seen |= {*panel["topics"]}
    assert seen == set(held)

    def panels(node: Any) -> list[str]:
        return [node] if isinstance(node, str) else panels(node["first"]) + panels(node["second"])

    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
    (colour,) = {p["color"] for p in layout["configById"]["Plot!nis"]["paths"] if p["label"] == "pd-hef"}
    assert colour == "#123456"


def test_every_curve_of_plotjuggler_is_in_the_log(written: Path) -> None:
    held = fields_by_topic(written / "annotated.mcap")
    root = ET.fromstring((written / "plotjuggler.xml").read_bytes())
    curves = [curve.attrib["name"].rpartition("/") for curve in root.iter("curve")]
    assert curves and all(field in held[topic] for topic, _, field in curves)
    assert {topic for topic, *_ in curves} == {t for t in held if t.endswith("/state")}
    (splitter,) = root.iter("DockSplitter")
    assert int(splitter.attrib["count"]) == len(splitter) == len(splitter.attrib["sizes"].split(";"))
