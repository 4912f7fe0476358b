"""The document to sign: its content and its omissions."""

import re
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from pypdf import PdfReader

sys.path.insert(0, str(Path(__file__).parent))
from browser import CHROMIUM, WHY_NOT
from made_runs import drive_tracks, write_run
from test_drive import plan_of

from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.reports.drive import drive_page
from pdhef_logtool.reports.pdf import pdf_page, write_pdf
from pdhef_logtool.results.opened_run import open_run
from tests.run_report import text_of


def test_the_document_has_a_cover_contents_verdicts_figures_and_hashes_but_no_positions(tmp_path):
    run = open_run(write_run(tmp_path, drive_tracks(3.0), plan=plan_of("PASS", "FAIL")))
    page = pdf_page(run)
    text = text_of(page)
    order = ["Validation of 1 drive", "Prepared by", "Without positions", "Contents",
             "Plan plan.toml: 1 FAIL, 1 PASS (this drive alone)", "sha256 of the file, of its signals"]  # fmt: skip
    assert [text.find(part) for part in order] == sorted(text.find(part) for part in order) and -1 not in map(
        text.find, order
    )
    assert str(run.document["logs"][0]["sha256"]) in text
    captions = r"<figcaption>(\w+)"
    assert re.findall(captions, page.decode()) == ["Largest", "Sideslip", "Absolute", "Yaw", "Lateral"]
    assert not re.search(rb"""(src|href)="http""", page)
    assert "Path" in re.findall(captions, pdf_page(run, positions=True).decode())


def test_a_drive_without_dates_has_none(tmp_path):
    run = open_run(write_run(tmp_path, [replace(t, stamps_ns=t.stamps_ns - t.stamps_ns[0]) for t in drive_tracks(3.0)]))
    dated = open_run(write_run(tmp_path / "dated", drive_tracks(3.0)))
    assert "drive.mcap, 3.0 s; sha256" in text_of(pdf_page(run))
    assert "drive.mcap, 3.0 s from 20" in text_of(pdf_page(dated)) and " UTC; sha256" in text_of(pdf_page(dated))
    for page in (pdf_page(run), drive_page(run.logs[0]).html):
        assert not re.search(r"1970|UTC", text_of(page.partition(b"</main>")[0]))


@pytest.mark.parametrize(("file", "title"), [("", "Validation of 1 drive"), ("plan.toml", "Release 3")])
def test_the_title_is_that_of_a_plan_of_the_user(tmp_path, file, title):
    run = open_run(write_run(tmp_path, drive_tracks(3.0)))
    run = replace(run, document=run.document | {"plan": {"file": file, "title": "Release 3", "requirements": []}})
    assert f"<h1>{title}</h1>" in pdf_page(run).decode()


def test_the_document_has_the_key_figures_of_manoeuvres(tmp_path):
    figure = {"signal": "yaw_rate_rad_s", "segment": "all", "metric": "step_response_time", "unit": "s", "n": 9}
    metrics = [{**figure, "estimator": n, "value": v} for n, v in (("truth", 0.101), ("pd-hef", 0.123))]
    run = open_run(write_run(tmp_path, drive_tracks(3.0), metrics=metrics))
    for page in (pdf_page(run), drive_page(run.logs[0]).html):
        assert "Key figures of manoeuvres truth pd-hef yaw rate: response time ms 101 123" in text_of(page)


def test_without_chromium_there_is_one_clear_line(tmp_path, monkeypatch):
    run = open_run(write_run(tmp_path, drive_tracks(3.0)))
    monkeypatch.setattr(shutil, "which", lambda _name: None)
    with pytest.raises(OutputError, match="expected Chromium, which prints the PDF, got none on this machine; apt-get"):
        write_pdf(run)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=WHY_NOT)
def test_chromium_prints_it(tmp_path):
    target = write_pdf(open_run(write_run(tmp_path, drive_tracks(3.0), plan=plan_of("PASS"))))
    pages = [" ".join(page.extract_text().split()) for page in PdfReader(target).pages]
    assert len(pages) >= 4 and "Prepared by" in pages[0] and pages[1].startswith(f"2 / {len(pages)}")
    for title in ("Requirements", "Inputs and versions"):
        number = int(re.search(rf"{title} ?p\. ?(\d+)", pages[1])[1])
        assert title in pages[number - 1] and title not in pages[number - 2].replace(pages[1], "")
