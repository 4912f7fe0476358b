"""Topics as columns into files of tables: text (``dialects.toml``), MAT, JSON, HDF5 (``documents.toml``), Parquet, MDF.

A field is named as its column, with the unit in brackets: ``Lateral Acc. [g]``.
"""

import datetime as dt
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from scipy.io import savemat

from pdhef_logtool.records.signals import IntArray
from studies.pages import read_toml
from studies.strangers.cars import Topic

#: GPS time is ahead of UTC by 18 leap seconds, and began 315964800 s after 1970.
_GPS_NS, _WEEK_NS, _DAY_NS = (18 - 315_964_800) * 10**9, 604_800 * 10**9, 86_400 * 10**9
#: Text files and files of nested tables, documented in their files.
_DIALECTS, _DOCUMENTS = (read_toml(Path(__file__).with_name(f"{name}.toml")) for name in ("dialects", "documents"))


def _columns(topics: Sequence[Topic]) -> tuple[IntArray, dict[str, NDArray[np.float64]]]:
    """Return the union of all times in ns, and every column at these times, NaN at times without a value."""
    stamps = np.unique(np.concatenate([t.arrival_ns for t in topics]))
    columns: dict[str, NDArray[np.float64]] = {}
    for topic in topics:
        rows = np.searchsorted(stamps, topic.arrival_ns)
        for title, values in topic.fields.items():
            columns[title] = np.full(len(stamps), np.nan)
            columns[title][rows] = values
    return stamps, columns


