"""The inspection of a log as record, JSON, tables, a page with pictures, and a mapping to edit or paste."""

import html
import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fake_drive_log import FakeLog, FakeTopic
from hypothesis import given, strategies as st

from pdhef_logtool import Car, ReadOptions, read_drive
from pdhef_logtool.cli.inspecting import render_inspection
from pdhef_logtool.logs.byte_source import LocalFile
from pdhef_logtool.logs.mcap_index import read_index
from pdhef_logtool.logs.remote_place import RemotePlace
from pdhef_logtool.mapping import SignalSource, load_mapping
from pdhef_logtool.records.errors import EXIT_OK, EXIT_PARTIAL, UsageError
from pdhef_logtool.records.signals import Loss
from pdhef_logtool.runs.inspection.asking import ask_mapping
from pdhef_logtool.runs.inspection.fields import fields_of_log
from pdhef_logtool.runs.inspection.page import inspection_page, sparkline
from pdhef_logtool.runs.inspection.report import Inspection, inspect_drive_log, inspect_log, write_mapping
from pdhef_logtool.storage.documents import jsonable
from tests.command_line import called, printed, rendered
from tests.counting_server import serving
from tests.mcap_files import mcap_writer
from tests.reports.browser import AXE, CHROMIUM, WHY_NOT, Browser, serious
from tests.run_report import text_of
from tests.runs.wrong_mapping import wrong_sign

T0 = 1_700_000_000_000_000_000


def small_log(n: int = 3000, period_ms: int = 10) -> FakeLog:
    """An IMU with a gap of 1.51 s after 10 s, a late publisher, and a vendor topic that nobody recognises."""
    stamps = T0 + np.arange(n, dtype=np.int64) * period_ms * 1_000_000
    stamps[1001:] += 1_500_000_000
    rng = np.random.default_rng(0)
    fields = {"header.stamp": stamps, "linear_acceleration.x": rng.normal(size=n)}
    fields |= {"linear_acceleration.y": rng.normal(2.0, 3.0, size=n), "angular_velocity.z": rng.normal(size=n)}
    fields["linear_acceleration.y"][5] = np.nan
    imu = FakeTopic("sensor_msgs/msg/Imu", stamps + 3_000_000, fields, publish_time_ns=stamps + 1_000_000)
    vendor = FakeTopic("vendor_msgs/msg/Box", stamps[::10] + 3_000_000, {"speed_kmh": np.zeros(len(stamps[::10]))})
    lost = (Loss("truncated", "the file ends early", "memory.mcap", start_ns=int(stamps[-1])),)
    return FakeLog({"/imu": imu, "/vendor": vendor}, lost=lost)


def test_topics_are_measured():
    log = small_log()
    found = inspect_drive_log(log)
    imu = next(t for t in found.topics if t.name == "/imu")
    assert (imu.messages, imu.type, imu.encoding) == (3000, "sensor_msgs/msg/Imu", "cdr")
    assert imu.rate_hz == pytest.approx(100.0)
    assert imu.jitter_p95_s == pytest.approx(0.0, abs=1e-9)
    assert imu.largest_gap_s == pytest.approx(1.51)
    assert imu.largest_gap_at_s == pytest.approx(10.0)
    assert imu.delay_median_s == pytest.approx(0.002)
    assert found.duration_s == pytest.approx(31.49, abs=1e-6)


def test_signals_are_measured():
    log = small_log()
    found = inspect_drive_log(log)
    ay = found.signals["ay_m_s2"]
    values = log.contents["/imu"].fields["linear_acceleration.y"]
    good = values[np.isfinite(values)]
    assert (ay.topic, ay.field) == ("/imu", "linear_acceleration.y")
    assert (ay.samples, ay.gaps, ay.dropped) == (2999, 1, {"nan": 1})
    assert [ay.mean, ay.std, ay.minimum, ay.maximum] == pytest.approx([good.mean(), good.std(), good.min(), good.max()])
    assert ay.latency_s == pytest.approx(0.003)
    assert found.signals["ax_m_s2"].dropped == {}
    assert found.missing == ("steer_rad", "speed_m_s")
    assert [(x.kind, x.severity) for x in found.lost] == [("truncated", "lost"), ("nan", "lost")]
    assert found.exit_code == EXIT_PARTIAL


