"""The study of the sideslip reference: its cases, made receivers, faults, stored figures and page."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from pdhef_logtool.estimators.reference.drive import ReferencePrior
from pdhef_logtool.records.signals import Signals
from studies import reference as study
from studies.pages import DOCS, RESULTS

N = 6000
T = np.arange(N) * 0.01


def _drive():
    nan = np.full(N, np.nan)
    stamps = np.rint(T * 1e9).astype(np.int64)
    signals = Signals(
        stamps, stamps, nan, np.zeros(N), 0.2 * np.sin(T), np.full(N, 0.1), nan, nan, np.full((N, 4), np.nan)
    )
    return study.ScoredDrive(signals, ReferencePrior(1.5, 2.7), np.full(N, 20.0), np.full(N, 0.4), 0.1 * T, np.zeros(N))


def test_names_of_cases_are_unique_and_all_are_stored_and_on_the_page():
    names = [case.name for case in study.cases()]
    assert len(set(names)) == len(names)
    stored = json.loads((RESULTS / "reference" / study.STORED).read_text(encoding="utf-8"))
    assert set(names) <= set(stored)
    figures = {n: study.Figures(**{k: v for k, v in stored[n].items() if k != "key"}) for n in names}
    assert study.page(figures) == (DOCS / "reference.md").read_text(encoding="utf-8")


def test_a_made_receiver_has_its_rate_and_error_and_the_velocity_of_the_antenna():
    drive = _drive()
    receiver = study.Receiver(10.0, 0.05, 0.02, 5.0)
    made = study.with_gnss(drive, receiver).gnss_velocity_m_s
    sampled = np.isfinite(made).all(axis=1)
    assert sampled.sum() == pytest.approx(N / 10, abs=1)
    rate = 0.1
    forward = 20.0 - study.ANTENNA_M[1] * rate
    left = 0.4 + study.ANTENNA_M[0] * rate
    error = np.hypot(*made[sampled].T) - np.hypot(forward, left)
    assert abs(error.mean()) < 0.02
    assert 0.03 < error.std() < 0.08


def test_faults_change_gnss_or_the_imu_where_they_say():
    signals = study.with_gnss(_drive(), study.RECEIVERS[study.MADE])
    outage = study.FAULTS["no GNSS from 20 to 40 s"](signals).gnss_velocity_m_s
    inside = (T >= 20.0) & (T < 40.0)
    assert np.isnan(outage[inside]).all()
    np.testing.assert_array_equal(outage[~inside], signals.gnss_velocity_m_s[~inside])
    jumped = study.FAULTS["multipath of 0.5 m/s from 20 to 25 s"](signals).gnss_velocity_m_s
    difference = np.hypot(*(jumped - signals.gnss_velocity_m_s).T)
    assert np.nanmax(difference) == pytest.approx(0.5)
    level = replace(signals, ax_m_s2=np.zeros(N), ay_m_s2=np.zeros(N))
    assert study.FAULTS["IMU turned and tilted by 2°"](level).ay_m_s2 == pytest.approx(0.342, abs=1e-3)
