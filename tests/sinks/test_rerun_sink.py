from __future__ import annotations

import io
import itertools
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rerun.chunk import RrdReader

from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.sinks import rerun
from pdhef_logtool.sinks.base import Event
from pdhef_logtool.sinks.palette import colour_rgb
from pdhef_logtool.sinks.rerun import LONGEST_BRIDGE_NS, RerunSink, _Line, _Trajectory

HASH = "0123456789abcdef" * 4
#: Of one track only: the others have those of the palette.
COLOURS = {"phy-ukf": 0x123456}
START_NS = 1_700_000_000_000_000_123
REPORT = {
    "log": {"name": "drive", "file": "drive.mcap", "kind": "mcap", "duration_s": 6.0, "sha256": HASH},
    "vehicle": {"name": "sedan"},
    "warnings": ["a warning"],
    "losses": [],
    "truth": {"available": False, "quantities": [], "latency_s": None, "not_independent": [], "notes": []},
    "metrics": [],
    "estimators": [],
    "mapping": {"signals": [], "missing": []},
    "versions": {"python": "3"},
}
EVENTS = (
    Event("nonlinear", START_NS + 10**9, START_NS + 3 * 10**9, "|ay| above 0.5 g"),
    Event("start", START_NS, START_NS + 1, ""),
)

#: Every entity of the recording of two windows of 300 stamps of phy-ukf, zero and truth, with its number of rows.
#: 12 of 600 rows are not valid, each of which breaks a line once; the very last one has nothing behind it.
STATE_ROWS = 588 + 11
ROWS = {
    **{
        f"/{quantity}/{name}": STATE_ROWS
        for quantity in ("sideslip_deg", "yaw_rate_deg_s", "vx_m_s", "vy_m_s", "ay_m_s2", "friction")
        for name in ("phy-ukf", "zero", "truth")
    },
    **{
        f"/{quantity}/{name}/band95": STATE_ROWS
        for quantity in ("sideslip_deg", "yaw_rate_deg_s", "vx_m_s", "vy_m_s")
        for name in ("phy-ukf", "zero")
    },
    **{f"/{quantity}/{name}": STATE_ROWS for quantity in ("network_trust", "r_scale") for name in ("phy-ukf", "zero")},
    **{
        f"/error/{quantity}/{name}": STATE_ROWS
        for quantity in ("sideslip_deg", "yaw_rate_deg_s", "vx_m_s", "vy_m_s", "ay_m_s2")
        for name in ("phy-ukf", "zero")
    },
    "/nis/phy-ukf": 504,  # 588 valid rows without the 86 - 2 unknown ones, which are bridged
    "/nis/zero": 504,
    "/inputs/steer_deg": 600,
    "/inputs/speed_m_s": 300,
    "/inputs/ax_m_s2": 600,
    "/inputs/ay_m_s2": 600,
    "/inputs/yaw_rate_deg_s": 600,
    "/plan/phy-ukf/now": 120,
    "/plan/zero/now": 120,
    "/plan/truth/now": 120,
    "/events": 2,
}
STATIC = {
    "/__properties",
    "/plan/phy-ukf",
    "/plan/zero",
    "/plan/truth",
    "/report",
    *(e for e in ROWS if e != "/events"),
}


def write(path: Path, circle, circle_signals, events=EVENTS) -> None:
    sink = RerunSink(path, log_name="drive", input_hash=HASH, start_ns=START_NS, colours=COLOURS)
    for k in range(2):
        sink.append_signals(circle_signals(300 * k, 300))
        for name in ("phy-ukf", "truth", "zero"):
            sink.append(circle(name, 300 * k, 300, bias=0.0 if name == "truth" else 0.02))
    sink.finish(REPORT, events)


@pytest.fixture
def recording(tmp_path, circle, circle_signals) -> Path:
    path = tmp_path / "recording.rrd"
    write(path, circle, circle_signals)
    return path


def tables(path: Path, blueprint: bool = False) -> tuple[dict[str, pa.Table], dict[str, list[pa.RecordBatch]]]:
    """Return by entity what stands on the timelines and what is static."""
    reader = RrdReader(path)
    store = (reader.blueprints() if blueprint else reader.recordings())[0]
    timed: dict[str, list[pa.RecordBatch]] = defaultdict(list)
    static: dict[str, list[pa.RecordBatch]] = defaultdict(list)
    for chunk in reader.stream(store=store):
        (static if chunk.is_static else timed)[chunk.entity_path].append(chunk.to_record_batch())
    return {e: pa.concat_tables([pa.Table.from_batches([b]) for b in bs]) for e, bs in timed.items()}, dict(static)


