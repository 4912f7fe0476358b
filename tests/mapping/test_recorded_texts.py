"""Joints as recorders leave them: texts of real messages."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping.joints import joint_names

START = 1_700_000_000_000_000_000


def write(path: Path, *, ros1: bool) -> Path:
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    types: Any = store.types
    time = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)

    header = types["std_msgs/msg/Header"](stamp=time, frame_id="", **({"seq": 0} if ros1 else {}))
    values = np.array([0.1, 0.2])
    joints = types["sensor_msgs/msg/JointState"](
        header=header, name=["left_steer", "right_steer"], position=values, velocity=values, effort=values
    )
    with Writer1(path) if ros1 else Writer2(path, version=8) as writer:
        name = "sensor_msgs/msg/JointState"
        connection = writer.add_connection("/joint_states", name, typestore=store)
        data = store.serialize_ros1(joints, name) if ros1 else store.serialize_cdr(joints, name)
        for i in range(3):
            writer.write(connection, START + i * 10_000_000, data)
    return path


@pytest.mark.parametrize("name", ["log.bag", "log"])
def test_joints_of_real_messages(tmp_path: Path, name: str) -> None:
    log = open_log(write(tmp_path / name, ros1=name.endswith(".bag")))
    (topic,) = (t for t in log.topics if t.name == "/joint_states")
    assert joint_names(log, topic) == ("left_steer", "right_steer")
    log.close()
