"""Frames and joints as recorders leave them: texts and lists of structs of real messages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping.frames import placement_of
from pdhef_logtool.mapping.joints import joint_names

START = 1_700_000_000_000_000_000


def write(path: Path, *, ros1: bool) -> Path:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage"))
    types: Any = store.types
    time = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)

    def header(frame: str) -> Any:
        more = {"seq": 0} if ros1 else {}
        return types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **more)

    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    place = types["geometry_msgs/msg/Transform"](
        translation=vector(x=0.3, y=-0.1, z=0.5), rotation=quaternion(x=1.0, y=0.0, z=0.0, w=0.0)
    )
    step = types["geometry_msgs/msg/TransformStamped"](
        header=header("base_link"), child_frame_id="imu_link", transform=place
    )
    nine = np.zeros(9)
    rest = quaternion(x=0.0, y=0.0, z=0.0, w=1.0)
    zero = vector(x=0.0, y=0.0, z=9.8)
    imu = types["sensor_msgs/msg/Imu"](
        header=header("imu_link"), orientation=rest, orientation_covariance=nine, angular_velocity=zero,
        angular_velocity_covariance=nine, linear_acceleration=zero, linear_acceleration_covariance=nine,
    )  # fmt: skip
    values = np.array([0.1, 0.2])
    joints = types["sensor_msgs/msg/JointState"](
        header=header(""), name=["left_steer", "right_steer"], position=values, velocity=values, effort=values
    )
    messages = {
        "/tf_static": ("tf2_msgs/msg/TFMessage", types["tf2_msgs/msg/TFMessage"](transforms=[step])),
        "/imu/data": ("sensor_msgs/msg/Imu", imu),
        "/joint_states": ("sensor_msgs/msg/JointState", joints),
    }
    with Writer1(path) if ros1 else Writer2(path, version=8) as writer:
        for topic, (name, message) in messages.items():
            connection = writer.add_connection(topic, name, typestore=store)
            data = store.serialize_ros1(message, name) if ros1 else store.serialize_cdr(message, name)
            for i in range(3):
                writer.write(connection, START + i * 10_000_000, data)
    return path


@pytest.mark.parametrize("name", ["log.bag", "log"])
def test_frames_and_joints_of_real_messages(tmp_path: Path, name: str) -> None:
    log = open_log(write(tmp_path / name, ros1=name.endswith(".bag")))
    placed = placement_of(log, "/imu/data")
    assert placed is not None
    assert (placed.frame, placed.base) == ("imu_link", "base_link")
    np.testing.assert_allclose(placed.rotation, np.diag([1.0, -1.0, -1.0]), atol=1e-12)
    (topic,) = (t for t in log.topics if t.name == "/joint_states")
    assert joint_names(log, topic) == ("left_steer", "right_steer")
    log.close()
