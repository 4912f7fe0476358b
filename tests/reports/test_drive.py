"""The page of a drive of any kind, and the document to sign, without a browser but for printing."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pypdf import PdfReader

from pdhef_logtool.evaluation.dead_reckoned import path_drift
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.reports.drive import drive_page
from pdhef_logtool.reports.pages import write_pages
from pdhef_logtool.reports.pdf import pdf_page, write_pdf
from pdhef_logtool.results.opened_run import open_run
from tests.reports.browser import CHROMIUM, WHY_NOT
from tests.reports.made_runs import START_NS, drive_tracks, write_run
from tests.run_report import text_of


def page_of(folder: Path, wrong: int = 0) -> str:
    result = write_pages(open_run(folder))
    assert (len(result.wrong), result.exit_code) == ((1, 3) if wrong else (0, 0))
    return result.pages[0].file.read_text(encoding="utf-8")


def figures(page: str) -> dict:
    return json.loads(re.search(r'id="document">(.*?)</script>', page, re.DOTALL)[1])["figures"]


def test_a_page_has_its_figures_and_needs_nothing_else(tmp_path):
    page = page_of(write_run(tmp_path, drive_tracks()))
    assert {"sideslip", "error", "yaw_rate", "speed", "ay", "strip", "path", "ay_sideslip"} <= set(figures(page))
    assert page.count("<script") == page.count("</script>")
    assert re.findall(r'(?:src|href)="(?!data:|#)[^"]*"', page) == ['href="../../report.html"']
    assert " style=" not in page
    assert "Leon Sorokin" in page


@pytest.mark.slow
def test_a_one_sample_error_is_in_the_table_with_its_exact_stamp_and_in_the_figure(tmp_path):
    tracks = drive_tracks(duration_s=600.0)
    tracks[1].sideslip_rad[12_345] += np.radians(5.0)
    run = open_run(write_run(tmp_path, tracks))
    page = drive_page(run.logs[0])
    text = text_of(page.html)
    stamp = START_NS + 123_450_000_000
    assert re.search(rf"1 (4\.9|5\.0)\d° \S+ \S+ 123\.450 s 2023-11-14T22:15:23\.450000000Z {stamp}", text)
    errors = next(s for s in page.charts.figures["error"].series if s.label == "pd-hef")
    assert np.nanmax(errors.values) == pytest.approx(5.0, abs=0.2)
    assert page.charts.figures["error"].marks[0].at_s == pytest.approx(123.45)


def test_sideslip_below_the_low_speed_blend_is_a_gap(tmp_path):
    page = drive_page(open_run(write_run(tmp_path, drive_tracks())).logs[0])
    for line in page.charts.figures["sideslip"].series:
        cells = len(line.values)
        assert np.isnan(line.values[int(0.42 * cells) : int(0.58 * cells)]).all()
        assert np.isfinite(line.values[: int(0.38 * cells)]).all()


def test_without_truth_the_page_says_why_there_is_no_score_and_shows_disagreement(tmp_path):
    page = page_of(write_run(tmp_path, drive_tracks(truth=False)))
    text = text_of(page)
    assert "The log has no ground truth" in text
    assert "Largest disagreements of pd-hef" in text
    assert "estimator NIS pd-hef 1.03" in text  # NIS of 3.1 at 3 degrees of freedom
    assert figures(page)["error"]["title"].startswith("Disagreement")
    assert [s["label"] for s in figures(page)["error"]["series"]] == ["physics", "zero"]


def test_a_log_that_failed_has_a_page_with_its_reason(tmp_path):
    outcome = "failed: a.mcap: expected an IMU, got a damaged log <b>; copy it again"
    page = page_of(write_run(tmp_path, [], outcome=outcome))
    assert "A damaged log &lt;b&gt; (expected: an IMU)." in page and "<p>Copy it again</p>" in page
    page = page_of(write_run(tmp_path / "2", [], outcome="failed: nothing heard for 2 s, 2 tries"))
    assert "<p>Nothing heard for 2 s, 2 tries</p>" in page and "--set log_timeout_s=SECONDS." in page
    page = page_of(write_run(tmp_path / "3", [], outcome="failed: something else"))
    assert "<p>Something else</p>" in page and "<p>pdhef inspect LOG shows what the log contains.</p>" in page


@pytest.mark.parametrize("damage", ["absent", "cut", "empty"])
def test_without_usable_estimates_the_page_says_so_and_shows_the_rest(tmp_path, damage):
    folder = write_run(tmp_path, drive_tracks())
    file = folder / "logs" / "drive" / "estimates.parquet"
    if damage == "absent":
        file.unlink()
    else:
        file.write_bytes(b"" if damage == "empty" else file.read_bytes()[:1000])
    text = text_of(page_of(folder, wrong=damage != "absent"))
    assert "estimates.parquet is not in the folder" in text if damage == "absent" else "cannot be drawn" in text
    assert "Errors over the whole drive" in text


def plan_of(*outcomes: str) -> dict:
    """Return the plan of a report with one requirement per outcome."""
    texts = [{"id": f"SR-{i}", "reason": f"reason {i}", "next": f"do {i}"} for i in range(len(outcomes))]
    named = [{"label": "sideslip RMSE ≤ 0.5°", "outcome": outcome} for outcome in outcomes]
    return {"file": "plan.toml", "requirements": [a | b for a, b in zip(texts, named, strict=True)]}


def test_the_first_screen_has_answer_verdicts_what_was_tested_the_worst_place_and_next_steps_in_this_order(tmp_path):
    check = {"name": "a.sign", "subject": "a", "verdict": "failed", "evidence": "gain -1", "remedy": ""}
    check["waived"] = False
    answer = {"why": "", "texts": {"result": "Sideslip RMSE 0.1°", "assumed": "not causal"}}
    plan = plan_of("PASS", "FAIL", "INCONCLUSIVE")
    page = page_of(write_run(tmp_path, drive_tracks(), plan=plan, checks=[check], answer=answer))
    text = text_of(page)
    order = [
        "Result Sideslip RMSE 0.1° Assumed: not causal.", "Check FAILED: a.sign: gain -1",
        "Plan plan.toml: 1 FAIL, 1 INCONCLUSIVE, 1 PASS (this drive alone)", "FAIL sideslip RMSE ≤ 0.5° SR-1 reason 1",
        "INCONCLUSIVE sideslip RMSE ≤ 0.5° SR-2", "PASS sideslip RMSE ≤ 0.5° SR-0",
        "Tested Car sedan", "Largest error", "Next SR-1: do 1 SR-2: do 2",
        "Over time",
    ]  # fmt: skip
    places = [text.find(part) for part in order]
    assert -1 not in places and places == sorted(places), dict(zip(order, places, strict=True))
    assert re.search(r'<li class="requirement fail">\s*<span class="chip">FAIL', page)


def test_the_path_is_aligned_at_the_start_and_its_drift_is_stated(tmp_path):
    tracks = drive_tracks()
    angle, x, y = 0.3, tracks[0].x_m, tracks[0].y_m
    turned = np.cos(angle) * x - np.sin(angle) * y + 5.0, np.sin(angle) * x + np.cos(angle) * y
    longer = [x[0] + 1.02 * (x - x[0]), y[0] + 1.02 * (y - y[0])]
    tracks[1] = replace(tracks[1], x_m=turned[0], y_m=turned[1])
    assert path_drift(tracks[1], tracks[0])["end_m"] == pytest.approx(0.0, abs=1e-6)  # an unknown heading is no drift
    tracks[1] = replace(tracks[1], x_m=longer[0], y_m=longer[1])
    made = path_drift(tracks[1], tracks[0])
    page = drive_page(open_run(write_run(tmp_path, tracks, path_drift=made)).logs[0])
    text = text_of(page.html)
    length = float(np.hypot(np.diff(x), np.diff(y)).sum())
    drift = float(re.search(r"Drift: ([\d.]+) m", text)[1])
    assert drift == pytest.approx(0.02 * np.hypot(x[-1] - x[0], y[-1] - y[0]), rel=0.1)
    assert f"{length / 1000.0:.2f} km" in text
    figure = page.charts.figures["path"]
    assert figure.clouds[0].label == "truth" and all("°" in cloud.label for cloud in figure.clouds[1:])
    assert figure.x_label == "m, along the heading at the start"  # this log has neither position nor heading


@pytest.mark.parametrize(
    ("quantities", "names", "axis"),
    [
        (("position_m", "yaw_rad"), ("lat_deg", "lon_deg"), "m east"),
        (("position_m", "yaw_rad"), ("x_m", "y_m", "yaw_rad"), "x of the log in m"),
        (("position_m",), ("x_m", "y_m"), "m, along the heading at the start"),
        ((), (), "m, along the heading at the start"),
    ],
)
def test_the_axes_of_the_path_are_those_of_its_ground_truth(tmp_path, quantities, names, axis):
    truth = {"available": True, "latency_s": None, "notes": [], "not_independent": []}
    sample = {"role": "truth", "source": "/ins", "total": 1, "used": 1, "dropped": {}}
    changes = {
        "truth": truth | {"quantities": dict.fromkeys(quantities, "/ins")},
        "ledger": {"samples": [{"name": n, **sample} for n in names]},
    }
    figure = drive_page(open_run(write_run(tmp_path, drive_tracks(), **changes)).logs[0]).charts.figures["path"]
    assert figure.x_label == axis and figure.equal


def test_steering_and_motion_are_drawn_over_time(tmp_path):
    tracks = drive_tracks()
    steer = np.radians(2.0) * np.sin(np.arange(len(tracks[1])) / 100.0)
    tracks[1] = replace(tracks[1], steer_rad=steer)
    page = drive_page(open_run(write_run(tmp_path, tracks)).logs[0])
    over_time = [key for key in page.charts.figures if f'data-figure="{key}"' in page.html.decode()]
    drawn = [key for key in over_time if key not in ("worst", "path", "ay_sideslip")]
    assert drawn == ["sideslip", "error", "steer", "yaw_rate", "ay", "speed", "strip"]
    (line,) = page.charts.figures["steer"].series
    assert line.label == "measured" and np.nanmax(line.values) == pytest.approx(2.0, abs=1e-3)


HOSTILE = (
    "</script><script>document.title='ran'</script>",
    '"><img src=x onerror="document.title=\'ran\'">',
    "../../../outside",
    "long " + "x" * 10_000,
    "\u202egnp.exe\u2066",
    "{{ 7*7 }}{% raw %}",
    "\x1b[31m\x00",
    "\ud800",
)


def hostile_run(folder: Path) -> Path:
    tracks = [*drive_tracks(), *drive_tracks(names=tuple(HOSTILE[:-1]), truth=False)]
    tracks = [t for t in tracks if t.name != "truth"] + [t for t in tracks if t.name == "truth"]
    name = HOSTILE[0].replace("/", "_")
    all_of_it = " ".join(HOSTILE[:-1])
    when = {"start_ns": START_NS, "end_ns": START_NS + 10**9}
    check = {"verdict": "failed", "waived": False}
    said = {
        "warnings": list(HOSTILE), "remarks": list(HOSTILE),
        "losses": [{"kind": "gap", "what": h, "where": h, "count": 1, "severity": "lost", **when} for h in HOSTILE],
        "segments": [{"name": h, "text": h, **when} for h in HOSTILE],
        "checks": [dict.fromkeys(("name", "subject", "evidence", "remedy"), h) | check for h in HOSTILE],
        "versions": dict.fromkeys(HOSTILE, all_of_it), "metadata": dict(zip(HOSTILE, HOSTILE, strict=True)),
    }  # fmt: skip
    vehicle = {"name": all_of_it, "file": all_of_it, "sha256": "0", "proven": False, "low_speed_blend_m_s": 3.0}
    return write_run(folder, tracks, name, outcome=f"lost: {all_of_it}", vehicle=vehicle, **said)


def test_hostile_names_are_text_and_nothing_is_written_outside(tmp_path):
    inside = tmp_path / "a" / "b" / "out"
    page = page_of(hostile_run(inside))
    assert not re.search(r"<img|<script>document", page)
    assert page.count("<script") == page.count("</script>") == page.count("<script type=") + 3
    assert not re.search("[\u202e\u2066\x1b\x00]", page)
    assert "x" * 2000 not in page
    assert {p.name for p in (tmp_path / "a").iterdir()} == {"b"}
    assert {p.name for p in (tmp_path / "a" / "b").iterdir()} == {"out"}
    assert len(list(inside.rglob("report.html"))) == 2  # the drive's and the run's


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
