"""Folders of finished runs with figures set by a test."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.records.tracks import make_track
from pdhef_logtool.results.parquet_sink import write_estimates as write_estimates_file
from pdhef_logtool.results.run_report import LogOutcome
from pdhef_logtool.results.tables import drive_part, write_tables as write_files
from pdhef_logtool.storage.documents import seal

START_NS = 1_700_000_000_000_000_000


def digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def entry(label: str, **changed: Any) -> dict[str, Any]:
    car = {"file": "golf", "name": "golf", "sha256": digest("golf"), "network_sha256": None}
    content = {f"{of}_sha256": digest(f"{of} {label}") for of in ("signals", "truth")}
    content |= {"sha256": digest(f"file {label}"), "mapping_sha256": digest("mapping"), "car": car}
    return {"log": label, "file": f"{label}.mcap", "outcome": "ok", "main": "pd-hef", **content, **changed}


def row(label: str, value: float, **changed: Any) -> MetricRow:
    base = {"estimator": "pd-hef", "signal": "sideslip_rad", "segment": "all", "metric": "rmse", "unit": "rad", "n": 99}
    return MetricRow(log=label, value=value, **{**base, **changed})


def write_tables(
    folder: Path,
    entries: Sequence[Mapping[str, Any]],
    rows: Sequence[MetricRow],
    reports: Mapping[str, Mapping[str, Any]] | None = None,
) -> None:
    """Write the tables of a run: ``entries`` as in run.json, and the report of each log that has one."""
    names = {f.name for f in fields(LogOutcome)}
    parts = []
    for of in entries:
        kind, _, reason = of["outcome"].partition(": ")
        ends = {"failed": reason if kind == "failed" else None, "lost": [reason] if kind == "lost" else ()}
        known = {"file": f"{of['log']}.mcap", "sha256": None, **{k: v for k, v in of.items() if k in names}}
        report = (reports or {}).get(of["log"])
        parts.append(drive_part(LogOutcome(**{**known, **ends}), report, [r for r in rows if r.log == of["log"]]))
    write_files(folder / "tables", parts)


def write_run(
    folder: Path,
    rmse: Mapping[str, float],
    *,
    entries: Sequence[dict[str, Any]] | None = None,
    rows: Sequence[MetricRow] = (),
    reports: Mapping[str, Mapping[str, Any]] | None = None,
    **document: Any,
) -> Path:
    """Write a run of drives with such RMSE of ``pd-hef``; ``entries`` and more ``rows`` as they are."""
    folder.mkdir(parents=True, exist_ok=True)
    logs = [entry(label) for label in rmse] if entries is None else list(entries)
    head = {"format": "pdhef.run", "version": 1, "config": {"friction": "auto"}, "versions": {"numpy": "2.0"}}
    (folder / "run.json").write_text(json.dumps(seal({**head, "logs": logs, **document})))
    known = {"log": {"start_ns": START_NS, "duration_s": 1.0}}
    reports = reports or {of["log"]: known for of in logs if not of["outcome"].startswith("failed")}
    write_tables(folder, logs, [*(row(label, value) for label, value in rmse.items()), *rows], reports)
    return folder


def write_estimates(folder: Path, label: str, **tracks: Mapping[str, Any]) -> None:
    """Write a log's estimates.parquet, of columns of tracks by name; ``stamps_ns`` is at 100 Hz if it is not given."""
    made = []
    for name, columns in tracks.items():
        known = dict(columns)
        n = len(next(iter(known.values())))
        stamps = known.pop("stamps_ns", START_NS + 10_000_000 * np.arange(n, dtype=np.int64))
        made.append(make_track(name.replace("_", "-"), stamps, **known))
    write_estimates_file(folder / "logs" / label / "estimates.parquet", made)
