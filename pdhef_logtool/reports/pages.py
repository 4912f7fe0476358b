"""Write the pages of a finished run."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pdhef_logtool.records.errors import EXIT_FAILURE, EXIT_OK, EXIT_PARTIAL, OutputError
from pdhef_logtool.results.opened_run import PAGE_FILE, REPORT_FILE, OpenedLog, OpenedRun
from pdhef_logtool.results.run_report import write_json
from pdhef_logtool.storage.files import write_bytes

if TYPE_CHECKING:
    from pdhef_logtool.reports.charts import Charts


@dataclass(frozen=True, slots=True, eq=False)
class Page:
    """The HTML of a page, and its figures.

    Attributes
    ----------
    wrong : error of a file that could not be read. document : the page of a run as JSON-able values.
    key_figures : of the manoeuvres of a drive.
    """

    html: bytes
    charts: "Charts"
    wrong: str = ""
    document: dict[str, Any] | None = None
    key_figures: dict[str, Any] | None = None


@dataclass(frozen=True, slots=True)
class WrittenPage:
    """A page: its log (empty for the page of the run), its file (None on failure), and its error."""

    log: str
    file: Path | None
    wrong: str = ""


@dataclass(frozen=True, slots=True)
class WrittenPages:
    """The pages of a run: one per log, ``fleet`` for all of them, and the optional ``pdf``."""

    output: Path
    pages: tuple[WrittenPage, ...]
    fleet: WrittenPage
    pdf: Path | None = None

    @property
    def wrong(self) -> tuple[str, ...]:
        """One line for each page that could not be made, or not completely."""
        pages = [p for p in (*self.pages, self.fleet) if p.wrong]
        return tuple(f"{'no ' if p.file is None else ''}page of {p.log or 'the run'}: {p.wrong}" for p in pages)

    @property
    def exit_code(self) -> int:
        """0 if every page is complete, 1 if no log has a page, else 3."""
        if self.pages and all(p.file is None for p in self.pages):
            return EXIT_FAILURE
        return EXIT_PARTIAL if self.wrong else EXIT_OK

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        return {
            "output": str(self.output),
            "exit_code": self.exit_code,
            **_to_dict(self.fleet),
            "pdf": None if self.pdf is None else str(self.pdf),
            "logs": [{"log": p.log, **_to_dict(p)} for p in self.pages],
        }


def _to_dict(page: WrittenPage) -> dict[str, Any]:
    return {"page": None if page.file is None else str(page.file), "wrong": page.wrong or None}


def write_pages(
    run: OpenedRun,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
    *,
    by: Sequence[str] = (),
    logs: Sequence[OpenedLog] | None = None,
) -> WrittenPages:
    """Write the page of each log of a run, then the page of the run; a failed page never stops the others.

    The caller must lock the folder. ``progress`` receives the log and the completed share;
    ``by``: keys to break the drives down by; by default all that distinguish drives.

    Raises
    ------
    OutputError
        A page cannot be written.
    """
    from pdhef_logtool.reports.fleet import fleet_page

    pages = []
    logs = run.logs if logs is None else logs
    for number, log in enumerate(logs):
        progress(f"{log.label}: page", number / len(logs))
        pages.append(write_drive_page(log))
    fleet = _write(run.folder, "", partial(fleet_page, run, by))
    return WrittenPages(run.folder, tuple(pages), fleet)


def write_drive_page(log: OpenedLog) -> WrittenPage:
    """Write the page of a log; raises OutputError."""
    from pdhef_logtool.reports.drive import drive_page

    return _write(log.folder, log.label, partial(drive_page, log, f"../../{PAGE_FILE}"))


def remove_pages(run: OpenedRun) -> None:
    """Remove the pages of an earlier run, which show other estimates."""
    pages = [folder / PAGE_FILE for folder in (run.folder, *(log.folder for log in run.logs))]
    for path in (*pages, run.folder / REPORT_FILE):
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _write(folder: Path, label: str, make: Callable[[], Page]) -> WrittenPage:
    try:
        page = make()
    except Exception as error:  # noqa: BLE001 (a defect of one report must not stop the other pages)
        shown = str(error) if isinstance(error, OutputError) else f"internal error, {type(error).__name__}: {error}"
        return WrittenPage(label, None, shown)
    path = folder / PAGE_FILE
    write_bytes(path, page.html)
    if page.document is not None:
        write_json(folder / REPORT_FILE, page.document)
    return WrittenPage(label, path, page.wrong)
