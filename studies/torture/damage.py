"""Damage for recordings, tables and CAN logs: bytes, or records and blocks that are written with valid checksums.

The CRC of a compressed chunk detects a flipped byte, so that later code never reads it. Therefore chunks are opened,
their records are changed, and the chunks are closed again: the faults reach the readers of declarations, schemas and
payloads. Tables are damaged in their structure: links in circles, sizes, bombs, formulas, other files. A block that is
new is put behind the others, and a link to another block is directed to it. HDF5 and Parquet files are changed by their
own libraries. The same seed and number give the same file.
"""

import bz2
import io
import random
import re
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import lz4.frame
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import zstandard

from studies.pages import read_toml
from studies.torture.seeds import TOPICS

#: Numbers at which arithmetic, allocation and time go wrong.
EDGES = (
    0, 1, 2, 7, 255, 256, 0x7FFF, 0x8000, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**62, 2**63 - 1, 2**63,
    2**64 - 1,
)  # fmt: skip
#: Hostile texts by their kind, documented in their file.
_TEXTS = {
    kind: tuple(re.sub(r"<<(.+?) \* (\d+)>>", lambda m: m[1] * int(m[2]), text).encode("latin-1") for text in texts)
    for kind, texts in read_toml(Path(__file__).with_name("texts.toml")).items()
}
TEXTS, _FORMULAS, _CELLS = _TEXTS["texts"], _TEXTS["formulas"], _TEXTS["texts"] + _TEXTS["cells"]
_DOUBLING = b"".join(b"\n%s\nMSG: p/A%d\nA%d[2] a\nA%d[2] b" % (b"=" * 80, i, i + 1, i + 1) for i in range(40))
SCHEMAS = (*_TEXTS["schemas"][:3], b"A0 a" + _DOUBLING, *_TEXTS["schemas"][3:])


# ------------------------------------------------------------------------------------------------ bytes


def damage_bytes(content: bytes, rng: random.Random) -> bytes:
    """Flip, overwrite, cut, insert, repeat or move bytes, one to four times."""
    data = bytearray(content)
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if not data:
            break
        offset = _place(len(data), rng)
        match rng.randrange(7):
            case 0 | 1:
                data[offset] ^= 1 << rng.randrange(8)
            case 2:
                _overwrite(data, offset, rng)
            case 3:
                del data[offset : len(data) if rng.random() < 0.5 else offset + rng.randrange(1, 400)]
            case 4:
                data[offset:offset] = rng.randbytes(rng.randrange(1, 64))
            case 5:
                part = data[offset : offset + rng.randrange(1, 2000)]
                to = _place(len(data), rng)
                data[to:to] = part
            case _:
                n = rng.randrange(1, 300)
                data[offset : offset + n] = bytes([rng.choice((0, 255, 32))]) * min(n, len(data) - offset)
    return bytes(data)


def _place(size: int, rng: random.Random) -> int:
    """Return a byte: anywhere, or near either end, where the most critical bytes are."""
    near = min(size, 400)
    return rng.choice((rng.randrange(size), rng.randrange(near), size - 1 - rng.randrange(near)))


def _overwrite(data: bytearray, offset: int, rng: random.Random) -> None:
    """Write a number of 1, 2, 4 or 8 bytes."""
    width = rng.choice((1, 2, 4, 4, 8, 8))
    value = rng.choice(EDGES) % (1 << (8 * width))
    if rng.random() < 0.3 and offset + width <= len(data):
        value = (int.from_bytes(data[offset : offset + width], "little") + rng.choice((-1, 1, 7, -128))) % (
            1 << (8 * width)
        )
    data[offset : offset + width] = value.to_bytes(width, "little")


def _damage_payload(payload: bytes, rng: random.Random) -> bytes:
    """Change a record's inside: a number, a text, a schema, or bytes."""
    data = bytearray(payload)
    choice = rng.random()
    if choice < 0.5 and data:
        _overwrite(data, min(rng.randrange(len(data)), rng.randrange(64)), rng)
        return bytes(data)
    if choice < 0.7:
        return _with_text(payload, rng)
    return damage_bytes(payload, rng)


