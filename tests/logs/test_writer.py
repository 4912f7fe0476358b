"""Writing: bytes against rosbags' serialiser, files against the readers of other projects."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from recorded import decoded_by_rosbags

from pdhef_logtool.logs.encoding import CdrEncoder
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.logs.schema_files import message_definition
from pdhef_logtool.logs.writer import McapLogWriter, TopicBatch
from pdhef_logtool.records.errors import MappingError, OutputError

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


def _message(type_name: str, **members: Any) -> Any:
    return STORE.types[type_name](**members)


def _header(stamp: int, frame: str) -> Any:
    time = _message("builtin_interfaces/msg/Time", sec=stamp // 10**9, nanosec=stamp % 10**9)
    return _message("std_msgs/msg/Header", stamp=time, frame_id=frame)


def _vector(values: Any, type_name: str = "geometry_msgs/msg/Vector3") -> Any:
    return _message(type_name, x=float(values[0]), y=float(values[1]), z=float(values[2]))


def _quaternion(wxyz: Any) -> Any:
    w, x, y, z = (float(v) for v in wxyz)
    return _message("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _encoded(type_name: str, fields: dict[str, np.ndarray], constants: dict[str, Any]) -> bytes:
    encoder = CdrEncoder("/t", type_name, message_definition(type_name), constants)
    return encoder.encode(1, fields).tobytes()


def _serialised(message: Any, type_name: str) -> bytes:
    return bytes(STORE.serialize_cdr(message, type_name, little_endian=True))


@_settings
@given(
    stamp=_stamps,
    frame=_texts,
    child=_texts,
    values=hnp.arrays(np.float64, 13, elements=_floats),
    covariance=hnp.arrays(np.float64, 36, elements=_floats),
)
def test_odometry_bytes_equal_an_independent_serialiser(
    stamp: int, frame: str, child: str, values: np.ndarray, covariance: np.ndarray
) -> None:
    name = "nav_msgs/msg/Odometry"
    pose = _message(
        "geometry_msgs/msg/Pose",
        position=_vector(values[:3], "geometry_msgs/msg/Point"),
        orientation=_quaternion(values[3:7]),
    )
    twist = _message("geometry_msgs/msg/Twist", linear=_vector(values[7:10]), angular=_vector(values[10:13]))
    message = _message(
        name,
        header=_header(stamp, frame),
        child_frame_id=child,
        pose=_message("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance),
        twist=_message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )
    fields = {
        "header.stamp": np.array([stamp]),
        "pose.pose.position": values[None, :3],
        "pose.pose.orientation": values[None, 3:7],
        "pose.covariance": covariance[None, :],
        "twist.twist.linear": values[None, 7:10],
        "twist.twist.angular.x": values[10:11],
        "twist.twist.angular.y": values[11:12],
        "twist.twist.angular.z": values[12:13],
    }
    constants = {"header.frame_id": frame, "child_frame_id": child}
    assert _encoded(name, fields, constants) == _serialised(message, name)


@_settings
@given(
    stamp=_stamps,
    frame=_texts,
    values=hnp.arrays(np.float64, 20, elements=_floats),
    flags=st.tuples(*[st.booleans()] * 2),
    reason=st.integers(0, 2**32 - 1),
)
def test_own_message_bytes_equal_an_independent_serialiser(
    stamp: int, frame: str, values: np.ndarray, flags: tuple[bool, bool], reason: int
) -> None:
    names = [
        *("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2"),
        *("sideslip_std_rad", "network_trust", "r_scale", "nis", "friction", "mixture_weight"),
    ]
    scalars = dict(zip(names, values[:11].tolist(), strict=True))
    message = _message(
        ESTIMATE,
        header=_header(stamp, frame),
        **scalars,
        covariance=values[11:],
        valid=flags[0],
        diverged=flags[1],
        reason=reason,
    )
    fields: dict[str, np.ndarray] = {
        "header.stamp": np.array([stamp]),
        **{name: np.array([v]) for name, v in scalars.items()},
        "covariance": values[None, 11:],
        "valid": np.array([flags[0]]),
        "diverged": np.array([flags[1]]),
        "reason": np.array([reason], dtype=np.uint32),
    }
    assert _encoded(ESTIMATE, fields, {"header.frame_id": frame}) == _serialised(message, ESTIMATE)


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
    log = open_log(path)
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
    log.close()


def test_an_exception_leaves_nothing_behind(tmp_path: Path) -> None:
    def interrupted() -> None:
        with McapLogWriter(tmp_path / "log.mcap") as writer:
            writer.add_topic("/imu", "sensor_msgs/msg/Imu")
            raise RuntimeError("stop")

    with pytest.raises(RuntimeError, match="stop"):
        interrupted()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("fields", "problem"),
    [
        ({"angular_velocity.q": np.zeros(3)}, "angular_velocity.q"),
        ({"angular_velocity.z": np.zeros(2)}, "3 rows"),
        ({"angular_velocity": np.zeros((3, 2))}, r"\[N, 3\]"),
        ({"orientation_covariance": np.zeros((3, 8))}, r"\[N, 9\]"),
        ({"header.stamp": np.zeros(3)}, "int64 nanoseconds"),
        ({"header.frame_id": np.zeros(3)}, "frame_id"),
    ],
)
def test_columns_that_do_not_fit_are_named(fields: dict[str, np.ndarray], problem: str) -> None:
    encoder = CdrEncoder("/imu", "sensor_msgs/msg/Imu", message_definition("sensor_msgs/msg/Imu"), {})
    with pytest.raises(MappingError, match=problem):
        encoder.encode(3, fields)


def test_errors_of_use_are_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="a place to write to"):
        McapLogWriter(tmp_path / "file" / "log.mcap")
    with McapLogWriter(tmp_path / "log.mcap") as writer:
        with pytest.raises(MappingError, match="no_such/msg/Type"):
            writer.add_topic("/x", "no_such/msg/Type")
        with pytest.raises(MappingError, match="frame_idd"):
            writer.add_topic("/x", "sensor_msgs/msg/Imu", constants={"header.frame_idd": "a"})
        writer.add_topic("/imu", "sensor_msgs/msg/Imu")
        with pytest.raises(MappingError, match="ascending"):
            writer.write([TopicBatch("/imu", np.array([T0 + 1, T0]), np.array([T0, T0]), {})])
        with pytest.raises(MappingError, match="unknown"):
            writer.write([TopicBatch("/other", np.array([T0]), np.array([T0]), {})])
