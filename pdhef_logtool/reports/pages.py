"""Writes the pages of a finished run."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL, OutputError
from pdhef_logtool.records.files import write_bytes
from pdhef_logtool.reports.drive import FIGURES, drive_page
from pdhef_logtool.results.opened_run import PAGE_FILE, OpenedLog, OpenedRun

#: Folder of a log's pictures within its outputs.
PICTURES = "figures"


@dataclass(frozen=True, slots=True)
class WrittenPage:
    """The page of one log: its file, or None and what is wrong; ``pictures``: files of its figures."""

    log: str
    file: Path | None
    wrong: str = ""
    pictures: tuple[Path, ...] = ()


@dataclass(frozen=True, slots=True)
class WrittenPages:
    """The pages of a run."""

    output: Path
    pages: tuple[WrittenPage, ...]

    @property
    def wrong(self) -> tuple[str, ...]:
        """A line for each page that could not be made."""
        return tuple(f"no page of {p.log}: {p.wrong}" for p in self.pages if p.wrong)

    @property
    def exit_code(self) -> int:
        """0 if every page was made, else 3."""
        return EXIT_PARTIAL if self.wrong else EXIT_OK

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        return {
            "output": str(self.output),
            "exit_code": self.exit_code,
            "logs": [
                {
                    "log": p.log,
                    "page": None if p.file is None else str(p.file),
                    "pictures": [str(f) for f in p.pictures],
                    "wrong": p.wrong or None,
                }
                for p in self.pages
            ],
        }


def write_pages(
    run: OpenedRun, progress: Callable[[str, float], None] = lambda _text, _share: None, *, png: bool = False
) -> WrittenPages:
    """Write the page of each log of a run; one that cannot be made never stops the others.

    The caller holds the folder. ``progress`` is told which log, and the share that is done; ``png``: whether each
    figure is written as a picture too.

    Raises
    ------
    OutputError
        A page cannot be written.
    """
    pages = []
    for number, log in enumerate(run.logs):
        progress(f"{log.label}: page", number / len(run.logs))
        pages.append(_write(log, png=png))
    return WrittenPages(run.folder, tuple(pages))


def remove_pages(run: OpenedRun) -> None:
    """Remove the pages that an earlier run left in the folders of a run's logs: they are of other estimates."""
    for log in run.logs:
        for path in (log.folder / PAGE_FILE, *_pictures(log)):
            with suppress(OSError):
                path.unlink(missing_ok=True)


def _write(log: OpenedLog, *, png: bool) -> WrittenPage:
    try:
        page = drive_page(log)
    except Exception as error:  # noqa: BLE001 (whatever a report holds, the others get their pages)
        shown = str(error) if isinstance(error, OutputError) else f"internal error, {type(error).__name__}: {error}"
        return WrittenPage(log.label, None, shown)
    path = log.folder / PAGE_FILE
    write_bytes(path, page.html)
    for old in _pictures(log):
        old.unlink(missing_ok=True)
    if not png:
        return WrittenPage(log.label, path)
    from pdhef_logtool.reports.pictures import write_pictures

    return WrittenPage(log.label, path, pictures=write_pictures(page.charts, log.folder / PICTURES, log.label))


def _pictures(log: OpenedLog) -> list[Path]:
    """Return the pictures that this command wrote into a log's folder at some time."""
    return [p for key in FIGURES if (p := log.folder / PICTURES / f"{key}.png").is_file()]
