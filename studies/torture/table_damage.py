"""Damage for tables and CAN logs that knows their structure: links in circles, sizes, bombs, formulas, other files.

A block that is new is put behind the others, and a link to another block is directed to it. HDF5 and Parquet files are
changed by their own libraries.
"""

from __future__ import annotations

import io
import random
import re
import struct
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from studies.torture.mutating import EDGES, TEXTS, damage_bytes
from studies.torture.table_seeds import COLUMNS

#: Writes this file where a reader evaluates it.
CALL = b"__import__('os').system('echo x > formula_was_run')"
_FORMULAS = (
    CALL + b"+X*1.0", b"X1*(" + CALL + b")", b"9**9**9**9", b"(" * 5000 + b"X" + b")" * 5000, b"X/0", b"X[10**9]",
    b"sin(X)+Y", b"X.__class__.__mro__[1].__subclasses__()", b"(lambda: X)()",
    b"X if X else open('formula_was_run', 'w')",
)  # fmt: skip
_CELLS = (
    *TEXTS, b"nan", b"-nan(ind)", b"1e999", b"-1e308", b"5e-324", b"0x4f", b"1,5", b'"', b'"a\nb', b"\xe2\x88\x921",
    b"9" * 400, b"1_000", b"inf", b"=" + CALL, b"2024-05-01T12:00:00+99:99", b"24:60:61", b"-",
    b"9223372036854775808", b"#", b";", b"\t",
)  # fmt: skip


def zeros(size: int) -> bytes:
    """Return a zlib stream of so many zeros, in MiB, at once: blocks that end with a full flush are equal."""
    compressor = zlib.compressobj(9)
    first = compressor.compress(bytes(1 << 20)) + compressor.flush(zlib.Z_FULL_FLUSH)
    block = compressor.compress(bytes(1 << 20)) + compressor.flush(zlib.Z_FULL_FLUSH)
    total = size >> 20
    return first + block * (total - 1) + b"\3\0" + struct.pack(">HH", total * (1 << 20) % 65_521, 1)


def _bomb(rng: random.Random) -> tuple[int, bytes]:
    size = 1 << rng.choice((20, 26, 30, 32))
    return rng.choice((size, size, 1000, *EDGES)), zeros(size)


def _put(data: bytearray, offset: int, width: int, value: int) -> None:
    """Write a number where the file has room for it."""
    if 0 <= offset <= len(data) - width:
        data[offset : offset + width] = (value % (1 << (8 * width))).to_bytes(width, "little")


def _number(data: bytes, offset: int, width: int) -> int:
    return int.from_bytes(data[offset : offset + width], "little")


