"""Topics as messages on CAN buses, with the DBC file of each bus: BLF, ASC, MF4 of bus logging, and MCAP.

A topic is a message, its type the bus. Every field takes 16 bits, from the first byte on.
"""

import datetime as dt
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from mcap.records import Attachment

from studies.strangers.cars import Topic

#: Time in ns, bus, identifier and bytes of a frame.
_Frame = tuple[int, int, int, bytes]


def _coded(topics: Sequence[Topic]) -> tuple[list[_Frame], dict[str, str]]:
    """Return the frames in the order in which they were sent, and the text of each bus's DBC file."""
    frames: list[_Frame] = []
    databases: dict[str, str] = {}
    buses = list(dict.fromkeys(t.type_name for t in topics))
    for topic in topics:
        number = 0x101 + databases.get(topic.type_name, "").count("BO_ ")
        text = databases.get(topic.type_name, 'VERSION ""\nNS_ :\nBS_:\nBU_: ECU\n')
        text += f"BO_ {number} {topic.name.strip('/')}: 8 ECU\n"
        columns = []
        for i, (title, values) in enumerate(topic.fields.items()):
            name, _, unit = title.partition(" [")
            finest = float(np.abs(values).max()) / 32_000.0 or 1.0
            factor = next(f for e in range(-6, 6) for f in (10.0**e, 2 * 10.0**e, 5 * 10.0**e) if f >= finest)
            columns.append(np.round(values / factor).astype("<i2"))
            unit = unit.rstrip("]")
            text += (
                f' SG_ {name} : {16 * i}|16@1- ({factor:g},0) [{-32768 * factor:g}|{32767 * factor:g}] "{unit}" ECU\n'
            )
        databases[topic.type_name] = text
        data = np.stack(columns, axis=1)
        bus = buses.index(topic.type_name)
        frames += [
            (t, bus, number, row.tobytes().ljust(8, b"\0"))
            for t, row in zip(topic.arrival_ns.tolist(), data, strict=True)
        ]
    return sorted(frames), databases


def _python_can(frames: Sequence[_Frame], path: Path, suffix: str) -> None:
    import can

    with can.Logger(str(path / f"drive{suffix}")) as log:
        for t, bus, number, data in frames:
            sent = {"arbitration_id": number, "is_extended_id": False, "data": data}
            log.on_message_received(can.Message(timestamp=t / 1e9, channel=bus, **sent))


def _mdf(frames: Sequence[_Frame], path: Path) -> None:
    import asammdf
    from asammdf.blocks.source_utils import Source

    parts = ("BusChannel", "<u1"), ("ID", "<u4"), ("IDE", "<u1"), ("DLC", "<u1"), ("DataLength", "<u1")
    kind = np.dtype([(f"CAN_DataFrame.{name}", code) for name, code in (*parts, ("DataBytes", "(8,)u1"))])
    start = frames[0][0] // 10**9
    with asammdf.MDF(version="4.10") as file:
        file.start_time = dt.datetime.fromtimestamp(start, tz=dt.UTC)
        rows = np.array([(bus + 1, i, 0, 8, 8, tuple(data)) for _, bus, i, data in frames], kind)
        clock = np.array([(t - start * 10**9) * 1e-9 for t, *_ in frames])
        source = Source(source_type=Source.SOURCE_BUS, bus_type=Source.BUS_TYPE_CAN, name="CAN", path="CAN", comment="")
        file.append(asammdf.Signal(rows, clock, name="CAN_DataFrame", source=source), common_timebase=True)
        file.save(path / "drive.mf4", overwrite=True)


def _mcap(frames: Sequence[_Frame], databases: dict[str, str], path: Path) -> Path:
    """Write a topic of frames for each bus, and the DBC files as attachments."""
    from studies.strangers.containers import write_mcap

    topics, files = [], []
    for number, (name, text) in enumerate(databases.items()):
        mine = [frame for frame in frames if frame[1] == number]
        stamps = np.array([t for t, *_ in mine])
        data = np.frombuffer(b"".join(d for *_, d in mine), np.uint8).reshape(-1, 8)
        fields = {"header.stamp": stamps, "id": np.array([i for _, _, i, _ in mine]), "data": data}
        topics.append(Topic(f"/{name}/received_messages", "can_msgs/msg/Frame", stamps, stamps, fields, {"dlc": 8.0}))
        files.append(Attachment(int(stamps[0]), int(stamps[0]), f"{name}.dbc", "text/plain", text.encode()))
    return write_mcap(topics, path, files)


def write(kind: str, topics: Sequence[Topic], path: Path) -> Path:
    """Write frames as ``blf``, ``asc``, ``mdf`` or ``mcap``; return the log, or its folder with the DBC files."""
    frames, databases = _coded(topics)
    if kind == "mcap":
        return _mcap(frames, databases, path)
    shutil.rmtree(path, ignore_errors=True)
    path.mkdir(parents=True)
    if kind == "mdf":
        _mdf(frames, path)
    else:
        _python_can(frames, path, f".{kind}")
    for name, text in databases.items():
        (path / f"{name}.dbc").write_text(text)
    return path