def plain(table: pa.Table | pa.RecordBatch) -> dict[str, list]:
    """Return the columns as lists, times as integers; row ids hold the time of writing and are left out."""
    columns = {}
    for name in table.schema.names:
        column = table[name]
        if pa.types.is_timestamp(column.type) or pa.types.is_duration(column.type):
            column = column.cast(pa.int64())
        if name != "rerun.controls.RowId":
            columns[name] = column.to_pylist()
    return columns


def series(table: pa.Table) -> tuple[np.ndarray, list[list[float]]]:
    order = np.argsort(table["time"].to_numpy().astype(np.int64), kind="stable")
    values = table["Scalars:scalars"].to_pylist()
    return table["time"].to_numpy().astype(np.int64)[order], [values[i] for i in order]


def test_every_entity_has_its_rows(recording):
    timed, static = tables(recording)
    assert {e: t.num_rows for e, t in timed.items()} == ROWS
    assert set(static) == STATIC
    for table in timed.values():
        assert {"time", "elapsed"} <= set(table.column_names)


def test_identity_and_footer(recording):
    reader = RrdReader(recording)
    (entry,) = reader.recordings()
    assert (entry.application_id, entry.recording_id) == ("pdhef-logtool", HASH[:32])
    assert reader.store() is not None
    _, static = tables(recording)
    properties = {k: v for b in static["/__properties"] for k, v in b.to_pydict().items()}
    assert properties["RecordingInfo:name"] == [["drive"]]
    assert properties["RecordingInfo:start_time"] == [[START_NS]]


def test_blueprint_shows_every_view(recording):
    assert len(RrdReader(recording).blueprints()) == 1
    timed, static = tables(recording, blueprint=True)
    names, origins = [], []
    for part in [*itertools.chain(*static.values()), *timed.values()]:
        columns = plain(part)
        if "ViewBlueprint:space_origin" in columns:
            names += columns["ViewBlueprint:display_name"][0]
            origins += columns["ViewBlueprint:space_origin"][0]
    assert sorted(origins) == sorted(
        [
            "/sideslip_deg",
            "/yaw_rate_deg_s",
            "/ay_m_s2",
            "/inputs",
            "/plan",
            "/events",
            "/error/sideslip_deg",
            "/error/yaw_rate_deg_s",
            "/error/vx_m_s",
            "/error/vy_m_s",
            "/error/ay_m_s2",
            "/nis",
            "/network_trust",
            "/r_scale",
            "/mixture_weight",
            "/reasons",
            "/vx_m_s",
            "/vy_m_s",
            "/report",
        ]
    )
    assert "Sideslip [deg]" in names
    drawn = set(ROWS) | STATIC
    for origin in set(origins) - {"/mixture_weight", "/reasons"}:  # of an adaptive estimator only
        assert any(e == origin or e.startswith(origin + "/") for e in drawn), origin


def test_values_stamps_bands_and_errors(recording, circle):
    timed, _ = tables(recording)
    truth = circle("truth", 0, 600)
    track = circle("phy-ukf", 0, 600, bias=0.02)
    stamps, values = series(timed["/sideslip_deg/phy-ukf"])
    shown = np.array([len(v) == 1 for v in values])
    np.testing.assert_array_equal(stamps[shown], track.stamps_ns[track.valid])
    np.testing.assert_allclose([v[0] for v in values if v], np.degrees(track.sideslip_rad[track.valid]))
    _, band = series(timed["/sideslip_deg/phy-ukf/band95"])
    half = np.degrees(1.959963985 * 0.03)
    middle = np.degrees(track.sideslip_rad[track.valid])
    np.testing.assert_allclose([b for b in band if b], np.stack([middle - half, middle + half], axis=1))
    _, error = series(timed["/error/sideslip_deg/phy-ukf"])
    expected = np.degrees(track.sideslip_rad - truth.sideslip_rad)[track.valid]
    np.testing.assert_allclose([e[0] for e in error if e], expected, atol=1e-9)
    elapsed = timed["/inputs/steer_deg"]["elapsed"].to_numpy().astype(np.int64)
    np.testing.assert_array_equal(np.sort(elapsed), np.arange(600) * 10_000_000)


