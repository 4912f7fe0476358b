"""Topics as columns into files of tables: CSV in three dialects, VBO, Parquet, MAT and MDF.

A field is named as its column, with the unit in brackets: ``Lateral Acc. [g]``.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.records.signals import IntArray

if TYPE_CHECKING:
    from studies.strangers.containers import Topic

#: GPS time is ahead of UTC by 18 leap seconds, and began 315964800 s after 1970.
_GPS_NS, _WEEK_NS = (18 - 315_964_800) * 10**9, 604_800 * 10**9


def _columns(topics: Sequence[Topic]) -> tuple[IntArray, dict[str, NDArray[np.float64]]]:
    """Return the union of all times in ns, and every column on it, NaN where it has no value."""
    stamps = np.unique(np.concatenate([t.arrival_ns for t in topics]))
    columns: dict[str, NDArray[np.float64]] = {}
    for topic in topics:
        rows = np.searchsorted(stamps, topic.arrival_ns)
        for title, values in topic.fields.items():
            columns[title] = np.full(len(stamps), np.nan)
            columns[title][rows] = values
    return stamps, columns


def _split(title: str) -> tuple[str, str]:
    name, _, unit = title.partition(" [")
    return name, unit.rstrip("]")


def _iso(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    clock = [f"{stamp}Z" for stamp in np.datetime_as_string(stamps.astype("datetime64[ns]"), "us")]
    path.write_bytes(b"\xef\xbb\xbf" + _text(clock, columns, ["timestamp", *columns], ",").encode())


def _german(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    names = [_split(title) for title in columns]
    head = ["Messung;7", "", ";".join(["Zeit", *(n for n, _ in names)]), ";".join(["ms", *(u for _, u in names)])]
    rows = _text([f"{s / 1e6:.3f}" for s in stamps.tolist()], columns, [], ";").replace(".", ",")
    path.write_bytes("\r\n".join([*head, *rows.split("\n")]).encode("latin-1"))


def _gps(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    weeks = [divmod(stamp + _GPS_NS, _WEEK_NS) for stamp in stamps.tolist()]
    clock = [f"{week}\t{rest / 1e9:.4f}" for week, rest in weeks]
    path.write_text(_text(clock, columns, ["GPS week", "TOW [s]", *columns], "\t"))


def _text(clock: Sequence[str], columns: dict[str, Any], titles: Sequence[str], separator: str) -> str:
    cells = [["" if np.isnan(v) else f"{v:.9g}" for v in values.tolist()] for values in columns.values()]
    rows = [separator.join(row) for row in zip(clock, *cells, strict=True)]
    return "\n".join([separator.join(titles), *rows, ""] if titles else [*rows, ""])


def _vbo(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write the columns of one topic: titles with units are those of input modules, and come last."""
    titles = list(columns)
    modules = [_split(t) for t in titles if "[" in t]
    named = [t for t in titles if "[" not in t]
    day = stamps % (86_400 * 10**9) / 1e9
    clock = day // 3600 * 1e4 + day % 3600 // 60 * 1e2 + day % 60
    created = dt.datetime.fromtimestamp(int(stamps[0] // 10**9), tz=dt.UTC)
    header = ["satellites", "time", *named, *(name for name, _ in modules)]
    lines = [f"File created on {created:%d/%m/%Y @ %H:%M}", "", "[header]", *header, "", "[channel units]"]
    lines += [*(unit for _, unit in modules), "", "[comments]", "", "[data]"]
    table = np.stack([columns[t] for t in [*named, *(t for t in titles if "[" in t)]], axis=1)
    lines += [
        f"012 {t:010.3f} " + " ".join(f"{v:+.8E}" for v in row)
        for t, row in zip(clock.tolist(), table.tolist(), strict=True)
    ]
    path.write_bytes("\r\n".join([*lines, ""]).encode("latin-1"))


def _mat(path: Path, topics: Sequence[Topic]) -> None:
    from scipy.io import savemat

    structs: dict[str, Any] = {}
    for topic in topics:
        structs[topic.name.strip("/")] = {"time": topic.arrival_ns * 1e-9, **topic.fields}
    savemat(path, structs)


def _parquet(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    fields = [pa.field("t", pa.timestamp("ns"))]
    split = [(_split(title), values) for title, values in columns.items()]
    fields += [pa.field(name, pa.float64(), metadata={"unit": unit}) for (name, unit), _ in split]
    arrays = [pa.array(stamps.astype("datetime64[ns]")), *(pa.array(values, from_pandas=True) for _, values in split)]
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), path)


def _mdf(path: Path, topics: Sequence[Topic]) -> None:
    import asammdf

    start = min(int(t.arrival_ns[0]) for t in topics)
    start -= start % 10**9
    with asammdf.MDF(version="4.10") as file:
        file.start_time = dt.datetime.fromtimestamp(start // 10**9, tz=dt.UTC)
        for topic in topics:
            clock = (topic.arrival_ns - start) * 1e-9
            named = ((_split(title), values) for title, values in topic.fields.items())
            signals = [asammdf.Signal(v, clock, name=name, unit=unit) for (name, unit), v in named]
            file.append(signals, comment=topic.name.strip("/"), common_timebase=True)
        file.save(path, overwrite=True)


_TABLES: dict[str, tuple[str, Callable[[Path, IntArray, dict[str, Any]], None]]] = {
    "csv": (".csv", _iso),
    "csv-german": (".csv", _german),
    "csv-gps": (".csv", _gps),
    "parquet": (".parquet", _parquet),
    "vbo": (".vbo", _vbo),
}
_GROUPS: dict[str, tuple[str, Callable[[Path, Sequence[Topic]], None]]] = {
    "mat": (".mat", _mat),
    "mdf": (".mf4", _mdf),
}


def writers() -> Iterator[tuple[str, Callable[[Sequence[Topic], Path], Path]]]:
    """Yield the containers and their writers, which return the path with the suffix."""
    for name in (*_TABLES, *_GROUPS):
        yield name, partial(_write, name)


def _write(container: str, topics: Sequence[Topic], path: Path) -> Path:
    if container in _GROUPS:
        suffix, put = _GROUPS[container]
        put(path.with_suffix(suffix), topics)
    else:
        suffix, write = _TABLES[container]
        write(path.with_suffix(suffix), *_columns(topics))
    return path.with_suffix(suffix)
