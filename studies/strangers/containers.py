"""Topics as columns into the containers and encodings that recorders leave."""

import json
import re
import shutil
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache, partial
from itertools import chain
from pathlib import Path
from typing import Any

from mcap.records import Attachment

from pdhef_logtool.logs.container import ChannelRecord, RawMessage, block_of
from pdhef_logtool.logs.drive_log import Columns
from pdhef_logtool.logs.writer import McapLogWriter
from studies.mcap_logs import Message, messages, write_log
from studies.pages import paragraphs
from studies.strangers import buses, tables
from studies.strangers.cars import Topic as Topic


@lru_cache(maxsize=2)
def _store(ros1: bool) -> Any:
    """Return the types of a distribution, extended by ``shapes.txt``."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    for name, text in shapes().items():
        store.register(get_types_from_msg(text, name))
    return store


@lru_cache(maxsize=1)
def shapes() -> dict[str, str]:
    """Return the definition, with comments, of every type in ``shapes.txt``."""
    types = paragraphs(Path(__file__).with_name("shapes.txt"))
    return {name: "".join(_lines(*line.partition("#")) for line in lines) for name, *lines in types}


def _lines(code: str, sign: str, comment: str) -> str:
    """Return the lines of a definition for a line of ``shapes.txt``: one for each field, or a comment."""
    kind, *names = code.split() or [""]
    return "".join(f"{kind} {name} {sign}{comment}".strip() + "\n" for name in names or [""])


def definition(type_name: str, *, ros1: bool = False) -> str:
    """Return the full text of a type as ROS 1 or ROS 2 has it, with all types in it and their comments."""
    text: str = _store(ros1).generate_msgdef(type_name, ros_version=1 if ros1 else 2)[0]
    sign = f"{'=' * 80}\nMSG: "
    first, *others = text.split(sign)
    named = (other.partition("\n") for other in others)
    parts = [f"{name}\n" + _commented(name.replace("/", "/msg/"), lines) for name, _, lines in named]
    return sign.join([_commented(type_name, first), *parts])


_FIELD = re.compile(r"((?:^#.*\n)*)^[^#\s]\S* (\S+)(.*)\n", re.MULTILINE)


def _commented(type_name: str, lines: str) -> str:
    """Return the fields of a type with the comments that its shape has above and beside them."""
    for above, name, beside in _FIELD.findall(shapes().get(type_name, "")):
        lines = re.sub(rf"(?m)^\S+ {name}$", rf"{above}\g<0>{beside}", lines)
    return lines


def write(topics: Sequence[Topic], path: Path, container: str) -> Path:
    """Write a log and return its path with the container's suffix.

    Parameters
    ----------
    container : ``mcap``, ``mcap-json`` (with schemas), ``mcap-json-bare`` (without), ``mcap-protobuf``, ``mcap-ros1``,
        ``rosbag1``, ``rosbag2`` (sqlite3), ``rosbag2-bare`` (without message definitions, as up to Humble),
        ``rosbag2-mcap``, or one of the files of ``tables.py``.
    """
    if container in tables.WRITERS:
        suffix, put = tables.WRITERS[container]
        put(path.with_suffix(suffix), topics)
        return path.with_suffix(suffix)
    return _WRITERS[container](topics, path)


# ------------------------------------------------------------------------------------------------ ROS


def write_mcap(topics: Sequence[Topic], path: Path, attachments: Iterable[Attachment] = ()) -> Path:
    """Write topics as ROS 2 messages in MCAP; return the path."""
    path = path.with_suffix(".mcap")
    with McapLogWriter(path) as writer:
        joints = [t for t in topics if t.type_name == "sensor_msgs/msg/JointState"]
        for topic in topics:
            if topic not in joints:
                text = definition(topic.type_name)
                writer.add_topic(topic.name, topic.type_name, constants=topic.constants, definition=text)
        for attachment in attachments:
            writer.attachment(attachment)
        raws = [message for topic in joints for message in _joints(writer, topic)]
        batches = [Columns(t.name, t.arrival_ns, t.stamps_ns, t.fields) for t in topics if t not in joints]
        writer.write(batches, [block_of(raws)])
    return path


def _joints(writer: McapLogWriter, topic: Topic) -> Iterator[RawMessage]:
    """Yield the messages of joints, with an array of texts as names."""
    types, kind = _store(False).types, topic.type_name
    text = definition(kind).encode()
    channel = writer.add_channel(ChannelRecord(-1, topic.name, "cdr", kind, "ros2msg", text))
    names = str(topic.constants["name"]).split()
    columns = {name: topic.fields[name] for name in ("position", "velocity", "effort")}
    for i, (arrival, stamp) in enumerate(zip(topic.arrival_ns.tolist(), topic.stamps_ns.tolist(), strict=True)):
        time = types["builtin_interfaces/msg/Time"](sec=stamp // 10**9, nanosec=stamp % 10**9)
        header = types["std_msgs/msg/Header"](stamp=time, frame_id="")
        joints = types[kind](header=header, name=names, **{name: values[i] for name, values in columns.items()})
        yield RawMessage(channel, arrival, stamp, i, bytes(_store(False).serialize_cdr(joints, kind)))


def _messages(topics: Sequence[Topic], path: Path, *, ros1: bool) -> Iterator[tuple[Topic, int, int, bytes]]:
    """Yield topic, arrival, stamp and the bytes of every message, in CDR or as ROS 1 has them, as they arrive."""
    by_name = {t.name: t for t in topics}
    scratch = write_mcap(topics, path.with_name(f".{path.stem}-scratch"))
    store = _store(False)
    try:
        for m in messages(scratch):
            topic = by_name[m.topic]
            data = bytes(store.cdr_to_ros1(m.data, topic.type_name)) if ros1 else m.data
            yield topic, m.log_time_ns, m.publish_time_ns, data
    finally:
        scratch.unlink()


def copied(topics: Sequence[Topic], path: Path, writer: Any, *, ros1: bool) -> Path:
    """Write the messages of topics with a writer of rosbags; return the path."""
    store = _store(ros1)

    def described(name: str) -> dict[str, str]:
        digest = {"md5sum": store.generate_msgdef(name)[1]} if ros1 else {"rihs01": store.hash_rihs01(name)}
        return {"msgdef": definition(name, ros1=ros1), **digest}

    with writer:
        connections = {t.name: writer.add_connection(t.name, t.type_name, **described(t.type_name)) for t in topics}
        for topic, arrival, _, data in _messages(topics, path, ros1=ros1):
            writer.write(connections[topic.name], arrival, data)
    return path


def _rosbag1(topics: Sequence[Topic], path: Path) -> Path:
    from rosbags.rosbag1 import Writer

    path = path.with_suffix(".bag")
    return copied(topics, path, Writer(path), ros1=True)


def _mcap_ros1(topics: Sequence[Topic], path: Path) -> Path:
    texts = {t.name: definition(t.type_name, ros1=True).encode() for t in topics}
    encoded = (
        Message(arrival, stamp, t.name, data, "ros1", (t.type_name.replace("/msg/", "/"), "ros1msg", texts[t.name]))
        for t, arrival, stamp, data in _messages(topics, path, ros1=True)
    )
    return write_log(path.with_suffix(".mcap"), encoded, "ros1")


def _rosbag2(topics: Sequence[Topic], path: Path, plugin: str = "SQLITE3") -> Path:
    from rosbags.rosbag2 import StoragePlugin, Writer

    shutil.rmtree(path, ignore_errors=True)
    return copied(topics, path, Writer(path, version=9, storage_plugin=StoragePlugin[plugin]), ros1=False)


def _rosbag2_bare(topics: Sequence[Topic], path: Path) -> Path:
    path = _rosbag2(topics, path)
    for database in path.glob("*.db3"):
        with sqlite3.connect(database) as connection:
            connection.execute("DROP TABLE message_definitions")
            connection.execute("UPDATE schema SET schema_version = 3")
        connection.close()
    return path


# ------------------------------------------------------------------------------------------------ JSON, protobuf


def _rows(topic: Topic) -> Iterator[tuple[int, int, dict[str, Any]]]:
    """Yield arrival, stamp and the nested values of every message."""
    columns = {path: values.tolist() for path, values in topic.fields.items()}
    for i, (arrival, stamp) in enumerate(zip(topic.arrival_ns.tolist(), topic.stamps_ns.tolist(), strict=True)):
        row: dict[str, Any] = {}
        for path, value in topic.constants.items():
            tables.nested(row, path, value)
        for path, column in columns.items():
            tables.nested(row, path, column[i])
        yield arrival, stamp, row


def _json_schema(value: Any) -> dict[str, Any]:
    if isinstance(value, dict):
        return {"type": "object", "properties": {name: _json_schema(v) for name, v in value.items()}}
    if isinstance(value, list | tuple):
        return {"type": "array", "items": {"type": "number"}}
    return {"type": "string" if isinstance(value, str) else "number"}


def _json(topics: Sequence[Topic], path: Path, *, bare: bool = False) -> Path:
    def encoded(topic: Topic) -> Iterator[Message]:
        schema = "", "", b""
        for i, (arrival, stamp, row) in enumerate(_rows(topic)):
            if not bare and not i:
                schema = topic.type_name, "jsonschema", json.dumps(_json_schema(row)).encode()
            yield Message(arrival, stamp, topic.name, json.dumps(row).encode(), "json", schema)

    return _by_time(path, map(encoded, topics))


def _by_time(path: Path, of_topics: Iterable[Iterable[Message]]) -> Path:
    """Write the messages of topics by their arrival."""
    return write_log(path.with_suffix(".mcap"), sorted(chain.from_iterable(of_topics), key=lambda m: m.log_time_ns))


def _protobuf(topics: Sequence[Topic], path: Path) -> Path:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    def encoded(topic: Topic) -> Iterator[Message]:
        package, _, name = topic.type_name.rpartition(".")
        files = descriptor_pb2.FileDescriptorSet()
        file = files.file.add(name=f"{name}.proto", package=package, syntax="proto3")
        _, _, example = next(_rows(topic))
        _add_message(file.message_type.add(name=name), topic.type_name, example)
        pool = descriptor_pool.DescriptorPool()
        pool.Add(files.file[0])
        kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(topic.type_name))
        schema = topic.type_name, "protobuf", files.SerializeToString()
        for arrival, stamp, row in _rows(topic):
            yield Message(arrival, stamp, topic.name, kind(**row).SerializeToString(), "protobuf", schema)

    return _by_time(path, map(encoded, topics))


def _add_message(message: Any, full_name: str, example: Mapping[str, Any]) -> None:
    """Add the fields that an example has: numbers as double, texts as string, dictionaries as nested messages."""
    for number, (name, value) in enumerate(example.items(), 1):
        if isinstance(value, dict):
            nested = re.sub(r"(?:^|_)(.)", lambda m: m[1].upper(), name)
            _add_message(message.nested_type.add(name=nested), f"{full_name}.{nested}", value)
            message.field.add(name=name, number=number, type=11, label=1, type_name=f".{full_name}.{nested}")
        else:
            repeated = isinstance(value, list | tuple)
            message.field.add(
                name=name, number=number, type=9 if isinstance(value, str) else 1, label=3 if repeated else 1
            )


_WRITERS: dict[str, Callable[[Sequence[Topic], Path], Path]] = {
    "mcap": write_mcap,
    "mcap-ros1": _mcap_ros1,
    "mcap-json": _json,
    "mcap-json-bare": partial(_json, bare=True),
    "mcap-protobuf": _protobuf,
    "rosbag1": _rosbag1,
    "rosbag2": _rosbag2,
    "rosbag2-bare": _rosbag2_bare,
    "rosbag2-mcap": partial(_rosbag2, plugin="MCAP"),
    **{f"can-{kind}": partial(buses.write, kind) for kind in ("blf", "asc", "mdf", "mcap")},
}