def test_colours_are_the_same_in_every_plot(recording):
    _, static = tables(recording)
    for name in ("phy-ukf", "zero", "truth"):
        r, g, b = colour_rgb(name, COLOURS)
        assert name not in COLOURS or (r << 16) | (g << 8) | b == COLOURS[name]
        packed = (r << 24) | (g << 16) | (b << 8)
        for entity in (f"/sideslip_deg/{name}", f"/vx_m_s/{name}"):
            (batch,) = static[entity]
            assert batch["SeriesLines:colors"].to_pylist() == [[packed | 0xFF]]
            assert batch["SeriesLines:names"].to_pylist() == [[name]]
        (strips,) = static[f"/plan/{name}"]
        assert strips["LineStrips2D:colors"].to_pylist() == [[packed | 0xFF]]


def test_the_plan_has_north_up_and_parts_where_the_track_is_not_valid(recording, circle):
    _, static = tables(recording)
    (batch,) = static["/plan/truth"]
    strips = batch["LineStrips2D:strips"].to_pylist()[0]
    assert len(strips) == 12
    truth = circle("truth", 0, 600)
    expected = np.stack([truth.x_m, -truth.y_m], axis=1)[:49]
    np.testing.assert_allclose(np.array(strips[0]), expected, rtol=1e-5, atol=1e-5)


def test_events_and_report_are_text(recording):
    timed, static = tables(recording)
    order = np.argsort(timed["/events"]["time"].to_numpy())
    texts = [timed["/events"]["TextLog:text"].to_pylist()[i][0] for i in order]
    assert texts == ["start, 0.00 s", "nonlinear, 2.00 s: |ay| above 0.5 g"]
    (batch,) = static["/report"]
    assert batch["TextDocument:media_type"].to_pylist() == [["text/markdown"]]
    assert batch["TextDocument:text"].to_pylist()[0][0].startswith("# drive\n")


def test_weights_and_reasons_are_drawn_over_windows(tmp_path, circle):
    path = tmp_path / "recording.rrd"
    sink = RerunSink(path, log_name="drive", input_hash=HASH, start_ns=START_NS, colours=COLOURS)
    for k in range(5):
        sink.append(circle("pd-hef", 120 * k, 120, adaptive=True))  # the gyro is stuck over the first cut
        sink.append(circle("zero", 120 * k, 120))
    sink.finish(REPORT)
    timed, _ = tables(path)
    track = circle("pd-hef", 0, 600, adaptive=True)
    _, weights = series(timed["/mixture_weight/pd-hef"])
    np.testing.assert_allclose([w[0] for w in weights if w], track.mixture_weight[track.valid])
    assert {e for e in timed if e.startswith(("/mixture_weight", "/reasons"))} == {
        *("/mixture_weight/pd-hef", "/reasons/pd-hef/stuck_yaw_rate", "/reasons/pd-hef/spike_ay")
    }
    stuck = timed["/reasons/pd-hef/stuck_yaw_rate"]
    assert stuck["StateChange:state"].to_pylist() == [["gyro stuck"], [""]]
    assert plain(stuck)["time"] == [int(track.stamps_ns[100]), int(track.stamps_ns[149]) + 1]
    spikes = plain(timed["/reasons/pd-hef/spike_ay"])
    assert spikes["time"][::2] == [int(track.stamps_ns[30]), int(track.stamps_ns[400])]
    texts = [t[0] for t in timed["/events"]["TextLog:text"].to_pylist()]
    assert texts == ["pd-hef: a_y spike, 0.00 s", "pd-hef: gyro stuck, 0.49 s", "pd-hef: a_y spike, 0.00 s"]


def test_same_input_gives_the_same_content(tmp_path, circle, circle_signals):
    contents = []
    for name in ("a.rrd", "b.rrd"):
        write(tmp_path / name, circle, circle_signals)
        timed, static = tables(tmp_path / name)
        contents.append(({e: plain(t) for e, t in timed.items()}, {e: [*map(plain, bs)] for e, bs in static.items()}))
    assert contents[0] == contents[1]


def test_slow_sideslip_is_not_drawn(tmp_path, circle):
    path = tmp_path / "recording.rrd"
    sink = RerunSink(path, log_name="drive", input_hash=HASH, start_ns=START_NS, min_speed_m_s=11.0)
    sink.append(circle("zero"))
    sink.append(circle("truth"))
    sink.finish(REPORT)
    timed, _ = tables(path)
    assert "/vx_m_s/zero" in timed
    assert "/error/vx_m_s/zero" in timed
    assert not {"/sideslip_deg/zero", "/sideslip_deg/zero/band95", "/error/sideslip_deg/zero", "/events"} & set(timed)


