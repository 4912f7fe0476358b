"""A small MCAP with everything that a full copy must keep, written by the mcap library."""

import json
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType
from rosbags.typesys import Stores, get_typestore

from tests.mcap_files import mcap_writer

START_NS = 1_700_000_000_000_000_123
IMU = "sensor_msgs/msg/Imu"


def write_source(path: Path, seconds: float = 6.0) -> None:
    """Write IMU at 100 Hz (CDR), speed at 20 Hz (JSON), bytes at 1 Hz (no schema), attachments and metadata."""
    store = get_typestore(Stores.ROS2_HUMBLE)
    definition, _ = store.generate_msgdef(IMU, ros_version=2)
    with mcap_writer(
        path, profile="ros2", library="recorder 1.2", compression=CompressionType.LZ4, chunk_size=20_000
    ) as writer:
        imu_schema = writer.register_schema(IMU, "ros2msg", definition.encode())
        speed_schema = writer.register_schema("can.Speed", "jsonschema", b'{"type": "object"}')
        imu = writer.register_channel("/imu", "cdr", imu_schema, {"offered_qos_profiles": "- depth: 10"})
        speed = writer.register_channel("/can/speed", "json", speed_schema, {"bus": "2"})
        blob = writer.register_channel("/blob", "octets", 0)
        writer.add_attachment(START_NS - 5, START_NS - 9, "calibration.txt", "text/plain", b"gain 1.02\n")
        writer.add_attachment(START_NS - 4, START_NS - 8, "report.json", "application/json", b'{"by": "someone else"}')
        writer.add_metadata("recorder", {"car": "blue", "driver": "A"})
        for i in range(round(seconds * 100)):
            stamp = START_NS + 10_000_000 * i
            writer.add_message(imu, stamp + 2_000_000, _imu(store, stamp, i), stamp, sequence=3 * i + 1)
            if i % 5 == 0:
                text = json.dumps({"v": 10.0 + i, "t": i}).encode()
                writer.add_message(speed, stamp + 4_000_000, text, stamp + 1, sequence=i)
            if i % 100 == 50:
                writer.add_message(blob, stamp + 5_000_000, bytes([i % 256, 0, 255]), stamp, sequence=7)


def _imu(store, stamp_ns: int, i: int) -> bytes:
    types = store.types
    vector, quaternion = types["geometry_msgs/msg/Vector3"], types["geometry_msgs/msg/Quaternion"]
    header = types["std_msgs/msg/Header"](
        types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9), "imu_link"
    )
    zero = np.zeros(9)
    message = types[IMU](header, quaternion(0.0, 0.0, 0.0, 1.0), zero, vector(0.0, 0.0, 0.25), zero,
                         vector(0.1, 2.5, 9.81 + i), zero)  # fmt: skip
    return bytes(store.serialize_cdr(message, IMU))
