"""The output of a run in an object store: each worker uploads its drives, the command uploads the files of the run.

A worker writes a drive to a local folder and uploads it, report.json last. It returns the report and the figures to the
command, which keeps them with the journal and the pages in a local folder. The command uploads the journal when a drive
ends, at most every 30 s, and all files at the end of the run.
"""

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from pdhef_logtool.logs.discovery import RUN_FILE, LogInput
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.results import opened_run
from pdhef_logtool.runs.drive_outputs import STALE_FILES
from pdhef_logtool.runs.working import DriveEnd, DriveTask, Work
from pdhef_logtool.storage.files import open_new, scratch_folder
from pdhef_logtool.storage.object_store import Mirror, ObjectFolder
from pdhef_logtool.workers.supervisor import Tell

#: Least time between two uploads of the journal.
EVERY_S = 30.0


@dataclass(frozen=True, slots=True, eq=False)
class StoredEnd:
    """Result of an uploaded drive: ``names`` of its objects, and the ``files`` that the command needs."""

    end: DriveEnd
    names: tuple[str, ...]
    files: dict[str, bytes]


def stored_drive(objects: ObjectFolder, work: Work, task: DriveTask, tell: Tell) -> StoredEnd | OutputError:
    """Process a drive and upload its files. An error of the store is returned, because it ends the run."""
    with scratch_folder() as scratch:
        folder = Path(scratch) / task.output.name
        folder.mkdir()
        end = work(replace(task, output=folder), tell)
        if isinstance(end, OutputError):
            return end
        files = (p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file())
        # The report is last: it states that the drive is done.
        names = sorted(
            (n for n in files if "/." not in f"/{n}"), key=lambda n: (n.endswith(f"/{opened_run.REPORT_FILE}"), n)
        )
        here, report = (
            f"{opened_run.LOGS}/{task.log.stem}",
            f"{opened_run.LOGS}/{task.log.stem}/{opened_run.REPORT_FILE}",
        )
        try:
            if report in names:
                stale = {f"{here}/{name}" for name in STALE_FILES}.difference(names)
                objects.remove(sorted({report, *stale}))
            for name in names:
                tell(f"{task.log.stem}: puts {Path(name).name}", 1.0)
                objects.put(name, folder / name)
        except OutputError as error:
            return error
        needed = [name for name in names if name == report or name.startswith(f"{opened_run.PARTS}/")]
        return StoredEnd(end, tuple(names), {name: (folder / name).read_bytes() for name in needed})


def _is_page(name: str) -> bool:
    return name == opened_run.REPORT_FILE or name.endswith(opened_run.PAGE_FILE)


class StoredOutput(Mirror):
    """The output of a run at a URL, locked by this command while the context is entered.

    The local folder contains empty files for the pages in the store.

    Raises
    ------
    OutputError
        The store fails, or another command is writing there.
    """

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self._names: set[str] = set()
        self._uploaded_s = 0.0

    def __enter__(self) -> Self:
        """Lock the URL and list its objects."""
        self.objects.acquire()
        try:
            for name in self.objects.names():
                self._see(name)
        except BaseException:
            self.objects.release()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        """Release the lock."""
        self.objects.release()

    def _see(self, name: str) -> None:
        """Record an object of the store."""
        self._names.add(name)
        if _is_page(name):
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            (self.folder / name).touch()

    def check_no_input(self, inputs: Iterable[LogInput]) -> None:
        """Refuse logs that lie among the outputs; raises UsageError."""
        within = f"{self.objects.shown}/{opened_run.LOGS}/"
        for log in inputs:
            if isinstance(log.path, RemotePlace) and str(log.path).startswith(within):
                raise UsageError(
                    expected="an output that is no input of the same command",
                    got=f"the log {log.path}, which lies in it",
                    where="output",
                    remedy="choose another URL",
                )

    def fetch_journal(self) -> None:
        """Fetch the journal of an earlier run, and figures and reports of its drives."""
        if self.fetch(opened_run.JOURNAL_FILE) is not None:
            needed = (
                n
                for n in self._names
                if n.startswith(f"{opened_run.PARTS}/") or n.endswith(f"/{opened_run.REPORT_FILE}")
            )
            self.objects.get_all(sorted(needed), self.folder)

    def take(self, stored: StoredEnd | None) -> DriveEnd | None:
        """Store the files of a drive and return its result; None without one."""
        if stored is None:
            return None
        for name in stored.names:
            self._see(name)
        for name, data in stored.files.items():
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            with open_new(self.folder / name) as file:
                file.write(data)
        return stored.end

    def begin(self) -> None:
        """Upload the journal of the start of the run; remove figures that it does not list."""
        self._put_journal()
        mirrored = (name for name in self._names if _is_page(name) or name.startswith(f"{opened_run.PARTS}/"))
        gone = sorted(name for name in mirrored if not (self.folder / name).is_file())
        self.objects.remove(gone)
        self._names.difference_update(gone)

    def note_end(self) -> None:
        """Upload the journal after the end of a drive, unless it was uploaded recently."""
        if time.monotonic() - self._uploaded_s >= EVERY_S:
            self._put_journal()

    def publish(self) -> None:
        """Upload figures, pages and run.json, and the journal last."""
        self.objects.renew()
        pages = [p for p in (self.folder / opened_run.LOGS).glob(f"*/{opened_run.PAGE_FILE}") if p.stat().st_size]
        names = (
            *map(opened_run.table_file, opened_run.TABLES),
            opened_run.METRICS_FILE,
            opened_run.PAGE_FILE,
            opened_run.REPORT_FILE,
        )
        for path in [*(self.folder / name for name in names), *pages, self.folder / RUN_FILE]:
            if path.is_file() and path.stat().st_size:
                name = path.relative_to(self.folder).as_posix()
                self.objects.put(name, path)
                self._see(name)
        self.begin()

    def _put_journal(self) -> None:
        """Renew the lock and upload the journal; raises OutputError if another command has the lock."""
        self.objects.renew()
        if (path := self.folder / opened_run.JOURNAL_FILE).is_file():
            self.objects.put(opened_run.JOURNAL_FILE, path)
        self._uploaded_s = time.monotonic()
