"""Where something holds in the drives of a run, and clips of it."""

import json
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.results.clips import write_clips
from pdhef_logtool.results.events import FoundEvents, event_condition, find_events
from pdhef_logtool.results.opened_run import open_run
from tests.results import source_log
from tests.results.made_run import START_NS, entry, write_estimates, write_run
from tests.run_report import report

N = 600


def _find(folder: Path, where: str, **options: Any) -> FoundEvents:
    return find_events(open_run(folder), event_condition(where), **options)


def _report(folder: Path, label: str, **vehicle: Any) -> dict[str, Any]:
    document = report()
    document["log"] |= {"name": label, "start_ns": START_NS - 1_000_000_000, "end_ns": START_NS + 10_000_000_000}
    document["vehicle"] |= vehicle
    place = folder / "logs" / label / "report.json"
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(json.dumps(document))
    return document


@pytest.fixture
def run(tmp_path):
    entries = [entry("a"), entry("b"), entry("no_truth"), entry("bad", outcome="failed: empty", main=None)]
    reports = {label: _report(tmp_path / "out", label) for label in ("a", "b", "no_truth")}
    folder = write_run(tmp_path / "out", {}, entries=entries, reports=reports)
    slip = np.zeros(N)
    slip[100:111] = np.deg2rad(np.linspace(1.0, 3.0, 11))
    slip[130:141] = -np.deg2rad(4.0)
    speed = np.full(N, 20.0)
    speed[:50] = 2.0
    still = {"vx_m_s": speed, "vy_m_s": np.zeros(N), "sideslip_rad": np.zeros(N)}
    wild = {**still, "sideslip_rad": np.where(np.arange(N) < 50, 1.02 * np.pi, 0.0)}
    valid = np.ones(N, dtype=np.bool_)
    valid[105:] = False
    write_estimates(folder, "a", truth=still, pd_hef={**still, "sideslip_rad": slip}, physics=still)
    write_estimates(folder, "b", truth=still, pd_hef={**wild, "valid": valid})
    write_estimates(folder, "no_truth", pd_hef=still)
    return folder


def test_rows_have_drive_start_end_and_peak(run):
    found = _find(run, "abs(sideslip_error_deg) > 1.5 and speed_m_s > 10")
    first, second = found.events
    assert len(_find(run, "abs(sideslip_error_deg) > 1.5 and speed_m_s > 10", pad_s=0.15).events) == 1
    assert (first.drive, second.drive, found.searched) == ("a", "a", 2)
    assert (first.start_ns, first.end_ns) == (START_NS + 1_030_000_000, START_NS + 1_100_000_001)
    assert first.start_s == pytest.approx(2.03)
    assert (first.peak, first.peak_ns) == (pytest.approx(3.0, abs=1e-4), START_NS + 1_100_000_000)
    assert second.peak == pytest.approx(4.0, abs=1e-4)
    assert found.left_out == {"no_truth": "it has no ground truth", "bad": "failed: empty"}
    assert found.exit_code == 3


def test_an_error_is_known_only_where_it_is_scored(run):
    assert [e.drive for e in _find(run, "abs(sideslip_error_deg) > 170").events] == ["b"]
    assert not _find(run, "abs(sideslip_error_deg) > 181").events
    slow = {**report(), "vehicle": {**report()["vehicle"], "low_speed_blend_m_s": 3.0}}
    entries = [entry("a"), entry("b"), entry("no_truth")]
    write_run(run, {}, entries=entries, reports={e["log"]: slow for e in entries})
    assert not _find(run, "abs(sideslip_error_deg) > 170").events
    unknown = _find(run, "not abs(vx_error_m_s) > 1").events  # the error of an invalid value is not below 1 either
    ends = {e.drive: round((e.end_ns - START_NS) * 1e-9, 2) for e in unknown}
    assert ends == {"a": 5.99, "b": 1.04}


def test_other_tracks_are_read_at_the_same_stamps(run, tmp_path):
    found = _find(run, "abs(sideslip_deg - physics.sideslip_deg) > 2.5")
    assert [e.drive for e in found.events] == ["a", "a"]
    assert found.left_out["b"] == "it has no estimator physics"
    assert len(_find(run, "speed_km_h < 8", estimator="physics").events) == 1
    with pytest.raises(UsageError, match="an estimator of this run: pd-hef, physics, truth, got ukf"):
        _find(run, "ukf.sideslip_deg > 1")
    with pytest.raises(UsageError, match="--estimator: expected an estimator of this run"):
        _find(run, "sideslip_deg > 1", estimator="ukf")
    scored = write_run(tmp_path / "scored", {}, entries=[entry("a", main=None)])
    write_estimates(scored, "a", esc={"vx_m_s": np.ones(9)})
    with pytest.raises(UsageError, match="an estimator of this run: esc, got none named"):
        _find(scored, "vx_m_s > 0")
    assert len(_find(scored, "vx_m_s > 0", estimator="esc").events) == 1