def _with_text(payload: bytes, rng: random.Random) -> bytes:
    """Put a hostile text in the place of one in the record, after its length."""
    places = []
    for offset in range(min(len(payload) - 4, 400)):
        (n,) = struct.unpack_from("<I", payload, offset)
        if 0 < n <= len(payload) - offset - 4 and payload[offset + 4 : offset + 8].isascii():
            places.append((offset, n))
    if not places:
        return payload
    offset, n = rng.choice(places[:8])
    text = rng.choice(SCHEMAS if n > 60 and rng.random() < 0.7 else TEXTS)
    return payload[:offset] + struct.pack("<I", len(text)) + text + payload[offset + 4 + n :]


# ------------------------------------------------------------------------------------------------ MCAP and bags

#: Head and body: operation and payload of MCAP, header and data of a bag.
Record = tuple[bytes, bytes]
MAGIC = b"\x89MCAP0\r\n"
_CHUNK = b"\6"
#: Records behind the data of a file, which are missing after its recorder was killed.
_SUMMARY = (b"\7", b"\x08", b"\x0b", b"\x0d", b"\x0e")


def damage_mcap(content: bytes, rng: random.Random) -> bytes:
    """Change top-level records, or records inside a chunk; then correct the chunk's size, compression and CRC."""
    records = _damaged(_split_mcap(content[8:-8]), _damage_mcap_chunk, rng)
    if rng.random() < 0.2:
        records = [r for r in records if r[0] not in _SUMMARY]
    return MAGIC + join_mcap(records) + (MAGIC if rng.random() < 0.9 else b"")


def damage_bag(content: bytes, rng: random.Random) -> bytes:
    """Change headers and data of records, inside chunks as well; chunks are compressed again."""
    head = content.index(b"\n") + 1
    return content[:head] + join_bag(_damaged(_split_bag(content[head:]), _damage_bag_chunk, rng))


def _damaged(
    records: list[Record], damage_chunk: Callable[[Record, random.Random], Record | None], rng: random.Random
) -> list[Record]:
    """Return the records after one to three damages; most of them are inside a chunk if there is one."""
    for _ in range(rng.choice((1, 1, 2, 3))):
        order = rng.sample(range(len(records)), len(records)) if rng.random() < 0.6 else ()
        if found := next(((i, chunk) for i in order if (chunk := damage_chunk(records[i], rng))), None):
            records[found[0]] = found[1]
        elif records:
            _damage_list(records, rng)
    return records


def _damage_list(records: list[Record], rng: random.Random) -> None:
    """Remove, repeat, move or change a record."""
    i = rng.randrange(len(records))
    head, body = records[i]
    match rng.randrange(9):
        case 0:
            del records[i]
        case 1:
            records.insert(rng.randrange(len(records) + 1), records[i])
        case 2:
            records.insert(rng.randrange(len(records)), records.pop(i))
        case 3 | 4:
            other = bytes([rng.choice((*range(16), 128, 255))])
            records[i] = (other if len(head) == 1 else _damage_payload(head, rng), body)
        case 5:
            records[i:i] = [(head, body)] * rng.choice((2, 50, 500))
        case _:
            records[i] = (head, _damage_payload(body, rng))


def _split_mcap(body: bytes) -> list[Record]:
    records, offset = [], 0
    while offset + 9 <= len(body):
        (n,) = struct.unpack_from("<Q", body, offset + 1)
        records.append((body[offset : offset + 1], body[offset + 9 : offset + 9 + n]))
        offset += 9 + n
    return records


def join_mcap(records: Iterable[Record]) -> bytes:
    """Return the bytes of MCAP records."""
    return b"".join(op + struct.pack("<Q", len(payload)) + payload for op, payload in records)


def _damage_mcap_chunk(record: Record, rng: random.Random) -> Record | None:
    """Return a chunk with a damaged record; None for other records."""
    op, payload = record
    if op != _CHUNK:
        return None
    try:
        start, end, size, _, n = struct.unpack_from("<QQQII", payload)
        compression = payload[32 : 32 + n]
        inner = _split_mcap(_CODECS.get(compression, _PLAIN)[0](payload[40 + n :], size))
    except Exception:  # noqa: BLE001 (the decompressor raises any exception on an earlier fault)
        return op, damage_bytes(payload, rng)
    if inner:
        _damage_list(inner, rng)
    body = join_mcap(inner)
    size, crc = len(body), zlib.crc32(body)
    if rng.random() < 0.1:
        compression = rng.choice((b"", b"lz4", b"zstd", b"xz", b"\xff"))
    packed = _CODECS.get(compression, _PLAIN)[1](body)
    if rng.random() < 0.15:
        size = rng.choice(EDGES)
    if rng.random() < 0.15:
        start, end = rng.choice(EDGES), rng.choice(EDGES)
    if rng.random() < 0.1:
        packed = damage_bytes(packed, rng)
    head = struct.pack("<QQQI", start, end, size, crc if rng.random() < 0.9 else 0)
    return op, head + struct.pack("<I", len(compression)) + compression + struct.pack("<Q", len(packed)) + packed


