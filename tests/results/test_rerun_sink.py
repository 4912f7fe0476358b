import math
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import HealthCheck, given, settings, strategies as st
from rerun.chunk import RrdReader

from pdhef_logtool.records.tracks import make_track
from pdhef_logtool.results.rerun_sink import LONGEST_BRIDGE_NS, MOST_OTHERS, write_recording
from pdhef_logtool.results.sink import Event
from tests import run_report

HASH = "0123456789abcdef" * 4
#: Of one track only: the others use the colours of the palette.
COLOURS = {"phy-ukf": 0x123456}
#: The third track that is written, zero, is neither.
SHOWN = ["phy-ukf"]
START_NS = 1_700_000_000_000_000_123
REPORT = run_report.report(None)
EVENTS = (
    Event("nonlinear", START_NS + 10**9, START_NS + 3 * 10**9, "|ay| above 0.5 g"),
    Event("start", START_NS, START_NS + 1, ""),
)

STATES = ("sideslip_deg", "yaw_rate_deg_s", "vx_m_s", "vy_m_s", "ay_m_s2")
HEALTH = ("nis", "network_trust", "r_scale", "mixture_weight", "friction")
ERRORS = ("error_sideslip_deg", "error_yaw_rate_deg_s", "error_vy_m_s")
#: Every entity of the recording of 600 stamps of phy-ukf, truth and zero: rows and components.
HELD = {
    "/truth": (600, STATES),
    "/main": (600, STATES + HEALTH + ERRORS),
    "/other/1": (600, STATES + ERRORS),
    "/inputs": (600, ("speed_m_s", "steer_deg", "ax_m_s2", "ay_m_s2", "yaw_rate_deg_s")),
    "/plan/truth/now": (120, ()),
    "/plan/main/now": (120, ()),
    "/plan/other/1/now": (120, ()),
    "/events": (2, ()),
}
STATIC = {
    *("/__properties", "/__properties/drive", "/report", "/truth", "/main", "/other/1"),
    *(f"/plan/{place}{now}" for place in ("truth", "main", "other/1") for now in ("", "/now")),
}


def record(path: Path, tracks, signals=None, report=REPORT, events=(), shown=SHOWN, end_ns=START_NS, **facts) -> None:
    """Write a recording of tracks."""
    log = report["log"] | {"name": "drive", "start_ns": START_NS, "end_ns": end_ns}
    report = report | {"log": log, "vehicle": report["vehicle"] | {"low_speed_blend_m_s": 1.0}}
    facts = {"application_id": "pdhef-x", "input_hash": HASH, **facts}
    write_recording(path, signals, tracks, report, events, shown=shown, **facts)


@pytest.fixture
def recording(tmp_path, circle, circle_signals):
    path, names = tmp_path / "recording.rrd", ("phy-ukf", "truth", "zero")
    tracks = [circle(name, 0, 600, bias=0.0 if name == "truth" else 0.02) for name in names]
    record(path, tracks, circle_signals(0, 600), events=EVENTS, colours=COLOURS)
    return path


def tables(path: Path) -> tuple[dict[str, pa.Table], dict[str, list[pa.RecordBatch]]]:
    """Return the timed and the static columns by entity."""
    reader = RrdReader(path)
    store = reader.recordings()[0]
    timed: dict[str, list[pa.RecordBatch]] = defaultdict(list)
    static: dict[str, list[pa.RecordBatch]] = defaultdict(list)
    for chunk in reader.stream(store=store):
        (static if chunk.is_static else timed)[chunk.entity_path].append(chunk.to_record_batch())
    return {
        e: pa.concat_tables([pa.Table.from_batches([b]) for b in bs], promote_options="default")
        for e, bs in timed.items()
    }, dict(static)


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


def series(table: pa.Table, component: str) -> tuple[np.ndarray, list[list[float]]]:
    """Return stamps and values of the rows of a component that hold something."""
    (name,) = [n for n in table.column_names if n.endswith(f":{component}")]
    order = np.argsort(table["time"].to_numpy().astype(np.int64), kind="stable")
    values = table[name].to_pylist()
    held = [i for i in order if values[i] is not None]
    return table["time"].to_numpy().astype(np.int64)[held], [values[i] for i in held]


def test_every_entity_has_its_rows_and_each_track_is_there_once(recording):
    timed, static = tables(recording)
    stamps = {e: set(t["time"].to_numpy().tolist()) for e, t in timed.items()}
    assert {e: len(times) for e, times in stamps.items()} == {e: rows for e, (rows, _) in HELD.items()}
    assert set(static) == STATIC
    for entity, (_, components) in HELD.items():
        names = timed[entity].column_names
        assert {"time", "elapsed"} <= set(names)
        if components:
            assert {n.split(":")[1] for n in names if ":" in n} == set(components)


