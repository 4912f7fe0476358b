"""The validation report of a run as a PDF for signature: cover, contents, verdicts, drives and input hashes.

The document is an HTML file with the figures of the pages, printed by a headless Chromium.
"""

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pdhef_logtool.evaluation.requirement_verdicts import next_steps
from pdhef_logtool.evaluation.statistics import gathered
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.printable import listed
from pdhef_logtool.reports.charts import Charts, TimeFigure
from pdhef_logtool.reports.drive import drive_page
from pdhef_logtool.reports.page import render
from pdhef_logtool.results.opened_run import OpenedLog, OpenedRun
from pdhef_logtool.results.selected_estimate import assumptions_of, failed_checks, figures_of
from pdhef_logtool.storage.files import write_bytes

PDF_FILE = "report.pdf"
#: Maximum number of drives with a section; drives with the worst verdicts come first.
_MOST_DRIVES = 20
#: Figures of a drive in the document. The path contains the positions of the car.
_FIGURES, _POSITIONS = ("worst", "sideslip", "error", "steer", "yaw_rate", "ay"), ("path",)
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_TIMEOUT_S = 180.0


def write_pdf(run: OpenedRun, *, positions: bool = False) -> Path:
    """Write the PDF of a run; ``positions``: include the paths of the drives.

    Raises
    ------
    OutputError : Chromium is missing or fails, or the file cannot be written.
    """
    browser = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
    target = run.folder / PDF_FILE
    if browser is None:
        raise OutputError(
            expected="Chromium, which prints the PDF",
            got="none on this machine",
            where=target,
            remedy="apt-get install chromium, or print report.html from any browser",
        )
    with tempfile.TemporaryDirectory(prefix="pdhef-pdf-") as scratch:
        page, made = Path(scratch) / "report.html", Path(scratch) / PDF_FILE
        document = pdf_page(run, positions=positions)
        page.write_bytes(document)
        _print(browser, page, made, target)
        page.write_bytes(_numbered(document, made))
        _print(browser, page, made, target)
        write_bytes(target, made.read_bytes())
    return target


def _numbered(document: bytes, printed: Path) -> bytes:
    """Return the document with page numbers in its contents, as found in a print without them."""
    from pypdf import PdfReader

    reader = PdfReader(printed)
    pages = {
        name.lstrip("/"): reader.get_destination_page_number(place) for name, place in reader.named_destinations.items()
    }

    def numbered(match: re.Match[bytes]) -> bytes:
        page = pages.get(match[1].decode())
        return match[0] + (b"" if page is None else str(page + 1).encode())

    return re.sub(rb'<span class="at" data-of="([^"]+)">', numbered, document)


def _print(browser: str, page: Path, made: Path, target: Path) -> None:
    command = [
        browser, "--headless", "--disable-gpu", "--no-first-run", "--disable-extensions", "--disable-dev-shm-usage",
        "--disable-background-networking", f"--user-data-dir={page.parent / 'profile'}", "--no-pdf-header-footer",
        *(["--no-sandbox"] if hasattr(os, "geteuid") and os.geteuid() == 0 else []),
        f"--print-to-pdf={made}", page.as_uri(),
    ]  # fmt: skip
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_TIMEOUT_S, check=False)  # noqa: S603
        got = done.stderr.strip().splitlines()[-1:] if done.returncode or not made.is_file() else []
    except (OSError, subprocess.TimeoutExpired) as error:
        got = [str(error)]
    if not made.is_file():
        raise OutputError(expected="a PDF", got=(got or ["none"])[0], where=target, remedy="print report.html")


def pdf_page(run: OpenedRun, *, positions: bool = False) -> bytes:
    """Return the document as HTML."""
    document = run.document
    reports = [(log, log.readable_report()) for log in run.logs]
    ranked = sorted(reports, key=lambda pair: _gravity(pair[1]))[:_MOST_DRIVES]
    seconds = sum(r["log"]["duration_s"] for _, r in reports if r is not None)
    plan = document.get("plan") or {}
    charts = Charts()
    return render(
        "pdf.html",
        charts,
        title=(plan.get("file") and plan.get("title"))
        or f"Validation of {len(run.logs)} {'drive' if len(run.logs) == 1 else 'drives'}",
        run=document,
        seconds=seconds,
        steps=next_steps(plan),
        answer=reports[0][1] if len(reports) == 1 else None,
        told=_told([(log.label, report) for log, report in reports if report is not None]),
        sections=[_section(log, report, charts, positions=positions) for log, report in ranked],
        left_out=len(reports) - len(ranked),
        positions=positions,
    )


def _told(reports: Sequence[tuple[str, Mapping[str, Any]]]) -> dict[str, str]:
    """Return failed checks, then assumptions, each with the names of its drives; an empty text for all drives."""
    labels = gathered(
        (text, label) for label, report in reports for text in (*failed_checks(report), *assumptions_of(report))
    )
    ranked = sorted(labels.items(), key=lambda of: (not of[0].startswith(("FAILED", "waived")), -len(of[1])))
    return {text: "" if len(of) == len(reports) else listed(of) for text, of in ranked}


def _gravity(report: Mapping[str, Any] | None) -> tuple[int, float]:
    """Return the sort key of drives: failed requirements first, then the sideslip error."""
    if report is None:
        return (1, 0.0)
    fails = sum(r["outcome"] == "FAIL" for r in (report.get("plan") or {}).get("requirements") or ())
    wanted = (str(report.get("selected_estimate")), "sideslip_rad", "all", "rmse")
    return -fails, -(figures_of(report).get(wanted) or 0.0)


def _section(log: OpenedLog, report: Mapping[str, Any] | None, charts: Charts, *, positions: bool) -> dict[str, Any]:
    """Return a drive of the document; add its figures, each with its own time, to ``charts``."""
    drive: dict[str, Any] = {"label": log.label, "outcome": log.outcome, "report": report}
    if report is None:
        return drive | {"figures": (), "key_figures": None}
    page, keys = drive_page(log), list[str]()
    for key in (*_FIGURES, *(_POSITIONS if positions else ())):
        if (figure := page.charts.figures.get(key)) is not None:
            keys.append(f"{key}-{len(charts.figures)}")
            figure = replace(figure, time=page.charts.time()) if isinstance(figure, TimeFigure) else figure
            charts.figures[keys[-1]] = figure
    return drive | {"figures": keys, "key_figures": page.key_figures}
