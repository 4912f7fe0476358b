"""MCAP files that the mcap library writes."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.writer import Writer


@contextmanager
def mcap_writer(path: Path, *, profile: str = "", library: str = "test", **options: Any) -> Iterator[Writer]:
    """Return a started writer, and finish the file at the end."""
    with path.open("wb") as stream:
        writer = Writer(stream, **options)
        writer.start(profile=profile, library=library)
        yield writer
        writer.finish()


def copied(source: Path, writer: Writer, keep: Callable[[Channel], bool] = lambda _: True) -> Iterator[Message]:
    """Copy the messages of an MCAP (default: all channels), and yield each one that was written."""
    channels: dict[int, int] = {}
    with source.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            if keep(channel):
                if channel.id not in channels:
                    id_ = 0 if schema is None else writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, id_)
                writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
                yield message
