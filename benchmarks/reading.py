"""Reading the mapped signals of the one-hour log; decompression alone and rosbags; logs with images.

All readers read the same eleven fields of five topics and check the CRCs that they support. The lower bound
decompresses every chunk and checks its CRC. The peer decodes a tenth of the hour (scaled by 10). The log with images in
shared chunks has 150 MB of them in a minute; `inspect` of it includes the start of the process.
"""

import sys
import zlib
from contextlib import closing
from pathlib import Path

from benchmarks.measuring import ROUNDS, Row, best_seconds, command_cost
from benchmarks.one_hour_log import HOUR_S, IMAGE_LOG_S, MAPPED, SHARED_S, drive_log, image_log

#: Share of the hour that the peer decodes.
_SLICE = 10


def read_mapped(path: Path) -> int:
    """Read the mapped fields with our reader; returns the number of messages."""
    from pdhef_logtool.logs.open_log import open_log

    with closing(open_log(path)) as log:
        columns = log.read(MAPPED)
        if log.lost:
            raise SystemExit(f"{path.name} is damaged; delete it")
        return sum(len(c) for c in columns.values())


def decompress_all(path: Path) -> int:
    """Decompress every chunk and check its CRC, from the summary's index."""
    import zstandard
    from mcap.reader import make_reader

    decompressor = zstandard.ZstdDecompressor()
    total = 0
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
        if summary is None:
            raise SystemExit(f"{path.name} has no summary; delete it")
        for index in summary.chunk_indexes:
            file.seek(index.chunk_start_offset)
            record = file.read(index.chunk_length)
            stored = memoryview(record)[9 + 40 + len(index.compression) :]
            content = decompressor.decompress(stored, max_output_size=index.uncompressed_size)
            if zlib.crc32(content) != int.from_bytes(record[33:37], "little"):
                raise SystemExit(f"{path.name} is damaged; delete it")
            total += len(content)
    return total


def decode_with_rosbags(path: Path) -> int:
    """Decode the mapped topics of a slice with rosbags; returns the number of messages."""
    from rosbags.highlevel import AnyReader

    n = 0
    with AnyReader([path]) as reader:
        connections = [c for c in reader.connections if c.topic in MAPPED]
        end_ns = reader.start_time + HOUR_S // _SLICE * 10**9
        for connection, _, data in reader.messages(connections, stop=end_ns):
            reader.deserialize(data, connection.msgtype)
            n += 1
    return n


def rows() -> list[Row]:
    """Measure."""
    path = drive_log()
    messages = read_mapped(path)
    fast = best_seconds({"floor": lambda: decompress_all(path), "ours": lambda: read_mapped(path)}, rounds=5)
    slow = best_seconds({"rosbags": lambda: decode_with_rosbags(path)}, rounds=2)
    peer = slow["rosbags"] * messages / decode_with_rosbags(path)
    ours = fast["ours"]
    images = image_log(SHARED_S)
    once = best_seconds({"floor": lambda: decompress_all(images)})
    shared = min(command_cost("inspect", images).seconds for _ in range(ROUNDS))
    without, with_images = (
        command_cost(log, module="benchmarks.reading").peak_bytes for log in (drive_log(IMAGE_LOG_S), image_log())
    )
    return [
        Row("decompress all and check the CRC: lower bound", fast["floor"], "s"),
        Row("read 11 fields of 5 topics with CRC", ours, "s", peers={"rosbags": peer / ours}),
        Row("read / lower bound", ours / fast["floor"], "x", 1.5, peers={"rosbags": peer / fast["floor"]}),
        Row("inspect 60 s with 150 MB of images in shared chunks", shared, "s", command="pdhef inspect images.mcap"),
        Row("the same / decompressing it once", shared / once["floor"], "x"),
        Row("peak memory of reading 6 min", without / 1e6, "MB"),
        Row("more with 150 MB of images a minute", (with_images - without) / 1e6, "MB", 100.0),
    ]


if __name__ == "__main__":
    read_mapped(Path(sys.argv[1]))
