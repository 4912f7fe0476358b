"""What a log on a server costs in requests and bytes, counted by a web server on this machine.

    python -m studies.remote [--write-docs]

Three logs: a sample log, whose chunks hold all topics; the same with a camera, whose chunks hold either the camera or
the sensors; and that one as a compressed file. ``--write-docs`` puts the table into docs/remote.md.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import zstandard
from mcap.reader import make_reader
from mcap.writer import Writer

from studies.counting_server import CountingServer, serving
from studies.pages import DOCS, ROOT, measured, table

DOCUMENT = DOCS / "remote.md"
SAMPLE = ROOT / "sample_logs" / "road.mcap"
COMMANDS = {
    "inspect": ["inspect", "{}", "--json"],
    "run": ["run", "{}", "-o", "{out}"],
    "run --annotate sidecar": ["run", "{}", "--annotate", "sidecar", "-o", "{out}"],
}
_SLICE_NS = 20_000_000_000
_IMAGE_BYTES, _IMAGE_NS = 20_000, 200_000_000
_CAMERA = ("sensor_msgs/msg/CompressedImage", "ros2msg", b"uint8[] data")

#: Name, encoding and text of a message's definition.
Definition = tuple[str, str, bytes]
#: Topic, definition, log time and CDR bytes.
Message = tuple[str, Definition, int, bytes]


def write_apart(path: Path, chunks: Iterable[list[Message]]) -> None:
    """Write an MCAP with just these chunks."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1 << 40)
        writer.start("ros2")
        schemas: dict[Definition, int] = {}
        channels: dict[str, int] = {}
        for chunk in chunks:
            for topic, definition, log_time, data in chunk:
                if topic not in channels:
                    if definition not in schemas:
                        schemas[definition] = writer.register_schema(*definition)
                    channels[topic] = writer.register_channel(topic, "cdr", schemas[definition])
                writer.add_message(channels[topic], log_time, data, log_time)
            writer._Writer__finalize_chunk()  # type: ignore[attr-defined]  # the library has no name for it
        writer.finish()  # type: ignore[no-untyped-call]


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
            assert schema is not None
            if sensors and message.log_time - sensors[0][2] >= slice_ns:
                yield sensors
                yield images(sensors[0][2])
                sensors = []
            definition = (schema.name, schema.encoding, schema.data)
            sensors.append((channel.topic, definition, message.log_time, message.data))
    yield sensors


def _cost(server: CountingServer, name: str, command: list[str]) -> list[str]:
    """Run a command on a log of the server; return requests, bytes and share of the file."""
    server.requests.clear()
    with tempfile.TemporaryDirectory() as out:
        words = [word.format(server.place(name), out=out) for word in command]
        subprocess.run(
            [sys.executable, "-m", "pdhef_logtool", *words],
            check=True,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
        )
    size = len(server.files[name])
    sent = server.bytes_sent
    return [str(len(server.requests)), f"{sent / 1e6:.2f}", f"{sent / size:.3f}", str(server.twice())]


def measure() -> str:
    """Return the table of all commands on all logs."""
    with tempfile.TemporaryDirectory() as folder:
        apart = Path(folder) / "apart.mcap"
        write_apart(apart, with_camera(SAMPLE))
        files = {"mixed.mcap": SAMPLE.read_bytes(), "apart.mcap": apart.read_bytes()}
    files["apart.mcap.zst"] = zstandard.ZstdCompressor(1).compress(files["apart.mcap"])
    head = ["log", "MB", "chunks", "command", "requests", "MB fetched", "share", "bytes fetched twice"]
    body = []
    with serving(**files) as server:
        for name, data in files.items():
            for label, command in COMMANDS.items():
                print(f"{name} {label} ...", file=sys.stderr)
                size, chunks = f"{len(data) / 1e6:.2f}", _chunks(data) if name.endswith(".mcap") else ""
                body.append([name, size, chunks, f"`{label}`", *_cost(server, name, command)])
    return table(head, body, right_from=4)


def _chunks(data: bytes) -> str:
    from io import BytesIO

    summary = make_reader(BytesIO(data)).get_summary()
    assert summary is not None
    camera = {id_ for id_, channel in summary.channels.items() if channel.topic == "/camera"}
    others = sum(not camera.isdisjoint(c.message_index_offsets) for c in summary.chunk_indexes)
    return f"{len(summary.chunk_indexes)}" + (f", {others} of the camera" if others else "")


if __name__ == "__main__":
    measured("remote", __doc__, DOCUMENT, measure)
