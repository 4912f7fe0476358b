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


def _lab(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write a laboratory system's export: test metadata above the names, units in brackets below them."""
    names = [_split(title) for title in columns]
    head = ["Measurement:;Test 12;;", "Recorder:;17,5 V;car 3;", "Start:;24.11.2025;14:05:12,125;", ""]
    head += [";".join(["Time", *(n for n, _ in names)]), ";".join(["[s]", *(f"[{u}]" for _, u in names)])]
    rows = _text([f"{s / 1e9:.4f}" for s in (stamps - stamps[0]).tolist()], columns, [], ";").replace(".", ",")
    path.write_text("\n".join([*head, rows]), encoding="utf-8")


def _dated(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write day and time of day in two columns."""
    texts = np.datetime_as_string(stamps.astype("datetime64[ns]"), "ms")
    clock = [f"{t[8:10]}.{t[5:7]}.{t[:4]},{t[11:]}" for t in texts]
    path.write_text(_text(clock, columns, ["Date", "Time", *columns], ","))


def _bare(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write names without units."""
    clock = [f"{s / 1e9:.4f}" for s in (stamps - stamps[0]).tolist()]
    path.write_text(_text(clock, columns, ["Time", *columns], ","))


def _plain(path: Path, _: IntArray, columns: dict[str, Any], separator: str = ",") -> None:
    """Write the columns as they are; one of them is the time."""
    rows = (separator.join(f"{v:.15g}" for v in row) for row in np.stack(list(columns.values()), 1).tolist())
    path.write_text("\n".join([separator.join(columns), *rows, ""]), encoding="utf-8")


def _sources(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write a lap timer's export: remarks, names of which some are equal, units, sources."""
    names = [_split(title) for title in columns]
    above = ["This file is created using a lap timer", "Format,3", 'Track name,"Test"', "Created,24/11/2025,14:05", ""]
    above.append(",".join(["timestamp", "fragment_id", *(n for n, _ in names)]))
    above.append(",".join(["unix time", "", *(u.partition("|")[0] for _, u in names)]))
    above.append(",".join(["", "", *(u.partition("|")[2] for _, u in names)]))
    rows = _text([f"{s / 1e9:.3f},0" for s in stamps.tolist()], columns, [], ",")
    path.write_text("\n".join([*above, rows]), encoding="utf-8")


def _pipes(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write titles of name, unit, limits and rate between bars."""
    titles = [f'"{n}"|"{u}"|0.0|0.0|100' for n, u in map(_split, columns)]
    clock = [f"{(s - int(stamps[0])) // 10**6},{s // 10**6}" for s in stamps.tolist()]
    path.write_text(_text(clock, columns, ['"Interval"|"ms"|0|0|1', '"Utc"|"ms"|0|0|1', *titles], ","))


def _units_row(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write a row of units below the names, and a count before the time."""
    names = [_split(title) for title in columns]
    head = [",".join(["FRAME", "TIME", *(n for n, _ in names)]), ",".join(["n/a", "s", *(u for _, u in names)])]
    clock = [f"{11630 + 10 * i}.00000,{s / 1e9:.5f}" for i, s in enumerate((stamps - stamps[0]).tolist())]
    path.write_text("\n".join([*head, _text(clock, columns, [], ",")]), encoding="utf-8")


def _keyed(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write a logger's export: quoted keys and values above the titles, units and an empty line below them."""
    names = [_split(title) for title in columns]
    head = [["Format", "Logger CSV File"], ["Vehicle", "car 3"], ["Date", "Monday, November 24, 2025"]]
    head += [["Time", "2:05 PM"], ["Sample Rate", "100"], ["Duration", "90.000"], ["Segment Times", "1:30.000"], []]
    head += [["Time", *(n for n, _ in names)], ["sec", *(u for _, u in names)], []]
    rows = [",".join(f'"{cell}"' for cell in row) for row in head]
    clock = [f"{s / 1e9:.3f}" for s in (stamps - stamps[0]).tolist()]
    path.write_text("\r\n".join([*rows, *_text(clock, columns, [], ",").split("\n")]), encoding="utf-8")


def _remarks(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write an inertial sensor's export: remarks, and columns between tabulators."""
    remarks = ["// General information:", "//  ProductCode: INS", "// Coordinate system: ENU"]
    clock = [f"{i % 65536}\t{(s // 100_000) % 2**32}" for i, s in enumerate(stamps.tolist())]
    text = _text(clock, columns, ["PacketCounter", "SampleTimeFine", *columns], "\t")
    path.write_text("\n".join([*remarks, text]), encoding="utf-8")


def _frame(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write a data frame with its index, which has no title, and times as texts."""
    texts = np.datetime_as_string(stamps.astype("datetime64[ns]"), "us").tolist()
    clock = [f"{i},{text.replace('T', ' ')}" for i, text in enumerate(texts)]
    path.write_text(_text(clock, columns, ["", "Zeitstempel", *columns], ","), encoding="utf-8")


def _logger(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write a manufacturer's logger: tabulators, a row of names and one of units in parentheses, time in µs."""
    names = [_split(title) for title in columns]
    head = ["\t".join(["timestamp", "status", *(n for n, _ in names)])]
    head += ["\t".join(["(us)", "(na)", *(f"({u})" for _, u in names)])]
    clock = [f"{(s - int(stamps[0])) // 1000}\t0" for s in stamps.tolist()]
    path.write_text("\n".join([*head, _text(clock, columns, [], "\t")]), encoding="utf-8")


def _levels(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write a data frame whose titles have two levels, ``device|signal``, below them the name of the index."""
    names = [title.split("|") for title in columns]
    head = [",".join(["device", *(n[0] for n in names)]), ",".join(["signal", *(n[1] for n in names)])]
    head.append(",".join(["time", *("" for _ in names)]))
    clock = [f"{s / 1e9:.3f}" for s in (stamps - stamps[0]).tolist()]
    path.write_text("\n".join([*head, _text(clock, columns, [], ",")]), encoding="utf-8")


def _duration(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write a timetable whose times are durations with their unit."""
    clock = [f"{s / 1e9:.6g} sec" for s in (stamps - stamps[0]).tolist()]
    path.write_text(_text(clock, columns, ["Time", *columns], ","), encoding="utf-8")


def _race_export(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write a race analysis program's export: pairs of keys above the titles, units and empty lines, quoted cells."""
    names = [_split(title) for title in columns]
    head = [
        ["Format", "MoTeC CSV File", "", "", "Workbook", ""],
        ["Log Date", "24/11/2025", "", "", "Origin Time", "0.000", "s"],
    ]
    head += [["Log Time", "14:05:12", "", "", "Start Time", "0.000", "s"], ["Sample Rate", "100.000", "Hz"], []]
    head += [["Time", *(n for n, _ in names)], ["s", *(u for _, u in names)], [], []]
    table = [
        [f"{s / 1e9:.3f}" for s in (stamps - stamps[0]).tolist()],
        *([f"{v:.9g}" for v in c] for c in columns.values()),
    ]
    rows = [",".join(f'"{cell}"' for cell in row) for row in (*head, *zip(*table, strict=True))]
    path.write_text("\r\n".join([*rows, ""]), encoding="utf-8")


def _sections(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write an engine tuner's log: sections in brackets, numbers of the channels above their names and units."""
    names = [_split(title) for title in columns]
    head = ["Log File", "Version: 1.0", "", "[Log Information]", "Creation Time: 11/24/2025 2:05:12 PM", "Notes: ", ""]
    head += ["[Channel Information]", ",".join(str(i) for i in (0, *range(12, 12 + len(names))))]
    head += [
        ",".join(["Offset", *(n for n, _ in names)]),
        ",".join(["s", *(u for _, u in names)]),
        "",
        "[Channel Data]",
    ]
    clock = [f"{s / 1e9:.3f}" for s in (stamps - stamps[0]).tolist()]
    path.write_text("\n".join([*head, _text(clock, columns, [], ",")]), encoding="utf-8")


def _time_of_day(
    path: Path, stamps: IntArray, columns: dict[str, Any], title: str, encoding: str, comma: bool = True
) -> None:
    """Write names and units in two rows and the time of day, in the encoding and with the decimal sign of a country."""
    names = [_split(column) for column in columns]
    clock = [t[11:] for t in np.datetime_as_string(stamps.astype("datetime64[ns]"), "ms")]
    head = [";".join([title, *(n for n, _ in names)]), ";".join(["", *(u for _, u in names)])]
    text = "\n".join([*head, _text(clock, columns, [], ";")])
    path.write_bytes((text.replace(".", ",") if comma else text.replace(";", ",")).encode(encoding))


def _calendar(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write an inertial sensor's export: remarks, and the time from year to nanosecond in seven columns."""
    titles = [
        "PacketCounter",
        *(f"UTC_{n}" for n in ("Nano", "Year", "Month", "Day", "Hour", "Minute", "Second")),
        "UTC_Valid",
    ]
    clock = []
    for i, stamp in enumerate(stamps.tolist()):
        at = dt.datetime.fromtimestamp(stamp // 10**9, tz=dt.UTC)
        clock.append(f"{i % 65536}\t{stamp % 10**9}\t{at:%Y\t%m\t%d\t%H\t%M\t%S}\t5")
    remarks = [
        "// Start Time: Unknown",
        "// Update Rate: 100.0Hz",
        "// Filter Profile: automotive",
        "// Option Flags: none",
    ]
    path.write_text("\n".join([*remarks, _text(clock, columns, [*titles, *columns], "\t")]), encoding="utf-8")


def _hashes(path: Path, stamps: IntArray, columns: dict[str, Any]) -> None:
    """Write a phone's lap timer: remarks after #, quoted titles, seconds since the start beside those of the epoch."""
    head = ["# RaceRender Data: lap timer on a phone", "# Vehicle: car 3", "# Device Free Space: 12345 MB"]
    titles = [f'"{title}"' for title in ("Time", "UTC Time", "Lap", *columns)]
    clock = [f"{(s - int(stamps[0])) / 1e9:.3f},{s / 1e9:.3f},1" for s in stamps.tolist()]
    path.write_text("\n".join([*head, _text(clock, columns, titles, ","), "# Session End"]), encoding="utf-8")


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


def _parameters(path: Path, topics: Sequence[Topic]) -> None:
    """Write an app's long form: quoted seconds of the day, parameter, value and unit, with a semicolon at the end."""
    rows = [
        (f"{stamp % (86_400 * 10**9) / 1e9:.6f}", name, f"{v:.9g}", unit) for stamp, name, v, unit in _long_rows(topics)
    ]
    cells = [("SECONDS", "PID", "VALUE", "UNITS"), *rows]
    path.write_text("\n".join([*("".join(f'"{cell}";' for cell in row) for row in cells), ""]), encoding="utf-8")


def _long_rows(topics: Sequence[Topic]) -> list[tuple[int, str, float, str]]:
    """Return a row for each value: time in ns, signal, value, unit."""
    rows = [
        (stamp, *_split(title)[:1], value, _split(title)[1])
        for topic in topics
        for title, values in topic.fields.items()
        for stamp, value in zip(topic.arrival_ns.tolist(), values.tolist(), strict=True)
    ]
    return sorted(rows)


def _long_csv(path: Path, topics: Sequence[Topic]) -> None:
    rows = [f"{stamp / 1e9:.6f},{name},{value:.9g}" for stamp, name, value, _ in _long_rows(topics)]
    path.write_text("\n".join(["timestamp,signal,value", *rows, ""]))


def _records_csv(path: Path, topics: Sequence[Topic]) -> None:
    """Write a stream of values with columns on the session beside them."""
    about = "expire_at,lap,meta_event,meta_session,meta_source,meta_time,original_vehicle_id,outing"
    rows = [f"{about},telemetry_name,telemetry_value,timestamp,vehicle_id,vehicle_number"]
    for stamp, name, value, _ in _long_rows(topics):
        clock, late = np.datetime_as_string(np.array([stamp, stamp + 10**14], "datetime64[ns]"), "ms")
        about = f",1,I_R04_2025-11-24,R1,kafka:raw,{late}Z,CAR-002-2,0"
        rows.append(f"{about},{name},{value:.6g},{clock}Z,CAR-002-2,2")
    path.write_text("\n".join([*rows, ""]))


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


def _mat_series(path: Path, topics: Sequence[Topic]) -> None:
    """Write a struct for each signal, as MATLAB's timeseries become."""
    from scipy.io import savemat

    signals = ((t, *_split(title), values) for t in topics for title, values in t.fields.items())
    series = {
        name: {
            "Name": name,
            "Time": (t.arrival_ns - topics[0].arrival_ns[0]) * 1e-9,
            "Data": v,
            "DataInfo": {"Units": u},
        }
        for t, name, u, v in signals
    }
    savemat(path, {"data": series})


def _mat_pairs(path: Path, topics: Sequence[Topic]) -> None:
    """Write two vectors for each signal, its values and its times."""
    from scipy.io import savemat

    vectors: dict[str, Any] = {"Sample_rate": 100.0, "Start_time": "2025/11/24 14:05:12.125"}
    for topic in topics:
        for name, values in topic.fields.items():
            vectors[f"Data1_time_{name}"] = (topic.arrival_ns - topics[0].arrival_ns[0]) * 1e-9
            vectors[f"Data1_{name}"] = values
    savemat(path, vectors)


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
    "csv-lab": (".csv", _lab),
    "csv-dated": (".csv", _dated),
    "csv-bare": (".csv", _bare),
    "csv-plain": (".csv", _plain),
    "csv-tabs": (".txt", partial(_plain, separator="\t")),
    "csv-sources": (".csv", _sources),
    "csv-pipes": (".csv", _pipes),
    "csv-units": (".csv", _units_row),
    "csv-keyed": (".csv", _keyed),
    "csv-remarks": (".txt", _remarks),
    "csv-frame": (".csv", _frame),
    "csv-logger": (".txt", _logger),
    "csv-levels": (".csv", _levels),
    "csv-duration": (".csv", _duration),
    "csv-race": (".csv", _race_export),
    "csv-sections": (".csv", _sections),
    "csv-japanese": (".csv", partial(_time_of_day, title="時刻", encoding="cp932", comma=False)),
    "csv-swedish": (".csv", partial(_time_of_day, title="Tid", encoding="utf-8")),
    "csv-calendar": (".txt", _calendar),
    "csv-hashes": (".csv", _hashes),
    "parquet-nested": (".parquet", _nested_parquet),
    "parquet": (".parquet", _parquet),
    "vbo": (".vbo", _vbo),
    "vbo-fewer": (".vbo", partial(_vbo, fewer=1)),
}
_GROUPS: dict[str, tuple[str, Callable[[Path, Sequence[Topic]], None]]] = {
    "csv-long": (".csv", _long_csv),
    "csv-records": (".csv", _records_csv),
    "csv-times": (".csv", _own_times),
    "csv-parameters": (".csv", _parameters),
    "parquet-long": (".parquet", _long_parquet),
    "mat": (".mat", _mat),
    "mat-runs": (".mat", _mat_runs),
    "mat-series": (".mat", _mat_series),
    "mat-recorder": (".mat", _mat_recorder),
    "mat-7.3": (".mat", _mat_hdf5),
    "mat-pairs": (".mat", _mat_pairs),
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