def test_errors_stand_where_both_are_valid_and_share_a_stamp(tmp_path, circle):
    path = tmp_path / "recording.rrd"
    track, truth = circle("zero", 0, 40), circle("truth", 5, 40)
    track.valid[20] = False
    truth.valid[25] = False  # stamp 30 of the track
    sink = RerunSink(path, log_name="drive", input_hash=HASH, start_ns=START_NS, colours=COLOURS)
    sink.append(track)
    sink.append(truth)
    sink.finish(REPORT)
    timed, _ = tables(path)
    stamps, values = series(timed["/error/sideslip_deg/zero"])
    shown = [int(t) for t, v in zip(stamps, values, strict=True) if v]
    assert shown == track.stamps_ns[[i for i in range(5, 40) if i not in (20, 30)]].tolist()
    drawn = [int(t) for t, v in zip(*series(timed["/vx_m_s/zero"]), strict=True) if v]
    assert drawn == track.stamps_ns[[i for i in range(40) if i != 20]].tolist()


def test_nothing_stands_under_the_final_name_before_finish(tmp_path, circle):
    path = tmp_path / "out" / "recording.rrd"
    sink = RerunSink(path, log_name="drive", input_hash=HASH, start_ns=START_NS, colours=COLOURS)
    sink.append(circle("zero"))
    assert not path.exists()
    sink.abort()
    sink.abort()
    assert list(path.parent.iterdir()) == []
    sink = RerunSink(path, log_name="drive", input_hash=HASH, start_ns=START_NS, colours=COLOURS)
    sink.append(circle("zero"))
    with pytest.raises(KeyError):
        sink.finish({})
    assert list(path.parent.iterdir()) == []
    sink = RerunSink(path, log_name="drive", input_hash=HASH, start_ns=START_NS, colours=COLOURS)
    sink.finish(REPORT)
    sink.abort()
    assert [p.name for p in path.parent.iterdir()] == ["recording.rrd"]


def test_unwritable_place_is_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="expected a place to write to"):
        RerunSink(tmp_path / "file" / "recording.rrd", log_name="drive", input_hash=HASH, start_ns=START_NS)


SCRIPT = """
import sys
from pathlib import Path
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.sinks.rerun import RerunSink
try:
    RerunSink(Path(sys.argv[1]), log_name="d", input_hash="ab" * 32, start_ns=0).abort()
except OutputError as error:
    print(error)
"""


def run_script(tmp_path: Path, **env: str) -> str:
    home = tmp_path / "home"
    home.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(tmp_path / "recording.rrd")],
        env={**os.environ, "HOME": str(home), "XDG_CONFIG_HOME": "", "XDG_DATA_HOME": "", **env},
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    assert not [p for p in home.rglob("*") if "rerun" in p.name or "analytics" in p.name]
    return done.stdout


def test_writing_starts_no_analytics_and_a_switched_off_rerun_is_said(tmp_path):
    assert "unset RERUN" in run_script(tmp_path, RERUN="off")


@pytest.mark.parametrize("call", [0, 1, 3, "close"])
def test_a_disk_that_is_full_is_told_and_leaves_nothing(tmp_path, circle, circle_signals, monkeypatch, call):
    class Full(io.BytesIO):
        calls = 0

        def write(self, data):
            self.calls += 1
            if call != "close" and self.calls > call:
                raise OSError(28, "No space left on device")
            return len(data)

        def close(self):
            if call == "close":
                raise OSError(28, "No space left on device")

    monkeypatch.setattr(rerun, "open_new", lambda _path: Full())
    with pytest.raises(OutputError, match=r"recording\.rrd: .*No space left on device; free some space"):
        write(tmp_path / "recording.rrd", circle, circle_signals)
    assert list(tmp_path.iterdir()) == []


def test_a_recording_without_its_end_is_none(tmp_path, circle, circle_signals, monkeypatch):
    monkeypatch.setattr(rerun, "_FOOTER", b"something that Rerun does not write")
    with pytest.raises(OutputError, match="got one without its end"):
        write(tmp_path / "recording.rrd", circle, circle_signals)
    assert list(tmp_path.iterdir()) == []