def test_an_empty_log_is_reported():
    found = inspect_drive_log(FakeLog({}))
    assert found.topics == ()
    json.dumps(found.to_dict(), allow_nan=False)
    assert "missing" in rendered(render_inspection, found, 80)


@pytest.mark.parametrize("width", [80, 120])
def test_tables_fit_and_say_what_matters(width):
    text = rendered(render_inspection, inspect_drive_log(small_log()), width)
    assert max(len(line) for line in text.splitlines()) <= width
    for part in ["/imu", "sensor_msgs/Imu", "/vendor", "yaw_rate_rad_s", "linear_acceleration.y", "steer_rad"]:
        assert part in text, part
    assert "1.51 @ 10.0" in text and "lost" in text and "the file ends early" in text


def test_the_written_mapping_loads_and_names_the_candidates(tmp_path):
    found = inspect_drive_log(small_log())
    path = tmp_path / "m.toml"
    write_mapping(found, path)
    again = load_mapping(path)
    assert again.signals == found.mapping.signals
    text = path.read_text()
    assert "# [signals.speed_m_s]" in text
    assert "/vendor (vendor_msgs/msg/Box): speed_kmh" in text
    assert "# sensor_msgs/msg/Imu, 100 Hz, " in text
    assert [p.name for p in tmp_path.iterdir()] == ["m.toml"]


def test_a_drive_has_its_checks_and_tells_the_failed_ones(sample_logs_dir, tmp_path):
    told: list[str] = []
    log, car = sample_logs_dir / "sweep.mcap", Car.load(sample_logs_dir / "vehicle.toml")
    mapping = load_mapping(wrong_sign(log, tmp_path))
    options = ReadOptions(waived=("steer_rad.sign", "steer.sign"))
    with read_drive(log, car, mapping, options, tell=told.append) as drive:
        (failed,) = (c for c in drive.checks if c.verdict == "failed")
    assert (failed.name, failed.waived) == ("steer_rad.sign", True)
    assert any("check steer_rad.sign failed (waived)" in text for text in told)
    assert any("--waive steer.sign: no check of this log is called that" in text for text in told)


# --------------------------------------------------------------------------------------------- real drives


@pytest.mark.slow
def test_a_log_with_a_dropout_and_losses(shared_dir):
    found = inspect_log(shared_dir / "data" / "drives" / "faulty" / "revs_250lm_a_disorder.mcap")
    imu = next(t for t in found.topics if t.name == "/imu/data")
    assert imu.largest_gap_s == pytest.approx(30.01, abs=0.02)
    assert imu.largest_gap_at_s == pytest.approx(135.0, abs=0.1)
    counts = {(x.kind, x.where.split(" ")[0]): x.count for x in found.lost if x.kind in ("nan", "duplicate-stamp")}
    assert counts == {
        ("nan", "ay_m_s2"): 2,
        ("nan", "yaw_rate_rad_s"): 1,
        ("nan", "steer_rad"): 2,
        ("duplicate-stamp", "/imu/data"): 20,
    }
    assert found.signals["ay_m_s2"].dropped == {"nan": 2, "duplicate-stamp": 20}
    # The ground truth of the same name has lost no sample.
    assert found.truth["yaw_rate_rad_s"].dropped == {}
    assert found.exit_code == EXIT_PARTIAL


def test_covariances_do_not_hide_the_gyro(sample_logs_dir):
    found = fields_of_log(sample_logs_dir / "dlc.mcap", "/imu/data")
    (topic,) = found["topics"]
    paths = [f["path"] for f in topic["fields"]]
    assert "angular_velocity.z" in paths
    assert sum("covariance" in p for p in paths) == 3
    gravity = next(f for f in topic["fields"] if f["path"] == "linear_acceleration.z")
    assert gravity["type"] == "float64"
    assert gravity["minimum"] <= gravity["mean"] <= gravity["maximum"]
    assert found["whole"]
    text = printed("fields", found)
    assert max(map(len, text.splitlines()[1:])) <= 80
    json.dumps(jsonable(found), allow_nan=False)


