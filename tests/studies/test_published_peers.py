"""The scores and the page of ``studies.peers``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from pdhef_logtool.records.tracks import make_track
from studies.pages import DOCS, RESULTS
from studies.peers import __main__ as study
from studies.peers.drives import FULL_SIZE, PEER_DRIVES
from studies.peers.page import estimator_table
from studies.peers.scoring import errors, scores


def track(sideslip: np.ndarray, speed: float = 10.0):
    """Return ground truth with a sideslip [N] in rad."""
    stamps = np.arange(len(sideslip), dtype=np.int64) * 10_000_000
    speeds = np.full(len(sideslip), speed)
    return make_track("truth", stamps, vx_m_s=speeds * np.cos(sideslip), vy_m_s=speeds * np.sin(sideslip),
                      yaw_rate_rad_s=np.zeros(len(sideslip)), sideslip_rad=sideslip)  # fmt: skip


def test_a_missing_estimate_counts_as_0():
    truth = track(np.radians(np.full(10, 3.0)))
    half = np.where(np.arange(10) < 5, np.nan, truth.sideslip_rad)
    found = errors(replace(truth, sideslip_rad=half), truth, 3.0)
    assert (found["rmse_deg"], found["available"]) == (pytest.approx(3.0 / np.sqrt(2.0)), 0.5)


def test_slow_stamps_are_not_scored_and_an_offset_is_removed_where_it_is_declared():
    slow = track(np.zeros(5), speed=2.9)
    assert errors(slow, slow, 3.0)["scored_s"] == 0.0
    truth = track(np.radians(np.array([2.0, 2.0, 2.0, 5.0])))
    found = errors(track(np.zeros(4)), truth, 3.0, has_offset=True)
    assert (found["offset_deg"], found["rmse_deg"]) == (pytest.approx(2.0), pytest.approx(1.5))


def test_the_page_shows_the_stored_scores_of_every_drive(tmp_path: Path):
    stored = pl.read_parquet(RESULTS / "peers" / "scores.parquet")
    assert stored["log"].unique(maintain_order=True).to_list() == [drive.log for drive in PEER_DRIVES]
    assert study.main(["--stored", "--out", str(tmp_path)]) == 0
    assert (tmp_path / "peers.md").read_text(encoding="utf-8") == (DOCS / "peers.md").read_text(encoding="utf-8")
    assert sum(drive.group == FULL_SIZE for drive in PEER_DRIVES) == 9


def made_table(file: Path) -> Path:
    """Write two runs in the layout of the tables of arXiv:2408.15610: times without a name, a column of runs."""
    t = np.arange(1200) * 0.01
    delta = 0.15 * np.sin(2.0 * t)
    columns = {
        "": np.concatenate([28.13 + t, 3.0 + t]),
        "delta": np.tile(delta, 2),
        "run_id": np.repeat([4, 7], len(t)),
    }
    columns |= {
        "v_x": np.full(2 * len(t), 2.0),
        "v_y": np.tile(0.1 * delta, 2),
        "omega_wheels": np.full(2 * len(t), 2.05),
    }
    columns |= {name: np.tile(2.0 * delta / 0.33, 2) for name in ("r", "r_imu")}
    columns |= {"ax_imu": np.zeros(2 * len(t)), "ay_imu": 2.0 * columns["r"], "Iq": np.zeros(2 * len(t))}
    pl.DataFrame(columns | {"friction": np.full(2 * len(t), 0.6)}).write_csv(file)
    return file


def test_a_published_table_is_a_log_for_each_run(tmp_path: Path):
    entries = list(study.published(made_table(tmp_path / "hoons_all_test.csv"), tmp_path))
    assert [e.log.name for e in entries] == ["hoons_all_test_4.csv", "hoons_all_test_7.csv"]
    rows = {row["estimator"]: row for row in scores(entries[1])[0]}
    assert {"zero", "kinematic", "linear-kf"} <= rows.keys()
    sideslip = np.arctan2(0.015 * np.sin(2.0 * np.arange(1200) * 0.01), 2.0)
    assert rows["zero"]["rmse_deg"] == pytest.approx(np.degrees(np.sqrt(np.mean(sideslip**2))), rel=0.01)
    assert rows["zero"]["scored_s"] == pytest.approx(11.99, abs=0.05)


def test_the_benchmark_weighs_drives_by_time_and_compares_with_zero_on_the_same_drives():
    def row(log: str, estimator: str, rmse: float, seconds: float):
        figures = {"available": 1.0, "coverage95": np.nan, "winkler_deg": np.nan, "seconds_per_hour": 2.0}
        names = {"group": "g", "log": log, "drive": log, "car": "c", "estimator": estimator}
        return names | {"scored_s": seconds, "rmse_deg": rmse} | figures

    rows = [row("a", "zero", 4.0, 30.0), row("b", "zero", 2.0, 10.0), row("b", "half", 1.0, 10.0)]
    head, _, half, zero = estimator_table(pl.DataFrame(rows)).splitlines()
    assert head.startswith("| estimator | drives | RMSE |")
    assert half == "| `half` | 1 | 1.00 | – to – | 0.50 | 1.00 | 1.00 | 100% | – | – | 2.0 |"
    assert [cell.strip() for cell in zero.split("|")[2:4]] == ["2", f"{np.sqrt((30 * 16 + 10 * 4) / 40):.2f}"]
