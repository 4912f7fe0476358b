"""Writing: bytes against rosbags' serialiser, files against the readers of other projects."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from recorded import attribute, decoded_by_rosbags

from pdhef_logtool.logs.definitions import message_definition
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.wire_layout import CdrEncoder
from pdhef_logtool.logs.writer import McapLogWriter, TopicBatch
from pdhef_logtool.records.errors import OutputError

pytestmark = pytest.mark.slow

ESTIMATE = "pdhef_msgs/msg/VehicleStateEstimate"
T0 = 1_700_000_000_000_000_000

_floats = st.floats(allow_nan=True, allow_infinity=True, width=64)
_texts = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=9)
_stamps = st.integers(0, 2**31 * 10**9 - 1)
_settings = settings(
    max_examples=20, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def _store() -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.LATEST)
    store.register(get_types_from_msg(message_definition(ESTIMATE), ESTIMATE))
    return store


STORE = _store()


#: Fields of a type: the width of an array, 0 for a number, or the members of a vector.
FIELDS: dict[str, dict[str, int | str]] = {
    "nav_msgs/msg/Odometry": {
        "pose.pose.position": "xyz", "pose.pose.orientation": "wxyz", "pose.covariance": 36,
        "twist.twist.linear": "xyz", **{f"twist.twist.angular.{axis}": 0 for axis in "xyz"},
    },
    ESTIMATE: {
        **dict.fromkeys(("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2", "sideslip_std_rad"), 0),
        **dict.fromkeys(("network_trust", "r_scale", "nis", "friction", "mixture_weight"), 0), "covariance": 9,
    },
}  # fmt: skip


@pytest.mark.parametrize("name", FIELDS)
@_settings
@given(stamp=_stamps, frame=_texts, flags=st.tuples(*[st.booleans()] * 2), data=st.data())
def test_bytes_are_those_of_an_independent_serialiser(
    name: str, stamp: int, frame: str, flags: tuple[bool, bool], data: st.DataObject
) -> None:
    fields, constants = {"header.stamp": np.array([stamp])}, {"header.frame_id": frame}
    if name == ESTIMATE:
        fields |= {"valid": np.array(flags[:1]), "diverged": np.array(flags[1:])}
        fields["reason"] = np.array([data.draw(st.integers(0, 2**32 - 1))], dtype=np.uint32)
    else:
        constants["child_frame_id"] = data.draw(_texts)
    for path, shape in FIELDS[name].items():
        width = len(shape) if isinstance(shape, str) else shape
        fields[path] = data.draw(hnp.arrays(np.float64, (1, width) if width else 1, elements=_floats))
    encoded = CdrEncoder("/t", name, message_definition(name), constants).encode(1, fields).tobytes()
    message = STORE.deserialize_cdr(encoded, name)
    assert bytes(STORE.serialize_cdr(message, name, little_endian=True)) == encoded
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(stamp, 10**9)
    for path, text in constants.items():
        assert attribute(message, path) == text
    for path, values in fields.items():
        shape, part = FIELDS[name].get(path, 0), attribute(message, path)
        if path != "header.stamp":
            found = [getattr(part, axis) for axis in shape] if isinstance(shape, str) else part
            np.testing.assert_array_equal(np.ravel(found), values.ravel())


@st.composite
def _batches(draw: st.DrawFn) -> list[TopicBatch]:
    batches = []
    for topic in ("/a", "/b"):
        n = draw(st.integers(0, 30))
        steps = draw(st.lists(st.integers(0, 3), min_size=n, max_size=n))
        log_time = T0 + np.cumsum(np.array(steps, dtype=np.int64)) * 1_000_000
        values = draw(hnp.arrays(np.float64, (n, 3), elements=_floats))
        batches.append(
            TopicBatch(topic, log_time, log_time - 5, {"header.stamp": log_time - 7, "linear_acceleration": values})
        )
    return batches


@_settings
@given(batches=_batches())
def test_what_is_written_is_read_back_by_this_and_by_other_readers(tmp_path: Path, batches: list[TopicBatch]) -> None:
    from mcap.reader import make_reader

    path = tmp_path / "log.mcap"
    with McapLogWriter(path) as writer:
        for topic in ("/a", "/b"):
            writer.add_topic(topic, "sensor_msgs/msg/Imu", constants={"header.frame_id": topic})
        writer.write(batches)
    with closing(open_log(path)) as log:
        read = log.read({b.topic: ["header.stamp", "linear_acceleration"] for b in batches})
        theirs = decoded_by_rosbags([path])
        with path.open("rb") as file:
            raw = list(make_reader(file, validate_crcs=True).iter_messages())
        assert [m.log_time for _, _, m in raw] == sorted(m.log_time for _, _, m in raw)
        for batch in batches:
            columns, n = read[batch.topic], len(batch.log_time_ns)
            np.testing.assert_array_equal(columns.log_time_ns, batch.log_time_ns)
            np.testing.assert_array_equal(columns.publish_time_ns, batch.publish_time_ns)
            np.testing.assert_array_equal(columns.fields["header.stamp"], batch.fields["header.stamp"])
            written = batch.fields["linear_acceleration"]
            np.testing.assert_array_equal(columns.fields["linear_acceleration"].reshape(n, 3), written)
            decoded = [m.linear_acceleration for _, m in theirs.get(batch.topic, [])]
            np.testing.assert_array_equal(np.array([[m.x, m.y, m.z] for m in decoded]).reshape(n, 3), written)
            of_topic = [m for _, c, m in raw if c.topic == batch.topic]
            assert [m.sequence for m in of_topic] == list(range(n))
            assert [m.publish_time for m in of_topic] == batch.publish_time_ns.tolist()
        assert log.lost == ()


def test_a_place_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="a place to write to"):
        McapLogWriter(tmp_path / "file" / "log.mcap")
