"""The page of an inspection: pictures of candidate fields, reasons, and a mapping that loads as it is pasted."""

import html
import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pdhef_logtool.mapping import load_mapping
from pdhef_logtool.runs.inspection import inspect_log
from pdhef_logtool.runs.inspection.page import inspection_page, sparkline
from tests.command_line import called
from tests.mcap_files import mcap_writer
from tests.reports.browser import AXE, CHROMIUM, WHY_NOT, Browser, serious
from tests.run_report import text_of

HOSTILE = "/<script>document.title='ran'</script>\x1b[31m\u202e&quot;\"'"
_MOST_BYTES = 500_000
_VALUES = st.one_of(st.floats(-1e6, 1e6), st.just(float("nan")))


def write_log(
    path: Path, topics: dict[str, dict[str, np.ndarray]], stamps_ns: dict[str, np.ndarray] | None = None
) -> Path:
    """Write JSON messages, at 20 Hz if no stamps are given."""
    with mcap_writer(path) as writer:
        for topic, columns in topics.items():
            kinds = {name: {"type": "number"} for name in columns}
            schema = writer.register_schema(f"t{topic}", "jsonschema", json.dumps({"properties": kinds}).encode())
            channel = writer.register_channel(topic, "json", schema)
            count = len(next(iter(columns.values())))
            stamps = (stamps_ns or {}).get(topic, 10**18 + np.arange(count) * 50_000_000)
            for i, stamp in enumerate(stamps.tolist()):
                data = json.dumps({name: float(column[i]) for name, column in columns.items()}).encode()
                writer.add_message(channel, stamp, data, stamp)
    return path


def car(count: int = 300) -> dict[str, np.ndarray]:
    time_s = np.arange(count) * 0.05
    yaw_rate = 0.3 * np.sin(time_s)
    return {
        "yaw_rate_rad_s": yaw_rate,
        "ay_mps2": 20.0 * yaw_rate,
        "steering_angle_deg": np.degrees(yaw_rate * 2.7 / 20.0),
        "speed_kmh": np.full(count, 72.0) + 0.1 * np.sin(3.0 * time_s),
        "yaw_rate_2": 1.01 * yaw_rate,
    }


@given(st.lists(_VALUES, min_size=1, max_size=100))
def test_a_sparkline_shows_each_run_of_finite_values_within_its_box(values):
    v = np.array(values)
    drawn = str(sparkline(v))
    finite = np.isfinite(v)
    runs = int(np.count_nonzero(np.diff(np.concatenate([[False], finite]).astype(int)) == 1))
    assert drawn.count("M") == runs
    width = float(re.search(r'viewBox="0 0 (\d+) 60"', drawn)[1])
    for x, y, down in re.findall(r"[ML](\d+) (\d+)(?:V(\d+))?", drawn):
        assert 0 <= float(x) <= width
        assert 0 <= float(y) <= 60
        assert down == "" or 0 <= float(down) <= 60
    if finite.sum() > 1 and np.ptp(v[finite]) > 0.0:
        ys = {int(y) for y in re.findall(r"[ML]\d+ (\d+)", drawn)}
        assert {2, 58} <= ys


def _page(path: Path) -> str:
    """Return the page of a log, written while the log is open."""
    pages: list[bytes] = []
    inspect_log(path, then=lambda inspection, log: pages.append(inspection_page(inspection, log)))
    return pages[0].decode()


def test_a_page_shows_fields_reasons_and_a_mapping_to_paste(tmp_path):
    log = write_log(tmp_path / "car.mcap", {"/car": car(), "/other": {"temperature": np.arange(300.0)}})
    file = tmp_path / "page.html"
    assert called("inspect", str(log), "--report", str(file)).returncode == 0
    page, inspection = file.read_text(), inspect_log(log)
    text = text_of(page)
    assert inspection.signals
    for report in inspection.signals.values():
        assert f"{report.topic}.{report.field}" in text
    for candidate in inspection.candidates:
        assert f"taken {candidate.score:.2f}" in text if candidate.taken else f"{candidate.score:.2f} /car" in text
        assert " ".join(candidate.reason.split()) in text
    assert "scale 0.277778" in text
    assert "71.9 to 72.1" not in text  # SI, as it is used
    assert "range 20 to 20 m/s" in text
    assert "rate 20 Hz" in text
    assert "temperature range" not in text
    drawn = [n for n in re.findall(r'<path d="([^"]*)"', page) if n]
    assert len(drawn) == len(inspection.signals) + len([c for c in inspection.candidates if not c.taken])
    pasted = tmp_path / "mapping.toml"
    pasted.write_text(html.unescape(re.search(r'<pre class="paste"[^>]*>(.*?)</pre>', page, re.DOTALL)[1]))
    assert load_mapping(pasted).signals == inspection.mapping.signals
    assert len(page) < _MOST_BYTES
    called("inspect", str(log), "--mapping", str(pasted), "--report", str(file))
    assert "named by the mapping file" in text_of(file.read_text())


def test_a_log_of_many_fields_stays_below_the_limit(tmp_path):
    rng = np.random.default_rng(1)
    topics = {f"/ecu{k}": {f"signal_{i}_{'x' * 200}": rng.normal(size=120) for i in range(60)} for k in range(8)}
    log = write_log(tmp_path / "many.mcap", {"/car": car(120), **topics})
    page = _page(log)
    assert len(page) < _MOST_BYTES


def test_the_log_is_never_replaced_and_fields_stand_alone(tmp_path):
    log = write_log(tmp_path / "car.mcap", {"/car": car()})
    before = log.read_bytes()
    result = called("inspect", str(log), "--report", str(log))
    assert result.returncode == 2
    assert "would replace the input" in result.stderr
    assert log.read_bytes() == before
    assert called("inspect", str(log), "--fields", "--report", str(tmp_path / "x.html")).returncode == 2


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason=WHY_NOT)
def test_hostile_names_run_nothing_and_a_narrow_dark_page_is_readable(tmp_path):
    log = write_log(tmp_path / "hostile.mcap", {HOSTILE: car(), "/car": {"<img src=x>": np.arange(300.0)}})
    file = tmp_path / "page.html"
    file.write_text(_page(log))
    with Browser() as browser:
        for width, scheme in ((390, "dark"), (1280, "light")):
            browser.show(width, scheme=scheme)
            browser.open(file)
            browser.value("document.querySelectorAll('details').forEach(n => { n.open = true })")
            assert browser.value("document.documentElement.scrollWidth") <= width
            assert AXE is None or serious(browser) == []
            assert "ran" not in browser.value("document.title").split()
            assert browser.value("document.images.length") == 0
            browser.value("document.querySelector('button.copy').click()")
            assert browser.value("document.querySelector('.copied').textContent").startswith(("Copied", "Selected"))
            chosen = browser.value("getSelection().toString()")
            assert "[signals.yaw_rate_rad_s]" in chosen
            assert browser.messages == []
            assert len(browser.requests) == 1
