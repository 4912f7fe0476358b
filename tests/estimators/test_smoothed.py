"""The smoother: against an independent one, better than its filter, and bounded in look-ahead and memory."""

from dataclasses import replace

import numpy as np
import pytest
import test_estimators as properties
from made_models import random_network
from physics_oracle import vehicle
from reference_car import drive, keep, rough_drive, slalom, with_noise

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.base import Smoother
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.smoothed import BLOCK_S, SmoothedPhysics
from pdhef_logtool.estimators.table import SPECS, make_estimator
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf
from pdhef_logtool.records.signals import Signals

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle()
ALL = 10**6  # seconds: a block that holds every drive
BUNDLE = random_network(2)


def smoother(block_s: float = ALL, *, trust: float = 1.0, parts: tuple[str, ...] = ("lag", "biases")):
    return SmoothedPhysics(AdaptivePhysics(VehicleUkf(vehicle(*parts)), BUNDLE, trust), block_s=block_s)


def flat_smoother(*parts: str) -> SmoothedPhysics:
    """For the reference car, which does not roll, without network."""
    return SmoothedPhysics(AdaptivePhysics(VehicleUkf(vehicle(*parts, roll_gradient_rad_per_m_s2=0.0))))


def on_time(signals: Signals) -> Signals:
    """Without latency, for the filter, which then has each step at its own stamp."""
    return replace(signals, ready_ns=signals.stamps_ns)


# --- the estimator ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rough():
    """A rough drive with a gap that restarts the filter and a gyro that jumps."""
    s = rough_drive(12, 700, 6)
    t = (s.stamps_ns - s.stamps_ns[0]) * 1e-9
    s.yaw_rate_rad_s[(t > 5.0) & (t < 5.6)] += 0.5
    return keep(s, (t < 3.0) | (t > 3.8))


def test_it_sees_one_to_two_blocks_ahead_and_no_further(rough):
    estimator, j = smoother(0.5), 150
    ay = rough.ay_m_s2.copy()
    ay[j] = 1.0
    a, b = estimator.smooth(rough), estimator.smooth(replace(rough, ay_m_s2=ay))
    differs = np.flatnonzero(a.vy_m_s != b.vy_m_s)
    assert 0.5 <= (rough.stamps_ns[j] - rough.stamps_ns[differs.min()]) * 1e-9 < 1.0


@pytest.mark.parametrize(("block_s", "parts", "tolerance_m_s"), [(4.0, (), 1e-5), (BLOCK_S, ("lag", "biases"), 5e-3)])
def test_blocks_are_as_good_as_the_whole_drive(block_s, parts, tolerance_m_s):
    """Without sensor biases four seconds are enough. The biases of a drive at 20 Hz take minutes: 0.01° of sideslip."""
    signals = with_noise(drive(slalom(0.02, 0.3), 200.0, step_s=0.05).signals, seed=1)
    a, b = (smoother(s, parts=parts).smooth(signals) for s in (block_s, ALL))
    assert not np.array_equal(a.vy_m_s, b.vy_m_s)
    np.testing.assert_allclose(a.vy_m_s, b.vy_m_s, atol=tolerance_m_s)


def test_an_empty_drive_has_an_empty_track(rough):
    assert len(smoother().smooth(rough.rows(0, 0))) == 0


def test_nothing_behind_a_gap_tells_of_before(rough):
    gap = int(np.argmax(np.diff(rough.stamps_ns))) + 1
    first = rough.rows(0, gap)
    whole, before = smoother().smooth(rough), smoother().smooth(first)
    properties.same_bits(whole, before, gap)
    filtered = run_estimator(smoother().filtered, on_time(first))
    assert before.vy_m_s[-1] == filtered.vy_m_s[-1], "at the end of a stretch it is the filter"


@pytest.mark.parametrize("parts", [(), ("biases",)])
def test_it_is_nearer_to_the_truth_than_its_filter(parts):
    errors = []
    for seed in range(6):
        made = drive(slalom(0.03, 0.4 + 0.1 * seed), 10.0, 20.0 + seed, step_s=0.01)
        signals = on_time(with_noise(made.signals, seed=seed))
        estimator = flat_smoother(*parts)
        track, filtered = (run_estimator(e, signals) for e in (estimator, estimator.filtered))
        both = filtered.valid & track.valid
        errors.append([np.mean((e.sideslip_rad - made.sideslip)[both] ** 2) for e in (track, filtered)])
        assert (np.abs(track.vy_m_s - made.vy) < 1.96 * track.vy_std_m_s).mean() > 0.8
    ours, theirs = np.array(errors).T
    assert (ours < theirs).sum() >= 5
    assert np.mean(ours) < 0.93**2 * np.mean(theirs)


# --- the detector ----------------------------------------------------------------------------------------------------


def test_what_it_says_of_itself(rough):
    trusted = Car(VEHICLE, network=BUNDLE, network_gain=0.6)
    estimator = make_estimator("pd-hef-smoothed", trusted)
    assert isinstance(estimator, SmoothedPhysics) and isinstance(estimator, Smoother)
    assert (estimator.name, estimator.causal, estimator.filtered.trust) == ("pd-hef-smoothed", False, 0.6)
    assert "not causal" in estimator.notes[0]
    assert "residual gain 0.6" in estimator.notes[1]
    assert [s.name for s in SPECS if not s.causal] == ["open-loop:calibrated", "pd-hef-smoothed"]
    track = run_estimator(estimator, rough)
    assert track.valid[0], "it needs no arrival"
    assert np.isnan(track.nis).all()
    assert not track.nis_dof.any()
    assert set(track.network_trust[track.valid]) == {0.6}
    assert np.array_equal(track.stamps_ns, rough.stamps_ns)
