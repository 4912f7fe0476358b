"""Damage recordings: change bytes, or parse records, change them, and write them with valid checksums.

The CRC of a compressed chunk detects a flipped byte, so that later code never reads it. Therefore chunks are opened,
their records are changed, and the chunks are closed again: the faults reach the readers of declarations, schemas and
payloads. The same seed and number give the same file.
"""

from __future__ import annotations

import bz2
import random
import re
import sqlite3
import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import PurePath

#: Numbers at which arithmetic, allocation and time go wrong.
EDGES = (
    0, 1, 2, 7, 255, 256, 0x7FFF, 0x8000, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**32, 2**62, 2**63 - 1, 2**63,
    2**64 - 1,
)  # fmt: skip
#: Texts that turn into paths, markup, terminal codes, forged lines, recursion.
TEXTS = (
    b"", b"..", b"/", b"../../../etc/passwd", b"/wheels[/red]", b"[bold]x[/]", b"\x1b[2J\x1b[31mwarning",
    b"a\nwarning: b", b"\0", b"\xff\xfe", b"\xed\xa0\x80", "\u202etxt.mcap".encode(), b"a" * 5000, b"$(id)",
    b"</script>", b"%s%n", b"../../odd/msg/T", b"sensor_msgs/msg/Imu", b"nav_msgs/msg/Odometry", b"std_msgs/String",
)  # fmt: skip
SCHEMAS = (
    b"float64[4294967296] x\n",
    b"float64[99999999999999999999] x\n",
    b"A[] a\n" + b"=" * 80 + b"\nMSG: p/A\nA[] a\n",
    b"\n".join([b"A0 a"] + [b"=" * 80 + b"\nMSG: p/A%d\nA%d[2] a\nA%d[2] b" % (i, i + 1, i + 1) for i in range(40)]),
    b'{"$ref": "#"}',
    b'{"properties": {"a": {"$ref": "#"}, "b": {"$ref": "#"}}}',
    b'{"a":' * 900 + b"1" + b"}" * 900,
    b'{"type": "array", "items": [{}, {}]}',
    b'{"type": ["number", "null"], "properties": 3}',
    b"[" * 5000,
    b"string<=5 a\nint32 A=3\n",
    b"float64 x  # [/red]\nfloat64 x\n",
    b"module a { module b { struct C { sequence<sequence<double>> x; }; }; };",
    b"\x0a\xff\xff\xff\xff\x0f",
    b"\x0a\x02\x0a\x00",
)


def mutant(name: str, content: bytes, seed: int, number: int) -> tuple[str, bytes]:
    """Return the kind of the damage and the damaged file, the same for the same numbers."""
    rng = random.Random(f"{seed} {name} {number}")
    if rng.random() < 0.35:
        return "bytes", damage_bytes(content, rng)
    apart = {".mcap": damage_mcap, ".bag": damage_bag, ".db3": damage_database}[PurePath(name).suffix]
    changed = apart(content, rng)
    return ("records", changed) if rng.random() < 0.8 else ("records and bytes", damage_bytes(changed, rng))


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
        start, end, size, _ = struct.unpack_from("<QQQI", payload)
        (n,) = struct.unpack_from("<I", payload, 28)
        compression = payload[32 : 32 + n]
        inner = _split_mcap(_unpacked(compression, payload[40 + n :], size))
    except Exception:  # noqa: BLE001 (the decompressor raises any exception on an earlier fault)
        return op, damage_bytes(payload, rng)
    if inner:
        _damage_list(inner, rng)
    body = join_mcap(inner)
    size, crc = len(body), zlib.crc32(body)
    if rng.random() < 0.1:
        compression = rng.choice((b"", b"lz4", b"zstd", b"xz", b"\xff"))
    packed = _packed(compression, body)
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
        inner = _split_bag(_unpacked(found[1], data, 0))
    except Exception:  # noqa: BLE001 (as above)
        return header, damage_bytes(data, rng)
    if inner:
        _damage_list(inner, rng)
    body = join_bag(inner)
    size = struct.pack("<I", len(body) if rng.random() < 0.95 else rng.choice(EDGES) % 2**32)
    return re.sub(rb"(?s)(?<=size=).{4}", lambda _: size, header), _packed(found[1], body)