def _split_bag(body: bytes) -> list[Record]:
    records, offset = [], 0
    while offset + 8 <= len(body):
        parts = []
        for _ in range(2):
            (n,) = struct.unpack_from("<I", body, offset)
            parts.append(body[offset + 4 : offset + 4 + n])
            offset += 4 + n
        records.append((parts[0], parts[1]))
    return records


def join_bag(records: Iterable[Record]) -> bytes:
    """Return the bytes of records of a bag."""
    return b"".join(struct.pack("<I", len(part)) + part for record in records for part in record)


def _damage_bag_chunk(record: Record, rng: random.Random) -> Record | None:
    """Return a chunk with a damaged record; None for other records."""
    header, data = record
    found = re.search(rb"compression=(none|bz2|lz4)", header)
    if found is None:
        return None
    try:
        inner = _split_bag(_CODECS.get(found[1], _PLAIN)[0](data, 0))
    except Exception:  # noqa: BLE001 (as above)
        return header, damage_bytes(data, rng)
    if inner:
        _damage_list(inner, rng)
    body = join_bag(inner)
    size = struct.pack("<I", len(body) if rng.random() < 0.95 else rng.choice(EDGES) % 2**32)
    return re.sub(rb"(?s)(?<=size=).{4}", lambda _: size, header), _CODECS.get(found[1], _PLAIN)[1](body)


_CODECS: dict[bytes, tuple[Callable[[bytes, int], bytes], Callable[[bytes], bytes]]] = {
    b"zstd": (
        lambda stored, size: zstandard.ZstdDecompressor().decompress(stored, max_output_size=size),
        lambda body: zstandard.ZstdCompressor().compress(body),
    ),
    b"lz4": (lambda stored, _: lz4.frame.decompress(stored), lz4.frame.compress),
    b"bz2": (lambda stored, _: bz2.decompress(stored), bz2.compress),
}
_PLAIN = (lambda stored, _: stored, bytes)


# ------------------------------------------------------------------------------------------------ databases

#: Statements with a value and an identifier, and statements that change the structure.
_SQL = read_toml(Path(__file__).with_name("statements.toml"))
ENDLESS_VIEW, HUGE_ROWS = _SQL["structure"][-1], _SQL["huge_rows"]


def damage_database(content: bytes, rng: random.Random) -> bytes:
    """Change rows, types of values, tables."""
    with sqlite3.connect(":memory:") as database:
        database.deserialize(content)
        for _ in range(rng.choice((1, 1, 2, 3))):
            changes_rows = rng.random() < 0.9
            statement = rng.choice(_SQL["rows" if changes_rows else "structure"])
            text = rng.choice((*TEXTS, *SCHEMAS))
            signed = rng.choice(EDGES) - 2**63 if rng.random() < 0.3 else rng.choice(EDGES) % 2**63
            as_text = text.decode("utf-8", errors="surrogateescape")
            as_text = as_text if as_text.isprintable() else as_text.encode("ascii", "replace").decode()
            value = rng.choice((signed, text, as_text, None, 0.5, rng.randbytes(40)))
            try:
                if changes_rows:
                    database.execute(statement, (value, rng.randrange(1, 200)))
                else:
                    database.executescript(statement)
            except sqlite3.Error:
                continue
        database.commit()
        return bytes(database.serialize())


# ------------------------------------------------------------------------------------------------ tables


def zeros(size: int) -> bytes:
    """Return a zlib stream of zeros (a multiple of 1 MiB), quickly: blocks that end with a full flush are equal."""
    compressor = zlib.compressobj(9)
    first, block = (compressor.compress(bytes(1 << 20)) + compressor.flush(zlib.Z_FULL_FLUSH) for _ in range(2))
    return first + block * ((size >> 20) - 1) + b"\3\0" + struct.pack(">HH", size % 65_521, 1)


