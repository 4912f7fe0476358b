"""A finished run, read back from the files that it left; every command that reads a run reads it here.

run.json contains its own digest and the sha256 of the files that are read back.
"""

import os
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pdhef_logtool.car.names import MODEL_FILE as MODEL_FILE
from pdhef_logtool.logs.discovery import RUN_FILE
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.storage.documents import checked_sha256, read_json, read_sealed
from pdhef_logtool.storage.object_store import Mirror, is_url

if TYPE_CHECKING:
    import polars as pl

#: Folder of logs in the outputs of a run, and the files of a log's folder.
LOGS = "logs"
METRICS_FILE = "metrics.parquet"
REPORT_FILE = "report.json"
#: Tables of a run (schemas/<name>.parquet.json), their folder, and the parts of drives there (:mod:`~.tables`).
TABLES = ("drives", "metrics", "checks", "events", "faults", "exposure", "metadata", "verdicts")
TABLES_FOLDER = "tables"
PARTS = "tables/parts"
#: Journal of a run of several logs, a line per drive.
JOURNAL_FILE = "journal.jsonl"
ESTIMATES_FILE = "estimates.parquet"
RECORDING_FILE = "recording.rrd"
#: A page for people: of a log in its folder, of all logs in the run's.
PAGE_FILE = "report.html"

#: Bytes of one document: run.json of 10⁵ logs has 40 MB.
MAX_DOCUMENT_BYTES = 1 << 28

_REMEDY = "pdhef run LOG -o OUT writes one"
_AGAIN = "run the log again"


@dataclass(frozen=True, slots=True)
class OpenedLog:
    """Outputs of a run for one log. ``entry`` is its record in run.json; files are read on demand.

    ``document``: report.json of a log without a folder.

    Files of a run at a URL are fetched into a local folder on demand.
    """

    label: str
    outcome: str
    folder: Path
    entry: dict[str, Any]
    mirror: Mirror | None = None
    document: dict[str, Any] | None = None
    _sound: set[str] = field(default_factory=set, repr=False, compare=False)

    def file(self, name: str) -> Path | None:
        """Return a file of the log's folder, None where the run wrote none.

        Raises
        ------
        OutputError
            The file is not as the run wrote it, or a store fails.
        """
        path = self.folder / name if self.mirror is None else self.mirror.fetch(f"{LOGS}/{self.label}/{name}")
        if path is None or not os.path.isfile(path):  # noqa: PTH113 (False for a name that no file can have)
            return None
        if name not in self._sound:
            checked_sha256(path, self.entry.get("files", {}).get(name), RUN_FILE, _AGAIN)
            self._sound.add(name)
        return path

    def report(self) -> dict[str, Any] | None:
        """Return report.json, None where the log failed; raises OutputError for a damaged one."""
        path = self.file(REPORT_FILE) if self.document is None else None
        if path is None:
            return self.document
        report = read_json(path, "a report.json", OutputError, _AGAIN, MAX_DOCUMENT_BYTES)
        if report.get("format") != "pdhef.report":
            got = f"format {report.get('format')!r}"
            raise OutputError(expected="a report.json", got=got, where=path, remedy=_AGAIN)
        return report

    def readable_report(self) -> dict[str, Any] | None:
        """Return report.json, None also if it is damaged."""
        with suppress(OutputError):
            return self.report()
        return None

    def main(self) -> str:
        """Return the selected estimator of the drive, or an empty string."""
        return str(self.entry.get("main") or "")

    def estimates(self) -> "pl.LazyFrame | None":
        """Return estimates.parquet lazily, or None if it does not exist."""
        import polars as pl

        path = self.file(ESTIMATES_FILE)
        return None if path is None else pl.scan_parquet(path)


@dataclass(frozen=True, slots=True)
class OpenedRun:
    """A run's folder: ``document`` is run.json, ``logs`` are in its order, failed ones too.

    For a run at a URL the folder is local and temporary and contains the fetched files.
    """

    folder: Path
    document: dict[str, Any]
    logs: tuple[OpenedLog, ...]
    mirror: Mirror | None = None
    _sound: set[str] = field(default_factory=set, repr=False, compare=False)

    @property
    def place(self) -> str:
        """Folder or URL of the run, for messages."""
        return str(self.folder) if self.mirror is None else self.mirror.objects.shown

    def table(self, name: str) -> "pl.LazyFrame":
        """Return one of :data:`TABLES`, read when collected; raises OutputError for a file that is not as written."""
        import polars as pl

        return pl.scan_parquet(self.table_path(name))

    def table_path(self, name: str) -> Path:
        """Return the file of one of :data:`TABLES`; raises OutputError for one that is not as written."""
        file = table_file(name)
        path = self.folder / file
        if name not in self._sound:
            if self.mirror is not None:
                self.mirror.fetch(file)
            checked_sha256(path, self.document.get("files", {}).get(file), RUN_FILE, "run the logs again")
            self._sound.add(name)
        return path


def table_file(name: str) -> str:
    """Return the file of a table below the folder of a run."""
    return f"{TABLES_FOLDER}/{name}.parquet"


def open_run(output: Path | str) -> OpenedRun:
    """Open the outputs of a run.

    Parameters
    ----------
    output : the argument of ``-o``, a folder or a URL.

    Raises
    ------
    OutputError
        There is no finished run in the folder: run.json is missing or unreadable. Its exit code is 2 where there is no
        such folder.
    """
    mirror = Mirror(str(output)) if is_url(output) else None
    folder = Path(output) if mirror is None else mirror.folder
    what, path = "the run.json of a run", folder / RUN_FILE
    if mirror is not None:
        mirror.fetch(RUN_FILE)
    if not path.is_file():
        got = f"a folder without {RUN_FILE}" if folder.is_dir() else "no such folder"
        where = folder if mirror is None else mirror.objects.shown
        missing = mirror is None and not folder.exists()
        raise OutputError(expected="the outputs of a run", got=got, where=where, remedy=_REMEDY, missing=missing)
    document = read_sealed(path, what, OutputError, _REMEDY, MAX_DOCUMENT_BYTES)
    if document.get("format") != "pdhef.run":
        got = f"format {document.get('format')!r}"
        raise OutputError(expected=what, got=got, where=path, remedy=_REMEDY)
    place = folder / LOGS
    logs = tuple(_opened(entry, place, mirror) for entry in document["logs"])
    return OpenedRun(folder, document, logs, mirror)


def _opened(entry: dict[str, Any], folder: Path, mirror: Mirror | None) -> OpenedLog:
    label = entry.get("log")
    if not isinstance(label, str) or label in {"", ".", ".."} or {"/", "\\"} & set(label):
        # A label names a folder that reports are written to: it may not lead out of the run's.
        got, where = repr(label)[:80], folder.parent / RUN_FILE
        raise OutputError(expected="the name of a log's folder", got=got, where=where, remedy=_REMEDY)
    return OpenedLog(label, str(entry.get("outcome", "")), folder / label, entry, mirror)
