"""Writing 4 x 360 k estimates: an hour at 100 Hz of two estimators, each as our message and as Odometry.

The peer serialises a tenth of them with rosbags and writes them with mcap's Writer (scaled by 10); its messages are
built before the measurement. Both write zstd chunks with CRCs, message indexes and a summary, and the first messages of
both files are compared.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.measuring import CACHE, Row, best_seconds
from pdhef_logtool.logs.schema_files import message_definition
from pdhef_logtool.logs.writer import McapLogWriter, TopicBatch
from pdhef_logtool.records.geometry import quat_from_yaw
from pdhef_logtool.records.signals import FloatArray, IntArray
from pdhef_logtool.results.mcap_sink import BODY_FRAME, MAP_FRAME, ODOMETRY_TYPE, STATE_TYPE, topic_of

START_NS = 1_700_000_000_000_000_000
STAMPS = 360_000
ESTIMATORS = ("pd-hef", "phy-ukf")
_SLICE = 10
_WINDOW = 6_000
_STATE_FIELDS = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "ay_m_s2", "sideslip_std_rad", "nis")


def _columns() -> tuple[IntArray, FloatArray, FloatArray]:
    """Return stamps, seven values and nine covariances a stamp."""
    rng = np.random.default_rng(0)
    stamps_ns = START_NS + np.arange(STAMPS, dtype=np.int64) * 10_000_000
    t = np.arange(STAMPS) * 0.01
    smooth = np.sin(np.outer(t, [0.02, 0.3, 0.4, 0.3, 0.4, 0.01, 0.5]))
    return stamps_ns, smooth + 0.01 * rng.standard_normal((STAMPS, 7)), rng.standard_normal((STAMPS, 9))


def write_ours(stamps_ns: IntArray, values: FloatArray, covariance: FloatArray) -> None:
    """Write all estimates with our writer in windows of a minute."""
    with McapLogWriter(CACHE / "estimates.mcap", level=3) as writer:  # as a run does
        for estimator in ESTIMATORS:
            writer.add_topic(topic_of(estimator, "state"), STATE_TYPE, constants={"header.frame_id": BODY_FRAME})
            frames = {"header.frame_id": MAP_FRAME, "child_frame_id": BODY_FRAME}
            writer.add_topic(topic_of(estimator, "odometry"), ODOMETRY_TYPE, constants=frames)
        for first in range(0, len(stamps_ns), _WINDOW):
            rows = slice(first, first + _WINDOW)
            stamps, v, p = stamps_ns[rows], values[rows], covariance[rows]
            state = {name: v[:, i] for i, name in enumerate(_STATE_FIELDS)}
            odometry = {
                "pose.pose.position": v[:, :3],
                "pose.pose.orientation": quat_from_yaw(v[:, 3]),
                "twist.twist.linear": v[:, 3:6],
            }
            batches = []
            for estimator in ESTIMATORS:
                fields = {"header.stamp": stamps, "covariance": p, **state}
                batches.append(TopicBatch(topic_of(estimator, "state"), stamps, stamps, fields))
                fields = {"header.stamp": stamps, **odometry}
                batches.append(TopicBatch(topic_of(estimator, "odometry"), stamps, stamps, fields))
            writer.write(batches)


def _store() -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.LATEST)
    store.register(get_types_from_msg(message_definition(STATE_TYPE), STATE_TYPE))
    return store


def _peer_messages(
    store: Any, stamps_ns: IntArray, values: FloatArray, covariance: FloatArray
) -> list[tuple[Any, Any]]:
    """Build a state and an odometry message a stamp."""
    types = store.types
    header, time = types["std_msgs/msg/Header"], types["builtin_interfaces/msg/Time"]
    vector, point = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Point"]
    quaternion, zero = types["geometry_msgs/msg/Quaternion"], np.zeros(36)
    posed, moved = types["geometry_msgs/msg/PoseWithCovariance"], types["geometry_msgs/msg/TwistWithCovariance"]
    pose, twist = types["geometry_msgs/msg/Pose"], types["geometry_msgs/msg/Twist"]
    quats = quat_from_yaw(values[:, 3]).tolist()
    made = []
    for stamp, v, (w, x, y, z), p in zip(stamps_ns.tolist(), values.tolist(), quats, covariance, strict=True):
        time_of_stamp = time(sec=stamp // 10**9, nanosec=stamp % 10**9)
        state = types[STATE_TYPE](
            header=header(stamp=time_of_stamp, frame_id=BODY_FRAME),
            covariance=p,
            network_trust=0.0,
            r_scale=0.0,
            friction=0.0,
            valid=False,
            diverged=False,
            mixture_weight=0.0,
            reason=0,
            **dict(zip(_STATE_FIELDS, v, strict=True)),
        )
        odometry = types[ODOMETRY_TYPE](
            header=header(stamp=time_of_stamp, frame_id=MAP_FRAME),
            child_frame_id=BODY_FRAME,
            pose=posed(pose=pose(position=point(*v[:3]), orientation=quaternion(x=x, y=y, z=z, w=w)), covariance=zero),
            twist=moved(twist=twist(linear=vector(*v[3:6]), angular=vector(0.0, 0.0, 0.0)), covariance=zero),
        )
        made.append((state, odometry))
    return made


def write_with_peers(store: Any, stamps_ns: IntArray, messages: list[tuple[Any, Any]]) -> None:
    """Serialise with rosbags and write with mcap, each message for two estimators."""
    from mcap.writer import Writer

    with (CACHE / "estimates_peer.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="peer")
        schemas = [
            writer.register_schema(t, "ros2msg", message_definition(t).encode()) for t in (STATE_TYPE, ODOMETRY_TYPE)
        ]
        channels = [
            (writer.register_channel(topic_of(name, "state"), "cdr", schemas[0]),
             writer.register_channel(topic_of(name, "odometry"), "cdr", schemas[1]))
            for name in ESTIMATORS
        ]  # fmt: skip
        for i, (stamp, (state, odometry)) in enumerate(zip(stamps_ns.tolist(), messages, strict=True)):
            for state_channel, odometry_channel in channels:
                data = bytes(store.serialize_cdr(state, STATE_TYPE))
                writer.add_message(state_channel, stamp, data, stamp, i)
                data = bytes(store.serialize_cdr(odometry, ODOMETRY_TYPE))
                writer.add_message(odometry_channel, stamp, data, stamp, i)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it without types


def _check_equal() -> None:
    """Compare the first messages of both files."""
    from itertools import islice

    from mcap.reader import make_reader

    messages = []
    for name in ("estimates.mcap", "estimates_peer.mcap"):
        with (CACHE / name).open("rb") as file:
            first = [(c.topic, m.log_time, m.data) for _, c, m in islice(make_reader(file).iter_messages(), 400)]
        messages.append(sorted(first))
    if messages[0] != messages[1]:
        raise SystemExit("the two ways wrote different messages")


def rows() -> list[Row]:
    """Measure."""
    CACHE.mkdir(parents=True, exist_ok=True)
    stamps_ns, values, covariance = _columns()
    part = slice(0, STAMPS // _SLICE)
    store = _store()
    messages = _peer_messages(store, stamps_ns[part], values[part], covariance[part])
    ways = {
        "ours": lambda: write_ours(stamps_ns, values, covariance),
        "peer": lambda: write_with_peers(store, stamps_ns[part], messages),
    }
    seconds = best_seconds(ways)
    _check_equal()
    peer = _SLICE * seconds["peer"]
    ratio = peer / seconds["ours"]
    return [
        Row("write 4 x 360 k estimates", seconds["ours"], "s"),
        Row("mcap Writer with rosbags' serialiser / ours", ratio, "x", 8.0, "at least"),
    ]
