"""Faults that the sideslip reference finds in ground truth (turned, drifting, frozen), and none in a sound one."""

from __future__ import annotations

import numpy as np
import pytest

from pdhef_logtool.records.tracks import make_track
from pdhef_logtool.runs.referencing import audit_truth

N, RATE_HZ = 6000, 100
STAMPS = np.arange(N, dtype=np.int64) * (1_000_000_000 // RATE_HZ)
SECONDS = STAMPS * 1e-9
SIDESLIP = np.radians(2.0) * np.sin(0.5 * SECONDS)


def _track(name, sideslip, **columns):
    vx = np.full(N, 20.0)
    return make_track(name, STAMPS, vx_m_s=vx, vy_m_s=vx * np.tan(sideslip), yaw_rate_rad_s=np.zeros(N), **columns)


REFERENCE = _track("reference", SIDESLIP, sideslip_std_rad=np.full(N, np.radians(0.2)))


def test_a_sound_ground_truth_is_not_contradicted():
    assert audit_truth(_track("truth", SIDESLIP + np.radians(0.3)), REFERENCE, 3.0) == ()


@pytest.mark.parametrize(
    ("sideslip", "named"),
    [
        (SIDESLIP + np.radians(1.0), "turned by +1.00°"),
        (SIDESLIP + np.radians(2.0 * SECONDS / 60.0), "drifts by +2.00° per minute"),
        (SIDESLIP - np.radians(1.5) * ((SECONDS > 20.0) & (SECONDS < 30.0)), "mean difference -1.50°"),
        (np.where((SECONDS > 20.0) & (SECONDS < 32.0), SIDESLIP[2000], SIDESLIP), "repeats its values"),
    ],
    ids=["turned", "drifting", "wrong for a while", "held"],
)
def test_a_wrong_ground_truth_is_named(sideslip, named):
    (text,) = audit_truth(_track("truth", sideslip), REFERENCE, 3.0)
    assert named in text
    assert "estimated sideslip reference" in text


def test_where_the_reference_is_not_valid_nothing_is_stated():
    nothing = _track("reference", SIDESLIP, sideslip_std_rad=np.full(N, 0.003), valid=np.zeros(N, dtype=np.bool_))
    assert audit_truth(_track("truth", SIDESLIP + 0.1), nothing, 3.0) == ()