def test_identity_and_footer(recording):
    reader = RrdReader(recording)
    (entry,) = reader.recordings()
    assert (entry.application_id, entry.recording_id) == ("pdhef-x", HASH[:32])
    assert reader.store() is not None
    _, static = tables(recording)
    properties = {k: v for b in static["/__properties"] for k, v in b.to_pydict().items()}
    assert properties["RecordingInfo:name"] == [["drive"]]
    assert properties["RecordingInfo:start_time"] == [[START_NS]]


def test_properties_filter_a_catalog(tmp_path):
    check = {"name": "ay.scale", "verdict": "failed", "waived": False, "evidence": "3 %", "remedy": ""}
    report = run_report.report(
        metrics=run_report.errors_deg(phy_ukf=0.5, zero=math.nan),
        checks=[check, {**check, "name": "ay.sign", "verdict": "passed"}],
        faults=[{"sensor": "a_y", "kind": "stuck", "count": 1, "seconds": 1.0, "intervals": []}],
        versions={"pdhef-logtool": "1.2.3"},
    )
    report |= {"plan": {"file": "", "requirements": [{"id": "SR-1", "label": "x", "outcome": "PASS", "reason": ""}]}}
    record(tmp_path / "x.rrd", [], report=report)
    _, static = tables(tmp_path / "x.rrd")
    found = {
        (entity.removeprefix("/__properties/"), name): values[0]
        for entity, batches in static.items()
        if entity.startswith("/__properties/")
        for name, values in plain(*batches).items()
    }
    assert found == {
        ("sideslip_rmse_deg", "phy-ukf"): [pytest.approx(0.5)],
        ("verdicts", "SR-1"): ["PASS"],
        ("drive", "car"): ["sedan"],
        ("drive", "selected"): ["pd-hef"],
        ("drive", "faults"): ["stuck a_y"],
        ("drive", "failed_checks"): ["ay.scale"],
        ("drive", "version"): ["1.2.3"],
    }


def blueprint_of(path: Path) -> dict[str, list]:
    """Return all values of the blueprint by component."""
    found: dict[str, list] = defaultdict(list)
    reader = RrdReader(path)
    for chunk in reader.stream(store=reader.blueprints()[0]):
        for name, values in plain(chunk.to_record_batch()).items():
            found[name] += [v for row in values if isinstance(row, list) for v in row]
    return found


def test_the_blueprint_opens_on_truth_main_and_baseline_and_names_no_estimator(recording):
    assert len(RrdReader(recording).blueprints()) == 1
    blueprint = blueprint_of(recording)
    titles = blueprint["ViewBlueprint:display_name"]
    assert {"Sideslip [deg]", "Speed [m/s]", "Road-wheel angle [deg]", "Plan, north up [m]", "Report"} <= set(titles)
    assert blueprint["TimePanelBlueprint:timeline"] == ["elapsed"]
    entities = {line.strip("+ ") for query in blueprint["ViewContents:query"] for line in query.splitlines()}
    drawn = {e for e in entities if not e.startswith(("/plan", "/events", "/reasons", "/report", "$"))}
    others = {f"/other/{number}" for number in range(1, MOST_OTHERS + 1)}
    assert drawn == {"/truth", "/baseline", "/main", "/inputs"} | others
    assert not {"phy-ukf", "zero"} & {word for text in titles for word in text.split()}
    sources = {m["source_component"] for m in blueprint["VisualizerInstruction:component_map"]}
    timed, _ = tables(recording)
    held = {n for e in ("/main", "/inputs") for n in timed[e].column_names}
    assert sources <= held and len(sources) == 14


def test_values_stamps_bands_and_errors(recording, circle):
    timed, _ = tables(recording)
    truth = circle("truth", 0, 600)
    track = circle("phy-ukf", 0, 600, bias=0.02)
    stamps, values = series(timed["/main"], "sideslip_deg")
    np.testing.assert_array_equal(stamps, track.stamps_ns)
    middle = np.where(track.valid, np.degrees(track.sideslip_rad), np.nan)
    half = np.degrees(1.959963985 * 0.03)
    np.testing.assert_allclose(values, np.stack([middle, middle - half, middle + half], axis=1), rtol=1e-6)
    _, error = series(timed["/main"], "error_sideslip_deg")
    expected = np.where(track.valid, np.degrees(track.sideslip_rad - truth.sideslip_rad), np.nan)
    np.testing.assert_allclose([e[0] for e in error], expected, rtol=1e-6)
    elapsed = timed["/inputs"]["elapsed"].to_numpy().astype(np.int64)
    np.testing.assert_array_equal(np.unique(elapsed), np.arange(600) * 10_000_000)
    speed_stamps, speed = series(timed["/inputs"], "speed_m_s")  # every second one: no value and no gap between
    assert speed_stamps.tolist() == track.stamps_ns[::2].tolist() and {v[0] for v in speed} == {10.0}


def test_events_and_report_are_text(recording):
    timed, static = tables(recording)
    order = np.argsort(timed["/events"]["time"].to_numpy())
    texts = [timed["/events"]["TextLog:text"].to_pylist()[i][0] for i in order]
    assert texts == ["start, 0.00 s", "nonlinear, 2.00 s: |ay| above 0.5 g"]
    (batch,) = static["/report"]
    assert batch["TextDocument:media_type"].to_pylist() == [["text/markdown"]]
    assert batch["TextDocument:text"].to_pylist()[0][0].startswith("# drive\n")