def _times(stamp: int, start: int, i: int) -> dict[str, Any]:
    """Return the spellings of a time in ns, by the names of ``dialects.toml``."""
    at = dt.datetime.fromtimestamp(stamp // 10**9, tz=dt.UTC) + dt.timedelta(microseconds=stamp % 10**9 // 1000)
    week, tow = divmod(stamp + _GPS_NS, _WEEK_NS)
    day_s = stamp % _DAY_NS / 1e9
    since = {"s": 1e9, "ms": 1e6, "us": 1e3}
    units = {"": 1e9, "_ms": 1e6, "_us": 1e3}
    return {
        "i": i, "at": at, "second": stamp // 10**9, "milli": at.microsecond // 1000, "micro": at.microsecond,
        "nano": stamp % 10**9, "week": week, "tow": tow / 1e9, "fine": (stamp - start) // 100_000,
        "day": day_s, "days": stamp / _DAY_NS, "unix_ns": stamp,
        "clock": day_s // 3600 * 1e4 + day_s % 3600 // 60 * 1e2 + day_s % 60,
        **{name: (stamp - start) / ns for name, ns in since.items()},
        **{f"unix{name}": stamp / ns for name, ns in units.items()},
    }  # fmt: skip


def _text(dialect: str, path: Path, topics: Sequence[Topic]) -> None:
    """Write a text file."""
    form = _DIALECTS["default"] | _DIALECTS[dialect]
    titles = [title for topic in topics for title in topic.fields]
    parts = [_parts(title) for title in titles]
    cells = {f"{key}s": [p[key] for p in parts] for key in ("title", "source", "group")}
    cells |= {f"{key}s": [form[key].format(**p) for p in parts] for key in ("name", "unit")}
    cells["numbers"] = [str(i) for i in range(12, 12 + len(titles))]
    lines_of = {
        "channels": [form["channel"].format(number=i, **p) for i, p in enumerate(parts, 1)],
        "modules": [p["unit"] for p in parts if p["unit"].strip()],
    }
    start = min(int(t.arrival_ns[0]) for t in topics)
    above = {name: form["separator"].join(row) for name, row in cells.items()} | _times(start, start, 0)
    above |= {name: "\n".join(lines) for name, lines in lines_of.items()}
    rows = _ROWS[form["rows"]](form, topics, start)
    rows = (row.replace(".", form["decimal"]) for row in rows)
    text = "\n".join([*(line.format(**above) for line in form["head"]), *rows, *form["tail"], ""])
    path.write_bytes(text.replace("\n", form["newline"]).encode(form["encoding"]))


def _parts(title: str) -> dict[str, str]:
    """Return the parts of a title: ``name [unit|source]`` or ``group|name``."""
    name, _, unit = title.partition(" [")
    group, _, name = name.rpartition("|")
    unit, _, source = unit.rstrip("]").partition("|")
    return {"title": title, "name": name, "unit": unit, "source": source, "group": group}


def _table_rows(form: dict[str, Any], topics: Sequence[Topic], start: int) -> Iterator[str]:
    stamps, columns = _columns(topics)
    parts = [_parts(title) for title in columns]
    for i, (stamp, row) in enumerate(zip(stamps.tolist(), np.stack([*columns.values()], 1).tolist(), strict=True)):
        at = _times(stamp, start, i)
        cells = zip(row, parts, strict=True)
        values = (form["empty"] if np.isnan(v) else form["number"].format(value=v, **p) for v, p in cells)
        whole = (*(cell.format(**at) for cell in form["clock"]), *values)
        yield form["separator"].join(f"{form['quote']}{cell}{form['quote']}" for cell in whole)


def _value_rows(form: dict[str, Any], topics: Sequence[Topic], start: int) -> Iterator[str]:
    """Yield a row for each value; in a series, signal after signal."""
    rows = sorted(_long_rows(topics), key=lambda row: row[1]) if form["rows"] == "series" else _long_rows(topics)
    for i, (stamp, name, value, unit) in enumerate(rows):
        if not i or name != rows[i - 1][1]:
            yield from (line.format(name=name, unit=unit) for line in form["above"])
        yield form["row"].format(name=name, value=value, unit=unit, **_times(stamp, start, i))


def _sample_rows(form: dict[str, Any], topics: Sequence[Topic], start: int) -> Iterator[str]:
    samples = ((int(stamp), topic, i) for topic in topics for i, stamp in enumerate(topic.arrival_ns))
    for stamp, topic, i in sorted(samples, key=lambda sample: sample[0]):
        named = ((_parts(title), values[i]) for title, values in topic.fields.items())
        fields = form["separator"].join(form["field"].format(value=v, **parts) for parts, v in named)
        yield form["row"].format(topic=topic.name.strip("/"), fields=fields, **_times(stamp, start, i))


def _side_by_side(form: dict[str, Any], topics: Sequence[Topic], start: int) -> Iterator[str]:
    """Yield the rows of groups side by side: a column of times, and the columns of their values."""
    columns = [form["margin"]] if form["margin"] else []
    for number, topic in enumerate(topics):
        group = {"letter": "ABC"[number], "number": f"'{number + 4:03d}"}
        times = (form["clock"][0].format(**_times(stamp, start, 0)) for stamp in topic.arrival_ns.tolist())
        columns.append([*(cell.format(**group) for cell in form["times"]), *times])
        for title, values in topic.fields.items():
            above = [cell.format(**_parts(title) | group) for cell in form["above"]]
            columns.append([*above, *(form["number"].format(value=v) for v in values.tolist())])
            group["number"] = ""  # only above the first column of a group
    length = max(map(len, columns))
    padded = ([*column, *[""] * (length - len(column))] for column in columns)
    yield from map(form["separator"].join, zip(*padded, strict=True))


_ROWS: dict[str, Callable[[dict[str, Any], Sequence[Topic], int], Iterator[str]]] = {
    "table": _table_rows, "samples": _sample_rows, "values": _value_rows, "series": _value_rows,
    "columns": _side_by_side,
}  # fmt: skip


def _long_rows(topics: Sequence[Topic]) -> list[tuple[int, str, float, str]]:
    """Return a row for each value: time in ns, signal, value, unit."""
    rows = [
        (stamp, parts["name"], value, parts["unit"])
        for topic in topics
        for parts, values in ((_parts(title), values) for title, values in topic.fields.items())
        for stamp, value in zip(topic.arrival_ns.tolist(), values.tolist(), strict=True)
    ]
    return sorted(rows)


# ------------------------------------------------------------------------------------------------ nested tables


def _signals(topics: Sequence[Topic]) -> Iterator[dict[str, Any]]:
    """Yield the texts and columns of each signal, as ``documents.toml`` names them."""
    start = topics[0].arrival_ns[0]
    for index, topic in enumerate(topics):
        ns = topic.arrival_ns
        seconds = (ns - start) * 1e-9
        run, _, device = topic.name.strip("/").partition("/")
        of_topic = {
            "topic": topic.name.strip("/"), "run": run, "device": device, "number": index + 1, "index": index,
            "axis": index + 1.0,
            "clock": ns * 1e-9, "stamps": ns, "us": ns // 1000, "ms": ns // 10**6, "seconds": seconds,
            "rate": round(1.0 / float(np.median(np.diff(seconds))), 3), "start_ms": int(start // 10**6),
        }  # fmt: skip
        for title, values in topic.fields.items():
            pairs = {"pairs": np.stack([seconds, values], 1), "us_pairs": np.stack([ns // 1000, values], 1)}
            yield of_topic | _parts(title) | pairs | {"values": values, "column": values.reshape(-1, 1)}


#: Columns of several signals.
_OF_SEVERAL: dict[str, Callable[[Sequence[Mapping[str, Any]]], Any]] = {
    "table": lambda signals: np.stack([signals[0]["seconds"], *(s["values"] for s in signals)], 1),
    "frame": lambda signals: np.stack([s["values"] for s in signals], 1),
    "labels": lambda signals: np.array([s["title"] for s in signals], "S"),
    "rows": lambda signals: pl.DataFrame(
        {s["title"]: s["values"] for s in signals} | {"timestamp": signals[0]["ms"]}
    ).to_dicts(),
}


def _filled(template: Any, signals: Sequence[Mapping[str, Any]]) -> Any:
    """Return the document of a template for signals."""
    if isinstance(template, str):
        column = template[1:]
        if template[:1] != "@":
            return template.format(**signals[0])
        return _OF_SEVERAL[column](signals) if column in _OF_SEVERAL else signals[0][column]
    if not isinstance(template, dict):
        return template
    made: dict[str, Any] = {}
    for key, name in dict.fromkeys((key, key.format(**signal)) for signal in signals for key in template):
        made[name] = _filled(template[key], [s for s in signals if key.format(**s) == name])
    entries, first = list(made.values()), next(iter(made))
    if first.startswith("()"):
        return np.array([tuple(entry.values()) for entry in entries], [(name, object) for name in entries[0]])
    return np.array(entries, object) if first.startswith("[]") else made


def _write_json(path: Path, document: dict[str, Any]) -> None:
    path.write_text(json.dumps(document, default=lambda array: array.tolist()), encoding="utf-8")


def _write_hdf5(path: Path, document: dict[str, Any]) -> None:
    import h5py

    def put(group: Any, entries: dict[str, Any]) -> None:
        for name, value in entries.items():
            if not isinstance(value, dict):
                group[name] = value
            elif "=" in value:
                attributes = {key: text for key, text in value.items() if key != "="}
                group.create_dataset(name, data=value["="], compression="gzip").attrs.update(attributes)
            else:
                put(group.create_group(name), value)

    with h5py.File(path, "w") as file:
        put(file, document)


def _mat_hdf5(path: Path, topics: Sequence[Topic]) -> None:
    """Write version 7.3: each variable is a row vector, which HDF5 stores as a column."""
    import h5py

    with h5py.File(path, "w", userblock_size=512) as file:
        for number, topic in enumerate(topics, 1):
            group = file.create_group(topic.name.strip("/")) if number > 1 else file
            vectors = {"t": (topic.arrival_ns - topics[0].arrival_ns[0]) * 1e-9, **topic.fields}
            for name, values in vectors.items():
                group.create_dataset(name, data=np.asarray(values).reshape(-1, 1)).attrs["MATLAB_class"] = b"double"
    head = b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM"
    with path.open("r+b") as raw:
        raw.write(head)


# ------------------------------------------------------------------------------------------------ Parquet and MDF


def nested(row: dict[str, Any], path: str, value: Any) -> None:
    """Put a value into a nested row at a dotted path."""
    *parents, leaf = path.split(".")
    for name in parents:
        row = row.setdefault(name, {})
    row[leaf] = value


def _parquet(path: Path, topics: Sequence[Topic]) -> None:
    stamps, columns = _columns(topics)
    parts = [_parts(title) for title in columns]
    fields = [pa.field("t", pa.timestamp("ns"))]
    fields += [pa.field(p["name"], pa.float64(), metadata={"unit": p["unit"]}) for p in parts]
    arrays = [pa.array(stamps.astype("datetime64[ns]")), *(pa.array(v, from_pandas=True) for v in columns.values())]
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), path)


def _seconds_parquet(path: Path, topics: Sequence[Topic]) -> None:
    stamps, columns = _columns(topics)
    pq.write_table(pa.table({**columns, "timestamps": (stamps - stamps[0]) * 1e-9}), path)


def _nested_parquet(path: Path, topics: Sequence[Topic]) -> None:
    stamps, columns = _columns(topics)
    rows: list[dict[str, Any]] = [{"event_time": stamp // 1000} for stamp in stamps.tolist()]
    for title, values in columns.items():
        for row, value in zip(rows, values.tolist(), strict=True):
            nested(row, title, None if np.isnan(value) else value)
    table = pa.Table.from_pylist(rows)
    clock = table.column("event_time").cast(pa.timestamp("us", "UTC"))
    pq.write_table(table.set_column(0, "event_time", clock), path)


def _long_parquet(path: Path, topics: Sequence[Topic]) -> None:
    stamps, names, values, units = (list(column) for column in zip(*_long_rows(topics), strict=True))
    clock = pa.array(np.array(stamps, "datetime64[ns]"))
    table = {"signal_name": pa.array(names).dictionary_encode(), "time": clock, "value": values, "unit": units}
    pq.write_table(pa.table(table), path)


def _measures_parquet(path: Path, topics: Sequence[Topic]) -> None:
    """Write a fleet's events: a row for each value, in the column of its type."""
    rows = pl.DataFrame(_long_rows(topics), ["stamp", "name", "value", "unit"], orient="row")
    events = {"eventId": pl.lit("7f"), "vehicleName": pl.lit("car-7"), "name": pl.col("name")}
    events |= {"time": pl.col("stamp") // 10**6, "measure_value_BOOLEAN": pl.lit(None, pl.Boolean)}
    rows.select(**events, measure_value_DOUBLE="value").write_parquet(path)


def _mdf(path: Path, topics: Sequence[Topic]) -> None:
    import asammdf

    start = min(int(t.arrival_ns[0]) for t in topics)
    start -= start % 10**9
    with asammdf.MDF(version="4.10") as file:
        file.start_time = dt.datetime.fromtimestamp(start // 10**9, tz=dt.UTC)
        for topic in topics:
            clock = (topic.arrival_ns - start) * 1e-9
            named = ((_parts(title), values) for title, values in topic.fields.items())
            signals = [asammdf.Signal(v, clock, name=p["name"], unit=p["unit"]) for p, v in named]
            file.append(signals, comment=topic.name.strip("/"), common_timebase=True)
        file.save(path, overwrite=True)


#: Suffix and writer of a document by the begin of a template's name.
_KINDS = {"mat": (".mat", savemat), "json": (".json", _write_json), "hdf5": (".h5", _write_hdf5)}


def _document(name: str, path: Path, topics: Sequence[Topic]) -> None:
    template = {key: entry for key, entry in _DOCUMENTS[name].items() if key != "suffix"}
    _KINDS[name.partition("-")[0]][1](path, _filled(template, list(_signals(topics))))


#: Suffix and writer of each container.
WRITERS: dict[str, tuple[str, Callable[[Path, Sequence[Topic]], None]]] = {
    **{name: (form.get("suffix", ".csv"), partial(_text, name)) for name, form in _DIALECTS.items()},
    **{
        name: (form.get("suffix", _KINDS[name.partition("-")[0]][0]), partial(_document, name))
        for name, form in _DOCUMENTS.items()
    },
    "parquet": (".parquet", _parquet),
    "parquet-nested": (".parquet", _nested_parquet),
    "parquet-seconds": (".parquet", _seconds_parquet),
    "parquet-long": (".parquet", _long_parquet),
    "parquet-measures": (".parquet", _measures_parquet),
    "mat-7.3": (".mat", _mat_hdf5),
    "mdf": (".mf4", _mdf),
}
