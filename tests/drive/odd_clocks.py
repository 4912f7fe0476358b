"""Copies of a simulated log with other log times and header stamps, as recorders with odd clocks leave them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

S = 1_000_000_000

#: Nanoseconds to add: of the number of the message on its topic, the seconds since the log's start, and the topic.
Shift = Callable[[int, float, str], int]


def rewrite(
    source: Path, target: Path, log_shift: Shift, stamp_shift: Shift | None = None, chunk: int = 1 << 20
) -> None:
    """Copy an MCAP in order of log time, with log times moved, and header stamps (None: as the log times are)."""
    with source.open("rb") as old, target.open("wb") as new:
        reader, writer = make_reader(old), Writer(new, chunk_size=chunk, compression=CompressionType.LZ4)
        writer.start(profile="ros2")
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        numbers: dict[str, int] = {}
        start = None
        for schema, channel, message in reader.iter_messages(log_time_order=True):
            assert schema is not None
            if channel.id not in channels:
                if schema.id not in schemas:
                    schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            start = message.log_time if start is None else start
            number = numbers[channel.topic] = numbers.get(channel.topic, -1) + 1
            at = (number, (message.log_time - start) * 1e-9, channel.topic)
            by = log_shift(*at)
            data = bytearray(message.data)
            stamp = int.from_bytes(data[4:8], "little") * S + int.from_bytes(data[8:12], "little")
            if abs(stamp - message.log_time) < 10 * S:  # behind the encapsulation: a stamp, bare or of a header
                stamp += by if stamp_shift is None else stamp_shift(*at)
                data[4:12] = (stamp // S).to_bytes(4, "little") + (stamp % S).to_bytes(4, "little")
            log_time = min(max(message.log_time + by, 0), 2**64 - 1)
            writer.add_message(channels[channel.id], log_time, bytes(data), log_time, message.sequence)
        writer.finish()
