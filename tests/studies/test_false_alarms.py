"""The study of false alarms: what it counts as before, how it plants, and what its drives are."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reference_car import drive, slalom, with_noise

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.records import reasons
from pdhef_logtool.watches.sensor_faults import AY, find_faults
from studies import false_alarms
from studies.false_alarms import PLANTS, Clean, detect, faster, surfaces, treated


@pytest.fixture(scope="module")
def clean() -> Clean:
    return Clean("slalom", with_noise(drive(slalom(0.03, 0.5), 12.0, speed=22.0).signals, seed=1), default_vehicle())


def test_before_is_all_that_the_filters_use_otherwise(clean):
    clean.signals.ay_m_s2[600] += 8.0
    faults, _ = find_faults(clean.signals, clean.vehicle, None)
    assert not faults.reason.any()
    np.testing.assert_array_equal(np.flatnonzero(treated(faults, clean.signals) & reasons.SPIKE_AY), [600])
    clean.signals.ay_m_s2[600] -= 8.0


@pytest.mark.parametrize("plant", [p for p in PLANTS if p.seconds >= 2.5 and "3 times" not in p.name])
def test_what_lasts_is_found_by_its_name(plant, clean):
    delays = detect(plant, [clean], AY, 1)
    assert len(delays.now) == len(delays.before) == 2
    assert np.isfinite(delays.before).all() and np.isfinite(delays.now[1])
    assert np.nanmax(delays.now) < plant.seconds + false_alarms.AFTER_S


def test_a_faster_clock_holds_samples_and_has_the_noise_that_is_asked_for():
    still = drive(lambda _t: 0.0, 60.0, speed=20.0).signals
    made = faster(still, np.random.default_rng(0), hold=4)
    np.testing.assert_allclose(np.diff(made.stamps_ns), 5e6)
    z = made.ay_m_s2[: len(made) // 4 * 4].reshape(-1, 4)
    assert (z == z[:, :1]).all()
    assert np.std(z[:, 0]) == pytest.approx(0.12, rel=0.1)
    level = np.std(surfaces(still, np.random.default_rng(1)).ay_m_s2) / 0.12
    assert 1.0 < level < 3.0 and math.isfinite(level)
