"""Online calibration of a car during its log: causal, independent of windows, and better than the vehicle file."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from reference_car import drive, with_noise

from pdhef_logtool.car.car import Car, WithoutTruth
from pdhef_logtool.car.vehicle import Tyres, VehicleParameters, default_vehicle
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.calibration.calibration import SelfCalibration, calibrate_online
from pdhef_logtool.estimators.calibration.driving import driving_of
from pdhef_logtool.estimators.causality_check import CausalityCheck
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.online_calibrated import OnlineCalibrated
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.runs.estimating import calibrator

#: The body does not roll; 0 would be a missing entry.
RIGHT = default_vehicle().model_copy(update={"roll_gradient_rad_per_m_s2": 1e-6})


def wrong() -> VehicleParameters:
    """Return a vehicle with half of the front axle's stiffness."""
    front = RIGHT.tyres.front
    assert front.B is not None
    tyres = Tyres(front=front.model_copy(update={"B": 0.5 * front.B}), rear=RIGHT.tyres.rear)
    return RIGHT.model_copy(update={"tyres": tyres})


@cache
def driven() -> tuple[Signals, np.ndarray]:
    run = drive(lambda t: 0.02 * math.sin(2.0 * math.pi * 0.5 * t) + 0.01 * math.sin(0.7 * t), 30.0)
    return with_noise(run.signals, 3), np.arctan2(run.vy, run.vx)


def calibrated(signals: Signals) -> SelfCalibration:
    return calibrate_online(driving_of(signals, wrong()), wrong())


def car_of(found: SelfCalibration) -> Car:
    def applied(one: SelfCalibration) -> WithoutTruth:
        return WithoutTruth(
            one.vehicle,
            one.noise,
            told_friction=True,
            note="",
            varied=one.varied,
            since_ns=one.since_ns,
            earlier=tuple(map(applied, one.earlier)),
        )

    return replace(Car.of(wrong()), self_calibrated=applied(found))


@cache
def online() -> OnlineCalibrated:
    estimator = make_estimator("physics", car_of(calibrated(driven()[0])))
    assert isinstance(estimator, OnlineCalibrated)
    return estimator


def test_the_first_stage_has_the_prior_and_later_ones_follow_in_time() -> None:
    found = calibrated(driven()[0])
    begins = [one.since_ns for one in (*found.earlier, found)]
    assert begins[0] == 0
    assert begins == sorted(begins)
    assert len(begins) == 6  # after 5, 7.5, 11.25, 16.9 and 25.3 s of driving
    assert not found.earlier[0].parameters


def test_what_follows_changes_no_earlier_stage() -> None:
    signals, _ = driven()
    late = np.arange(len(signals)) >= 2000
    wild = replace(signals, yaw_rate_rad_s=np.where(late, -3.0 * signals.yaw_rate_rad_s, signals.yaw_rate_rad_s))
    limit = int(signals.stamps_ns[2000])

    def before(of: Signals) -> list[object]:
        found = calibrated(of)
        return [one.parameters for one in (*found.earlier, found) if one.since_ns < limit and one.parameters]

    assert before(signals) == before(wild)
    assert len(before(signals)) == 4


def test_the_estimator_is_causal() -> None:
    check = CausalityCheck()
    run_window(online(), driven()[0], None, check)
    assert online().causal
    assert not check.failed


def test_it_is_better_than_the_file_once_it_is_calibrated() -> None:
    signals, truth = driven()
    late = slice(1500, None)

    def rms(car: Car) -> float:
        track, _ = run_window(make_estimator("physics", car), signals)
        return float(np.sqrt(np.mean((track.sideslip_rad - truth)[late] ** 2)))

    assert rms(car_of(calibrated(signals))) < 0.7 * rms(Car.of(wrong()))


def test_each_stage_has_its_interval() -> None:
    signals, _ = driven()
    car = car_of(calibrated(signals))
    track, _ = run_window(online(), signals)
    banded = calibrator(car, [online()]).apply(track, signals)
    assert len(banded) == len(track)
    inside = slice(900, None)
    assert (banded.sideslip_std_rad[inside] >= track.sideslip_std_rad[inside]).all()
    assert (banded.sideslip_std_rad[inside] > track.sideslip_std_rad[inside]).any()


def test_its_identity_names_what_runs_in_it() -> None:
    found = resolve(online())
    assert found.algorithm == "online-calibrated"
    assert found.options["estimator"] == "adaptive-physics"


@pytest.mark.parametrize("name", ["physics", "pd-hef-smoothed"])
def test_what_looks_ahead_takes_the_last_stage(name: str) -> None:
    estimator = make_estimator(name, car_of(calibrated(driven()[0])))
    assert isinstance(estimator, OnlineCalibrated) is (name == "physics")
