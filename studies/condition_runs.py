"""All drives of the condition table through all estimators, in processes, row by row; a finished row is kept.

A row's file carries a key: the hash of the drives' contents, the vehicle file, the model, the estimators' names, the
settings, and the sources of what computes. A row whose key is as it was is not computed again.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any

import polars as pl
import pyarrow.parquet as pq

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.table import FILTERS, Options, runnable
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.runs.estimating import calibrator
from pdhef_logtool.storage.documents import digest
from pdhef_logtool.storage.files import PendingFile
from pdhef_logtool.workers.supervisor import Crew, Tell
from studies.condition_drives import read_drive, score, told
from studies.pages import ROOT

COLUMNS = ("row", "drive", "estimator", "signal", "segment", "metric", "value", "unit", "n")
_KEY, _NOTES = b"key", b"notes"
#: What decides the figures, beside the drives: all sources of these folders.
_SOURCES = ("pdhef_logtool", "truthsim", "studies")


@dataclass(frozen=True, slots=True)
class Setup:
    """What every drive is run with: a car as ``--car`` takes it, and a network instead of its own."""

    car: Path
    network: Path | None
    estimators: tuple[str, ...]

    @property
    def loaded(self) -> Car:
        """The car, read once a process."""
        return _loaded(self.car, self.network)

    @property
    def identity(self) -> dict[str, Any]:
        """What the setup is, by content."""
        car = self.loaded
        parts = {"trust": car.trust, "intervals": car.intervals}
        return {
            "physics": car.physics_sha256,
            "noise": car.noise_sha256,
            "network": None if car.network is None else car.network.sha256,
            **{name: None if part is None else digest(part.model_dump(mode="json")) for name, part in parts.items()},
            "estimators": list(self.estimators),
        }


@dataclass(frozen=True, slots=True)
class Task:
    """One drive of one row."""

    row: str
    log: Path
    sha256: str
    assume: dict[str, Any]
    friction: float | None = None

    @property
    def use_speed(self) -> bool:
        """Whether the row has wheel speeds."""
        return self.assume.get("sensors") != "esp"


@dataclass(frozen=True, slots=True)
class RowResult:
    """What came of a row: figures in the columns ``COLUMNS``, and sentences on what did not run."""

    table: pl.DataFrame
    notes: tuple[str, ...]


#: A drive's figures in the columns ``COLUMNS`` but the row's name, and what did not run.
_Done = tuple[Task, list[tuple[Any, ...]], list[str]]


@cache
def source_digest() -> str:
    """Return the hash of the sources that decide the figures."""
    files = sorted(file for place in _SOURCES for file in (ROOT / place).rglob("*.py"))
    return digest([[f.relative_to(ROOT).as_posix(), f.read_text(encoding="utf-8")] for f in files])


def row_key(setup: Setup, tasks: Sequence[Task]) -> str:
    """Return the hash of all that the row's figures depend on."""
    document = {
        "setup": setup.identity,
        "assume": tasks[0].assume,
        "drives": [[t.log.name, t.sha256, t.friction] for t in tasks],
        "sources": source_digest(),
    }
    return digest(document)


def run_rows(setup: Setup, rows: dict[str, list[Task]], folder: Path, *, jobs: int, title: str) -> dict[str, RowResult]:
    """Run the tasks of every row, keep what is there already, write each row's Parquet as soon as it is whole."""
    folder.mkdir(parents=True, exist_ok=True)
    done: dict[str, RowResult] = {}
    rows = {name: tasks for name, tasks in rows.items() if tasks}
    with _workers(setup, jobs) as work:
        for name, tasks in rows.items():
            path, key = folder / f"{name}.parquet", row_key(setup, tasks)
            done[name] = _read(path, key) or _write(path, list(work(tasks)), key)
            progress(f"\r{title}: {len(done)} of {len(rows)} rows   ")
    progress("\n")
    return done


def _read(path: Path, key: str) -> RowResult | None:
    try:
        metadata = pq.read_metadata(path).metadata or {}
        if metadata.get(_KEY) != key.encode():
            return None
        return RowResult(pl.read_parquet(path), tuple(json.loads(metadata[_NOTES])))
    except (OSError, ValueError, KeyError):
        return None


def _write(path: Path, parts: list[_Done], key: str) -> RowResult:
    parts = sorted(parts, key=lambda p: p[0].log.as_posix())
    schema = dict.fromkeys(COLUMNS, pl.String) | {"value": pl.Float64, "n": pl.Int64}
    table = pl.DataFrame([(task.row, *r) for task, rows, _ in parts for r in rows], schema=schema, orient="row")
    notes = tuple(dict.fromkeys(n for _, _, notes in parts for n in notes))
    arrow = table.to_arrow().replace_schema_metadata({_KEY: key.encode(), _NOTES: json.dumps(notes).encode()})
    with PendingFile(path) as pending:
        pq.write_table(arrow, pending.path, compression="zstd")
    return RowResult(table, notes)


@contextmanager
def _workers(setup: Setup, jobs: int) -> Iterator[Callable[[Sequence[Task]], Iterator[_Done]]]:
    """Yield what runs tasks, here or in processes."""
    if jobs == 1:
        yield lambda tasks: (_run(setup, task) for task in tasks)
        return

    def work(tasks: Sequence[Task]) -> Iterator[_Done]:
        for ended in crew.each(tasks):
            if ended.result is None:
                raise RuntimeError(f"{ended.item.row}, {ended.item.log}: {ended.failure}")
            yield ended.result

    with Crew[Task, _Done](partial(_told, setup), jobs=jobs, preload=(__name__, *FILTERS)) as crew:
        yield work


def _told(setup: Setup, task: Task, _tell: Tell) -> _Done:
    return _run(setup, task)


def _run(setup: Setup, task: Task) -> _Done:
    rows, notes = _score(setup, task)
    return task, [(r.log, r.estimator, r.signal, r.segment, r.metric, r.value, r.unit, r.n) for r in rows], notes


@cache
def _loaded(car: Path, network: Path | None) -> Car:
    return Car.load(car, network=network)


@cache
def _estimators(setup: Setup, available: frozenset[str], use_speed: bool) -> tuple[tuple[Estimator, ...], list[str]]:
    """Build estimators once a process: they are immutable, and the network takes longer to build than to run."""
    ready, skipped = runnable(setup.estimators, setup.loaded, available, Options(use_speed))
    return tuple(ready), [f"{s.name} does not run: {s.reason}" for s in skipped]


def _score(setup: Setup, task: Task) -> tuple[list[MetricRow], list[str]]:
    drive = read_drive(task.log, setup.loaded, friction=task.friction)
    signals = told(drive, task.assume)
    estimators, skipped = _estimators(setup, signals.available, task.use_speed)
    notes, intervals = list(skipped), calibrator(setup.loaded, estimators)
    rows: list[MetricRow] = []
    for estimator in estimators:
        try:
            track, _ = run_window(estimator, signals)
            rows += score(intervals.add(track, signals), drive)
        except Exception as error:  # noqa: BLE001 (one estimator's failure on one drive is a result, not an end)
            notes.append(f"{estimator.name} failed on {task.row}/{drive.name}: {type(error).__name__}: {error}")
    return rows, notes


def as_frame(results: dict[str, RowResult]) -> pl.DataFrame:
    """Join the tables of all rows."""
    return pl.concat([r.table for r in results.values()]) if results else pl.DataFrame()


def progress(text: str) -> None:
    """Write a line, or its replacement, to stderr."""
    sys.stderr.write(text if text.startswith(("\r", "\n")) else text + "\n")
    sys.stderr.flush()
