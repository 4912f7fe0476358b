"""A finished run, read back from the files that it left; every command that reads a run reads it here."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any

from pdhef_logtool.logs.discovery import RUN_FILE
from pdhef_logtool.records.documents import read_json
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.object_store import Mirror, is_url

if TYPE_CHECKING:
    import polars as pl

#: Folder of a log's outputs within those of a run, the figures of all logs, and what lies in a log's folder.
LOGS = "logs"
METRICS_FILE = "metrics.parquet"
REPORT_FILE = "report.json"
#: What a run of several logs has done, a line a drive; and the folder of the figures of each, by run and car.
JOURNAL_FILE = "journal.jsonl"
PARTS = "metrics"
ESTIMATES_FILE = "estimates.parquet"
RECORDING_FILE = "recording.rrd"
#: A page for people: of a log in its folder, of all logs in the run's.
PAGE_FILE = "report.html"

#: Bytes of one document: run.json of 10⁵ logs has 40 MB.
MAX_DOCUMENT_BYTES = 1 << 28

_REMEDY = "pdhef run LOG -o OUT writes one"


@dataclass(frozen=True, slots=True)
class OpenedLog:
    """What a run left of one log. ``entry`` is its record in run.json; nothing is read before it is asked for.

    Of a run at a URL files are fetched into a folder of this machine when they are asked for.
    """

    label: str
    outcome: str
    folder: Path
    entry: dict[str, Any]
    mirror: Mirror | None = None

    def file(self, name: str) -> Path | None:
        """Return a file of the log's folder, None where the run wrote none; raises OutputError if a store fails."""
        if self.mirror is not None:
            return self.mirror.fetch(f"{LOGS}/{self.label}/{name}")
        path = self.folder / name
        return path if path.is_file() else None

    def report(self) -> dict[str, Any] | None:
        """Return report.json, None where the log failed; raises OutputError for a damaged one."""
        path = self.file(REPORT_FILE)
        if path is None:
            return None
        return read_json(path, "a report.json", OutputError, "run the log again", MAX_DOCUMENT_BYTES)

    def main(self) -> str:
        """Return the estimator that is the drive's answer; empty where there is none."""
        if "main" in self.entry:
            return str(self.entry["main"] or "")
        answer = (self.report() or {}).get("answer") or {}  # run.json of an older version does not say it
        return str(answer.get("main") or "")

    def estimates(self) -> pl.LazyFrame | None:
        """Return estimates.parquet, of which only what is asked for is read; None where there is none."""
        import polars as pl

        path = self.file(ESTIMATES_FILE)
        return None if path is None else pl.scan_parquet(path)


@dataclass(frozen=True, slots=True)
class OpenedRun:
    """A run's folder: ``document`` is run.json, ``logs`` stand in its order, failed ones too.

    Of a run at a URL the folder is one of this machine, which has of it what was asked for and goes with this.
    """

    folder: Path
    document: dict[str, Any]
    logs: tuple[OpenedLog, ...]
    mirror: Mirror | None = None

    @property
    def place(self) -> str:
        """Where people find it."""
        return str(self.folder) if self.mirror is None else self.mirror.objects.shown

    def metrics(self) -> pl.LazyFrame:
        """Return the figures of all logs, a row a figure (metrics.parquet), read when collected."""
        import polars as pl

        return pl.scan_parquet(self.folder / METRICS_FILE)


def open_run(output: Path | str) -> OpenedRun:
    """Open the outputs of a run.

    Parameters
    ----------
    output : what ``-o`` named, a folder or a URL.

    Raises
    ------
    OutputError
        There is no finished run in the folder: run.json or metrics.parquet is missing or unreadable.
    """
    mirror = Mirror(str(output)) if is_url(output) else None
    folder = Path(output) if mirror is None else mirror.folder
    for name in (RUN_FILE, METRICS_FILE):
        if mirror is not None:
            mirror.fetch(name)
        if not (folder / name).is_file():
            got = f"a folder without {name}" if folder.is_dir() else "no such folder"
            where = str(folder) if mirror is None else mirror.objects.shown
            raise OutputError(expected="the outputs of a run", got=got, where=where, remedy=_REMEDY)
    document = read_json(folder / RUN_FILE, "the run.json of a run", OutputError, _REMEDY, MAX_DOCUMENT_BYTES)
    if document.get("format") != "pdhef.run" or not isinstance(document.get("logs"), list):
        got = f"format {document.get('format')!r}"
        raise OutputError(expected="the run.json of a run", got=got, where=str(folder / RUN_FILE), remedy=_REMEDY)
    return OpenedRun(folder, document, tuple(_opened(entry, folder, mirror) for entry in document["logs"]), mirror)


def _opened(entry: object, folder: Path, mirror: Mirror | None) -> OpenedLog:
    label = entry.get("log") if isinstance(entry, dict) else None
    plain = isinstance(label, str) and PurePath(label).name == label and label not in {"", ".."}
    if not isinstance(entry, dict) or not isinstance(label, str) or not plain:
        # A label names a folder that reports are written to: it may not lead out of the run's.
        raise OutputError(
            expected="the name of a log's folder", got=repr(label)[:80], where=str(folder / RUN_FILE), remedy=_REMEDY
        )
    return OpenedLog(label, str(entry.get("outcome", "")), folder / LOGS / label, entry, mirror)
