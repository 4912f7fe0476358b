"""Estimators on a car that its log has calibrated."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from reference_car import cut, drive, slalom, with_noise

from pdhef_logtool.car.car import Car, WithoutTruth
from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.vehicle import VehicleParameters, corrected_anew, default_vehicle
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.base import run_window
from pdhef_logtool.estimators.self_calibrated import OPEN_LOOP, SELF_CALIBRATED, SelfCalibrated
from pdhef_logtool.estimators.table import SPECS, default_names, make_estimator
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack

OWN = default_vehicle()
FOUND = OWN.model_copy(
    update={
        "yaw_inertia_kg_m2": 1700.0,
        "steer_offset_rad": 0.003,
        "steering_ratio": 16.5,
        "sensors": OWN.sensors.model_copy(update={"ay_bias_m_s2": 0.1, "yaw_rate_bias_rad_s": 0.001}),
    }
)
NOTE, NOISE = "calibrated", FilterNoise(r_std={"ay_m_s2": 1.0})


def calibrated(vehicle: VehicleParameters = FOUND, *, told_friction: bool = True) -> Car:
    return replace(Car.of(OWN), self_calibrated=WithoutTruth(vehicle, NOISE, told_friction, NOTE))


@pytest.fixture(scope="module")
def signals() -> Signals:
    s = with_noise(drive(slalom(0.03, 0.5), 3.0, speed=22.0).signals, seed=3)
    return replace(s, friction=np.full(len(s), 0.85))


def tracks(name: str, car: Car, *parts: Signals) -> list[StateTrack]:
    estimator, carry, found = make_estimator(name, car), None, []
    for part in parts:
        track, carry = run_window(estimator, part, carry, None)
        found.append(track)
    return found


def test_the_names_are_names_of_estimators() -> None:
    assert SELF_CALIBRATED | {OPEN_LOOP} <= {s.name for s in SPECS}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["physics", "pd-hef"])
def test_what_takes_it_is_not_causal_and_says_why(name: str) -> None:
    if name.startswith("pd-hef"):
        pytest.importorskip("torch")
        if Car.load().network is None:
            pytest.skip("no network is shipped")
    car = replace(calibrated(), network=Car.load().network)
    estimator = make_estimator(name, car)
    assert isinstance(estimator, SelfCalibrated)
    assert not estimator.causal
    assert estimator.name == name
    assert NOTE in estimator.notes
    assert resolve(estimator).physics_sha256 == car.calibrated_car.physics_sha256


@pytest.mark.parametrize("name", ["zero", "kinematic", "open-loop", "phy-ukf"])
def test_what_does_not_take_it_is_as_without(name: str) -> None:
    estimator = make_estimator(name, calibrated())
    assert estimator.causal
    assert resolve(estimator) == resolve(make_estimator(name, Car.of(OWN)))


def test_the_open_loop_model_runs_once_more_only_on_a_calibrated_car() -> None:
    assert OPEN_LOOP in default_names(calibrated())
    assert OPEN_LOOP not in default_names(Car.of(OWN))
    with pytest.raises(UsageError, match="has not calibrated"):
        make_estimator(OPEN_LOOP, Car.of(OWN))


def test_it_is_the_estimator_on_signals_that_the_calibrated_vehicle_reads(signals: Signals) -> None:
    (track,) = tracks(OPEN_LOOP, calibrated(), signals)
    (own,) = tracks("open-loop", Car.of(FOUND), corrected_anew(signals, OWN, FOUND))
    np.testing.assert_array_equal(track.vy_m_s, own.vy_m_s)


def test_an_estimated_friction_is_not_taken(signals: Signals) -> None:
    (told,) = tracks(OPEN_LOOP, calibrated(told_friction=False), replace(signals, friction=signals.friction * 0.5))
    (own,) = tracks(OPEN_LOOP, calibrated(), signals)
    np.testing.assert_array_equal(told.vy_m_s, own.vy_m_s)


@pytest.mark.parametrize("name", ["physics", OPEN_LOOP])
def test_windows_change_no_bit(name: str, signals: Signals) -> None:
    (whole,) = tracks(name, calibrated(), signals)
    parts = tracks(name, calibrated(), cut(signals, 0, 111), cut(signals, 111, len(signals)))
    np.testing.assert_array_equal(np.concatenate([p.vy_m_s for p in parts]), whole.vy_m_s)