def _field(data: bytearray, offset: int, width: int, rng: random.Random, blocks: Sequence[int] = ()) -> None:
    """Write an edge, a small or negative step, or (a link) the address of a block."""
    value = _number(data, offset, width)
    near = (value - 1, value + 1, 8 * value, -value, 0, 0, len(data), len(data) - 8)
    _put(data, offset, width, rng.choice(blocks if blocks and rng.random() < 0.6 else (*EDGES, *near)))


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
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.choice(blocks)
        kind, count = bytes(data[at + 2 : at + 4]), min(_number(data, at + 16, 8), 12)
        match rng.randrange(8):
            case 0:
                _field(data, at + rng.choice((8, 16)), 8, rng)
            case 1 | 2 if count:
                _field(data, at + 24 + 8 * rng.randrange(count), 8, rng, blocks)
            case 3 | 4:
                width = rng.choice((1, 2, 4, 8))
                _field(data, at + 24 + 8 * count + width * rng.randrange(64 // width), width, rng)
            case 5:
                data[:8] = rng.choice((b"UnFinMF ", b"MDF     "))
                _put(data, 60, 2, rng.choice((1, 2, 3, 4, 0xFFFF, 0)))
            case _:
                data += bytes(-len(data) % 8)
                new = len(data)
                data += _formula4(new, rng) if kind == b"CN" else _data4(rng)
                link = {b"CN": 4, b"DG": 2}.get(kind, rng.randrange(max(count, 1)))
                _put(data, at + 24 + 8 * link, 8, new)
    return bytes(data)


def _block4(kind: bytes, links: Sequence[int], body: bytes) -> bytes:
    block = (
        struct.pack(f"<4s4xQQ{len(links)}Q", b"##" + kind, 24 + 8 * len(links) + len(body), len(links), *links) + body
    )
    return block + bytes(-len(block) % 8)


def _formula4(new: int, rng: random.Random) -> bytes:
    body = struct.pack("<BBHHHdd", rng.choice((3, 3, 3, 4, 7, 11)), 0, 0, 0, rng.choice((0, 0, 7, 65535)), 0.0, 1.0)
    conversion = _block4(b"CC", (0, 0, 0, 0, new + 24 + 40 + len(body)), body)
    _put(head := bytearray(conversion), 24 + 32, 8, new + len(conversion))
    return bytes(head) + _block4(b"TX", (), rng.choice(_FORMULAS) + b"\0")


def _data4(rng: random.Random) -> bytes:
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
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.choice(blocks)
        links = _LINKS3.get(bytes(data[at : at + 2]), 0)
        match rng.randrange(6):
            case 0:
                _field(data, at + 2, 2, rng)
            case 1 | 2 if links:
                _field(data, at + 4 + 4 * rng.randrange(links), 4, rng, blocks)
            case 3 if data[at : at + 2] == b"CN":
                _put(data, at + 8, 4, len(data))
                kind, text = rng.choice((10, 10, 10, 11, 12, 65_535)), rng.choice(_FORMULAS)[:4000]
                head = struct.pack(
                    "<2sHHdd20sHH", b"CC", 46 + 256, 0, 0.0, 0.0, b"m/s", kind, rng.choice((256, 65535, 0))
                )
                data += head + text.ljust(256, b"\0")
            case _:
                width = rng.choice((1, 2, 4))
                _field(data, at + 4 + 4 * links + width * rng.randrange(64 // width), width, rng)
    return bytes(data)


def damage_blf(content: bytes, rng: random.Random) -> bytes:
    """Change objects inside of compressed containers, the containers, or what they claim to contain."""
    head = bytearray(content[: _number(content, 4, 4)])
    parts, at = [], len(head)
    while content[at : at + 4] == b"LOBJ":
        size = _number(content, at + 8, 4)
        parts.append(bytearray(zlib.decompress(content[at + 32 : at + size])))
        at += size + size % 4
    for part in parts:
        objects = [m.start() for m in re.finditer(b"LOBJ", part)]
        for _ in range(rng.choice((0, 1, 1, 3))):
            offset, width = rng.choice(((4, 2), (8, 4), (8, 4), (12, 4), (4 * rng.randrange(4, 16), 4)))
            _field(part, rng.choice(objects) + offset, width, rng)
    if rng.random() < 0.3:
        _field(head, 4 * rng.randrange(1, 18), 4, rng)
    body = b""
    for part in parts * rng.choice((1, 1, 1, 3)):
        size, packed = (len(part), zlib.compress(part)) if rng.random() < 0.9 else _bomb(rng)
        container = bytearray(struct.pack("<4sHHIIH6xI4x", b"LOBJ", 16, 1, 32 + len(packed), 10, 2, size % 2**32))
        if rng.random() < 0.3:
            _field(container, *rng.choice(((4, 2), (8, 4), (12, 4), (16, 2), (24, 4))), rng)
        body += container + packed + bytes(len(packed) % 4)
    return bytes(head) + body


def damage_mat(content: bytes, rng: random.Random) -> bytes:
    """Change tags and sizes inside of compressed elements, nest them, or let them unfold."""
    out, at = bytearray(content[:128]), 128
    while at + 8 <= len(content):
        size = _number(content, at + 4, 4)
        element = bytearray(zlib.decompress(content[at + 8 : at + 8 + size]))
        at += 8 + size
        for _ in range(rng.choice((0, 1, 1, 3))):
            _field(element, 4 * rng.randrange(min(len(element), rng.choice((24, 64, 400))) // 4), 4, rng)
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
    """Change signed blocks and addresses, or add what reads other files, goes in circles, or has no end."""
    import h5py

    if rng.random() < 0.3:
        data = bytearray(content)
        blocks = [m.start() for m in re.finditer(rb"TREE|SNOD|HEAP|OHDR|\x89HDF|\x08\0\x17\0|\x01\0\x01\0", content)]
        for _ in range(rng.choice((1, 2, 4))):
            width = rng.choice((1, 2, 4, 8))
            relative = [b - 512 for b in blocks]
            _field(
                data,
                rng.choice(blocks) + width * rng.randrange(96 // width),
                width,
                rng,
                relative if width == 8 else (),
            )
        return bytes(data)
    file = io.BytesIO(content)
    with h5py.File(file, "r+") as target:
        car = target["car"]
        for _ in range(rng.choice((1, 1, 3))):
            name = rng.choice(list(car))
            if rng.random() < 0.5:
                del car[name]
            else:
                name = f"more {rng.random()}"
            rng.choice(_HDF5)(car, name, rng, canary)
    return content[:512] + file.getvalue()[512:]


def _many_groups(car: Any, name: str, rng: random.Random, _: Path) -> None:
    car["/".join([name] * rng.choice((20, 2000)))] = np.arange(3.0)


def _virtual(car: Any, name: str, rng: random.Random, canary: Path) -> None:
    import h5py

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
    import h5py

    odd: tuple[Any, ...] = (
        h5py.Empty("f8"), np.array("x" * 100_000, dtype=h5py.string_dtype()), np.zeros((1, 150), "c16"),
        np.float16(1.0), np.zeros((1, 150), [("a", "f8"), ("b", "S9")]),
        np.array([["a"] * 150], dtype=h5py.string_dtype()), np.zeros((0, 150)), np.zeros((1,) * 30 + (150,)),
        np.full((1, 150), np.nan), np.array([car.ref] * 150, h5py.ref_dtype),
    )  # fmt: skip
    car[name] = rng.choice(odd)
    attributes = rng.choice(
        ({}, {"MATLAB_class": b"cell"}, {"MATLAB_class": 3.0}, {"MATLAB_empty": 1}, {"unit": "x" * 60_000})
    )
    for key, value in attributes.items():
        car[name].attrs[key] = value


def _link(car: Any, name: str, rng: random.Random, canary: Path) -> None:
    import h5py

    links = (h5py.SoftLink(f"/car/{name}"), h5py.ExternalLink(f"{canary}.h5", "/x"), h5py.ExternalLink(".", "/"), car)
    car[name] = rng.choice((*links, h5py.SoftLink("/car"), h5py.ExternalLink("/dev/zero", "/"), car.parent))


def _external(car: Any, name: str, rng: random.Random, canary: Path) -> None:
    files = ((str(canary), 0, 1200), ("../canary", 0, 1200), ("/dev/zero", 0, 1 << 40), ("formula_was_run", 0, 1200))
    car.create_dataset(name, (1, 150), "f8", external=[rng.choice(files)])


_HDF5: tuple[Callable[[Any, str, random.Random, Path], None], ...] = (
    _many_groups,
    _virtual,
    _huge,
    _odd,
    _link,
    _external,
)


def damage_parquet(content: bytes, rng: random.Random) -> bytes:
    """Change the metadata at the end and heads of pages, or write columns of few bytes and many rows."""
    if rng.random() < 0.5:
        data = bytearray(content)
        size = _number(content, len(content) - 8, 4)
        for _ in range(rng.choice((1, 1, 3))):
            offset = rng.choice((4, len(data) - 8 - size, len(data) - 8 - size)) + rng.randrange(min(size, 200))
            data[offset : offset + 1] = rng.choice((b"\xff\xff\xff\xff\x07", b"\0", b"\x80\x80\x01", rng.randbytes(1)))
        footer = len(data) - len(content) + size
        _put(data, len(data) - 8, 4, footer if rng.random() < 0.9 else rng.choice(EDGES))
        return bytes(data)
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = rng.choice((150, 150, 300_000))
    times = np.resize(COLUMNS["time [s]"], rows)
    columns: dict[str, Any] = dict(
        rng.sample([(k, np.resize(v, rows)) for k, v in COLUMNS.items()], rng.randrange(1, 6))
    )
    columns |= {"time": times} if rng.random() < 0.7 else {}
    for k in range(rng.choice((1, 1, 20 if rows > 150 else 400))):
        columns[rng.choice(TEXTS).decode(errors="replace") + str(k)] = _arrow_values(rows, rng)
    kinds = ("none", "gzip", "zstd", "snappy", "brotli")
    file = io.BytesIO()
    with pq.ParquetWriter(file, (table := pa.table(columns)).schema, compression=rng.choice(kinds)) as writer:
        for _ in range(rng.choice((1, 1, 3, 10))):
            writer.write_table(table)
    return file.getvalue()


def _arrow_values(rows: int, rng: random.Random) -> Any:
    import pyarrow as pa

    text = rng.choice(_CELLS).decode(errors="replace")
    value, kind = rng.choice((
        (0.0, pa.float64()), (text, pa.string()), ([1.0, None], pa.list_(pa.float64())), (None, pa.null()),
        (b"x" * 99, pa.binary()), ({"a": {"b": 1.0}}, pa.struct([("a", pa.struct([("b", pa.float64())]))])),
        (2**62, pa.timestamp("ns")), (5, pa.decimal128(38, 9)), ([("k", 1.0)], pa.map_(pa.string(), pa.float64())),
        (2**62, pa.duration("ms")), (True, pa.bool_()), (1, pa.date32()),
    ))  # fmt: skip
    column = pa.repeat(pa.scalar(value, kind), rows)
    return column.dictionary_encode() if rng.random() < 0.2 and kind == pa.string() else column


#: Suffix and damage of each format.
DAMAGE: dict[str, tuple[str, Callable[..., bytes]]] = {
    "csv": ("csv", damage_text),
    "vbo": ("vbo", damage_text),
    "parquet": ("parquet", damage_parquet),
    "mat": ("mat", damage_mat),
    "mat73": ("mat", damage_hdf5),
    "mdf": ("mdf", damage_mdf3),
    "mf4": ("mf4", damage_mdf4),
    "mf4dz": ("mf4", damage_mdf4),
    "blf": ("blf", damage_blf),
    "asc": ("asc", damage_text),
}


def table_mutant(name: str, content: bytes, seed: int, number: int, canary: Path) -> bytes:
    """Return the damaged file of a format, the same for the same numbers."""
    rng = random.Random(f"{seed} {name} {number}")
    if rng.random() < 0.2:
        return damage_bytes(content, rng)
    damage = DAMAGE[name][1]
    changed = damage(content, rng, canary) if damage is damage_hdf5 else damage(content, rng)
    return changed if rng.random() < 0.9 else damage_bytes(changed, rng)
