"""``pdhef serve``, asked over HTTP and in a browser: it shows the runs, and nothing beside them."""

from __future__ import annotations

import csv
import http.client
import io
import json
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest

pytest.importorskip("starlette", reason="pip install 'pdhef-logtool[serve]'")
import uvicorn

from pdhef_logtool.cli.app import app
from pdhef_logtool.cli.serving import _listening
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.reports.server import Library, Query, application
from pdhef_logtool.results.drive_rows import csv_text, drive_rows
from pdhef_logtool.results.opened_run import open_run
from pdhef_logtool.results.parquet_sink import write_metrics
from pdhef_logtool.storage.documents import seal
from tests.reports.browser import CHROMIUM, WHY_NOT, Browser
from tests.results.made_run import entry, row, write_estimates, write_run

HOSTILE = "=cmd|' C calc'!A0<img src=x onerror=alert(1)>"
RMSE = {f"d{i}": 0.001 * (1 + i) for i in range(9)}


@contextmanager
def serving(*folders: Path) -> Iterator[int]:
    """Serve runs from a thread; yield the port."""
    listener = _listening(0)
    server = uvicorn.Server(uvicorn.Config(application(Library([open_run(f) for f in folders])), log_level="error"))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        yield listener.getsockname()[1]
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


Get = Callable[..., tuple[int, dict[str, str], str]]


def getter(port: int) -> Get:
    def get(path: str, host: str = "", method: str = "GET") -> tuple[int, dict[str, str], str]:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=300)
        connection.request(method, path, headers={"Host": host or f"127.0.0.1:{port}"})
        answer = connection.getresponse()
        text = answer.read().decode()
        connection.close()
        return answer.status, {k.lower(): v for k, v in answer.getheaders()}, text

    return get


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> Sequence[Path]:
    place = tmp_path_factory.mktemp("served")
    entries = [entry(label) for label in (*RMSE, HOSTILE)]
    entries.append(entry("bad", outcome="failed: bad.mcap: expected a log, got 3 bytes", main=None))
    more = [row("d0", 0.5, estimator="physics"), row(HOSTILE, 0.01)]
    a = write_run(place / "before", RMSE, entries=entries, rows=more)
    b = write_run(place / "after", {k: 2.0 * v for k, v in RMSE.items()})
    slip = np.linspace(0.0, 0.1, 200)
    for run, factor in ((a, 1.0), (b, 1.2)):
        write_estimates(run, "d0", truth={"sideslip_rad": slip}, pd_hef={"sideslip_rad": factor * slip})
    (a / "report.html").write_text("<p>the run")
    (a / "logs" / "d0" / "report.html").write_text("<p>the drive")
    (a / "logs" / "d1").mkdir(parents=True)
    (place / "secret.html").write_text("secret")
    (a / "logs" / "d1" / "report.html").symlink_to(place / "secret.html")
    return a, b


@pytest.fixture(scope="module")
def get(folders: Sequence[Path]) -> Iterator[Get]:
    with serving(*folders) as port:
        yield getter(port)


def drives_of(page: str) -> list[str]:
    return re.findall(r'<a href="/drive/[^"]*">([^<]*)</a>', page)


def test_drives_are_filtered_and_sorted(get: Get) -> None:
    status, headers, page = get("/")
    assert status == 200 and "20 drives of 2 runs" in page and 'data-figure="distributions"' in page
    assert headers["x-content-type-options"] == "nosniff" and headers["cache-control"] == "no-store"
    assert drives_of(page)[:2] == ["d8", "d7"] and drives_of(page)[-1] == "bad"  # no figure: last in any order
    assert drives_of(get("/?run=before&sort=sideslip_rmse_deg&order=up")[2])[:2] == ["d0", "d1"]
    assert drives_of(get("/?name=D3&run=after")[2]) == ["d3"]
    assert drives_of(get("/?at_least=0.4&at_most=0.5&run=before")[2]) == ["d7", "d6"]
    assert drives_of(get("/?estimator=physics")[2]) == ["d0"]
    assert drives_of(get("/?outcome=failed")[2]) == ["bad"]
    assert drives_of(get("/?outcome=no+such")[2]) == []
    assert 'aria-sort="descending"' in page


