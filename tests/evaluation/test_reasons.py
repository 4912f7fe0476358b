"""Intervals of reasons: merged over short breaks only, named by the longest."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pdhef_logtool.evaluation.reasons import LISTED_INTERVALS, Interval, reason_intervals, sensor_faults
from pdhef_logtool.evaluation.smoothing import RUN_GAP_S
from pdhef_logtool.records.reasons import REASONS, SPIKE_AY, STUCK_YAW_RATE
from pdhef_logtool.records.tracks import StateTrack, make_track

STEP_NS = 10_000_000
START_NS = 1_700_000_000_000_000_123


def track_of(stamps_ns: np.ndarray, reason: np.ndarray) -> StateTrack:
    return make_track("pd-hef", stamps_ns, reason=reason)


def stamps(count: int) -> np.ndarray:
    return START_NS + STEP_NS * np.arange(count, dtype=np.int64)


def by_hand(stamps_ns: np.ndarray, reason: np.ndarray, bit: int) -> list[Interval]:
    """One stamp after the other."""
    spans: list[list[int]] = []
    for t, mask in zip(stamps_ns.tolist(), reason.tolist(), strict=True):
        if mask & bit:
            if spans and t - spans[-1][1] <= RUN_GAP_S * 1e9:
                spans[-1][1] = t
            else:
                spans.append([t, t])
    return [Interval(a, b + 1) for a, b in spans]


@pytest.mark.slow
@settings(max_examples=100, derandomize=True, deadline=None)
@given(st.lists(st.tuples(st.integers(1, 40), st.integers(0, 15)), min_size=1, max_size=60))
def test_intervals_are_those_found_by_hand(samples: list[tuple[int, int]]) -> None:
    # Steps of 20 to 800 ms, masks of the first four bits.
    steps, masks = zip(*samples, strict=True)
    stamps_ns = START_NS + np.cumsum(np.array(steps, dtype=np.int64)) * 20_000_000
    reason = np.array(masks, dtype=np.int64)
    track = track_of(stamps_ns, reason)
    expected = {r.name: by_hand(stamps_ns, reason, r.bit) for r in REASONS}
    assert reason_intervals(track) == {name: spans for name, spans in expected.items() if spans}


def test_faults_are_told_by_sensor_and_kind_with_the_longest_intervals() -> None:
    n = 40_000
    reason = np.zeros(n, dtype=np.int64)
    reason[np.arange(0, 35_000, 500)] |= SPIKE_AY  # 70 single ones
    reason[1_000:1_400] |= STUCK_YAW_RATE
    spike, stuck = sensor_faults(make_track("x", stamps(n), reason=reason)) or ()
    assert (spike["sensor"], spike["kind"], spike["count"]) == ("ay_m_s2", "spike", 70)
    assert len(spike["intervals"]) == LISTED_INTERVALS
    assert [i.start_ns for i in spike["intervals"]] == sorted(i.start_ns for i in spike["intervals"])
    assert (stuck["sensor"], stuck["kind"], stuck["count"]) == ("yaw_rate_rad_s", "stuck", 1)
    assert stuck["seconds"] == pytest.approx(3.99)
    assert sensor_faults(make_track("x", stamps(3))) is None
    assert sensor_faults(make_track("x", stamps(3), reason=np.zeros(3, dtype=np.int64))) == []