def test_weights_and_reasons_are_drawn(tmp_path, circle):
    path = tmp_path / "recording.rrd"
    track = circle("pd-hef", 0, 600, adaptive=True)
    record(path, [track, circle("zero", 0, 600)], shown=["pd-hef", "zero"])
    timed, _ = tables(path)
    _, weights = series(timed["/main"], "mixture_weight")
    expected = np.where(track.valid, track.mixture_weight, np.nan)
    np.testing.assert_allclose([w[0] for w in weights], expected, rtol=1e-6)
    assert {e for e in timed if e.startswith("/reasons")} == {
        *("/reasons/pd-hef/stuck_yaw_rate", "/reasons/pd-hef/spike_ay")
    }
    stuck = timed["/reasons/pd-hef/stuck_yaw_rate"]
    assert stuck["StateChange:state"].to_pylist() == [["gyro stuck"], [""]]
    assert plain(stuck)["time"] == [int(track.stamps_ns[100]), int(track.stamps_ns[149]) + 1]
    spikes = plain(timed["/reasons/pd-hef/spike_ay"])
    assert spikes["time"][::2] == [int(track.stamps_ns[30]), int(track.stamps_ns[400])]
    texts = [t[0] for t in timed["/events"]["TextLog:text"].to_pylist()]
    assert texts == ["pd-hef: a_y spike, 0.00 s", "pd-hef: gyro stuck, 0.49 s", "pd-hef: a_y spike, 0.00 s"]


SCRIPT = """
import sys
from pathlib import Path
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.results.rerun_sink import write_recording
try:
    write_recording(
        Path(sys.argv[1]), None, [], {}, application_id="x", shown=["zero"], input_hash="ab" * 32
    )
except OutputError as error:
    print(error)
"""


@pytest.mark.slow
def test_writing_starts_no_analytics_and_a_switched_off_rerun_is_said(tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    env = {**os.environ, "HOME": str(home), "XDG_CONFIG_HOME": "", "XDG_DATA_HOME": "", "RERUN": "off"}
    call = [sys.executable, "-c", SCRIPT, str(tmp_path / "recording.rrd")]
    done = subprocess.run(call, env=env, capture_output=True, text=True, check=True, timeout=300)
    assert not [p for p in home.rglob("*") if "rerun" in p.name or "analytics" in p.name]
    assert "unset RERUN" in done.stdout


@settings(max_examples=6, derandomize=True, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(st.tuples(st.booleans(), st.integers(1, 1500)), min_size=1, max_size=40))
def test_a_sparse_line_goes_on_over_a_second_of_unknown_values(tmp_path, samples):
    known, steps = map(np.array, zip(*samples, strict=True))
    stamps = START_NS + np.cumsum(steps) * 1_000_000
    speed, path = np.full(len(known), 20.0), tmp_path / "recording.rrd"
    record(path, [make_track("phy-ukf", stamps, vx_m_s=speed, vy_m_s=0 * speed, nis=np.where(known, 1.0, np.nan))])
    timed, _ = tables(path)
    moved, _ = series(timed["/main"], "vx_m_s")
    assert len(moved) == len(known) + np.count_nonzero(np.diff(stamps) > LONGEST_BRIDGE_NS)
    at, values = series(timed["/main"], "nis")
    breaks = at[~np.isfinite(np.array(values)[:, 0])]
    if not known.any():
        assert breaks.tolist() == [stamps[0]]
        return
    seen = stamps[known]
    assert at[np.isfinite(np.array(values)[:, 0])].tolist() == seen.tolist()
    assert breaks.tolist() == [t + 1 for t in seen[:-1][np.diff(seen) > LONGEST_BRIDGE_NS]]


def test_of_a_long_drive_ten_rows_a_second_are_drawn_with_the_largest_nis_and_five_of_the_others(tmp_path):
    n, step_ns = 61_000, 10_000_000
    stamps = START_NS + np.arange(n) * step_ns
    nis = np.full(n, np.nan)
    nis[1::2] = 1.0
    nis[31_013] = 9.0
    path = tmp_path / "recording.rrd"
    speed = np.full(n, 20.0)
    tracks = [
        make_track(name, stamps, vx_m_s=speed, vy_m_s=0 * speed, nis=nis, x_m=speed, y_m=speed, yaw_rad=0 * speed)
        for name in ("zero", "zero:no-lateral")
    ]
    record(path, tracks, shown=["zero"], end_ns=int(stamps[-1]) + 1)
    timed, _ = tables(path)
    assert len(series(timed["/main"], "vx_m_s")[0]) == n // 10
    assert len(series(timed["/other/1"], "vx_m_s")[0]) == n // 20
    assert timed["/plan/main/now"].num_rows == pytest.approx(n / 50, abs=1)
    assert np.nanmax([v[0] for v in series(timed["/main"], "nis")[1]]) == 9.0
