"""Logs of the simulator as other libraries read them: mcap and rosbags."""

from pathlib import Path

from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore


def read_with_other_libraries(path: Path, *topics: str) -> tuple[dict[str, list], dict[str, str], dict[str, str]]:
    """Messages of topics (default: all) as (log time, publish time, message), types, metadata"""
    store = get_typestore(Stores.ROS2_HUMBLE)
    messages: dict[str, list] = {}
    types: dict[str, str] = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        for schema, channel, message in reader.iter_messages(topics or None):
            assert schema is not None and schema.encoding == "ros2msg" and channel.message_encoding == "cdr"
            if channel.topic not in types:
                store.register(get_types_from_msg(schema.data.decode(), schema.name))
            types[channel.topic] = schema.name
            decoded = store.deserialize_cdr(message.data, schema.name)
            messages.setdefault(channel.topic, []).append((message.log_time, message.publish_time, decoded))
        metadata = {m.name: m.metadata for m in reader.iter_metadata()}
    return messages, types, metadata["truthsim"]