@pytest.mark.parametrize(
    "query", ["sort=__class__", "order=x", "page=-3", "page=1e999", "at_least=nan", "x=" + "y" * 5000]
)
def test_a_wrong_query_is_the_default(get: Get, query: str) -> None:
    status, _, page = get(f"/?{query}")
    assert status == 200 and drives_of(page)[0] == "d8"


def test_a_drive_overlays_the_runs_and_opens_its_report(get: Get) -> None:
    _, _, page = get("/drive/before/d0")
    assert page.count(" checked") == 3  # one ground truth, the selected estimate of both runs
    assert all(f"{run}: pd-hef" in page for run in ("before", "after")) and 'data-figure="tracks"' in page
    _, _, one = get("/drive/after/d0?signal=vx_m_s&track=after%2Fpd-hef")
    assert one.count(" checked") == 1 and 'value="vx_m_s" selected' in one
    status, headers, text = get("/run/before/logs/d0/report.html")
    assert (status, text) == (200, "<p>the drive")
    assert headers["content-security-policy"].startswith("sandbox allow-scripts; default-src 'none'")
    assert get("/run/before/report.html")[2] == "<p>the run"
    assert "no tracks" in get("/drive/before/bad")[2]


@pytest.mark.parametrize(
    "path",
    [
        "/run/before/logs/d1/report.html",  # a link to a file outside
        "/run/before/logs/..%2f..%2fsecret/report.html",
        "/run/before/logs/%2e%2e/report.html",
        "/run/..%2fafter/report.html",
        "/run/after/report.html",
        "/drive/before/..",
        "/../secret.html",
        "/run/before/run.json",
        "/run/before/logs/d0/estimates.parquet",
        "/drive/none/d0",
    ],
)
def test_nothing_outside_of_the_reports_is_served(get: Get, path: str) -> None:
    status, _, text = get(path)
    assert status == 404 and "secret" not in text.replace("secret.html", "").replace("secret/", "")


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:80", "localhost.evil.example", "127.0.0.1.nip.io", "0.0.0.0"]
)
def test_a_name_that_points_to_this_machine_is_refused(get: Get, host: str) -> None:
    assert get("/", host=host)[0] == 400
    assert get("/drives.csv", host=host)[0] == 400


def test_a_request_that_could_write_is_refused(get: Get) -> None:
    assert get("/", host="localhost")[0] == 200
    assert [get("/", method=m)[0] for m in ("POST", "PUT", "DELETE", "PATCH")] == [405] * 4


def test_what_logs_say_is_text_and_no_formula(get: Get) -> None:
    _, _, page = get("/")
    assert "<img" not in page and "&lt;img" in page
    status, headers, text = get("/drives.csv?run=before")
    rows = list(csv.DictReader(io.StringIO(text)))
    assert (
        status == 200
        and headers["content-type"].startswith("text/csv")
        and "attachment" in headers["content-disposition"]
    )
    assert [r["drive"] for r in rows].count("'" + HOSTILE) == 1
    assert float(rows[-2]["sideslip_rmse_deg"]) == pytest.approx(np.degrees(0.001)) and rows[-1]["drive"] == "bad"
    assert get(f"/drive/before/{quote(HOSTILE, safe='')}")[0] == 200


@pytest.mark.parametrize("text", ["=1+1", "+1", "-1", "@x", "\t=1", "\r=1", " =1", "\n@a"])
def test_formulas_are_texts_in_csv(text: str) -> None:
    ((cell, number),) = csv.reader(io.StringIO(csv_text(["a", "b"], [(text, -1.5)]).partition("\n")[2]))
    assert (cell, number) == (f"'{text}", "-1.5")


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "a", RMSE)
    write_estimates(folder, "d0", truth={"sideslip_rad": np.zeros(9)})
    with serving(folder) as port:
        (folder / "logs" / "d0" / "estimates.parquet").write_bytes(b"PAR1 no")
        status, _, page = getter(port)("/drive/a/d0")
    assert status == 500 and "estimates.parquet" in page and "Traceback" not in page


