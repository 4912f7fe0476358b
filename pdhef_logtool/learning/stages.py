"""Stages of a long command: what one came to stands in a folder, and is taken from there on the same basis."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdhef_logtool.drive.reading import Tell
from pdhef_logtool.records.documents import digest, read_sealed, seal
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.files import write_bytes, writing
from pdhef_logtool.records.outputs import FolderTransaction
from pdhef_logtool.results.opened_run import MAX_DOCUMENT_BYTES
from pdhef_logtool.sinks.report import json_bytes

STAGE_FILE = "step.json"


@dataclass(frozen=True, slots=True)
class Stages:
    """Where the stages of a command stand, and whom it tells; ``shown`` says what a stage came to in a line."""

    folder: Path
    shown: Callable[[dict[str, Any]], str]
    say: Tell
    progress: Callable[[str, float], None]

    def do(
        self, number: int, name: str, basis: Any, share: float, work: Callable[[Path], dict[str, Any]]
    ) -> dict[str, Any]:
        """Return what a stage comes to: from an earlier call if its basis was the same, else by doing it.

        Parameters
        ----------
        basis : all that decides what comes out, as JSON-able values. share : how far the command is when it begins.
        work : does the stage in a folder, which then stands whole or not at all as ``NUMBER-NAME``.
        """
        key, folder = digest([name, basis]), self.place(number, name)
        document = read_own(folder / STAGE_FILE, self.say)
        if document is not None and document["basis"] == key:
            self.say(f"{name}: {document['shown']} (as found before)")
            return dict(document["found"])
        began = time.monotonic()
        self.progress(name, share)
        with writing(folder), FolderTransaction(folder, keep=False) as transaction:
            found = work(transaction.file("."))
            shown = self.shown(found)
            write_bytes(transaction.file(STAGE_FILE), json_bytes(seal({"basis": key, "shown": shown, "found": found})))
        self.say(f"{name}: {shown} ({time.monotonic() - began:.0f} s)")
        found_again: dict[str, Any] = json.loads(json_bytes(found))
        return found_again

    def place(self, number: int, name: str) -> Path:
        """Return the folder of a stage."""
        return self.folder / f"{number}-{name}"


def read_own(file: Path, say: Tell) -> dict[str, Any] | None:
    """Return a sealed document of what a command can do again, None without one; a damaged one is said and left out."""
    if not file.exists():
        return None
    try:
        remedy = "it is found again"
        return read_sealed(file, "what an earlier call found", OutputError, remedy, MAX_DOCUMENT_BYTES)
    except OutputError as error:
        say(str(error))
        return None
