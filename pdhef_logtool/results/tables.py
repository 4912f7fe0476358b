"""The tables of a run: a Parquet file each in ``OUT/tables``, which answer questions about many drives.

A drive leaves its rows of all tables in one part, a Parquet file of one row with a list of rows for each table, so that
a run that is interrupted has lost nothing. :func:`write_tables` concatenates parts, a few at a time.
"""

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from itertools import islice
from pathlib import Path, PurePath
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.records.signals import S_PER_NS
from pdhef_logtool.results.opened_run import TABLES
from pdhef_logtool.results.parquet_sink import arrow_array, arrow_schema, parquet_writer, reading
from pdhef_logtool.results.run_report import LogOutcome

#: Parts that are read before a row group of theirs is written.
_PARTS_AT_ONCE = 256
_JUDGED = "sideslip_rad"


def drive_part(
    outcome: LogOutcome,
    report: Mapping[str, Any] | None,
    rows: Sequence[MetricRow] = (),
    plan: Mapping[str, Any] | None = None,
) -> pa.Table:
    """Return the rows of a log in all tables.

    ``report``: the document of report.json, None if the log failed. ``plan``: verdicts of a plan on the log.
    """
    report, plan = report or {}, plan or {}
    space = report.get("operating_space") or {"cells": ()}
    of_log: dict[str, Iterable[Mapping[str, Any]]] = {
        "drives": [_drive(outcome, report, rows)],
        "checks": [{**c, "subject": c["name"].rpartition(".")[0]} for c in report.get("checks", ())],
        "events": [{**s, "event": s["name"], **_times(s)} for s in report.get("segments", ())],
        "faults": _faults(report),
        "exposure": [
            {**c, "speed_m_s": space["speed_edges_m_s"][c["speed"]], "ay_m_s2": space["ay_edges_m_s2"][c["ay"]]}
            for c in space["cells"]
        ],
        "metadata": [{"key": str(k), "value": str(v)} for k, v in (report.get("metadata") or {}).items()],
        "verdicts": _verdicts(plan),
    }
    columns = {
        name: _list(name, [{**row, "log": outcome.log} for row in of_table]) for name, of_table in of_log.items()
    }
    return pa.table({**columns, "metrics": _list("metrics", rows)})


def _list(name: str, rows: Sequence[Any]) -> pa.Array:
    """Return rows [N] as a column with one list of them."""
    table = _table(name, rows)
    struct = pa.StructArray.from_arrays([c.combine_chunks() for c in table.columns], fields=list(table.schema))
    return pa.ListArray.from_arrays(arrow_array(np.array([0, len(rows)]), pa.int32()), struct)


def _table(name: str, rows: Sequence[Any]) -> pa.Table:
    """Return rows, mappings or records, as a table; entries that a mapping lacks are null."""
    schema = arrow_schema(f"{name}.parquet.json")
    get: Any = dict.get if rows and isinstance(rows[0], dict) else getattr
    return pa.Table.from_arrays([arrow_array([get(r, f.name) for r in rows], f.type) for f in schema], schema=schema)


def _drive(outcome: LogOutcome, report: Mapping[str, Any], rows: Sequence[MetricRow]) -> dict[str, Any]:
    log, car = report.get("log") or {}, outcome.car or {}
    ran = {e["name"]: e["causal"] for e in report.get("estimators", ()) if e["outcome"] == "ran"}
    main = outcome.main or next(iter(ran), None)
    kind, _, reason = outcome.outcome.partition(": ")
    figures = _independent_figures(rows, main)
    faults = report.get("faults")
    return {
        **{key: getattr(outcome, key) for key in ("folder", "day", "route")},
        **{f"{key}sha256": getattr(outcome, f"{key}sha256") for key in ("", "signals_", "truth_", "mapping_")},
        "file": PurePath(outcome.file).name,
        "outcome": kind,
        "reason": reason or None,
        "log_format": log.get("kind"),
        "start_ns": log.get("start_ns"),
        "seconds": log.get("duration_s"),
        "car": car.get("name") or (report.get("vehicle") or {}).get("name"),
        "car_sha256": car.get("sha256"),
        "network_sha256": car.get("network_sha256"),
        "friction_source": (report.get("friction") or {}).get("source"),
        "friction_median": (report.get("operating_space") or {}).get("friction_median"),
        "low_speed_m_s": (report.get("vehicle") or {}).get("low_speed_blend_m_s"),
        "estimator": main,
        "causal": ran.get(main),
        "has_truth": (report.get("truth") or {}).get("available"),
        "unscored": None if "rmse" in figures else _why_unscored(report),
        "sideslip_rmse_rad": figures.get("rmse"),
        "sideslip_coverage95": figures.get("coverage95"),
        "failed_checks": sum(c["verdict"] == "failed" and not c["waived"] for c in report.get("checks", ())),
        "sensor_faults": None if faults is None else len(faults),
    }