@pytest.fixture
def clipped(tmp_path):
    """Return a run without full copies, and the folder with its log."""
    logs = tmp_path / "logs" / "deep"
    logs.mkdir(parents=True)
    source_log.write_source(logs / "drive.mcap")
    from pdhef_logtool.logs.discovery import hash_log

    sha256 = hash_log(logs / "drive.mcap")
    entries, reports = [entry("drive", file="drive.mcap", sha256=sha256)], {"drive": _report(tmp_path / "out", "drive")}
    folder = write_run(tmp_path / "out", {}, entries=entries, reports=reports)
    slip = np.zeros(N)
    slip[300:310] = 1.0
    stamps = source_log.START_NS + 10_000_000 * np.arange(N, dtype=np.int64)
    write_estimates(folder, "drive", pd_hef={"sideslip_rad": slip, "stamps_ns": stamps})
    return folder, tmp_path / "logs"


def test_a_clip_has_the_topics_of_the_source_and_ours_around_the_event(clipped):
    folder, logs = clipped
    found = _find(folder, "sideslip_rad > 0.5", pad_s=1.0)
    (name,) = write_clips(open_run(folder), found, pad_s=1.0, source=logs).clips
    with closing(open_log(folder / name)) as clip:
        assert {"/imu", "/can/speed", "/pdhef/pd_hef/state"} <= {t.name for t in clip.topics}
        assert clip.start_ns >= source_log.START_NS + 2_000_000_000
        assert clip.end_ns <= source_log.START_NS + 4_100_000_000
        messages = {t.name: t.messages for t in clip.topics}
        assert (messages["/imu"], messages["/pdhef/pd_hef/state"]) == (209, 210)
    write_clips(open_run(folder), _find(folder, "sideslip_rad > 2"), pad_s=1.0, source=logs)
    assert list((folder / "clips").iterdir()) == []  # only clips of the last search


def test_a_source_that_is_not_found_or_is_another_file_is_told(clipped):
    folder, logs = clipped
    found = _find(folder, "sideslip_rad > 0.5")
    told: list[str] = []
    without = write_clips(open_run(folder), found, pad_s=1.0, tell=told.append)
    assert (without.clips, without.exit_code) == ((), 3)
    assert "--source DIR" in told[0]
    (logs / "deep" / "drive.mcap").write_bytes(b"another")
    write_clips(open_run(folder), found, pad_s=1.0, source=logs, tell=told.append)
    assert "1 of that name with other content" in told[1]


def test_a_segment_bounds_what_is_found(run):
    document = _report(run, "a")
    ends = [(1.0, 1.05), (1.32, 1.35)]
    document["segments"] = [
        {"name": "slalom", "start_ns": START_NS + round(a * 1e9), "end_ns": START_NS + round(b * 1e9), "text": ""}
        for a, b in ends
    ]
    write_run(run, {}, entries=[entry("a")], reports={"a": document})
    found = _find(run, "slalom")
    assert [(e.start_ns, e.end_ns) for e in found.events] == [
        (START_NS + round(a * 1e9), START_NS + round((b - 0.01) * 1e9) + 1) for a, b in ends
    ]
    [late] = _find(run, 'slalom AND abs("pd-hef".sideslip_error_deg) > 3.5').events
    assert late.start_ns == START_NS + 1_320_000_000
    assert all(e.end_ns <= START_NS + 1_000_000_000 for e in _find(run, "NOT slalom AND speed_m_s < 10").events)


@pytest.mark.parametrize(
    ("where", "expected", "got"),
    [
        ("abs(sidslip_error_deg) > 2", "one of the columns vx_m_s, vy_m_s,", "sidslip_error_deg"),
        ("stamp_ns > 1", "one of the columns", "stamp_ns"),
        ("speed_m_s > 2 and", "a condition in the SQL of Polars", "unable to parse"),
        ("speed_m_s", "a condition, such as a comparison", "speed_m_s"),
        ("max(speed_m_s) > 1", "one of the columns", "max"),
        ("truth.sideslip_error_rad > 1", "an estimator before an error", "truth.sideslip_error_rad"),
        ("speed_m_s > 1 -- valid", "columns, numbers and operators", "-"),
        ("valid = 'true'", "columns, numbers and operators", "''"),
        ("valid or " * 300 + "valid", "columns, numbers and operators in at most 2000 characters", "2705 characters"),
    ],
)
def test_a_wrong_condition_is_one_line_with_the_names(where, expected, got):
    with pytest.raises(UsageError) as error:
        event_condition(where)
    assert f"--where: expected {expected}" in str(error.value) and f"got {got}" in str(error.value)


@pytest.mark.parametrize(
    "where",
    [
        "valid AND 1 = (SELECT 1 FROM read_csv('{file}'))",
        'valid AND 1 = (SELECT 1 FROM "read_csv"/**/("{file}"))',
        "EXISTS (TABLE x)",
        "read_csv('{file}')",
    ],
)
def test_a_condition_reads_no_file(where, tmp_path, monkeypatch):
    (tmp_path / "file.csv").write_text("a\n1\n")
    monkeypatch.setattr(pl, "sql_expr", lambda _: pytest.fail("Polars executes subqueries"))
    with pytest.raises(UsageError, match="--where"):
        event_condition(where.format(file=tmp_path / "file.csv"))
