"""Raw CAN in BLF with the DBC of a car: its signals are mapped on first contact, without a mapping file."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pdhef_logtool import inspect_log
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import fit_clocks, read_signals
from pdhef_logtool.mapping.can_frames import decoded_frames
from studies.strangers.cars import drive
from studies.strangers.containers import Topic, write
from tests.mcap_files import copied, mcap_writer


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
    with mcap_writer(target) as writer:
        list(copied(source, writer))
        if metadata:
            writer.add_metadata("dbc", {name: text.decode() for name, text in metadata.items()})


@pytest.mark.parametrize("place", ["attachments", "metadata", "given"])
def test_frames_in_mcap_are_decoded_by_the_files_in_it_or_given_with_it(tmp_path: Path, place: str) -> None:
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
def test_an_identifier_of_two_buses_is_decoded_by_the_file_that_fits_its_bus(tmp_path: Path, container: str) -> None:
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
