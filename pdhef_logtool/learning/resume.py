"""Stages of a long command: the result of each is in a folder and is used again for the same inputs."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdhef_logtool.drive.reading import Tell
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.results.opened_run import MAX_DOCUMENT_BYTES
from pdhef_logtool.results.run_report import json_bytes
from pdhef_logtool.storage.documents import digest, read_sealed, seal
from pdhef_logtool.storage.files import write_bytes, writing
from pdhef_logtool.storage.outputs import FolderTransaction

STAGE_FILE = "step.json"


@dataclass(frozen=True, slots=True)
class Stages:
    """Folder of the stages of a command and its reporting; ``shown`` returns the result of a stage in a line."""

    folder: Path
    shown: Callable[[dict[str, Any]], str]
    reporter: Reporter

    def do(
        self, number: int, name: str, basis: Any, share: float, work: Callable[[Path], dict[str, Any]]
    ) -> dict[str, Any]:
        """Return the result of a stage: from an earlier call if its inputs were the same, else by running it.

        Parameters
        ----------
        basis : all inputs that decide the result, as JSON-able values. share : progress of the command at its start.
        work : runs the stage in a folder, which then appears whole or not at all as ``NUMBER-NAME``.
        """
        key, folder = digest([name, basis]), self.place(number, name)
        document = read_own(folder / STAGE_FILE, self.reporter.note)
        if document is not None and document["basis"] == key:
            self.reporter.note(f"{name}: {document['shown']} (from an earlier call)")
            return dict(document["result"])
        began = time.monotonic()
        self.reporter.progress(name, share)
        with writing(folder), FolderTransaction(folder, keep=False) as transaction:
            result = work(transaction.file("."))
            shown = self.shown(result)
            write_bytes(
                transaction.file(STAGE_FILE), json_bytes(seal({"basis": key, "shown": shown, "result": result}))
            )
        self.reporter.note(f"{name}: {shown} ({time.monotonic() - began:.0f} s)")
        as_read: dict[str, Any] = json.loads(json_bytes(result))
        return as_read

    def place(self, number: int, name: str) -> Path:
        """Return the folder of a stage."""
        return self.folder / f"{number}-{name}"


def read_own(file: Path, say: Tell) -> dict[str, Any] | None:
    """Return a sealed document that a command can make again, None without one; a damaged one is reported."""
    if not file.exists():
        return None
    try:
        return read_sealed(file, "a result of an earlier call", OutputError, "it is made again", MAX_DOCUMENT_BYTES)
    except OutputError as error:
        say(str(error))
        return None
