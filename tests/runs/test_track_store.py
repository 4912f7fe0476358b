"""Tracks and signals on disk: windows go in, any rows of any column come out, and nothing else is read."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest

from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import concatenate, make_track
from pdhef_logtool.runs import track_store
from pdhef_logtool.runs.track_store import TrackStore

STAMPS = np.arange(10, dtype=np.int64)


@pytest.fixture(params=[0, 5, 1000], ids=["in files", "in files from the second window on", "in memory"])
def held(request, monkeypatch):
    monkeypatch.setattr(track_store, "ROWS_HELD", request.param)
    return request.param


def test_rows_of_a_stored_record_are_those_of_the_record(tmp_path, held):
    covariance = np.arange(90, dtype=float).reshape(10, 3, 3)
    windows = [
        make_track("ukf", STAMPS[p], vx_m_s=STAMPS[p] * 2.0, covariance=covariance[p]) for p in (slice(4), slice(4, 10))
    ]
    whole = concatenate(windows)
    columns = [STAMPS * float(i) for i in range(6)]
    signals = Signals(STAMPS, STAMPS, *columns, wheel_speed_m_s=np.ones((10, 4)), available=frozenset({"ay_m_s2"}))
    with TrackStore(tmp_path / "tracks") as store:
        for window in windows:
            store.append(window)
        store.append_signals(signals)
        pairs = ((store.read("ukf"), whole), (store.signals(), signals))
        for start, end in ((0, 10), (3, 7), (6, 99), (10, 10)):
            for stored, record in pairs:
                part, expected = stored.rows(start, end), record.rows(start, end)
                again = part.rows(1, 3), expected.rows(1, 3)
                for a, b in ((part, expected), *((again,) if len(expected) > 1 else ())):
                    assert len(a) == len(b)
                    for name in ("stamps_ns", *(c for c in ("vx_m_s", "covariance", "reason") if hasattr(record, c))):
                        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
        assert store.signals().rows(2, 4).available == {"ay_m_s2"}
        np.testing.assert_array_equal(store.read("ukf").rows(5, 8).vy_std_m_s, whole.vy_std_m_s[5:8])
        with patch.object(np, "fromfile", wraps=np.fromfile) as read:
            part = store.read("ukf").rows(2, 5).rows(1, 3)
            assert not read.called
            np.testing.assert_array_equal(part.vx_m_s, [6.0, 8.0])
            assert [call.args[2] for call in read.call_args_list] == ([] if held > 10 else [2])
        with pytest.raises(AttributeError):
            _ = part.no_such_column
        assert (tmp_path / "tracks").exists() == (held < 10)
    assert not (tmp_path / "tracks").exists()


def test_what_is_stored_does_not_follow_the_array_that_it_came_from(tmp_path):
    stamps, vx = STAMPS.copy(), STAMPS * 1.0
    with TrackStore(tmp_path / "tracks") as store:
        store.append(make_track("ukf", stamps, vx_m_s=vx))
        vx[:] = 0.0
        np.testing.assert_array_equal(store.read("ukf").vx_m_s, STAMPS * 1.0)


def test_windows_come_back_as_they_were_added_with_what_is_drawn(tmp_path, held):
    parts = (slice(0, 4), slice(4, 4), slice(4, 10))
    columns = [STAMPS * float(i) for i in range(6)]
    signals = Signals(STAMPS, STAMPS, *columns, wheel_speed_m_s=np.ones((10, 4)), available=frozenset({"ay_m_s2"}))
    truth = make_track("truth", STAMPS, vx_m_s=STAMPS * 1.0)
    drawn = make_track("truth", STAMPS, vx_m_s=STAMPS * 2.0)
    with TrackStore(tmp_path / "tracks") as store:
        for part in parts:
            rows = part.start, part.stop
            store.append_signals(signals.rows(*rows))
            store.append(truth.rows(*rows))
            store.append_drawn(drawn.rows(*rows))
            store.append(make_track("ukf", STAMPS[part], vx_m_s=STAMPS[part] * 3.0), drawn=True)
        windows = list(store.windows())
        np.testing.assert_array_equal(store.read("truth").vx_m_s, truth.vx_m_s)
    for part, (of_window, tracks) in zip(parts, windows, strict=True):
        np.testing.assert_array_equal(of_window.stamps_ns, STAMPS[part])
        assert of_window.available == {"ay_m_s2"}
        assert [t.name for t in tracks] == ["truth", "ukf"]
        for track, factor in zip(tracks, (2.0, 3.0), strict=True):
            np.testing.assert_array_equal(track.vx_m_s, STAMPS[part] * factor)


def test_a_column_that_never_changes_is_no_file_until_it_does(tmp_path, held):
    unknown, windows = np.full(10, np.nan), (slice(0, 4), slice(4, 4), slice(4, 10))
    late = np.where(STAMPS < 7, np.nan, 5.0)
    with TrackStore(tmp_path / "tracks") as store:
        for part in windows:
            store.append(
                make_track("ukf", STAMPS[part], vx_m_s=unknown[part], vy_m_s=late[part], valid=STAMPS[part] < 0)
            )
        track = store.read("ukf")
        np.testing.assert_array_equal(track.vx_m_s, unknown)
        np.testing.assert_array_equal(track.vy_m_s, late)
        np.testing.assert_array_equal(track.rows(5, 9).vy_m_s, late[5:9])
        assert track.valid.dtype == np.bool_
        assert not track.valid.any()
        files = {f.name.partition("-")[2] for f in (tmp_path / "tracks").glob("*")}
    assert files == (set() if held > 10 else {"stamps_ns", "vy_m_s"})


def test_minus_zero_is_another_value(tmp_path):
    with TrackStore(tmp_path / "tracks") as store:
        for sign in (1.0, -1.0):
            store.append(make_track("ukf", STAMPS, vx_m_s=np.zeros(10) * sign))
        assert np.signbit(store.read("ukf").vx_m_s).tolist() == [False] * 10 + [True] * 10


def test_a_stored_track_loses_its_sideslip_below_a_speed(tmp_path, held):
    track = make_track("ukf", STAMPS, vx_m_s=STAMPS * 1.0, vy_m_s=np.zeros(10), sideslip_rad=np.full(10, 0.1))
    with TrackStore(tmp_path / "tracks") as store:
        store.append(track)
        found = store.read("ukf").without_sideslip_below(4.0)
        np.testing.assert_array_equal(np.isfinite(found.sideslip_rad), STAMPS >= 4)
