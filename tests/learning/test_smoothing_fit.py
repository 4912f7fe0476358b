"""The noise with which a fitted ``physics`` is smoothed, on small drives of cars in plain Python."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_physics_fit import STATIC, guess, static_drive

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import SMOOTHING, FilterNoise, FittedPhysics, FittedValues
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.physics_filter import PHYSICS_Q_STD
from pdhef_logtool.estimators.table import Options, spec_of
from pdhef_logtool.learning.car import smoothing_fit
from pdhef_logtool.learning.car.fit_data import FitDrive, part_of
from pdhef_logtool.learning.car.physics_fit import PhysicsFit
from pdhef_logtool.learning.car.smoothing_fit import fit_smoothing, smoothed_errors


def fitted(vehicle: VehicleParameters, *, vy: float, yaw_rate: float) -> PhysicsFit:
    q = (PHYSICS_Q_STD[0], vy, yaw_rate, *PHYSICS_Q_STD[3:])
    noise = FilterNoise(q_std=q, r_std={"ay_m_s2": 0.3, "yaw_rate_rad_s": 0.003})
    return PhysicsFit(vehicle, noise, (), np.zeros(0), np.zeros((0, 0)), 0.0, 0.0)


def rms(drive: FitDrive, found: PhysicsFit, factors: tuple[float, float]) -> float:
    (error,) = smoothed_errors([drive], guess(), found, factors)
    return error.rms


@pytest.fixture(scope="module")
def short() -> FitDrive:
    return part_of(static_drive(1), 0, 600)


def test_noise_of_vy_that_is_too_large_is_taken_back(short: FitDrive) -> None:
    """The car is the model's: the less noise its v_y is given, the better; so it is on a drive that was not seen."""
    found = fitted(guess().model_copy(update={"physics": STATIC}), vy=1.0, yaw_rate=0.02)
    factors = fit_smoothing([short], guess(), found)
    assert factors[0] < 0.5
    assert rms(short, found, factors) < 0.9 * rms(short, found, (1.0, 1.0))
    unseen = part_of(static_drive(2), 0, 600)
    assert rms(unseen, found, factors) < 0.9 * rms(unseen, found, (1.0, 1.0))


def test_what_gains_too_little_is_left_alone(short: FitDrive, monkeypatch: pytest.MonkeyPatch) -> None:
    found = fitted(guess().model_copy(update={"physics": STATIC}), vy=1.0, yaw_rate=0.02)
    monkeypatch.setattr(smoothing_fit, "MAX_ITERATIONS", 1)
    assert fit_smoothing([short], guess(), found) != SMOOTHING
    monkeypatch.setattr(smoothing_fit, "LEAST_GAIN", 10.0)
    assert fit_smoothing([short], guess(), found) == SMOOTHING


def test_the_smoother_alone_takes_the_factors() -> None:
    q = (0.1, 0.2, 0.04, 0.05, 0.3, 0.3)
    physics = FittedPhysics(values=FittedValues(), noise=FilterNoise(q_std=q), smoothing=(0.5, 3.0))
    car = replace(Car.of(guess(), noise={"physics": physics.noise}), fitted_physics=physics)
    noise = {n: resolve(spec_of(n).make(car, Options())).noise for n in ("pd-hef", "pd-hef-smoothed")}
    assert noise["pd-hef"]["physics.q_std"] == list(q)
    assert noise["pd-hef-smoothed"]["filtered.physics.q_std"] == pytest.approx([0.1, 0.1, 0.12, 0.05, 0.3, 0.3])
    bare = resolve(spec_of("pd-hef-smoothed").make(Car.of(guess()), Options())).noise["filtered.physics.q_std"]
    usual = [PHYSICS_Q_STD[0], *(q * by for q, by in zip(PHYSICS_Q_STD[1:3], SMOOTHING, strict=True))]
    assert bare[:3] == pytest.approx(usual)
