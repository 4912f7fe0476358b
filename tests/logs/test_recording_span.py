"""Outlier stamps, clock resets and backward clock steps: detected before windows are cut; other times do not move."""

from contextlib import closing
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.logs import recording_span as span
from pdhef_logtool.logs.drive_log import windows
from pdhef_logtool.logs.open_log import open_log
from tests.mcap_files import mcap_writer

S = 1_000_000_000
T0 = 1_767_225_600 * S
LATEST = 2**63 - 2


@pytest.mark.parametrize("stray", [0, 1, LATEST, T0 - 900 * S, T0 + 5000 * S])
def test_one_message_far_from_all_others_is_stray(stray):
    times = np.append(T0 + np.arange(1000) * S // 100, stray)
    intervals, kept, strays = span.find_epochs(times, times + 1, np.ones(len(times), dtype=np.int64))
    assert intervals == [(T0, T0 + 999 * S // 100 + 1)]
    assert np.flatnonzero(strays).tolist() == [1000]
    assert kept.sum() == 1000


@pytest.mark.slow
@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    pieces=st.lists(
        st.tuples(st.integers(0, LATEST), st.integers(1, 10_000 * S), st.integers(1, 50)), min_size=1, max_size=12
    )
)
def test_every_piece_is_kept_stray_or_of_another_epoch(pieces):
    start = np.array([p[0] for p in pieces], dtype=np.int64)
    end = np.array([min(p[0] + p[1], LATEST + 1) for p in pieces], dtype=np.int64)
    intervals, kept, stray = span.find_epochs(start, end, np.array([p[2] for p in pieces], dtype=np.int64))
    assert kept.any()
    assert not (kept & stray).any()
    for i in np.flatnonzero(kept):
        assert any(a <= start[i] and end[i] <= b for a, b in intervals)
    for i in np.flatnonzero(~kept):
        assert all(end[i] <= a or start[i] >= b for a, b in intervals)
    for (_, b), (a, _) in pairwise(intervals):
        assert span.SILENCE_NS - 1000 < a - b < span.EPOCH_NS + 1000


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    steps=st.lists(st.tuples(st.integers(1, 199), st.integers(-8 * S, 8 * S)), max_size=4), seed=st.integers(0, 1000)
)
def test_what_is_left_never_interleaves_two_passes(steps, seed):
    rng = np.random.default_rng(seed)
    times = T0 + np.cumsum(rng.integers(S // 20, S // 5, 200))
    for at, by in steps:
        times[at:] += by
    left = np.ones(200, dtype=np.bool_)
    for place, low, high in span.recorded_twice(times):
        left[place:] &= ~((times[place:] >= low) & (times[place:] <= high))
    passes = np.concatenate([[0], np.cumsum(np.diff(times) < -S)])
    for p in range(passes[-1]):
        of_this, later = times[passes == p], times[left & (passes > p)]
        assert not ((later > of_this.min()) & (later < of_this.max())).any()
    if not (np.diff(times) < -S).any():
        assert left.all()


def test_windows_keep_their_borders_and_leave_silences_out():
    occupied = span.RecordingSpan(((100, 130), (1000, 1011), (1015, 1030)))
    whole = list(windows(100, 1030, 20))
    some = list(windows(100, 1030, 20, occupied))
    assert some == [w for w in whole if any(w[0] < b and a < w[1] for a, b in occupied.intervals)]
    assert list(windows(100, 1030, 20, span.RecordingSpan(((100, 1030),)))) == whole
    assert list(windows(200, 900, 20, occupied)) == []
    assert list(windows(110, 120, 20, occupied)) == [(110, 120)]


def test_any_time_can_be_shown():
    assert span.shown_time(0) == "1970-01-01 00:00:00 UTC"
    assert span.shown_time(-1) == "1969-12-31 23:59:59 UTC"
    assert span.shown_time(LATEST).startswith("2262-04-11")


@pytest.mark.parametrize("back_s", [0, 3])
def test_the_times_in_an_index_show_a_step_within_a_chunk(back_s, tmp_path):
    """In a chunk of 20 s the clock steps back midway; the first and last time do not show it."""
    path = tmp_path / "log.mcap"
    with mcap_writer(path, chunk_size=1 << 30) as writer:
        ids = [writer.register_channel(topic, "json", 0) for topic in ("/fast", "/slow")]
        for i in range(2000):
            ns = T0 + i * S // 100 - (back_s * S if i >= 1000 else 0)
            for id_ in ids if i % 10 == 0 else ids[:1]:
                writer.add_message(id_, ns, b"{}", ns)
    with closing(open_log(path)) as log:
        (container,) = log.containers
        (only,) = container.spans
        assert all((np.diff(times) >= 0).all() == (back_s == 0) for times in only.times.values())
        assert [loss.kind for loss in log.lost] == ([] if back_s == 0 else ["time-jump"])
