"""``pdhef report``: the pages of a finished run."""

from dataclasses import replace
from typing import TYPE_CHECKING

import typer

from pdhef_logtool.cli import console, options
from pdhef_logtool.records.errors import UsageError

if TYPE_CHECKING:
    from pdhef_logtool.reports.pages import WrittenPages


@options.command()
def report(
    output: str, *, show: bool = False, by: list[str] | None = None, pdf: bool = False, positions: bool = False
) -> None:
    """Write the HTML reports of a finished run again."""
    from pdhef_logtool.reports.pages import write_pages
    from pdhef_logtool.results.opened_run import LOGS, open_run
    from pdhef_logtool.storage.outputs import OutputFolder

    if positions and not pdf:
        raise UsageError(expected="--pdf", got="--positions alone", where="--positions")
    folder = options.local_folder(output)
    open_run(folder)  # before it is locked, which would create a missing one
    with OutputFolder(folder, (LOGS,)), console.reporter() as reporter:
        result = write_pages(open_run(folder), reporter.progress, by=by or ())
        if pdf:
            from pdhef_logtool.reports.pdf import write_pdf

            result = replace(result, pdf=write_pdf(open_run(folder), positions=positions))
    console.show(result, "pages")
    for line in result.wrong:
        console.warn(line)
    if show:
        open_page(result)
    raise typer.Exit(result.exit_code)


def open_page(result: "WrittenPages") -> None:
    """Open the page of the run, or of its only log, in the browser; without a browser, print the path."""
    import webbrowser

    pages = (*result.pages, result.fleet) if len(result.pages) == 1 else (result.fleet, *result.pages)
    page = next((p.file for p in pages if p.file is not None), None)
    if page is None:
        return
    if not console.has_display() or not webbrowser.open(page.resolve().as_uri()):
        console.say(f"no browser is available; open {page.resolve()}, a single file, on any machine")
