"""Topics as columns into files of tables: texts (``dialects.toml``), VBO, Parquet, MAT and MDF.

A field is named as its column, with the unit in brackets: ``Lateral Acc. [g]``.
"""

from __future__ import annotations

import datetime as dt
import json
import tomllib
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
_GPS_NS, _WEEK_NS, _DAY_NS = (18 - 315_964_800) * 10**9, 604_800 * 10**9, 86_400 * 10**9
#: Text files, documented in their file.
_DIALECTS = tomllib.loads(Path(__file__).with_name("dialects.toml").read_text(encoding="utf-8"))


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


def _split(title: str) -> tuple[str, str]:
    name, _, unit = title.partition(" [")
    return name, unit.rstrip("]")


def _times(stamp: int, start: int, i: int) -> dict[str, Any]:
    """Return the spellings of a time in ns, by the names of ``dialects.toml``."""
    at = dt.datetime.fromtimestamp(stamp // 10**9, tz=dt.UTC) + dt.timedelta(microseconds=stamp % 10**9 // 1000)
    week, tow = divmod(stamp + _GPS_NS, _WEEK_NS)
    since = {"s": 1e9, "ms": 1e6, "us": 1e3}
    units = {"": 1e9, "_ms": 1e6, "_us": 1e3}
    return {
        "i": i, "at": at, "second": stamp // 10**9, "milli": at.microsecond // 1000, "micro": at.microsecond,
        "nano": stamp % 10**9, "week": week, "tow": tow / 1e9, "fine": (stamp - start) // 100_000,
        "day": stamp % _DAY_NS / 1e9, "days": stamp / _DAY_NS, "unix_ns": stamp,
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
    cells["channels"] = [form["channel"].format(number=i, **p) for i, p in enumerate(parts, 1)]
    start = min(int(t.arrival_ns[0]) for t in topics)
    above = {
        name: ("\n" if name == "channels" else form["separator"]).join(row) for name, row in cells.items()
    } | _times(start, start, 0)
    rows = {"table": _table_rows, "samples": _sample_rows}.get(form["rows"], _value_rows)(form, topics, start)
    rows = (row.replace(".", form["decimal"]) for row in rows)
    lines = [*(line.format(**above) for line in form["head"]), *rows, *form["tail"], ""]
    path.write_bytes(form["newline"].join(lines).encode(form["encoding"]))


def _parts(title: str) -> dict[str, str]:
    """Return the parts of a title: ``name [unit|source]`` or ``group|name``."""
    name, unit = _split(title)
    group, _, name = name.rpartition("|")
    unit, _, source = unit.partition("|")
    return {"title": title, "name": name, "unit": unit, "source": source, "group": group}


def _table_rows(form: dict[str, Any], topics: Sequence[Topic], start: int) -> Iterator[str]:
    stamps, columns = _columns(topics)
    parts = [_parts(title) for title in columns]
    for i, (stamp, row) in enumerate(zip(stamps.tolist(), np.stack([*columns.values()], 1).tolist(), strict=True)):
        at = _times(stamp, start, i)
        cells = zip(row, parts, strict=True)
        values = (form["empty"] if np.isnan(v) else form["number"].format(value=v, **p) for v, p in cells)
        quoted = (
            f"{form['quote']}{cell}{form['quote']}" for cell in (*(c.format(**at) for c in form["clock"]), *values)
        )
        yield form["separator"].join(quoted)


def _value_rows(form: dict[str, Any], topics: Sequence[Topic], start: int) -> Iterator[str]:
    rows = sorted(_long_rows(topics), key=lambda row: row[1] if form["rows"] == "series" else "")
    for i, (stamp, name, value, unit) in enumerate(rows):
        yield form["row"].format(name=name, value=value, unit=unit, **_times(stamp, start, i))


def _sample_rows(form: dict[str, Any], topics: Sequence[Topic], start: int) -> Iterator[str]:
    samples = ((int(stamp), topic, i) for topic in topics for i, stamp in enumerate(topic.arrival_ns))
    for stamp, topic, i in sorted(samples, key=lambda sample: sample[0]):
        named = ((_parts(title), values[i]) for title, values in topic.fields.items())
        fields = form["separator"].join(form["field"].format(value=v, **parts) for parts, v in named)
        yield form["row"].format(topic=topic.name.strip("/"), fields=fields, **_times(stamp, start, i))


def _own_times(path: Path, topics: Sequence[Topic]) -> None:
    """Write a measurement tool's export: each device's columns follow a column of its own times."""
    start = min(int(t.arrival_ns[0]) for t in topics)
    columns = []
    for topic in topics:
        columns.append(["time [s]", *(f"{(s - start) / 1e9:.4f}" for s in topic.arrival_ns.tolist())])
        columns += [[title, *(f"{v:.6g}" for v in values.tolist())] for title, values in topic.fields.items()]
    length = max(map(len, columns))
    rows = zip(*([*column, *[""] * (length - len(column))] for column in columns), strict=True)
    path.write_text("\n".join([*map(";".join, rows), ""]), encoding="utf-8")


def _blocks(path: Path, topics: Sequence[Topic]) -> None:
    """Write a race data program's export: a block of times and values for each signal, one below the other."""
    lines = ["PiToolboxVersionedASCIIDataSet", "Version\t2", "", "{OutingInformation}", "CarName\tcar 3"]
    for seconds, name, unit, values in _signals(topics):
        lines += ["", "{ChannelBlock}", f"Time\t{name}[{unit}]"]
        lines += [f"{at:.3f}\t{v:.6g}" for at, v in zip(seconds.tolist(), values.tolist(), strict=True)]
    path.write_bytes("\r\n".join([*lines, ""]).encode("cp1252"))


def _stamps(path: Path, topics: Sequence[Topic]) -> None:
    """Write a workshop tester's log: groups side by side, each with a column of its own times."""
    start = min(int(t.arrival_ns[0]) for t in topics)
    columns = [["", "", "", "Marker"]]
    for number, topic in enumerate(topics):
        times = [f"{(s - start) / 1e9:.2f}" for s in topic.arrival_ns.tolist()]
        columns.append([f"Group {'ABC'[number]}:", "", "TIME", "STAMP", *times])
        for i, (title, values) in enumerate(topic.fields.items(), 1):
            name, unit = _split(title)
            above = [f"'{number + 4:03d}" if i == 1 else "", name, "", f" {unit}"]
            columns.append([*above, *(f"{v:.2f}" for v in values.tolist())])
    length = max(map(len, columns))
    rows = zip(*([*column, *[""] * (length - len(column))] for column in columns), strict=True)
    head = ["Monday,24,November,2025,14:05:12:00125", "1K0 907 379 AC,ESP MK60EC1  H31 0121"]
    path.write_text("\n".join([*head, *map(",".join, rows), ""]), encoding="latin-1")


def _long_rows(topics: Sequence[Topic]) -> list[tuple[int, str, float, str]]:
    """Return a row for each value: time in ns, signal, value, unit."""
    rows = [
        (stamp, *_split(title)[:1], value, _split(title)[1])
        for topic in topics
        for title, values in topic.fields.items()
        for stamp, value in zip(topic.arrival_ns.tolist(), values.tolist(), strict=True)
    ]
    return sorted(rows)


def _measures_parquet(path: Path, topics: Sequence[Topic]) -> None:
    """Write a fleet's events: a row for each value, in the column of its type."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    stamps, names, values, _ = (list(column) for column in zip(*_long_rows(topics), strict=True))
    table = {"eventId": ["7f"] * len(names), "vehicleName": ["car-7"] * len(names), "name": names}
    table |= {"time": [stamp // 10**6 for stamp in stamps], "measure_value_BOOLEAN": [None] * len(names)}
    pq.write_table(pa.table({**table, "measure_value_DOUBLE": values}), path)


def _long_parquet(path: Path, topics: Sequence[Topic]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    stamps, names, values, units = (list(column) for column in zip(*_long_rows(topics), strict=True))
    clock = pa.array(np.array(stamps, "datetime64[ns]"))
    table = {"signal_name": pa.array(names).dictionary_encode(), "time": clock, "value": values, "unit": units}
    pq.write_table(pa.table(table), path)


def _nested_parquet(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows: list[dict[str, Any]] = [{"event_time": stamp // 1000} for stamp in stamps.tolist()]
    for title, values in columns.items():
        *parents, leaf = title.split(".")
        for row, value in zip(rows, values.tolist(), strict=True):
            for parent in parents:
                row = row.setdefault(parent, {})
            row[leaf] = None if np.isnan(value) else value
    table = pa.Table.from_pylist(rows)
    clock = table.column("event_time").cast(pa.timestamp("us", "UTC"))
    pq.write_table(table.set_column(0, "event_time", clock), path)


def _vbo(path: Path, stamps: IntArray, columns: dict[str, Any], fewer: int = 0) -> None:
    """Write the columns of one topic: titles with units belong to input modules, and come last.

    ``fewer`` units than modules are written.
    """
    titles = list(columns)
    modules = [_split(t) for t in titles if "[" in t]
    named = [t for t in titles if "[" not in t]
    day = stamps % (86_400 * 10**9) / 1e9
    clock = day // 3600 * 1e4 + day % 3600 // 60 * 1e2 + day % 60
    created = dt.datetime.fromtimestamp(int(stamps[0] // 10**9), tz=dt.UTC)
    header = ["satellites", "time", *named, *(name for name, _ in modules)]
    lines = [f"File created on {created:%d/%m/%Y @ %H:%M}", "", "[header]", *header, "", "[channel units]"]
    lines += [*(unit for _, unit in modules[: len(modules) - fewer]), "", "[comments]", "", "[data]"]
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


def _mat_runs(path: Path, topics: Sequence[Topic]) -> None:
    """Write several runs: a struct for each, with the topics ``/RUN/DEVICE`` as structs of vectors."""
    from scipy.io import savemat

    runs: dict[str, dict[str, Any]] = {}
    for topic in topics:
        _, run, device = topic.name.split("/")
        seconds = (topic.arrival_ns - topics[0].arrival_ns[0]) * 1e-9
        runs.setdefault(run, {})[device] = {"time": seconds, **topic.fields}
    savemat(path, runs)


def _signals(topics: Sequence[Topic]) -> Iterator[tuple[NDArray[np.float64], str, str, NDArray[np.float64]]]:
    """Yield times in s since the first one, name, unit and values of each signal."""
    start = topics[0].arrival_ns[0]
    for topic in topics:
        yield from (((topic.arrival_ns - start) * 1e-9, *_split(title), v) for title, v in topic.fields.items())


def _mat_series(path: Path, topics: Sequence[Topic]) -> None:
    """Write a struct for each signal, as MATLAB's timeseries become."""
    from scipy.io import savemat

    series = {n: {"Name": n, "Time": s, "Data": v, "DataInfo": {"Units": u}} for s, n, u, v in _signals(topics)}
    savemat(path, {"data": series})


def _mat_pairs(path: Path, topics: Sequence[Topic]) -> None:
    """Write two vectors for each signal, its values and its times."""
    from scipy.io import savemat

    vectors: dict[str, Any] = {"Sample_rate": 100.0, "Start_time": "2025/11/24 14:05:12.125"}
    for seconds, name, _, values in _signals(topics):
        vectors |= {f"Data1_time_{name}": seconds, f"Data1_{name}": values}
    savemat(path, vectors)


def _mat_quantities(path: Path, topics: Sequence[Topic]) -> None:
    """Write a struct of quantities, each with data, unit and number of states, as a simulator's reader returns them."""
    from scipy.io import savemat

    quantities = {n: {"data": v, "unit": u, "nstates": 0.0} for _, n, u, v in _signals(topics)}
    seconds = next(_signals(topics))[0]
    savemat(path, {"data": {"Time": {"data": seconds, "unit": "s", "nstates": 0.0}, **quantities}})


def _mat_columns(path: Path, topics: Sequence[Topic]) -> None:
    """Write a matrix of times and values for each signal."""
    from scipy.io import savemat

    savemat(path, {name: np.stack([seconds, values], 1) for seconds, name, _, values in _signals(topics)})


def _mat_names(path: Path, topics: Sequence[Topic]) -> None:
    """Write a matrix, and the names and units of its columns as cells."""
    from scipy.io import savemat

    seconds, columns = next(_signals(topics))[0], [*_signals(topics)]
    cells = {"names": ["Time", *(n for _, n, _, _ in columns)], "units": ["s", *(u for _, _, u, _ in columns)]}
    table = {"data": np.stack([seconds, *(v for *_, v in columns)], 1)}
    savemat(path, table | {key: np.array(texts, dtype=object) for key, texts in cells.items()})


def _mat_values(path: Path, topics: Sequence[Topic]) -> None:
    """Write a struct for each channel with its times, values and units."""
    from scipy.io import savemat

    savemat(path, {n: {"Time": s, "Value": v, "Units": u} for s, n, u, v in _signals(topics)})


def _mat_recorder(path: Path, topics: Sequence[Topic]) -> None:
    """Write one struct with axes X and signals Y, as a real-time recorder exports."""
    from scipy.io import savemat

    record: dict[str, Any] = {"X": [], "Y": [], "Description": {"General": "recorder"}}
    for number, topic in enumerate(topics, 1):
        seconds = (topic.arrival_ns - topics[0].arrival_ns[0]) * 1e-9
        record["X"].append({"Name": f"t{number}", "Data": seconds, "Unit": "s"})
        for title, values in topic.fields.items():
            name, unit = _split(title)
            record["Y"].append({"Name": name, "Data": values, "Unit": unit, "XIndex": float(number)})
    savemat(path, {"rec1_001": record})


def _mat_scope(path: Path, topics: Sequence[Topic]) -> None:
    """Write what a scope logged: a struct for each topic, with the time and a struct array of signals."""
    from scipy.io import savemat

    kind = [("values", object), ("dimensions", object), ("label", object)]
    scopes = {}
    for topic in topics:
        signals = [(values.reshape(-1, 1), 1.0, title) for title, values in topic.fields.items()]
        seconds = (topic.arrival_ns - topics[0].arrival_ns[0]) * 1e-9
        scopes[topic.name.strip("/")] = {
            "time": seconds,
            "signals": np.array(signals, kind),
            "blockName": "model/Scope",
        }
    savemat(path, scopes)


def _json_lists(path: Path, topics: Sequence[Topic]) -> None:
    """Write one document: a list of objects for each topic, with times in ms."""
    document: dict[str, Any] = {"rideID": "7f", "startTime": int(topics[0].arrival_ns[0] // 10**6)}
    for topic in topics:
        columns = zip(*(values.tolist() for values in topic.fields.values()), strict=True)
        document[topic.name.strip("/")] = [
            {**dict(zip(topic.fields, row, strict=True)), "timestamp": stamp // 10**6}
            for stamp, row in zip(topic.arrival_ns.tolist(), columns, strict=True)
        ]
    path.write_text(json.dumps(document), encoding="utf-8")


def _mat_groups(path: Path, topics: Sequence[Topic]) -> None:
    """Write vectors named by the data groups of a measurement file, and those of their masters."""
    from scipy.io import savemat

    vectors: dict[str, Any] = {}
    for i, topic in enumerate(topics):
        vectors[f"DGM{i}_time"] = (topic.arrival_ns - topics[0].arrival_ns[0]) * 1e-9
        vectors |= {f"DG{i}_{name}": values for name, values in topic.fields.items()}
    savemat(path, vectors)


def _json_signals(path: Path, topics: Sequence[Topic]) -> None:
    """Write one document: for each signal its unit, and pairs of a time in µs and a value."""
    signals = {
        _split(title)[0]: {"unit": _split(title)[1] or None, "values": np.stack([t.arrival_ns // 1000, v], 1).tolist()}
        for t in topics
        for title, v in t.fields.items()
    }
    path.write_text(json.dumps(signals), encoding="utf-8")


def _json_channels(path: Path, topics: Sequence[Topic]) -> None:
    """Write one document: a list of channels with name, unit, rate and data."""
    rates = ((round(1.0 / float(np.median(np.diff(s))), 3), n, u, v) for s, n, u, v in _signals(topics))
    channels = [{"name": n, "unit": u, "samplerate": rate, "data": v.tolist()} for rate, n, u, v in rates]
    meta = {"vehicle": "car 3", "start": "2025-11-24T14:05:12.125Z"}
    path.write_text(json.dumps({"meta": meta, "channels": channels}), encoding="utf-8")


def _json_columns(path: Path, topics: Sequence[Topic]) -> None:
    """Write one document: an object for each topic, with a list for each column."""
    start = topics[0].arrival_ns[0]
    columns = {
        t.name.strip("/"): {
            "time": ((t.arrival_ns - start) * 1e-9).tolist(),
            **{n: v.tolist() for n, v in t.fields.items()},
        }
        for t in topics
    }
    path.write_text(json.dumps(columns), encoding="utf-8")


def _hdf5(path: Path, topics: Sequence[Topic]) -> None:
    """Write a group for each topic: a dataset of times in ns, and datasets with their units as attributes."""
    import h5py

    with h5py.File(path, "w") as file:
        for topic in topics:
            group = file.create_group(topic.name.strip("/"))
            group["timestamp"] = topic.arrival_ns
            for title, values in topic.fields.items():
                name, unit = _split(title)
                group.create_dataset(name, data=values, compression="gzip").attrs["unit"] = unit


def _hdf5_frame(path: Path, topics: Sequence[Topic]) -> None:
    """Write a data frame in the fixed format: names, index, and blocks of values."""
    import h5py

    with h5py.File(path, "w") as file:
        names = np.array([name for topic in topics for name in topic.fields], "S")
        frame = file.create_group("df")
        frame["axis0"], frame["block0_items"] = names, names
        frame["axis1"] = topics[0].arrival_ns * 1e-9
        frame["block0_values"] = np.stack([v for topic in topics for v in topic.fields.values()], 1)


def _hdf5_pairs(path: Path, topics: Sequence[Topic]) -> None:
    """Write a matrix of times and values for each signal, with its unit as an attribute."""
    import h5py

    with h5py.File(path, "w") as file:
        for seconds, name, unit, values in _signals(topics):
            file.create_dataset(f"channels/{name}", data=np.stack([seconds, values], 1)).attrs["unit"] = unit


def _hdf5_signals(path: Path, topics: Sequence[Topic]) -> None:
    """Write a group for each signal: its values, and their times in µs."""
    import h5py

    with h5py.File(path, "w") as file:
        for topic in topics:
            for title, values in topic.fields.items():
                group = file.create_group(_split(title)[0])
                group["timestamp"], group["data"] = topic.arrival_ns // 1000, values


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


def _parquet(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    fields = [pa.field("t", pa.timestamp("ns"))]
    split = [(_split(title), values) for title, values in columns.items()]
    fields += [pa.field(name, pa.float64(), metadata={"unit": unit}) for (name, unit), _ in split]
    arrays = [pa.array(stamps.astype("datetime64[ns]")), *(pa.array(values, from_pandas=True) for _, values in split)]
    pq.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), path)


def _seconds_parquet(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    pq.write_table(pa.table({**columns, "timestamps": (stamps - stamps[0]) * 1e-9}), path)


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
    "parquet-nested": (".parquet", _nested_parquet),
    "parquet": (".parquet", _parquet),
    "parquet-seconds": (".parquet", _seconds_parquet),
    "vbo": (".vbo", _vbo),
    "vbo-fewer": (".vbo", partial(_vbo, fewer=1)),
}
_GROUPS: dict[str, tuple[str, Callable[[Path, Sequence[Topic]], None]]] = {
    **{n: (d.get("suffix", ".csv"), partial(_text, n)) for n, d in _DIALECTS.items()},
    "csv-times": (".csv", _own_times),
    "txt-blocks": (".txt", _blocks),
    "csv-stamps": (".csv", _stamps),
    "mat-quantities": (".mat", _mat_quantities),
    "json-lists": (".json", _json_lists),
    "parquet-long": (".parquet", _long_parquet),
    "mat": (".mat", _mat),
    "mat-runs": (".mat", _mat_runs),
    "mat-series": (".mat", _mat_series),
    "mat-recorder": (".mat", _mat_recorder),
    "mat-7.3": (".mat", _mat_hdf5),
    "mat-pairs": (".mat", _mat_pairs),
    "mat-scope": (".mat", _mat_scope),
    "mat-columns": (".mat", _mat_columns),
    "mat-groups": (".mat", _mat_groups),
    "json-signals": (".json", _json_signals),
    "json-columns": (".json", _json_columns),
    "json-channels": (".json", _json_channels),
    "mat-values": (".mat", _mat_values),
    "mat-names": (".mat", _mat_names),
    "hdf5": (".h5", _hdf5),
    "hdf5-signals": (".hdf5", _hdf5_signals),
    "hdf5-frame": (".h5", _hdf5_frame),
    "hdf5-pairs": (".h5", _hdf5_pairs),
    "parquet-measures": (".parquet", _measures_parquet),
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