def test_an_estimator_that_has_seen_the_ground_truth_has_no_error(tmp_path: Path) -> None:
    flag = row("d0", 1.0, metric="not_independent")
    table = drive_rows([("a", open_run(write_run(tmp_path / "a", RMSE, rows=[flag])))])
    assert table.filter(table["drive"] == "d0")["sideslip_rmse_deg"].to_list() == [None]


def test_the_port_is_on_loopback_only_and_one_in_use_is_named() -> None:
    with _listening(0) as listener:
        host, port = listener.getsockname()
        assert host == "127.0.0.1"
        with pytest.raises(UsageError, match=r"--port: expected a free port, got \d+"):
            _listening(port)


def test_without_the_extra_a_line_names_the_command(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("uvicorn", "starlette", "starlette.applications", "pdhef_logtool.reports.server"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises((UsageError, ModuleNotFoundError)) as error:
        app(["serve", str(tmp_path)], prog_name="pdhef", standalone_mode=False)
    assert isinstance(error.value, UsageError) and "pip install 'pdhef-logtool[serve]'" in str(error.value)


def test_ten_thousand_drives_load_in_two_seconds(tmp_path: Path) -> None:
    labels = [f"drive_{i:05d}" for i in range(10_000)]
    rng = np.random.default_rng(0)
    figures = [(e, m) for e in ("pd-hef", "physics") for m in ("rmse", "coverage95")]
    rows = [
        MetricRow(x, e, "sideslip_rad", "all", m, float(rng.random()), "rad", 9) for x in labels for e, m in figures
    ]
    write_metrics(tmp_path / "metrics.parquet", rows)
    (tmp_path / "run.json").write_text(json.dumps(seal({"format": "pdhef.run", "logs": [entry(x) for x in labels]})))
    start = time.process_time()
    library = Library([open_run(tmp_path)])
    selected = Query().rows(library.table)
    assert time.process_time() - start < 2.0
    assert len(selected) == 10_000
    with serving(tmp_path) as port:
        start = time.process_time()
        assert "10000 rows, page 50 of 50" in getter(port)("/?page=99")[2]
        assert time.process_time() - start < 4.0  # with loading again


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=WHY_NOT)
def test_in_a_browser_forms_and_links_work_and_nothing_runs(folders: Sequence[Path]) -> None:
    with serving(*folders) as port, Browser(390, 800) as browser:
        browser.open(f"http://127.0.0.1:{port}/")
        assert browser.value("document.querySelectorAll('[data-figure] canvas').length") >= 1
        assert browser.value("document.documentElement.scrollWidth") <= 390
        unnamed = (
            "[...document.querySelectorAll('input:not([type=hidden]), select')].filter(n => !n.labels.length).length"
        )
        assert browser.value(unnamed) == 0
        browser.value("document.querySelector('[name=name]').value = 'd3'; document.forms[0].submit(); 1")
        browser.wait_for("location.search.includes('name=d3') && document.documentElement.dataset.drawn !== undefined")
        assert browser.value("document.querySelectorAll('tbody tr').length") == 2
        browser.open(f"http://127.0.0.1:{port}/drive/before/d0")
        assert browser.value("document.querySelectorAll('[data-figure=tracks] canvas').length") >= 1
        assert browser.messages == []
        assert all(url.startswith((f"http://127.0.0.1:{port}/", "data:")) for url in browser.requests)


def test_a_run_in_which_all_logs_failed_is_shown(tmp_path: Path) -> None:
    folder = write_run(tmp_path / "a", {}, entries=[entry("bad", outcome="failed: cut", main=None, car=None)])
    with serving(folder) as port:
        get = getter(port)
        assert drives_of(get("/")[2]) == ["bad"] and 'class="failed"' in get("/")[2]
        assert get("/drive/a/bad")[0] == 200 and get("/drives.csv")[0] == 200
