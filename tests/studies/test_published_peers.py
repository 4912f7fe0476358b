"""The scores and the page of ``studies.peers``."""

from __future__ import annotations

import json

import numpy as np
import pytest

from pdhef_logtool.records.tracks import make_track
from studies.pages import DOCS, RESULTS
from studies.peers.drives import FULL_SIZE, OFFSET, PEER_DRIVES, PeerDrive
from studies.peers.page import page
from studies.peers.parameters import pairs_table
from studies.peers.scoring import DriveErrors, score


def track(sideslip: np.ndarray, speed: float = 10.0):
    """Return ground truth with a sideslip [N] in rad."""
    stamps = np.arange(len(sideslip), dtype=np.int64) * 10_000_000
    speeds = np.full(len(sideslip), speed)
    return make_track("truth", stamps, vx_m_s=speeds * np.cos(sideslip), vy_m_s=speeds * np.sin(sideslip),
                      yaw_rate_rad_s=np.zeros(len(sideslip)), sideslip_rad=sideslip)  # fmt: skip


def test_a_missing_estimate_counts_as_0():
    truth = track(np.radians(np.full(10, 3.0)))
    half = np.where(np.arange(10) < 5, np.nan, truth.sideslip_rad)
    errors = score(PEER_DRIVES[0], {"none": np.full(10, np.nan), "half": half}, truth)
    assert errors.rmse_deg == pytest.approx({"none": 3.0, "half": 3.0 / np.sqrt(2.0)})
    assert errors.missing == {"none": 1.0, "half": 0.5}


def test_slow_stamps_are_not_scored_and_an_offset_is_removed_where_it_is_declared():
    assert score(PEER_DRIVES[0], {}, track(np.zeros(5), speed=2.9)).scored == 0
    truth = track(np.radians(np.array([2.0, 2.0, 2.0, 5.0])))
    offset = score(PeerDrive("log", "car", OFFSET), {"zero": np.zeros(4)}, truth)
    assert offset.offset_deg == pytest.approx(2.0)
    assert offset.rmse_deg["zero"] == pytest.approx(1.5)


def test_the_page_shows_the_stored_errors_of_every_drive():
    documents = json.loads((RESULTS / "peers" / "errors.json").read_text(encoding="utf-8"))
    assert [document["log"] for document in documents] == [drive.log for drive in PEER_DRIVES]
    parameters = json.loads((RESULTS / "peers" / "parameters.json").read_text(encoding="utf-8"))
    text = page([DriveErrors.of(d) for d in documents], pairs_table(parameters))
    assert (DOCS / "peers.md").read_text(encoding="utf-8") == text
    assert sum(drive.group == FULL_SIZE for drive in PEER_DRIVES) == 9