def test_all_topics_are_listed_and_a_wrong_one_is_refused(sample_logs_dir):
    found = fields_of_log(sample_logs_dir / "dlc.mcap")
    assert len(found["topics"]) > 5
    with pytest.raises(UsageError, match="topics: "):
        fields_of_log(sample_logs_dir / "dlc.mcap", "/imu")


@pytest.mark.slow
def test_missing_signals_are_named_and_doubtful_candidates_stand_in_the_file_as_comments(shared_dir, tmp_path):
    found = inspect_log(shared_dir / "reader_corpus" / "dart_ros1" / "4_sept_random_driving_fast.bag")
    text = rendered(render_inspection, found, 200)
    assert "speed_m_s" in next(line for line in text.splitlines() if line.startswith("missing"))
    assert "pdhef map LOG" in text
    write_mapping(found, tmp_path / "m.toml")
    text = (tmp_path / "m.toml").read_text()
    assert "undecided: /steering_angle_1.data is taken" in text
    assert '# topic = "/steering_1"' in text
    assert "score 0." in text
    assert set(load_mapping(tmp_path / "m.toml").signals) == {"steer_rad"}


def test_a_mapping_by_question_and_answer(shared_dir):
    found = inspect_log(shared_dir / "data" / "drives" / "lunda_v40")
    said: list[str] = []
    answers = iter(
        ["", "1", "nonsense", "/vbox y_accel_g", "/vbox/sample y_accel_g -9.81", "-", "", "", "", "", "", ""]
    )
    mapping = ask_mapping(found, lambda _: next(answers), said.append)
    assert mapping.signals["steering_wheel_rad"] == found.mapping.signals["steering_wheel_rad"]
    assert mapping.signals["yaw_rate_rad_s"].field == "yaw_rate_gnss_deg_s"
    assert mapping.signals["ay_m_s2"] == SignalSource("ay_m_s2", "/vbox/sample", "y_accel_g", scale=-9.81)
    assert "ax_m_s2" not in mapping.signals
    assert said[-1] == "missing: ax_m_s2"
    assert any("*" in line and "steer_ang_deg" in line for line in said)


S = 1_000_000_000
#: Chunks of road.mcap (41, of 7.3 s): one that no window holds, and one in the first minute.
UNSEEN, SEEN = 15, 3


@pytest.fixture
def _small_windows(monkeypatch):
    """Make a log of 300 s a large one: of it the first minute is checked, and four times 3 s are looked at."""
    monkeypatch.setattr("pdhef_logtool.runs.inspection.report.WHOLE_BYTES", 1 << 20)
    monkeypatch.setattr("pdhef_logtool.runs.inspection.report.WINDOW_NS", 60 * S)
    monkeypatch.setattr("pdhef_logtool.mapping.clocks.SURVEY_WHOLE_NS", 60 * S)
    monkeypatch.setattr("pdhef_logtool.mapping.clocks.SURVEY_WINDOWS", 4)
    monkeypatch.setattr("pdhef_logtool.mapping.clocks.SURVEY_WINDOW_NS", 3 * S)
    monkeypatch.setattr("pdhef_logtool.mapping.evidence.PIECES", 3)


def _by_times(found: Inspection) -> list[dict[str, object]]:
    """Return the entries of topics, without the delays."""
    return [{k: v for k, v in t.items() if not k.startswith("delay")} for t in found.to_dict()["topics"]]


