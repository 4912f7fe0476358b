"""The scorer against known series, the containers against what was written, CAN with DBC, and some of the logs."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool import ReadOptions, inspect_log
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import fit_clocks, read_signals
from pdhef_logtool.mapping.can_frames import decoded_frames
from pdhef_logtool.records.signals import Channel
from studies.mcap_logs import messages, write_log
from studies.strangers.__main__ import score_recording
from studies.strangers.cars import Series, drive
from studies.strangers.containers import Topic, write
from studies.strangers.layouts import layout
from studies.strangers.recordings import answers, imu, road_car, scalar
from studies.strangers.scoring import ANSWERS, agrees, other_recording

_NS = np.arange(0, 20_000_000_000, 10_000_000, dtype=np.int64)
_WAVE = np.sin(2.0 * np.pi * 0.2 * _NS * 1e-9)


@pytest.mark.parametrize(
    ("values", "shift_ns", "right"),
    [
        (_WAVE, 0, True),
        (_WAVE + np.random.default_rng(1).normal(0.0, 0.05, _NS.size), 0, True),  # noise
        (_WAVE, 8_000_000, True),  # a stamp that is late by a few milliseconds
        (np.where(np.arange(_NS.size) // 25 == 7, 1e3, _WAVE), 0, True),  # a few invalid samples
        (-_WAVE, 0, False),
        (_WAVE * 180.0 / np.pi, 0, False),
        (_WAVE * 0.9, 0, False),
        (_WAVE + 0.1, 0, False),
        (_WAVE, 300_000_000, False),
        (np.full(_NS.size, np.nan), 0, False),
        (_WAVE[:0], 0, False),
    ],
)
def test_values_decide_whether_a_channel_is_right(values, shift_ns, right):
    stamps_ns = _NS[: values.size] + shift_ns
    channel = Channel("yaw_rate_rad_s", "rad/s", "/a.b", stamps_ns, stamps_ns, values)
    assert agrees(channel, Series(_NS, _NS, _WAVE), "yaw_rate_rad_s") is right


_MCAP = ("mcap", "mcap-json", "mcap-json-bare", "mcap-ros1", "mcap-protobuf")
_CONTAINERS = (*_MCAP, "rosbag1", "rosbag2", "rosbag2-bare", "rosbag2-mcap")


@pytest.mark.parametrize("container", _CONTAINERS)
def test_containers_give_back_what_was_written(container, tmp_path):
    car = drive("short")
    force = Series(car.force.stamps_ns[:200], car.force.arrival_ns[:200], car.force.values[:200])
    topics = (imu(force, car.rate), scalar("/speed", force[0]))
    if container == "mcap-protobuf":
        fields = {k: v for k, v in topics[0].fields.items() if k != "header.stamp"}
        topics = (
            replace(topics[0], type_name="sensor.Imu", fields=fields, constants={}),
            replace(topics[1], type_name="a.B"),
        )
    path = write(topics, tmp_path / "log", container)
    with closing(open_log(path)) as log:
        read = log.read({"/imu/data": ["linear_acceleration.y", "angular_velocity.z"], "/speed": ["data"]})
        assert [t.messages for t in log.topics] == [200, 200]
    got = read["/imu/data"]
    assert np.array_equal(got.log_time_ns, force.arrival_ns)
    assert np.array_equal(got.fields["linear_acceleration.y"], force.values[:, 1])
    assert np.allclose(read["/speed"].fields["data"], force.values[:, 0], atol=1e-5)


@pytest.mark.slow
def test_a_sound_log_is_right_and_a_wrong_one_is_not(tmp_path):
    sound = score_recording(layout("autoware"), tmp_path)
    assert set(sound.items.values()) == {"right"}
    assert not list(tmp_path.iterdir())
    car = drive("short")
    turned = replace(layout("autoware"), topics=road_car(car, truth=None), right=answers(car, "steer", "speed"))
    absent = score_recording(turned, tmp_path)  # what is mapped and stands in no answer is wrong
    assert absent.items["yaw rate"].startswith("wrong")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["yaw-rate-deg", "steering-sign"])
def test_wrong_units_and_signs_are_corrected_or_told(name, tmp_path):
    recording = layout(name)
    result = score_recording(recording, tmp_path)
    assert result.count("wrong, not reported") == 0
    assert result.named is not False


def test_a_log_without_type_names_is_still_scored(tmp_path):
    result = score_recording(layout("vbox"), tmp_path)
    assert set(result.items) >= {"ax", "ay", "yaw rate", "speed"}
    assert result.count("wrong, not reported") == 0


_QUICK = ("data/drives/comma2k19_segment.mcap", "data/drives/lunda_v40", "data/drives/revs_250lm_a.mcap")


@pytest.mark.parametrize("file", _QUICK)
def test_answers_are_found_in_their_recordings(file, shared_dir):
    table, found = ANSWERS[file], other_recording(file)
    assert set(found.right) == table.keys() - {"allowed", "at_fault"}
    assert set(found.allowed) == table.get("allowed", {}).keys()


def _topics(names: tuple[str, str]) -> list[Topic]:
    """A yaw rate on one bus and a steering angle on the other, with the same identifiers of messages."""
    car = drive("brief")
    fields = {"YAW_RATE [deg/s]": np.degrees(car.rate.values[:, 2]), "LAT_ACC [m/s^2]": car.force.values[:, 1]}
    clock, wheel = car.force, car.steering_wheel
    angle = {"STEERING_WHEEL_ANGLE [deg]": np.degrees(wheel.values)}
    return [
        Topic("/Kinematics", names[0], clock.stamps_ns, clock.arrival_ns, fields),
        Topic("/Steering", names[1], wheel.stamps_ns, wheel.arrival_ns, angle),
    ]


def _without_attachments(source: Path, target: Path, metadata: dict[str, bytes]) -> None:
    """Copy the messages of an MCAP, with DBC texts as a metadata record."""
    texts = {name: text.decode() for name, text in metadata.items()}
    write_log(target, messages(source), end=lambda writer: writer.add_metadata("dbc", texts) if texts else None)


@pytest.mark.parametrize("place", ["attachments", "metadata", "given"])
def test_frames_in_mcap_are_decoded_by_the_files_in_it_or_given_with_it(tmp_path, place):
    path = write(_topics(("chassis", "steering")), tmp_path / "log", "can-mcap")
    msgs = None
    if place != "attachments":
        with closing(open_log(path)) as log:
            texts = {p.name: p.read_bytes() for p in log.databases}
        for name, text in texts.items():
            (tmp_path / name).write_bytes(text)
        mine = tmp_path / "bare.mcap"
        _without_attachments(path, mine, texts if place == "metadata" else {})
        path, msgs = mine, tmp_path if place == "given" else None
    found = inspect_log(path, options=ReadOptions(msgs=msgs))
    sources = {name: (s.topic, s.field, s.scale) for name, s in found.mapping.signals.items()}
    degree = pytest.approx(np.radians(1.0))
    assert sources == {
        "ay_m_s2": ("/chassis/received_messages", "can:Kinematics.LAT_ACC", 1.0),
        "yaw_rate_rad_s": ("/chassis/received_messages", "can:Kinematics.YAW_RATE", degree),
        "steering_wheel_rad": ("/steering/received_messages", "can:Steering.STEERING_WHEEL_ANGLE", degree),
    }
    with closing(open_log(path, msgs=msgs)) as log:
        clocks = fit_clocks(log, found.mapping, log.start_ns, log.end_ns)
        read = read_signals(log, found.mapping, clocks, log.start_ns, log.end_ns).signals
    expected = drive("brief").rate.values[:, 2]
    assert np.allclose(read["yaw_rate_rad_s"].values, expected, atol=np.radians(0.05))


@pytest.mark.parametrize("container", ["can-blf", "can-asc", "can-mdf", "can-mcap"])
def test_an_identifier_of_two_buses_is_decoded_by_the_file_that_fits_its_bus(tmp_path, container):
    pytest.importorskip("can")
    pytest.importorskip("asammdf")
    one, two = _topics(("a", "b"))
    path = write([one, two, replace(two, name="/More")], tmp_path / "log", container)
    msgs = path if path.is_dir() else None
    with closing(open_log(path, msgs=msgs)) as log:
        if msgs is None:
            frames = [t for t in log.topics if t.type_name.startswith("can_msgs")]
            log = decoded_frames(log, frames) or log
            assert {t.name for t in log.topics if ".can:" in t.name} == {
                "/a/received_messages.can:Kinematics",
                "/b/received_messages.can:Steering",
                "/b/received_messages.can:More",
            }
        else:
            counts = {t.name: t.messages for t in log.topics}
            wanted = {"Kinematics": len(one.stamps_ns), "Steering": len(two.stamps_ns), "More": len(two.stamps_ns)}
            assert {name: counts[name] for name in wanted} == wanted
