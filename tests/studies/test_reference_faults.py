"""The sideslip reference on one simulated drive (truthsim) with faults of sensors, GNSS and vehicle file."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pdhef_logtool.estimators.reference.drive import refer, sideslip_std
from studies import reference as study


@pytest.fixture(scope="module")
def road():
    return study.simulated_drive(replace(study.SIMULATED["road, 20 s"], duration_s=50.0))


@pytest.mark.parametrize("fault", ["", *study.FAULTS, study.WRONG_AXLE])
def test_a_fault_costs_little_and_the_interval_contains_the_error(road, fault):
    figures = study.figures(study.Case("road", study.MADE, fault=fault), road)
    assert figures.used_gnss
    assert not figures.refused
    assert figures.rmse < 0.35
    assert figures.coverage > 0.9


def test_multipath_is_within_two_standard_deviations(road):
    signals = study.FAULTS["multipath of 0.5 m/s from 20 to 25 s"](study.with_gnss(road, study.RECEIVERS[study.MADE]))
    found = refer(signals, road.prior)
    t = (found.stamps_ns - signals.stamps_ns[0]) * 1e-9
    beta = np.interp(found.stamps_ns, signals.stamps_ns, np.arctan2(road.vy_m_s, road.vx_m_s))
    error = np.abs(np.arctan2(found.vy_m_s, found.vx_m_s) - beta)
    inside = (t > 19.0) & (t < 26.0)
    assert (error <= 2.0 * sideslip_std(found.vx_m_s, found.vy_m_s, found.covariance))[inside].mean() > 0.95


def test_a_rollback_and_a_spin_are_followed_with_gnss_and_refused_without():
    spin = study.simulated_drive(study.SIMULATED["spin, fishhook at 110 km/h"])
    aided = study.figures(study.Case("spin", study.MADE), spin)
    assert aided.rmse < 0.5
    assert not aided.refused
    assert study.figures(study.Case("spin", study.NONE), spin).refused
