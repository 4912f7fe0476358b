"""pd-hef without trust in its network: the strongest filter on physics, behind the fault detector."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_car import cut, drive, slalom, with_noise

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.cautious import CautiousPhysics, strongest_physics
from pdhef_logtool.estimators.pd_hef import build_smoothed
from pdhef_logtool.estimators.physics import PhysicsUkf
from pdhef_logtool.estimators.physics_ukf import PhysicsFilter, physics_filter
from pdhef_logtool.estimators.smoothed import SmoothedHybrid
from pdhef_logtool.estimators.table import Options
from pdhef_logtool.records.reasons import STUCK_YAW_RATE
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import concatenate
from pdhef_logtool.residual_model.bundle import ModelBundle, Normalisation
from pdhef_logtool.residual_model.features import FEATURES
from pdhef_logtool.residual_model.network import Architecture, ResidualNetwork

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle().model_copy(update={"roll_gradient_rad_per_m_s2": 0.0})
TABLES = {n: FilterNoise(q_std=(0.1, 0.1, 0.05), r_std={"ay_m_s2": 1.0}) for n in ("phy-ukf-tuned", "physics")}
COLUMNS = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "covariance", "nis", "valid", "reason")


def noisy(*, stuck: bool) -> Signals:
    s = with_noise(drive(slalom(0.035, 0.5), 10.0, speed=22.0).signals, 3)
    t = (s.stamps_ns - s.stamps_ns[0]) * 1e-9
    s.friction[:] = 0.85
    if stuck:
        s.yaw_rate_rad_s[(t > 4.0) & (t < 7.0)] = 0.05
    return replace(s, ready_ns=s.stamps_ns + 10_000_000)


@pytest.fixture(scope="module")
def faulty() -> Signals:
    return noisy(stuck=True)


def test_without_faults_it_is_the_filter_on_physics() -> None:
    signals = noisy(stuck=False)
    ours, _ = CautiousPhysics(physics_filter(VEHICLE, None)).run(signals, None)
    plain, _ = physics_filter(VEHICLE, None).run(signals, None)
    quiet = np.cumsum(ours.reason != 0) == 0  # until the detector's first false alarm, if any
    assert quiet.sum() > 300
    np.testing.assert_array_equal(ours.vy_m_s[quiet], plain.vy_m_s[quiet])
    assert ours.name == "pd-hef"
    assert set(ours.network_trust[ours.valid]) == {0.0}


def test_a_stuck_gyro_is_left_out_and_said(faulty: Signals) -> None:
    truth = drive(slalom(0.035, 0.5), 10.0, speed=22.0)
    ours, _ = CautiousPhysics(physics_filter(VEHICLE, None)).run(faulty, None)
    plain, _ = physics_filter(VEHICLE, None).run(faulty, None)
    healthy, _ = physics_filter(VEHICLE, None).run(noisy(stuck=False), None)
    assert len(truth.signals) == len(faulty)
    hurt, heeded = (np.nanmax(np.abs(t.sideslip_rad - healthy.sideslip_rad)) for t in (plain, ours))
    assert heeded < 0.5 * hurt
    assert (ours.reason & STUCK_YAW_RATE).any()


@settings(derandomize=True, deadline=None, max_examples=10)
@given(st.lists(st.integers(0, 1001), max_size=6))
def test_windows_of_any_cut_join_bit_for_bit(faulty: Signals, inner: list[int]) -> None:
    estimator = CautiousPhysics(physics_filter(VEHICLE, None))
    whole, _ = estimator.run(faulty, None)
    parts, carry = [], None
    for first, end in pairwise([0, *sorted(min(i, len(faulty)) for i in inner), len(faulty)]):
        track, carry = estimator.run(cut(faulty, first, end), carry)
        parts.append(track)
    joined = concatenate(parts)
    for column in COLUMNS:
        np.testing.assert_array_equal(getattr(joined, column), getattr(whole, column))


@pytest.mark.parametrize(
    ("tables", "scores", "name"),
    [
        ((), [], "physics"),
        (("phy-ukf-tuned",), [], "phy-ukf-tuned"),
        (("phy-ukf-tuned", "physics"), [], "phy-ukf-tuned"),
        (("phy-ukf-tuned", "physics"), [0.14, 0.11], "physics"),
        (("phy-ukf-tuned", "physics"), [0.11, 0.14], "phy-ukf-tuned"),
    ],
)
def test_drives_with_truth_choose_the_filter(tables: tuple[str, ...], scores: list[float], name: str) -> None:
    told = scores or [None] * len(tables)
    noise = {n: TABLES[n].model_copy(update={"score_deg": s}) for n, s in zip(tables, told, strict=True)}
    chosen = strongest_physics(Car.of(VEHICLE, noise=noise))
    assert chosen.name == name
    assert isinstance(chosen, PhysicsFilter) == (name == "physics")


def test_the_smoothed_one_has_the_noise_of_the_tuned_filter(faulty: Signals) -> None:
    bare = Car.of(VEHICLE, network=bundle())
    tuned = bare.with_noise("phy-ukf-tuned", TABLES["phy-ukf-tuned"])

    def smoother(car: Car, trust: float) -> SmoothedHybrid:
        return build_smoothed("pd-hef-smoothed", car, Options(trust=trust))

    smoothed = smoother(tuned, 0.0)
    forward = smoothed.filter
    filtered = strongest_physics(tuned)
    assert isinstance(filtered, PhysicsUkf)
    assert (forward.q_std, forward.r_std, forward.bias_states) == (filtered.q_std, filtered.r_std, False)
    assert smoother(tuned, 1.0).filter.r_std != filtered.r_std
    assert smoother(bare, 0.0).filter.r_std != filtered.r_std
    track, _ = smoothed.run(faulty, None)
    assert np.isfinite(track.sideslip_rad[track.valid]).all()


def bundle() -> ModelBundle:
    torch.manual_seed(0)
    network = ResidualNetwork(Architecture(len(FEATURES), 8, 1, (4,)))
    weights = {k: v.numpy().copy() for k, v in network.state_dict().items()}
    n = len(FEATURES)
    return ModelBundle(FEATURES, 8, 1, (4,), 0.01, Normalisation((0.0,) * n, (10.0,) * n, (1.0, 1.0)), weights)
