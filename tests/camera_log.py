"""MCAP logs with either sensors or camera images in each chunk."""

import random
from collections.abc import Iterable, Iterator
from pathlib import Path

from mcap.reader import make_reader

from pdhef_logtool.logs.container import ChannelRecord, RawMessage, block_of
from pdhef_logtool.logs.writer import McapLogWriter

_SLICE_NS = 20_000_000_000
_IMAGE_BYTES, _IMAGE_NS = 20_000, 200_000_000
_CAMERA = ("sensor_msgs/msg/CompressedImage", "ros2msg", b"uint8[] data")

#: Name, encoding and text of a message's definition.
Definition = tuple[str, str, bytes]
#: Topic, definition, log time and CDR bytes.
Message = tuple[str, Definition, int, bytes]


def write_apart(path: Path, chunks: Iterable[list[Message]]) -> None:
    """Write an MCAP with just these chunks."""
    with McapLogWriter(path) as writer:
        ids: dict[str, int] = {}
        for chunk in chunks:
            for topic, (name, encoding, text), *_ in chunk:
                if topic not in ids:
                    ids[topic] = writer.add_channel(ChannelRecord(-1, topic, "cdr", name, encoding, text))
            writer.write([], [block_of(RawMessage(ids[topic], at, at, 0, data) for topic, _, at, data in chunk)])


def with_camera(source: Path, slice_ns: int = _SLICE_NS) -> Iterator[list[Message]]:
    """Yield the messages of a log in chunks of 20 s (or other slices), and after each as long a chunk of images."""
    noise = random.Random(1)
    sensors: list[Message] = []

    def images(start_ns: int) -> list[Message]:
        head = b"\0\1\0\0" + _IMAGE_BYTES.to_bytes(4, "little")
        stamps = range(start_ns, start_ns + slice_ns, _IMAGE_NS)
        return [("/camera", _CAMERA, at, head + noise.randbytes(_IMAGE_BYTES)) for at in stamps]

    with source.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if sensors and message.log_time - sensors[0][2] >= slice_ns:
                yield sensors
                yield images(sensors[0][2])
                sensors = []
            definition = (schema.name, schema.encoding, schema.data)
            sensors.append((channel.topic, definition, message.log_time, message.data))
    yield sensors
