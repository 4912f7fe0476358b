"""pd-hef: it is ``physics`` plus exactly the residual, and a right residual makes it right."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
import pytest
from made_models import random_network
from physics_oracle import G, Oracle, parts
from reference_car import FRICTION, drive, slalom, with_noise

from pdhef_logtool.car.vehicle import PhysicsParts, default_vehicle
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf
from pdhef_logtool.records.signals import ALIGNED_SIGNALS, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.bundle import ModelBundle

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle()
COMPARED = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2", "covariance", "nis", "valid")


@pytest.fixture(scope="module")
def signals() -> Signals:
    made = drive(slalom(0.02, 0.3), 8.0, step_s=np.random.default_rng(0).uniform(0.008, 0.012, 800), speed_every=1)
    noisy = with_noise(made.signals, 0)
    return replace(noisy, ready_ns=noisy.stamps_ns + 10_000_000, available=frozenset(ALIGNED_SIGNALS))


def _same(a: StateTrack, b: StateTrack) -> bool:
    return all(np.array_equal(getattr(a, c), getattr(b, c), equal_nan=True) for c in COMPARED)


def hybrid(*parts: str, network: ModelBundle | None = None, trust: float = 1.0) -> AdaptivePhysics:
    vehicle = VEHICLE.model_copy(update={"physics": PhysicsParts(**dict.fromkeys(parts, True))})
    return AdaptivePhysics(VehicleUkf(vehicle), network or random_network(), trust)


@pytest.mark.parametrize("parts", [(), ("lag", "roll", "biases", "bank"), tuple(PhysicsParts.model_fields)])
def test_without_trust_it_is_physics_to_the_bit(parts: tuple[str, ...], signals: Signals) -> None:
    trusted = hybrid(*parts)
    physics = run_estimator(AdaptivePhysics(trusted.physics, name="physics"), signals)
    for change in ({"trust": 0.0}, {"network": random_network(constant=(0.0, 0.0))}):
        track = run_estimator(replace(trusted, **change), signals)
        for f in fields(StateTrack):
            if f.name not in ("name", "network_trust"):
                np.testing.assert_array_equal(getattr(track, f.name), getattr(physics, f.name), err_msg=f.name)
    assert not _same(run_estimator(trusted, signals), physics)


def test_the_filter_of_another_vehicle_has_half_of_the_residual_and_that_of_a_banked_road_none(
    signals: Signals,
) -> None:
    estimator = hybrid("bank", "force_scale", network=random_network(constant=(0.4, 0.1)), trust=0.5)
    steps, _ = estimator.run(signals, None)
    unchanged, other_vehicle, banked = (f.residual_rate for f in steps.filters)
    np.testing.assert_allclose(unchanged[100:], np.tile([0.2, 0.05], (len(unchanged) - 100, 1)))
    np.testing.assert_array_equal(other_vehicle, 0.5 * unchanged)
    assert not banked.any()


#: A model without roll states has the body lean with a force of the residual at once.
@pytest.mark.parametrize(("has", "felt_m_s2"), [((), 0.8 * (1.0 + G * 0.0105)), (("lag", "roll"), 0.8)])
def test_a_residual_in_the_model_is_what_the_car_does_with_it(has: tuple[str, ...], felt_m_s2: float) -> None:
    """The car has a force and a moment that its model lacks. With both as a residual, the filter is correct."""
    oracle = Oracle(parts(*has))

    @dataclass(frozen=True)
    class Pushed(Oracle):
        def derivative(self, x: np.ndarray, steer: float, ax: float, mu: float) -> np.ndarray:
            return super().derivative(x, steer, ax, mu) + np.array([0.0, 0.8, 0.15, *[0.0] * (len(x) - 3)])

    made = Pushed(oracle.has).drive(lambda t: 0.02 * np.sin(2.0 * t), 8.0)
    felt = made.signals.ay_m_s2 + felt_m_s2
    signals = replace(made.signals, ay_m_s2=felt, friction=np.full(len(felt), FRICTION))
    network = random_network(constant=(0.8, 0.15))
    errors = []
    for trust in (0.0, 0.5, 1.0):
        track = run_estimator(AdaptivePhysics(VehicleUkf(oracle.as_vehicle()), network, trust), signals)
        errors.append(np.sqrt(np.mean((track.vy_m_s - made.vy)[200:] ** 2)))
    assert errors[2] < 0.05 * errors[0]
    assert errors[2] < errors[1] < errors[0]
    assert track.ay_m_s2[200:] == pytest.approx(made.ay[200:] + 0.8, abs=0.02)