HANGING = """
import sys, threading
from pathlib import Path
import numpy as np
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.records.tracks import make_track
from pdhef_logtool.sinks import rerun

class Hangs:
    left = int(sys.argv[2])
    def write(self, data):
        self.left -= 1
        if self.left < 0:
            threading.Event().wait()
    def close(self):
        threading.Event().wait()

rerun.LONGEST_WAIT_S = 1.0
rerun.open_new = lambda path: Hangs()
try:
    sink = rerun.RerunSink(Path(sys.argv[1]), log_name="d", input_hash="ab" * 32, start_ns=0)
    for k in range(6):
        stamps_ns = (np.arange(20000) + 20000 * k) * 10_000_000
        vy = np.sin(stamps_ns * 1.0)
        sink.append(make_track("zero", stamps_ns, vx_m_s=10 + vy, vy_m_s=vy, valid=np.ones(20000, dtype=bool)))
    sink._draw_whole = lambda *_: None
    sink.finish({})
except OutputError as error:
    print(error)
"""


@pytest.mark.slow
@pytest.mark.parametrize("writes", [0, 5, 1000])
def test_a_disk_that_hangs_is_given_up_and_the_process_ends(tmp_path, writes):
    done = subprocess.run(
        [sys.executable, "-c", HANGING, str(tmp_path / "recording.rrd"), str(writes)],
        capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    assert "recording.rrd: expected a place to write to, got nothing could be written for 1 s" in done.stdout


@settings(max_examples=200, derandomize=True, deadline=None)
@given(
    st.lists(st.booleans(), min_size=1, max_size=40),
    st.lists(st.integers(1, 3 * LONGEST_BRIDGE_NS // 2), min_size=40, max_size=40),
    st.integers(0, 40),
    st.sampled_from([0, LONGEST_BRIDGE_NS]),
)
def test_line_breaks_do_not_depend_on_windows(known, steps, cut, bridge):
    known_array = np.array(known)
    stamps = np.cumsum(np.array(steps[: len(known)], dtype=np.int64))
    whole = _Line(bridge)
    expected = whole.rows(stamps, known_array)
    parted = _Line(bridge)
    cut = min(cut, len(known))
    a = parted.rows(stamps[:cut], known_array[:cut])
    b = parted.rows(stamps[cut:], known_array[cut:])
    np.testing.assert_array_equal(np.concatenate([a[0], b[0]]), expected[0])
    np.testing.assert_array_equal(np.concatenate([a[2], b[2]]), expected[2])
    np.testing.assert_array_equal(np.concatenate([a[1], b[1] + cut]), np.flatnonzero(known_array))
    shown = np.flatnonzero(known_array)
    gaps = [
        j
        for j, (p, q) in enumerate(itertools.pairwise(shown))
        if (q - p > 1 and stamps[q] - stamps[p] > bridge) or stamps[q] - stamps[p] > LONGEST_BRIDGE_NS
    ]
    assert expected[2].sum() == len(gaps)
    assert (np.diff(expected[0]) > 0).all() or 1 in steps


@settings(max_examples=50, derandomize=True, deadline=None)
@given(st.lists(st.integers(0, 60), min_size=1, max_size=20))
def test_a_trajectory_stays_small_and_evenly_spaced(lengths):
    path = _Trajectory(50)
    total = sum(lengths)
    points = np.stack([np.arange(total), np.zeros(total)], axis=1).astype(float)
    for n, end in zip(lengths, np.cumsum(lengths), strict=True):
        path.append(points[end - n : end])
    strips = path.strips()
    if total > 1:
        (strip,) = strips
        assert len(strip) <= 50
        assert strip[0, 0] == 0
        assert len(set(np.diff(strip[:, 0]))) == 1
        assert total - strip[-1, 0] <= np.diff(strip[:, 0])[0]


def test_the_truth_stands_out_and_bands_stay_behind_the_lines(recording: Path) -> None:
    _, static = tables(recording)

    def widths(entity: str) -> list[float]:
        (batch,) = static[entity]
        (column,) = [n for n in batch.schema.names if n.endswith("widths")]
        return list(batch.column(column).to_pylist()[0])

    assert widths("/sideslip_deg/truth") == [2.0]
    assert widths("/sideslip_deg/phy-ukf") == [1.5]
    assert widths("/sideslip_deg/phy-ukf/band95") == [0.75, 0.75]
