"""``--no-position``: no output of a run contains a place, copied topics included."""

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from mcap.reader import make_reader

from pdhef_logtool.mapping.records import Mapping, SignalSource
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.results.no_position import topics_with_position
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.fleet import Schedule, run_logs
from tests.fake_drive_log import FakeLog, FakeTopic
from tests.mcap_files import mcap_writer


def _topics(path: Path) -> set[str]:
    with path.open("rb") as file:
        return {channel.topic for _, channel, _ in make_reader(file).iter_messages()}


PLACES = "gps.Latitude gps.longitudeDeg pos_x north x navLatDeg breite speed.lat speed_sample.p stamp_lat"
NO_PLACES = "latAccelG gps_speed twist.linear.z"


@pytest.mark.parametrize(
    ("type_name", "field", "left_out"),
    [
        *(("vendor/msg/State", field, True) for field in PLACES.split()),
        *(("vendor/msg/State", field, False) for field in NO_PLACES.split()),
        ("vendor/msg/Pedals", "brake_pedal_position", False),
        ("vendor/msg/Imu", "angular_velocity.z", False),
        ("vendor/msg/Imu", "orientation.z", True),
        ("sensor_msgs/msg/Imu", "orientation.z", False),
        ("tf2_msgs/msg/TFMessage", "n", True),
        ("geometry_msgs/msg/PoseStamped", "pose.position.x", True),
    ],
)
def test_topics_are_copied_if_each_field_is_known_not_to_be_a_place(type_name, field, left_out):
    stamps = np.arange(3, dtype=np.int64)
    log = FakeLog({"/a": FakeTopic(type_name, stamps, {"speed": np.zeros(3), field: np.zeros(3)})})
    assert topics_with_position(log, Mapping()) == (frozenset({"/a"}) if left_out else frozenset())


def test_a_mapped_field_is_no_place_unless_it_is_mapped_as_one_and_what_is_not_decoded_may_be_one():
    stamps = np.arange(3, dtype=np.int64)
    topics = {name: FakeTopic("v/msg/A", stamps, {"n": np.zeros(3)}) for name in ("/a", "/b")}
    log = FakeLog({**topics, "/c": FakeTopic("v/msg/C", stamps, {})})
    mapping = Mapping({"ay_m_s2": SignalSource("ay_m_s2", "/a", "n")}, {"x_m": SignalSource("x_m", "/b", "n")})
    assert topics_with_position(log, mapping) == {"/b", "/c"}


def test_entries_of_json_messages_that_the_schema_does_not_list_are_seen():
    stamps = np.arange(2, dtype=np.int64)
    messages = ({"speed": 1.0}, {"speed": 1.0, "home": {"lat": 57.0}})
    topic = FakeTopic("S", stamps, {"speed": np.zeros(2)}, encoding="json", examples=messages)
    assert topics_with_position(FakeLog({"/a": topic}), Mapping()) == {"/a"}


PLACES_IN_JSON = {
    "/place": {"latitude": 57.123456, "longitude": 11.98765},
    "/text": {"street": "Hemligagatan"},
    "/array": {"coordinates": [57.123456, 11.98765]},
}
SECRETS = (b"57.1234", b"Hemliga", b"Alice", b"jane", b"to_work", b"/gpx", b"Operator")


def _personal_log(path: Path) -> None:
    """Write 6 s of a drive with places in topics, attachment, metadata and channel metadata."""
    path.parent.mkdir()
    with mcap_writer(path) as writer:
        turn = {"/car": {"speed": 20.0, "steering_wheel_angle": 0.1}, "/imu": {"ax": 0.0, "ay": 1.0, "yaw_rate": 0.05}}
        channels = {}
        for topic, message in (turn | PLACES_IN_JSON).items():
            kinds = {str: "string", list: "array", float: "number"}
            schema = {"type": "object", "properties": {k: {"type": kinds[type(v)]} for k, v in message.items()}}
            id_ = writer.register_schema(topic[1:], "jsonschema", json.dumps(schema).encode())
            channels[topic] = writer.register_channel(topic, "json", id_, {"Operator": "Alice"})
        for i in range(300):
            at_ns = 1_700_000_000_000_000_000 + i * 20_000_000
            for topic, message in (turn | PLACES_IN_JSON).items():
                moved = {k: v + 0.001 * np.sin(i) if isinstance(v, float) else v for k, v in message.items()}
                writer.add_message(channels[topic], at_ns, json.dumps(moved).encode(), at_ns)
        writer.add_attachment(0, 0, "route/gpx", "text/xml", b'<trkpt lat="57.123456">')
        writer.add_metadata("drive", {"driver": "Alice", "start": "57.123456"})


def _all_bytes(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Yield names and contents of all files, decompressed."""
    for path in folder.rglob("*"):
        yield "names", str(path.relative_to(folder)).encode()
        if path.suffix == ".parquet":
            yield path.name, pl.read_parquet(path).write_ndjson().encode()
        elif path.suffix == ".mcap":
            with path.open("rb") as file:
                reader = make_reader(file)
                summary = reader.get_summary()
                yield path.name, repr((summary.channels, summary.schemas, [*reader.iter_metadata()])).encode()
                yield path.name, b"".join(a.name.encode() + a.data for a in reader.iter_attachments())
                yield path.name, b"".join(message.data for _, _, message in reader.iter_messages())
        if path.is_file():
            yield path.name, path.read_bytes()


@pytest.mark.parametrize("jobs", [1, 2])
def test_no_output_contains_a_place_a_name_of_a_file_or_metadata(tmp_path, jobs):
    log = tmp_path / "jane_doe" / "drive_to_work.mcap"
    _personal_log(log)
    damaged = log.with_name("jane_to_work.mcap")
    damaged.write_bytes(log.read_bytes()[:50])
    config = RunConfig(estimators=("zero",), annotate="full", keep="full", model="off", no_position=True)
    logs = [str(log)] if jobs == 1 else [str(log), str(damaged)]
    result = run_logs(logs, tmp_path / "out", config, schedule=Schedule(resume=jobs == 2))
    assert {name for name, data in _all_bytes(tmp_path / "out") if any(secret in data for secret in SECRETS)} == set()
    digits = hashlib.sha256(log.read_bytes()).hexdigest()[:8]
    folder = tmp_path / "out" / "logs" / f"log-{digits}"
    assert {"/car", "/imu", "/pdhef/zero/state"} <= _topics(folder / "annotated.mcap")
    estimates = pl.read_parquet(folder / "estimates.parquet")
    assert not estimates["vx_m_s"].drop_nulls().drop_nans().is_empty()
    assert all(estimates[name].drop_nulls().drop_nans().is_empty() for name in ("x_m", "y_m", "yaw_rad"))
    remarks = next(r.report["remarks"] for r in result.results if r.report)
    assert "--no-position leaves out topics /array, /place, /text, attachments, metadata and file names" in remarks


def test_outputs_with_names_are_not_mixed_with_outputs_without(sample_logs_dir, tmp_path):
    config = RunConfig(estimators=("zero",), keep="metrics", model="off", reference="off", end="2")
    log = str(sample_logs_dir / "dlc.mcap")
    run_logs([log], tmp_path, config, report=False)
    with pytest.raises(UsageError, match="outputs of a run without --no-position"):
        run_logs([log], tmp_path, replace(config, no_position=True), report=False)