def _independent_figures(rows: Sequence[MetricRow], estimator: str | None) -> dict[str, float]:
    """Return the sideslip figures of a whole drive by metric, where the ground truth is independent."""
    chosen = (r for r in rows if (r.estimator, r.signal, r.segment) == (estimator, _JUDGED, "all") and r.independent)
    return {r.metric: r.value for r in chosen if math.isfinite(r.value)}


def _why_unscored(report: Mapping[str, Any]) -> str | None:
    if "truth" not in report:
        return None
    if not report["truth"]["available"]:
        return "the log has no ground truth"
    if _JUDGED in report["truth"]["not_independent"]:
        return "its ground truth is not independent"
    texts = (report.get("answer") or {}).get("texts") or {}
    return str(texts.get("result", "")).partition(" is not scored: ")[2] or "no figure of it is scored"


def _faults(report: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for f in report.get("faults") or ():
        span = {"start_ns": f["intervals"][0]["start_ns"], "end_ns": f["intervals"][-1]["end_ns"]}
        yield {**f, **(span if f["intervals"] else {}), "origin": "sensor", "place": f["sensor"]}
    for x in report.get("losses", ()):
        yield {**x, **_times(x), "origin": "log", "place": x["where"], "text": x["what"]}


def _times(of: Mapping[str, Any]) -> dict[str, float]:
    if of["start_ns"] is None or of["end_ns"] is None:
        return {}
    return {"seconds": (of["end_ns"] - of["start_ns"]) * S_PER_NS}


def _verdicts(plan: Mapping[str, Any]) -> list[dict[str, Any]]:
    return [{**r, "requirement": r["id"]} for r in plan.get("requirements") or ()]


def write_part(path: Path, part: pa.Table) -> None:
    """Write a part, or another table; raises OutputError."""
    with parquet_writer(path, part.schema) as writer:
        writer.write_table(part)


def write_metrics(path: Path, rows: Sequence[MetricRow]) -> None:
    """Write metrics.parquet, rows in the order given; NaN becomes null; raises OutputError."""
    write_part(path, _table("metrics", rows))


def read_part(path: Path) -> pa.Table:
    """Return a part; raises OutputError."""
    with reading(path), pq.ParquetFile(path) as file:
        return file.read()


def write_tables(folder: Path, parts: Iterable[pa.Table], folders: Sequence[str] | None = None) -> None:
    """Write the tables from the parts of logs, in their order; raises OutputError.

    ``folders``: the present folder of each log below the folder of the run; None: as in the parts.
    """
    left, done = iter(parts), 0
    schemas = {name: arrow_schema(f"{name}.parquet.json") for name in TABLES}
    with ExitStack() as stack:
        writers = {
            name: stack.enter_context(parquet_writer(folder / f"{name}.parquet", schema))
            for name, schema in schemas.items()
        }
        while some := [*islice(left, _PARTS_AT_ONCE)]:
            whole = pa.concat_tables(some)
            for name, writer in writers.items():
                # To flatten the lists would import all functions of pyarrow.
                bounds = [(x.values, x.offsets[0].as_py(), x.offsets[-1].as_py()) for x in whole[name].chunks]
                rows = pa.concat_arrays([values[first:end] for values, first, end in bounds])
                columns = dict(zip(schemas[name].names, rows.flatten(), strict=True))
                if name == "drives" and folders is not None:
                    columns["folder"] = arrow_array(folders[done : done + len(some)], pa.string())
                writer.write_table(pa.Table.from_arrays([*columns.values()], schema=schemas[name]))
            done += len(some)


def add_verdicts(folder: Path, plan: Mapping[str, Any]) -> None:
    """Add the verdicts on the whole run to those on its drives; raises OutputError."""
    path = folder / "verdicts.parquet"
    write_part(path, pa.concat_tables([read_part(path), _table("verdicts", _verdicts(plan))]))
