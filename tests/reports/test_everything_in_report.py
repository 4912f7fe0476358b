"""Every number that a page shows is in report.json (or run.json, for a failed log), rounded alike."""

import html
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pdhef_logtool import RunConfig, open_run
from pdhef_logtool.evaluation.metrics.metric import registered
from pdhef_logtool.reports.page import DASH, degrees, duration, number
from pdhef_logtool.reports.pages import write_pages
from pdhef_logtool.runs.fleet import run_logs
from tests.reports.made_runs import drive_tracks, write_run
from tests.reports.test_fleet_page import run_of

#: Units of the page over units of report.json: degrees, percent, minutes, hours, kilometres, milliseconds.
FACTORS = (1.0, math.degrees(1.0), 100.0, 1 / 60, 1 / 3600, 1e-3, 1e3)
_NUMBER = re.compile(r"(?<![\w.,:#])[-−+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w:]|\.\d)")
#: Dates come from start_ns; digits within names, versions and hashes are no figures.
_NO_FIGURE = re.compile(r"\d{4}-\d\d-\d\d[T ]?[\d:.]*Z?|\d{19}|[\w-]*[A-Za-z_]\w*[-.]\d[\w.-]*")


def shown(page: str) -> str:
    """Return the text that a page shows, without what is no figure; elements are apart."""
    text = re.sub(r"<[^>]*>", " ", re.sub(r"<(script|style)\b.*?</\1>", " ", page, flags=re.DOTALL))
    return _NO_FIGURE.sub(" ", " ".join(html.unescape(text).split()))


def known(document: Any, start_ns: int) -> tuple[list[float], str]:
    """Return the numbers of a document, lengths of its lists, and stamps from the log's start; and all of its texts."""
    numbers, texts = [], []

    def walk(value: Any, key: str) -> None:
        if isinstance(value, dict):
            texts.extend(value)
            for name, entry in value.items():
                walk(entry, name) if name != "requirement_blocks" else None
        elif isinstance(value, list):
            numbers.append(float(len(value)))
            for entry in value:
                walk(entry, key)
        elif isinstance(value, str):
            texts.append(value)
        elif value is not None and not isinstance(value, bool):
            numbers.append(float(value))
            if key.endswith("_ns"):
                numbers.append((value - start_ns) * 1e-9)

    walk(document, "")
    return numbers + list(ratios(document)), " ".join(texts)


def ratios(document: dict[str, Any]) -> Iterator[float]:
    """Yield NIS over its degrees of freedom, and what the estimate is compared with at the largest errors."""
    yield from (place["estimate_rad"] - place["error_rad"] for place in document.get("largest_errors") or ())
    figures = {
        (m["estimator"], m["metric"]): m["value"] for m in document.get("metrics") or () if m["segment"] == "all"
    }
    for (name, metric), value in figures.items():
        if metric == "nis" and value is not None and figures.get((name, "nis_dof")):
            yield value / figures[name, "nis_dof"]


def missing(page: str, document: dict[str, Any], template: str = "") -> list[str]:
    """Return the numbers of a page, with their context, that the document lacks."""
    numbers, texts = known(document, (document.get("log") or {}).get("start_ns", 0))
    text, fixed = shown(page), shown(template) + texts
    absent = []
    for match in _NUMBER.finditer(text):
        word = match.group().replace("−", "-")
        half = 0.51 * 10.0 ** -(len(word.partition(".")[2]) if "e" not in word else 9)
        value = abs(float(word))
        half = max(half, 5.1e-4 * value if "e" in word else 0.0)
        if not (word.lstrip("+-") in fixed or any(abs(abs(x) * f - value) <= half for x in numbers for f in FACTORS)):
            absent.append(text[max(0, match.start() - 60) : match.end() + 20])
    return absent


def templates() -> str:
    folder = Path(open_run.__code__.co_filename).parents[1] / "reports" / "templates"
    definitions = [metric.definition for metric in registered().values()]
    return " ".join([*(path.read_text() for path in folder.glob("*.html")), *definitions])


def check(folder: Path) -> int:
    """Check all pages of a run; return how many."""
    pages = [folder / "report.html", *folder.glob("logs/*/report.html")]
    for page in pages:
        report = page.with_name("report.json")
        document = json.loads((report if report.is_file() else folder / "run.json").read_text())
        assert missing(page.read_text(), document, templates()) == []
    return len(pages)


def test_figures_are_shown_in_units_and_digits_by_their_size():
    assert [number(v) for v in (0.12345, 1234.6, None)] == ["0.123", "1235", DASH]
    assert [degrees(math.radians(v)) for v in (0.5, 2.0)] == ["0.500°", "2.00°"]
    assert [duration(v) for v in (5.0, 600.0, 9000.0)] == ["5.0 s", "10.0 min", "2.5 h"]


def test_a_number_that_is_not_in_the_report_is_found():
    document = {"log": {"start_ns": 5, "duration_s": 61.24}, "x_rad": 0.01}
    assert missing("<p>61.2 s, 0.573°, of 2026-01-01 00:00 UTC</p><td>1.02 min</td>", document) == []
    (absent,) = missing("<p>61.2 s and 0.574°</p>", document)
    assert "0.574" in absent


@pytest.mark.parametrize("truth", [True, False])
def test_pages_of_one_drive(tmp_path, truth):
    folder = write_run(tmp_path, drive_tracks(truth=truth))
    write_pages(open_run(folder))
    assert check(folder) == 2


def test_pages_of_a_fleet_and_of_a_failed_log(tmp_path):
    drives: dict[str, dict[str, Any]] = {f"d{i}": {"errors": (0.001 + 0.0007 * i, 0.002)} for i in range(9)}
    folder = run_of(tmp_path, drives, {"bad": "expected a whole file, got one cut at byte 4711"})
    write_pages(open_run(folder))
    assert check(folder) == 11


@pytest.mark.slow
def test_pages_of_sample_logs(sample_logs_dir, tmp_path):
    cut = tmp_path / "cut.mcap"
    cut.write_bytes((sample_logs_dir / "dlc.mcap").read_bytes()[:2000])
    logs = [str(sample_logs_dir / f"{name}.mcap") for name in ("dlc", "no_truth", "faults")]
    out = tmp_path / "out"
    run_logs([*logs, str(cut)], out, RunConfig(car=sample_logs_dir / "vehicle.toml", annotate="none", end="10"))
    assert check(out) == 5