def _unpacked(compression: bytes, stored: bytes, size: int) -> bytes:
    import lz4.frame
    import zstandard

    if compression == b"zstd":
        return zstandard.ZstdDecompressor().decompress(stored, max_output_size=size)
    if compression == b"lz4":
        return bytes(lz4.frame.decompress(stored))
    return bz2.decompress(stored) if compression == b"bz2" else stored


def _packed(compression: bytes, body: bytes) -> bytes:
    import lz4.frame
    import zstandard

    if compression == b"zstd":
        return zstandard.ZstdCompressor().compress(body)
    if compression == b"lz4":
        return bytes(lz4.frame.compress(body))
    return bz2.compress(body) if compression == b"bz2" else body


# ------------------------------------------------------------------------------------------------ databases

_STATEMENTS = (
    "UPDATE messages SET timestamp = ? WHERE id = ?",
    "UPDATE messages SET timestamp = ? WHERE id > ?",
    "UPDATE messages SET data = ? WHERE id = ?",
    "UPDATE messages SET topic_id = ? WHERE id = ?",
    "UPDATE topics SET name = ? WHERE id % 3 = ? % 3",
    "UPDATE topics SET type = ? WHERE id % 3 = ? % 3",
    "UPDATE topics SET serialization_format = ? WHERE id % 3 = ? % 3",
    "UPDATE topics SET offered_qos_profiles = ? WHERE id % 3 = ? % 3",
    "UPDATE message_definitions SET encoded_message_definition = ? WHERE id % 3 = ? % 3",
    "UPDATE message_definitions SET encoding = ? WHERE id % 3 = ? % 3",
    "INSERT INTO topics (name, type, serialization_format, offered_qos_profiles) VALUES (?1, ?1, 'cdr', ?2)",
    "INSERT INTO messages (topic_id, timestamp, data) VALUES (1, ?1, ?2)",
    "DELETE FROM messages WHERE id % ?2 = 0 AND ?1 IS ?1",
)
_STRUCTURE = (
    "DROP TABLE topics",
    "DROP TABLE messages",
    "DROP TABLE message_definitions",
    "DROP TABLE schema",
    "ALTER TABLE messages RENAME COLUMN data TO payload",
    "DELETE FROM topics",
    "DELETE FROM messages",
    "DROP TABLE messages; CREATE VIEW messages AS WITH RECURSIVE r(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM r) "
    "SELECT id, 1 AS topic_id, id AS timestamp, x'00' AS data FROM r",
)


def damage_database(content: bytes, rng: random.Random) -> bytes:
    """Change rows, types of values, tables."""
    with sqlite3.connect(":memory:") as database:
        database.deserialize(content)
        for _ in range(rng.choice((1, 1, 2, 3))):
            statement = rng.choice(_STATEMENTS if rng.random() < 0.9 else _STRUCTURE)
            text = rng.choice((*TEXTS, *SCHEMAS))
            signed = rng.choice(EDGES) - 2**63 if rng.random() < 0.3 else rng.choice(EDGES) % 2**63
            as_text = text.decode("utf-8", errors="surrogateescape")
            as_text = as_text if as_text.isprintable() else as_text.encode("ascii", "replace").decode()
            value = rng.choice((signed, text, as_text, None, 0.5, rng.randbytes(40)))
            try:
                if statement in _STRUCTURE:
                    database.executescript(statement)
                else:
                    database.execute(statement, (value, rng.randrange(1, 200)))
            except sqlite3.Error:
                continue
        database.commit()
        stored: bytes = database.serialize()
        return stored
