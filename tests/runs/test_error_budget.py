"""The error budget: a planted cause takes the error off, the others do not, and what cannot be told has a reason."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from reference_car import Drive, drive, slalom, with_noise

from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.pass_through import PassThrough
from pdhef_logtool.estimators.physics_filter import PhysicsFilter
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track
from pdhef_logtool.runs.drive_sample import BLOCKS, SETTLE_S, DriveSample, sample_drive
from pdhef_logtool.runs.error_budget import ErrorBudget, error_budget

#: Rolls not: the accelerometer of the reference car stands upright.
VEHICLE = default_vehicle().model_copy(update={"roll_gradient_rad_per_m_s2": 0.0, "relaxation_length_m": 0.0})
SLOW = VEHICLE.low_speed_blend_m_s


@pytest.fixture(scope="module")
def made() -> Drive:
    found = drive(lambda t: slalom(0.035, 0.4)(t) + 0.01 * math.sin(0.3 * t), 30.0)
    return replace(found, signals=with_noise(found.signals, 1, 0.3))


def physics(vehicle: VehicleParameters) -> AdaptivePhysics:
    return AdaptivePhysics(PhysicsFilter(vehicle), name="physics")


def truth_of(made: Drive) -> StateTrack:
    return make_track("truth", made.signals.stamps_ns, vx_m_s=made.vx, vy_m_s=made.vy, yaw_rate_rad_s=made.r)


def budget(signals: Signals, truth: StateTrack, vehicle: VehicleParameters = VEHICLE) -> ErrorBudget:
    estimator = physics(vehicle)
    error = signal_error(run_window(estimator, signals)[0], truth, "sideslip_rad", SLOW)
    sample = sample_drive(signals, truth, error**2)
    assert sample is not None
    return error_budget(estimator, sample, SLOW)


def taken_off(found: ErrorBudget) -> dict[str, float]:
    return {c.name: 1.0 - c.rmse_left_rad / found.rmse_rad for c in found.causes if not c.reason}


def stiffer_front(factor: float) -> VehicleParameters:
    """Return the car with one axle stiffened: both at once is what another friction does to tyres by Eq 2."""
    tyres = VEHICLE.tyres
    assert tyres.front.B is not None
    front = tyres.front.model_copy(update={"B": factor * tyres.front.B})
    return VEHICLE.model_copy(update={"tyres": tyres.model_copy(update={"front": front})})


def biased(signals: Signals) -> Signals:
    return replace(signals, ay_m_s2=signals.ay_m_s2 + 0.3, yaw_rate_rad_s=signals.yaw_rate_rad_s + 0.003)


def late_steering(signals: Signals) -> Signals:
    return replace(signals, steer_rad=np.concatenate([np.full(4, signals.steer_rad[0]), signals.steer_rad[:-4]]))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cause", "planted", "vehicle"),
    [
        ("tyres", lambda s: s, stiffer_front(1.3)),
        ("bias", biased, VEHICLE),
        ("delay", late_steering, VEHICLE),
        ("friction", lambda s: replace(s, friction=np.full(len(s), 0.6)), VEHICLE),
    ],
)
def test_the_planted_cause_takes_most_off(
    made: Drive, cause: str, planted: Callable[[Signals], Signals], vehicle: VehicleParameters
) -> None:
    found = budget(planted(made.signals), truth_of(made), vehicle)
    off = taken_off(found)
    assert max(off, key=lambda name: off[name]) == cause
    assert off[cause] > 0.5
    assert found.seconds == pytest.approx(28.0, abs=2.5)


@pytest.mark.slow
def test_the_parameter_is_found_where_it_was_planted(made: Drive) -> None:
    found = budget(late_steering(made.signals), truth_of(made))
    (delay,) = [c for c in found.causes if c.name == "delay"]
    assert {p.name: p.value for p in delay.moved}["steering"] == pytest.approx(0.04, abs=0.01)


@pytest.mark.slow
def test_noise_alone_has_no_cause(made: Drive) -> None:
    found = budget(with_noise(made.signals, 3), truth_of(made))
    assert all(off < 0.15 for off in taken_off(found).values())


def test_straight_driving_shows_no_friction_and_says_so() -> None:
    straight = drive(lambda _t: 0.0, 15.0)
    found = budget(straight.signals, truth_of(straight))
    friction = found.causes[0]
    assert (friction.name, friction.moved) == ("friction", ())
    assert math.isnan(friction.rmse_left_rad) and "shows it" in friction.reason


def test_what_cannot_be_told_has_a_reason(made: Drive) -> None:
    truth = truth_of(made)
    short = sample_drive(made.signals.rows(0, 800), truth.rows(0, 800), np.ones(800))
    assert short is not None
    assert "too little" in error_budget(physics(VEHICLE), short, SLOW).reason
    assert "no physics filter" in error_budget(PassThrough("zero", claims_zero_sideslip=True), short, SLOW).reason
    assert sample_drive(made.signals, truth, np.full(len(made.signals), np.nan)) is None
    one = DriveSample(short.signals, short.truth, np.where(short.block == 0, 0, -1))  # of a drive of a second
    assert "too little" in error_budget(physics(VEHICLE), one, SLOW).reason


def test_blocks_lie_where_the_weight_is_and_filters_settle_before_each(made: Drive) -> None:
    n = 60_000
    stamps = np.arange(n, dtype=np.int64) * 10_000_000
    signals = replace(made.signals.rows(0, 1), **{c: np.zeros(n) for c in ("steer_rad", "ax_m_s2", "ay_m_s2")})
    signals = replace(
        signals, stamps_ns=stamps, ready_ns=stamps, yaw_rate_rad_s=np.zeros(n), speed_m_s=np.zeros(n),
        friction=np.zeros(n), wheel_speed_m_s=np.zeros((n, 4)),
    )  # fmt: skip
    weight = np.zeros(n)
    heavy = [5_000, 12_000, 25_000, 34_000, 47_000, 58_500]
    weight[heavy] = 1.0
    sample = sample_drive(signals, None, weight)
    assert sample is not None
    for number, at in enumerate(heavy):
        inside = sample.signals.stamps_ns[sample.block == number]
        assert inside[0] <= stamps[at] <= inside[-1]
        before = (sample.signals.stamps_ns < inside[0]) & (sample.signals.stamps_ns >= inside[0] - SETTLE_S * 1e9)
        assert (sample.block[before] == -1).all() and np.count_nonzero(before) == SETTLE_S * 100
    halves = [sample.half(p) for p in (0, 1)]
    assert [np.unique(h.block).tolist() for h in halves] == [[-1, 0, 2, 4], [-1, 1, 3, 5]]
    assert sum(np.count_nonzero(h.block >= 0) for h in halves) == np.count_nonzero(sample.block >= 0)
    assert len(np.unique(sample.block)) == BLOCKS + 1
