"""The filter bank on roads of known friction: estimates, no estimate without excitation, and the source in a run."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference_car import drive, keep, slalom, tanh_tyre, with_noise

from pdhef_logtool.car.vehicle import AxleTyre, Tyres, default_vehicle
from pdhef_logtool.drive.friction import friction_source, parse_friction
from pdhef_logtool.estimators.friction_bank import FrictionBank, FrictionEstimate
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import Signals

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle().model_copy(update={"roll_gradient_rad_per_m_s2": 0.0})
NO_FRICTION = VEHICLE.model_copy(update={"friction": None})
STIFFNESS_VEHICLE = VEHICLE.model_copy(
    update={
        "tyres": Tyres(
            front=AxleTyre(cornering_stiffness_n_per_rad=105_000.0),
            rear=AxleTyre(cornering_stiffness_n_per_rad=96_000.0),
        )
    }
)
ALL = frozenset({"steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s"})


def estimate(signals: Signals, vehicle=VEHICLE) -> FrictionEstimate:
    return FrictionBank(vehicle).run(signals)


def excited(mu: float, duration_s: float = 8.0) -> Signals:
    """A slalom that uses most of the grip, from the start."""
    amplitude = 0.055 * mu / 0.6 * (20.0 / 22.0) ** 2
    return with_noise(drive(slalom(amplitude, 0.6), duration_s, speed=20.0, mu=mu).signals, seed=4)


@pytest.mark.parametrize("mu", [0.3, 0.6, 0.9])
def test_friction_is_found_after_three_seconds_of_excitation(mu):
    signals = excited(mu)
    found = estimate(signals)
    after = (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9 > 3.0
    assert abs(found.friction[after].mean() - mu) < 0.1
    assert found.observable[after].mean() > 0.8


@pytest.mark.parametrize("mu", [0.3, 0.9])
def test_a_straight_shows_nothing(mu):
    found = estimate(with_noise(drive(lambda _t: 0.0, 20.0, mu=mu).signals, seed=1))
    assert not found.observable.any()
    assert found.friction.min() > 0.75


def test_spinning_wheels_are_not_a_slippery_road():
    """A bend at low speed, in which the wheels turn for a second as if the car were twice as fast."""
    signals = with_noise(drive(lambda t: 0.06 * min(1.0, t), 12.0, speed=7.0, mu=0.85).signals, seed=7)
    t = (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9
    spin = np.interp(t, [4.0, 4.3, 5.0, 5.3], [0.0, 7.0, 7.0, 0.0])
    found = estimate(replace(signals, speed_m_s=signals.speed_m_s + spin))
    assert not found.observable.any()
    assert found.friction.min() > 0.7


@pytest.mark.parametrize(("front", "rear"), [(1.6, 1.6), (1.0, 1.6), (1.6, 1.0), (0.7, 0.7)])
def test_a_file_with_wrong_stiffness_is_no_slippery_road(front, rear):
    """Half of the grip of a dry road is used, all stiffness errors within the 1-sigma of a file's prior."""
    signals = with_noise(drive(slalom(0.03, 0.5), 12.0, speed=20.0, mu=1.0, tyre=tanh_tyre).signals, seed=9)
    vehicle = STIFFNESS_VEHICLE.with_stiffness(front, rear)
    found = FrictionBank(vehicle, validated=False).run(signals)
    assert found.friction.min() > 0.8
    assert not found.observable.any()


def rough() -> Signals:
    rng = np.random.default_rng(5)
    dt = rng.uniform(0.004, 0.022, 400)
    s = with_noise(drive(slalom(0.05, 0.6), speed=20.0, step_s=dt, mu=0.5).signals, seed=6)
    for column in (s.steer_rad, s.ax_m_s2, s.ay_m_s2, s.yaw_rate_rad_s):
        column[rng.random(len(s)) < 0.05] = np.nan
    t = (s.stamps_ns - s.stamps_ns[0]) * 1e-9
    return keep(s, (t < 3.0) | (t > 3.8))


ROUGH = rough()


@settings(derandomize=True, deadline=None, max_examples=20)
@given(st.integers(0, len(ROUGH) - 1), st.sampled_from([math.nan, 3.0]))
def test_an_estimate_is_made_before_its_own_samples(j, value):
    columns = {c: getattr(ROUGH, c).copy() for c in ("steer_rad", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s")}
    for column in columns.values():
        column[j:] = value
    a, b = estimate(ROUGH), estimate(replace(ROUGH, **columns))
    np.testing.assert_array_equal(a.friction[: j + 1], b.friction[: j + 1])


def test_the_friction_that_is_told_plays_no_part():
    told = replace(ROUGH, friction=np.full(len(ROUGH), 0.2))
    np.testing.assert_array_equal(estimate(ROUGH).friction, estimate(told).friction)
    np.testing.assert_array_equal(estimate(ROUGH).friction, estimate(ROUGH, NO_FRICTION).friction)


# --- where a run gets its friction from ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("choice", "vehicle", "available", "label"),
    [
        ("auto", VEHICLE, ALL | {"friction"}, "topic /road.mu"),
        ("auto", VEHICLE, ALL, "vehicle file, 0.85"),
        ("auto", NO_FRICTION, ALL, "estimate"),
        ("auto", NO_FRICTION, ALL - {"ay_m_s2"}, "assumed, 1"),
        ("file", VEHICLE, ALL | {"friction"}, "vehicle file, 0.85"),
        ("estimate", VEHICLE, ALL | {"friction"}, "estimate"),
        (0.4, VEHICLE, ALL | {"friction"}, "option, 0.4"),
    ],
)
def test_the_source_is_named(choice, vehicle, available, label):
    source = friction_source(choice, vehicle, available, "/road.mu")
    assert source.label == label
    assert source.from_log == label.startswith("topic")


def test_what_is_not_there_is_refused():
    with pytest.raises(UsageError, match="friction"):
        friction_source("file", NO_FRICTION, ALL)
    with pytest.raises(UsageError, match="ay_m_s2"):
        friction_source("estimate", VEHICLE, ALL - {"ay_m_s2"})


@pytest.mark.parametrize("text", ["wet", "", "nan", "-0.3", "0", "6", "inf"])
def test_what_is_no_friction_is_refused(text):
    with pytest.raises(UsageError, match="--friction"):
        parse_friction(text)