@pytest.mark.slow
@pytest.mark.usefixtures("_small_windows")
def test_a_sample_tells_what_the_whole_tells(sample_logs_dir):
    some, whole = (inspect_log(sample_logs_dir / "road.mcap", whole=w) for w in (False, True))
    assert whole.sample is None
    assert (some.sample.of_chunks, some.sample.times) == (41, "index")
    assert 10 <= some.sample.chunks <= 25
    assert _by_times(some) == _by_times(whole)
    assert some.mapping == whole.mapping
    assert some.checks == whole.checks
    assert some.proposals == whole.proposals
    assert (some.start_ns, some.end_ns, some.notes, some.missing) == (
        whole.start_ns, whole.end_ns, whole.notes, whole.missing
    )  # fmt: skip
    for name, report in some.signals.items():
        assert whole.signals[name].minimum <= report.minimum <= report.maximum <= whole.signals[name].maximum
        assert report.rate_hz == pytest.approx(whole.signals[name].rate_hz)
        assert report.gaps == 0, "what lies between two windows is no gap"
    assert some.to_dict()["sample"] == {"chunks": some.sample.chunks, "of_chunks": 41, "times": "index"}
    assert "--all reads" in " ".join(rendered(render_inspection, some).split())
    assert "--all" not in rendered(render_inspection, whole)


def test_a_small_log_is_read_whole(sample_logs_dir):
    assert inspect_log(sample_logs_dir / "dlc.mcap").sample is None


def _flip_in_chunk(number: int) -> Callable[[Path], None]:
    def spoil(file: Path) -> None:
        source = LocalFile(file)
        index, _ = read_index(source)
        source.close()
        data = bytearray(file.read_bytes())
        extent, _ = index.chunks[number]
        data[(extent.start + extent.end) // 2] ^= 1
        file.write_bytes(data)

    return spoil


def _cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-2000])


@pytest.mark.slow
@pytest.mark.usefixtures("_small_windows")
@pytest.mark.parametrize(
    ("spoil", "seen"), [(_flip_in_chunk(SEEN), True), (_flip_in_chunk(UNSEEN), False), (_cut, True)]
)
def test_damage_that_is_met_has_all_of_it_read(tmp_path, sample_logs_dir, spoil, seen):
    file = tmp_path / "damaged.mcap"
    file.write_bytes((sample_logs_dir / "road.mcap").read_bytes())
    spoil(file)
    found, whole = inspect_log(file), inspect_log(file, whole=True)
    assert whole.exit_code == EXIT_PARTIAL
    assert found.exit_code == (EXIT_PARTIAL if seen else EXIT_OK)
    assert (found.sample is None) is seen
    if seen:
        assert found.to_dict() == whole.to_dict()


@pytest.mark.slow
@pytest.mark.usefixtures("_small_windows")
def test_of_a_far_log_only_the_sample_is_fetched(sample_logs_dir):
    pytest.importorskip("aiohttp", reason="reads http://: pip install 'pdhef-logtool[http]'")
    data = (sample_logs_dir / "road.mcap").read_bytes()
    with serving(**{"road.mcap": data, "again.mcap": data, "fields.mcap": data}) as server:
        far = inspect_log(RemotePlace(server.place("road.mcap")))
        assert (far.sample.times, far.sample.of_chunks) == ("sample", 41)
        assert 0.3 < server.bytes_sent / len(data) < 0.65
        assert len(server.requests) <= 12
        assert server.twice() == 0
        near = inspect_log(sample_logs_dir / "road.mcap")
        assert far.mapping == near.mapping
        assert far.checks == near.checks
        assert [t.messages for t in far.topics] == [t.messages for t in near.topics]
        assert [t.rate_hz for t in far.topics] == pytest.approx([t.rate_hz for t in near.topics], rel=1e-3)
        assert far.to_dict()["signals"] == near.to_dict()["signals"]
        server.requests.clear()
        assert inspect_log(RemotePlace(server.place("again.mcap")), whole=True).sample is None
        assert server.bytes_sent == len(data) + 1, "the first byte is the check of the version"
        server.requests.clear()
        fields_of_log(RemotePlace(server.place("fields.mcap")), "/imu/data")
        assert server.bytes_sent < 0.6 * len(data)


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
    steer, speed = np.degrees(yaw_rate * 2.7 / 20.0), np.full(count, 72.0) + 0.1 * np.sin(3.0 * time_s)
    columns = {"yaw_rate_rad_s": yaw_rate, "ay_mps2": 20.0 * yaw_rate, "steering_angle_deg": steer}
    return columns | {"speed_kmh": speed, "yaw_rate_2": 1.01 * yaw_rate}


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
