"""MCAP logs message by message: copied with other chunks, other times or further topics."""

import struct
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from mcap.reader import make_reader
from mcap.writer import Writer

from pdhef_logtool.storage.files import PendingFile


class Message(NamedTuple):
    """A message with its topic, its encoding, and name, encoding and text of its schema."""

    log_time_ns: int
    publish_time_ns: int
    topic: str
    data: bytes
    encoding: str
    schema: tuple[str, str, bytes]


def stamp_ns(message: Message) -> int:
    """Return the stamp with which a message in CDR begins, bare or of a header."""
    seconds, nanoseconds = struct.unpack_from("<II", message.data, 4)
    return int(seconds * 10**9 + nanoseconds)


def stamped(message: Message, at_ns: int) -> Message:
    """Return a message in CDR with another stamp."""
    return message._replace(data=message.data[:4] + struct.pack("<II", *divmod(at_ns, 10**9)) + message.data[12:])


def messages(log: Path) -> Iterator[Message]:
    """Yield the messages of a log by log time."""
    with log.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            named = ("", "", b"") if schema is None else (schema.name, schema.encoding, schema.data)
            times = message.log_time, message.publish_time
            yield Message(*times, channel.topic, message.data, channel.message_encoding, named)


def write_log(
    path: Path,
    written: Iterable[Message],
    profile: str = "",
    end: Callable[[Writer], object] = lambda _: None,
    **options: Any,
) -> Path:
    """Write messages in their order; ``end`` may write more; ``options`` of ``mcap.writer.Writer``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with PendingFile(path) as pending:
        writer = Writer(str(pending.path), **options)
        writer.start(profile)
        channels: dict[str, int] = {}
        for i, m in enumerate(written):
            if m.topic not in channels:
                schema = writer.register_schema(*m.schema) if m.schema[0] else 0
                channels[m.topic] = writer.register_channel(m.topic, m.encoding, schema)
            writer.add_message(channels[m.topic], m.log_time_ns, m.data, m.publish_time_ns, i)
        end(writer)
        writer.finish()  # type: ignore[no-untyped-call]  # mcap leaves it without types
    return path
