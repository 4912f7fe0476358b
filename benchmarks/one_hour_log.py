"""The logs that the speed benchmarks read: an hour of a simulated road drive, 1.69 M messages of eight topics.

The log with images is shorter (an hour would be 9 GB) and has /image (sensor_msgs/msg/Image) with 150 MB a minute of
noise, which nobody maps, in chunks that images and sensors share, as recorders write them. Its memory is compared with
a log of the same length without images.
"""

import heapq
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType

from benchmarks.measuring import CACHE, ROOT
from pdhef_logtool.logs.definitions import message_definition
from studies.mcap_logs import Message, messages, write_log

HOUR_S, SHARED_S, IMAGE_LOG_S = 3600, 60, 360
IMAGE_HZ, IMAGE_BYTES = 5, 500_000
_IMAGE = "sensor_msgs/msg/Image"
#: Fields of a mapped run: eleven of five topics.
MAPPED = {
    "/imu/data": ("linear_acceleration.x", "linear_acceleration.y", "angular_velocity.z"),
    "/rtk/odometry": ("twist.twist.linear.x", "twist.twist.linear.y"),
    "/rtk/quality": ("position_std_m",),
    "/vehicle/status/steering_status": ("steering_tire_angle",),
    "/vehicle/wheel_speeds": ("fl_m_s", "fr_m_s", "rl_m_s", "rr_m_s"),
}


def drive_log(seconds: int = HOUR_S) -> Path:
    """Return the log of a drive, simulated once."""
    path = CACHE / f"drive_{seconds}_s.mcap"
    if not path.exists():
        CACHE.mkdir(parents=True, exist_ok=True)
        command = [sys.executable, "-m", "pdhef_logtool", "simulate", "road", "--duration", str(seconds), "--seed", "1"]
        subprocess.run([*command, "-o", str(path)], cwd=ROOT, check=True, capture_output=True)
    return path


def image_log(seconds: int = IMAGE_LOG_S) -> Path:
    """Return the same with images, written once; chunks contain images and all other topics."""
    path = CACHE / f"drive_{seconds}_s_with_images.mcap"
    if not path.exists():
        merged = heapq.merge(messages(drive_log(seconds)), _images(drive_log(seconds), seconds), key=lambda m: m[0])
        write_log(path, merged, "ros2", chunk_size=4 << 20, compression=CompressionType.ZSTD)
    return path


def _images(log: Path, seconds: int) -> Iterator[Message]:
    """Yield mono8 images of noise."""
    rng, start_ns = np.random.default_rng(0), next(messages(log)).log_time_ns
    schema = (_IMAGE, "ros2msg", message_definition(_IMAGE).encode())
    width = 1000
    height = IMAGE_BYTES // width
    for i in range(seconds * IMAGE_HZ):
        stamp = start_ns + i * 10**9 // IMAGE_HZ
        # CDR: stamp, frame_id "camera" with its padding, height, width, encoding, is_bigendian, step, data.
        head = b"\0\1\0\0" + np.array([stamp // 10**9, stamp % 10**9, 7], "<u4").tobytes() + b"camera\0\0"
        head += np.array([height, width, 6], "<u4").tobytes() + b"mono8\0\0\0"
        head += np.array([width, width * height], "<u4").tobytes()
        yield Message(stamp + 2_000_000, stamp, "/image", head + rng.bytes(width * height), "cdr", schema)
