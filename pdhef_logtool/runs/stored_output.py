"""The output of a run on an object store: drives are put there where they are worked on, the rest by the command.

A drive's work writes into a folder of its machine; then its files are put, report.json last, and only what the tables
of the run are made of comes back. The command has these, the journal and the pages in a folder of its own, from which
the store is brought up to date: the journal now and then, all of it at every end.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

from pdhef_logtool.logs.discovery import RUN_FILE, LogInput
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.records.errors import OutputError, UsageError
from pdhef_logtool.results.opened_run import JOURNAL_FILE, LOGS, METRICS_FILE, PAGE_FILE, PARTS, REPORT_FILE
from pdhef_logtool.runs.pipeline import STALE_FILES
from pdhef_logtool.runs.working import DriveEnd, DriveTask, Work
from pdhef_logtool.storage.files import open_new, scratch_folder
from pdhef_logtool.storage.object_store import HeldError, Mirror, ObjectFolder
from pdhef_logtool.workers.supervisor import Tell

#: The journal is put this often, or less often where putting it takes more than a twentieth of the time.
EVERY_S = 30.0
_SHARE = 20.0


@dataclass(frozen=True, slots=True, eq=False)
class StoredEnd:
    """How a drive ended whose files are in the store: ``names`` of these, and those that the command needs itself."""

    end: DriveEnd
    names: tuple[str, ...]
    files: dict[str, bytes]


def stored_drive(objects: ObjectFolder, work: Work, task: DriveTask, tell: Tell) -> StoredEnd | OutputError:
    """Do a drive's work and put its files into the store; what the store refuses is returned, for it ends the run."""
    with scratch_folder() as scratch:
        folder = Path(scratch) / task.output.name
        folder.mkdir()
        end = work(replace(task, output=folder), tell)
        files = (p for p in folder.rglob("*") if p.is_file() and not _is_hidden(p.relative_to(folder)))
        names = sorted((p.relative_to(folder).as_posix() for p in files), key=_order)
        here, report = f"{LOGS}/{task.log.stem}", f"{LOGS}/{task.log.stem}/{REPORT_FILE}"
        try:
            if report in names:
                stale = {f"{here}/{name}" for name in STALE_FILES}.difference(names)
                objects.remove(sorted({report, *stale}.intersection(task.stored)))
            for name in names:
                tell(f"{task.log.stem}: puts {Path(name).name}", 1.0)
                objects.put(name, folder / name)
        except OutputError as error:
            return error
        needed = [name for name in names if name == report or name.startswith(f"{PARTS}/")]
        return StoredEnd(end, tuple(names), {name: (folder / name).read_bytes() for name in needed})


def _is_hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def _order(name: str) -> tuple[bool, str]:
    """Put what states that a drive is done behind all else."""
    return name.endswith(f"/{REPORT_FILE}"), name


class StoredOutput(Mirror):
    """The output of a run at a URL, held by this command while it is entered.

    Pages of drives are in the folder as empty files where the store has them.

    Raises
    ------
    OutputError
        The store fails, or another command is writing there.
    """

    def __init__(self, url: str) -> None:
        super().__init__(url)
        self._there: dict[str, set[str]] = {}
        self._own: set[str] = set()
        self._ended = threading.Event()
        self._keeper = threading.Thread(target=self._keep, daemon=True)
        self._lost: OutputError | None = None
        self._putting = threading.Lock()
        self._journal_bytes = -1

    def __enter__(self) -> Self:
        """Lock the place and see what is there."""
        self.objects.acquire()
        try:
            for name in self.objects.names():
                self._see(name)
        except BaseException:
            self.objects.release()
            raise
        self._keeper.start()
        return self

    def __exit__(self, *_: object) -> None:
        """Let go of it."""
        self._ended.set()
        self._keeper.join()
        self.objects.release()

    def _see(self, name: str) -> None:
        """Take note of an object of the place."""
        parts = name.split("/")
        if parts[0] == LOGS and len(parts) > 2:
            self._there.setdefault(parts[1], set()).add(name)
        if parts[-1] == PAGE_FILE:
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            (self.folder / name).touch()
        if parts[-1] == PAGE_FILE or parts[0] == PARTS:
            self._own.add(name)

    def check_no_input(self, inputs: Iterable[LogInput]) -> None:
        """Refuse logs that lie among the outputs; raises UsageError."""
        within = f"{self.objects.shown}/{LOGS}/"
        for log in inputs:
            if isinstance(log.path, RemotePlace) and str(log.path).startswith(within):
                raise UsageError(
                    expected="an output that is no input of the same command",
                    got=f"the log {log.path}, which lies in it",
                    where="output",
                    remedy="choose another URL",
                )

    def fetch_journal(self) -> None:
        """Have what a run goes on from: its journal, the figures of its drives and their reports."""
        if self.fetch(JOURNAL_FILE) is not None:
            reports = [n for names in self._there.values() for n in names if n.endswith(f"/{REPORT_FILE}")]
            self.objects.get_all(sorted([*(n for n in self._own if n.startswith(f"{PARTS}/")), *reports]), self.folder)

    def there(self, label: str) -> tuple[str, ...]:
        """Return the names of what the store has of a drive."""
        return tuple(sorted(self._there.get(label, ())))

    def forget(self, part: str | None) -> None:
        """Remove the figures of a drive that is run again: were the run to end now, it would not be done."""
        if part in self._own:
            self.objects.remove([str(part)])
            self._own.discard(str(part))

    def take(self, stored: StoredEnd) -> DriveEnd:
        """Take how a drive ended, with what came of it; raises OutputError if another command took the place."""
        if self._lost is not None:
            raise self._lost
        for name in stored.names:
            self._see(name)
        for name, data in stored.files.items():
            (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
            with open_new(self.folder / name) as file:
                file.write(data)
        return stored.end

    def begin(self) -> None:
        """Put the journal as the run begins with it; figures that it does not list are removed."""
        self._put_journal()
        self._remove_gone()

    def publish(self) -> None:
        """Put what the command has made: figures, pages, run.json; and the journal, last."""
        if self._lost is not None:
            raise self._lost
        pages = [p for p in (self.folder / LOGS).glob(f"*/{PAGE_FILE}") if p.stat().st_size]
        for path in [*(self.folder / name for name in (METRICS_FILE, PAGE_FILE)), *pages, self.folder / RUN_FILE]:
            if path.is_file() and path.stat().st_size:
                name = path.relative_to(self.folder).as_posix()
                self.objects.put(name, path)
                self._see(name)
        self._put_journal()
        self._remove_gone()

    def _remove_gone(self) -> None:
        gone = sorted(name for name in self._own if not (self.folder / name).is_file())
        self.objects.remove(gone)
        self._own.difference_update(gone)

    def _put_journal(self) -> None:
        path = self.folder / JOURNAL_FILE
        with self._putting:
            size = path.stat().st_size if path.is_file() else 0
            if size not in (0, self._journal_bytes):
                self.objects.put(JOURNAL_FILE, path)
                self._journal_bytes = size

    def _keep(self) -> None:
        """Renew the lock and put the journal until the end; a store that fails for a while is asked again."""
        wait_s = EVERY_S
        while not self._ended.wait(wait_s):
            began = time.monotonic()
            try:
                self.objects.renew()
                self._put_journal()
            except HeldError as error:
                self._lost = error
                return
            except OutputError:
                pass
            wait_s = max(EVERY_S, _SHARE * (time.monotonic() - began))