def _bomb(rng: random.Random) -> tuple[int, bytes]:
    size = 1 << rng.choice((20, 26, 30, 32))
    return rng.choice((size, size, 1000, *EDGES)), zeros(size)


def _put(data: bytearray, offset: int, width: int, value: int) -> None:
    """Write a number where the file has room for it."""
    if 0 <= offset <= len(data) - width:
        data[offset : offset + width] = (value % (1 << (8 * width))).to_bytes(width, "little")


def _number(data: bytes | bytearray, offset: int, width: int) -> int:
    return int.from_bytes(data[offset : offset + width], "little")


def _fields(data: bytearray, places: Sequence[tuple[int, int]], rng: random.Random, blocks: Sequence[int] = ()) -> None:
    """Change up to four numbers, given as offset and width in bytes, to an edge, a step or the address of a block."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        offset, width = rng.choice(places)
        value = _number(data, offset, width)
        near = (value - 1, value + 1, 8 * value, -value, 0, 0, len(data), len(data) - 8)
        _put(data, offset, width, rng.choice(blocks if blocks and rng.random() < 0.4 else (*EDGES, *near)))


def damage_text(content: bytes, rng: random.Random) -> bytes:
    """Change cells and lines, also to millions of delimiters or characters."""
    lines = content.split(b"\n")
    for _ in range(rng.choice((1, 1, 2, 5))):
        i = rng.choice((rng.randrange(len(lines)), rng.randrange(min(len(lines), 20))))
        cells = re.split(rb"([,; \t]+)", lines[i])
        match rng.randrange(9):
            case 0 | 1 | 2:
                cells[rng.randrange(len(cells))] = rng.choice(_CELLS)
                lines[i] = b"".join(cells)
            case 3:
                del lines[i : i + rng.choice((1, 1, 40))]
                lines.append(b"")
            case 4:
                lines[i:i] = [lines[i]] * rng.choice((1, 100, 200_000))
            case 5:
                lines.insert(i, lines.pop(rng.randrange(len(lines))))
            case 6:
                lines[i] = rng.choice((b",", b";", b" ", b"\t", b'"', b"9", b"\0", b"a,")) * 10 ** rng.randrange(3, 8)
            case 7:
                lines[i] = b"".join(cells[: rng.randrange(len(cells))])
            case _:
                lines[i:i] = [rng.choice((b",", b";", b"")) * 5000] * rng.choice((10, 2000))
    changed = b"\n".join(lines)
    match rng.randrange(20):
        case 0:
            return changed.decode("latin-1").encode(rng.choice(("utf-16", "utf-32", "utf-8-sig", "utf-7")))
        case 1:
            return changed.replace(b"\n", rng.choice((b"\r", b"\r\n", b"\n\n", b"\0\n")))
    return changed


def damage_mdf4(content: bytes, rng: random.Random) -> bytes:
    """Change sizes, links and fields of blocks; add formulas and blocks of data that unfold."""
    data = bytearray(content)
    blocks = [m.start() for m in re.finditer(rb"##[A-Z]{2}\0{4}", content) if not m.start() % 8]
    block = rng.choice(blocks)
    first = [(block + 8 * i, 8) for i in (1, 2, 3, 3, 4, 4, 5, 6, 7)]
    _fields(data, [*first, *((block + rng.randrange(24, 160), rng.choice((1, 2, 4))) for _ in first)], rng, blocks)
    if rng.random() < 0.1:
        data[:8] = b"UnFinMF "
        _put(data, 60, 2, rng.choice((1, 2, 3, 4, 0xFFFF, 0)))
    kind, link, make = rng.choice(((b"CN", 4, _formula4), (b"DG", 2, _data4)))
    if (holders := [b for b in blocks if content[b + 2 : b + 4] == kind]) and rng.random() < 0.4:
        data += bytes(-len(data) % 8)
        _put(data, rng.choice(holders) + 24 + 8 * link, 8, len(data))
        data += make(len(data), rng)
    return bytes(data)


def _block4(kind: bytes, links: Sequence[int], body: bytes) -> bytes:
    size = 24 + 8 * len(links) + len(body)
    block = struct.pack(f"<2s2s4xQQ{len(links)}Q", b"##", kind, size, len(links), *links) + body
    return block + bytes(-size % 8)


def _formula4(new: int, rng: random.Random) -> bytes:
    body = struct.pack("<BBHHHdd", rng.choice((3, 3, 3, 4, 7, 11)), 0, 0, 0, rng.choice((0, 0, 7, 65535)), 0.0, 1.0)
    conversion = _block4(b"CC", (0, 0, 0, 0, new + 24 + 40 + len(body)), body)
    _put(head := bytearray(conversion), 24 + 32, 8, new + len(conversion))
    return bytes(head) + _block4(b"TX", (), rng.choice(_FORMULAS) + b"\0")


def _data4(_: int, rng: random.Random) -> bytes:
    size, packed = _bomb(rng)
    head = struct.pack("<2sBxIQQ", b"DT", rng.choice((0, 0, 1)), rng.choice((0, 1, 48, 2**32 - 1)), size, len(packed))
    return _block4(b"DZ", (), head + packed)


#: Links at the begin of the blocks of MDF 3.
_LINKS3 = {b"HD": 3, b"DG": 4, b"CG": 3, b"CN": 5}


def damage_mdf3(content: bytes, rng: random.Random) -> bytes:
    """Change sizes, links and fields of blocks; add formulas."""
    data, blocks, waiting = bytearray(content), [], [64]
    while waiting:
        at = waiting.pop()
        if at in blocks or not content[at : at + 2].isalpha():
            continue
        blocks.append(at)
        waiting += [_number(content, at + 4 + 4 * i, 4) for i in range(_LINKS3.get(content[at : at + 2], 0))]
    block = rng.choice(blocks)
    places = [(block + 2, 2), *((block + 4 + 4 * i, 4) for i in range(6))]
    _fields(data, [*places, *((block + rng.randrange(2, 120), rng.choice((1, 2, 4))) for _ in places)], rng, blocks)
    if rng.random() < 0.3:
        _put(data, rng.choice([b for b in blocks if content[b : b + 2] == b"CN"]) + 8, 4, len(data))
        kind, text = rng.choice((10, 10, 10, 11, 12, 65_535)), rng.choice(_FORMULAS)[:4000]
        head = struct.pack("<2sHHdd20sHH", b"CC", 46 + 256, 0, 0.0, 0.0, b"m/s", kind, rng.choice((256, 65535, 0)))
        data += head + text.ljust(256, b"\0")
    return bytes(data)


def damage_blf(content: bytes, rng: random.Random) -> bytes:
    """Change objects inside compressed containers, and sizes and data of the containers."""
    head = bytearray(content[: _number(content, 4, 4)])
    parts, at = [], len(head)
    while content[at : at + 4] == b"LOBJ":
        size = _number(content, at + 8, 4)
        parts.append(bytearray(zlib.decompress(content[at + 32 : at + size])))
        at += size + size % 4
    for part in parts:
        at = rng.choice([m.start() for m in re.finditer(b"LOBJ", part)])
        _fields(part, [(at + 4, 2), *((at + 4 * i, 4) for i in (2, 2, *range(2, 16)))], rng)
    if rng.random() < 0.3:
        _fields(head, [(4 * i, 4) for i in range(1, 18)], rng)
    body = b""
    for part in parts * rng.choice((1, 1, 1, 3)):
        size, packed = (len(part), zlib.compress(part)) if rng.random() < 0.9 else _bomb(rng)
        container = bytearray(struct.pack("<4sHHIIH6xI4x", b"LOBJ", 16, 1, 32 + len(packed), 10, 2, size % 2**32))
        if rng.random() < 0.3:
            _fields(container, ((4, 2), (8, 4), (12, 4), (16, 2), (24, 4)), rng)
        body += container + packed + bytes(len(packed) % 4)
    return bytes(head) + body


def damage_mat(content: bytes, rng: random.Random) -> bytes:
    """Change tags and sizes inside of compressed elements, nest them, or let them unfold."""
    out, at = bytearray(content[:128]), 128
    while at + 8 <= len(content):
        size = _number(content, at + 4, 4)
        element = bytearray(content[at : at + 8 + size])
        at += 8 + size
        if rng.random() < 0.5:
            _fields(element, [(4 * i, 4) for i in range(rng.choice((16, 100, len(element) // 4)))], rng)
        if rng.random() < 0.1:
            element = bytearray(_nested(bytes(element), rng.choice((2, 40, 1000, 5000))))
        packed = zlib.compress(element) if rng.random() < 0.9 else _bomb(rng)[1]
        if rng.random() < 0.1:
            element[16:32] = struct.pack("<IIII", 6, 8, rng.choice((1, 6, 9, 13, 255)), 0)
        if rng.random() < 0.1:
            out += element
        else:
            claimed = len(packed) if rng.random() < 0.9 else rng.choice(EDGES) % 2**32
            out += struct.pack("<II", 15, claimed) + packed
    return bytes(out)


def _nested(element: bytes, levels: int) -> bytes:
    head = struct.pack("<IIIIIIiiII", 6, 8, 1, 0, 5, 8, 1, 1, 1, 0)
    heads = [struct.pack("<II", 14, len(element) + 48 * k - 8 + len(head)) + head for k in range(levels, 0, -1)]
    return b"".join(heads) + element


def damage_hdf5(content: bytes, rng: random.Random, canary: Path) -> bytes:
    """Change signed blocks and addresses, or add external, cyclic, huge and unusual objects."""
    if rng.random() < 0.3:
        data = bytearray(content)
        blocks = [m.start() for m in re.finditer(rb"TREE|SNOD|HEAP|OHDR|\x89HDF|\x08\0\x17\0|\x01\0\x01\0", content)]
        block = rng.choice(blocks)
        places = [(block + width * rng.randrange(96 // width), width) for width in (1, 2, 4, 8, 8)]
        _fields(data, places, rng, [b - 512 for b in blocks])
        return bytes(data)
    file = io.BytesIO(content)
    with h5py.File(file, "r+") as target:
        car = rng.choice((target, target["car"]))
        for _ in range(rng.choice((1, 1, 3))):
            name = rng.choice((rng.choice(list(car)), f"more {rng.random()}"))
            if name in car:
                del car[name]
            rng.choice(_HDF5)(car, name, rng, canary)
    return content[:512] + file.getvalue()[512:]


def _many_groups(car: Any, name: str, rng: random.Random, _: Path) -> None:
    car["/".join([name] * rng.choice((20, 2000)))] = np.arange(3.0)


def _virtual(car: Any, name: str, rng: random.Random, canary: Path) -> None:
    layout = h5py.VirtualLayout((1, rng.choice((150, 1 << 40))), "f8")
    layout[:, :150] = h5py.VirtualSource(rng.choice((f"{canary}.h5", ".")), rng.choice(("x", f"car/{name}")), (1, 150))
    car.create_virtual_dataset(name, layout)


def _huge(car: Any, name: str, rng: random.Random, _: Path) -> None:
    size = 1 << rng.choice((20, 25, 31, 33, 40, 60))
    filters = rng.choice(({}, {"compression": "gzip"}, {"compression": "lzf"}, {"shuffle": True}))
    shape = rng.choice(((1, size), (size, 1), (size,), (size // 64, 64), (16, 16, size // 256)))
    chunks = tuple(min(n, 1 << rng.choice((8, 9))) for n in shape)
    values = car.create_dataset(name, shape, rng.choice(("f8", "f4", "i8")), chunks=chunks, **filters)
    if size == 1 << 20:
        values[:] = np.zeros(shape, values.dtype)


def _odd(car: Any, name: str, rng: random.Random, _: Path) -> None:
    odd: tuple[Any, ...] = (
        h5py.Empty("f8"), np.array("x" * 100_000, dtype=h5py.string_dtype()), np.zeros((1, 150), "c16"),
        np.float16(1.0), np.zeros((1, 150), [("a", "f8"), ("b", "S9")]),
        np.array([["a"] * 150], dtype=h5py.string_dtype()), np.zeros((0, 150)), np.zeros((1,) * 30 + (150,)),
        np.full((1, 150), np.nan), np.array([car.ref] * 150, h5py.ref_dtype),
    )  # fmt: skip
    car[name] = rng.choice(odd)
    about = (("MATLAB_class", b"cell"), ("MATLAB_class", 3.0), ("MATLAB_empty", 1), ("unit", "x" * 60_000))
    car[name].attrs.update([rng.choice(about)])


def _link(car: Any, name: str, rng: random.Random, canary: Path) -> None:
    soft = [h5py.SoftLink(path) for path in (f"{car.name}/{name}", "/car")]
    files = [h5py.ExternalLink(*target) for target in ((f"{canary}.h5", "/x"), (".", "/"), ("/dev/zero", "/"))]
    car[name] = rng.choice((*soft, *files, car, car.parent))


def _external(car: Any, name: str, rng: random.Random, canary: Path) -> None:
    files = ((str(canary), 0, 1200), ("../canary", 0, 1200), ("/dev/zero", 0, 1 << 40), ("formula_was_run", 0, 1200))
    car.create_dataset(name, (1, 150), "f8", external=[rng.choice(files)])


_HDF5: tuple[Callable[..., None], ...] = (_many_groups, _virtual, _huge, _odd, _link, _external)


def damage_parquet(content: bytes, rng: random.Random) -> bytes:
    """Change the metadata at the end and heads of pages, or write columns of few bytes and many rows."""
    if rng.random() < 0.4:
        data = bytearray(content)
        size = _number(content, len(content) - 8, 4)
        for _ in range(rng.choice((1, 1, 3))):
            offset = rng.choice((4, len(data) - 8 - size, len(data) - 8 - size)) + rng.randrange(min(size, 200))
            data[offset : offset + 1] = rng.choice((b"\xff\xff\xff\xff\x07", b"\0", b"\x80\x80\x01", rng.randbytes(1)))
        footer = len(data) - len(content) + size
        _put(data, len(data) - 8, 4, footer if rng.random() < 0.9 else rng.choice(EDGES))
        return bytes(data)
    rows = rng.choice((150, 150, 150, 300_000))
    columns: dict[str, Any] = {k: np.resize(v, rows) for topic in TOPICS for k, v in topic.fields.items()}
    columns |= {"time": TOPICS[0].stamps_ns[0] + 20_000_000 * np.arange(rows)} if rng.random() < 0.8 else {}
    for k in range(rng.choice((1, 1, 30))):
        columns[rng.choice(TEXTS).decode(errors="replace") + str(k)] = (
            _arrow_values(rng) if rows == 150 else pa.repeat(1.0, rows)
        )
    table = pa.concat_tables([pa.table(columns)] * rng.choice((1, 1, 3)))
    pq.write_table(table, file := io.BytesIO(), compression=rng.choice(("none", "gzip", "zstd", "snappy")))
    return file.getvalue()


def _arrow_values(rng: random.Random) -> Any:
    text = rng.choice(_CELLS).decode(errors="replace")
    value, kind = rng.choice((
        (0.0, pa.float64()), (text, pa.string()), ([1.0, None], pa.list_(pa.float64())), (None, pa.null()),
        (b"x" * 99, pa.binary()), ({"a": {"b": 1.0}}, pa.struct([("a", pa.struct([("b", pa.float64())]))])),
        (2**62, pa.timestamp("ns")), (5, pa.decimal128(38, 9)), ([("k", 1.0)], pa.map_(pa.string(), pa.float64())),
        (2**62, pa.duration("ms")), (True, pa.bool_()), (1, pa.date32()),
    ))  # fmt: skip
    column = pa.repeat(pa.scalar(value, kind), 150)
    return column.dictionary_encode() if rng.random() < 0.2 and kind == pa.string() else column


_DAMAGE: dict[str, Callable[..., bytes]] = {
    "parquet": damage_parquet, "mat5": damage_mat, "mdf3": damage_mdf3, "mdf4": damage_mdf4, "blf": damage_blf,
    "mcap": damage_mcap, "bag": damage_bag, "db3": damage_database,
}  # fmt: skip


def mutant(name: str, seeds: Sequence[bytes], seed: int, number: int, canary: Path) -> tuple[str, bytes]:
    """Return the kind of the damage and the damaged file of a format, the same for the same numbers.

    ``canary``: a file, and with ``.h5`` an HDF5 file, that damaged files refer to.
    """
    rng = random.Random(f"{seed} {name} {number}")
    content = seeds[number % len(seeds)]
    if rng.random() < 0.2:
        return "bytes", damage_bytes(content, rng)
    damage = partial(damage_hdf5, canary=canary) if name == "mat73" else _DAMAGE.get(name, damage_text)
    changed = damage(content, rng)
    return "structure", damage_bytes(changed, rng) if rng.random() < 0.1 else changed
