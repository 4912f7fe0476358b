"""``pd-hef`` of a taught car: the residual acts in the filter, causally, window by window, within its region."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from made_models import linear_residual, random_network
from reference_car import drive, slalom, with_noise

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.model import CarModel
from pdhef_logtool.car.posterior import Posterior
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.residual_response import residual_response
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.ladder import LadderModel

SEDAN = default_vehicle()


def taught_car(residual: LadderModel | None, *, calibrated: bool = False) -> Car:
    model = CarModel(physics_sha256=Car(SEDAN).physics_sha256, residual=residual, calibrated=calibrated)
    return replace(Car(SEDAN), model=model)


def acts(estimator: Any) -> bool:
    """Whether an estimator uses the taught residual."""
    return isinstance(estimator.network, LadderModel) and estimator.trust == 1.0


@pytest.fixture(scope="module")
def signals():
    s = with_noise(drive(slalom(0.03, 0.5), 6.0, speed=22.0).signals, seed=3)
    return replace(s, friction=np.full(len(s), 0.85))


def track_of(name: str, car: Car, signals: Signals) -> StateTrack:
    return run_estimator(make_estimator(name, car), signals)


def test_its_response_is_the_one_that_teaching_uses(signals):
    estimator = make_estimator("physics", taught_car(None))
    assert isinstance(estimator, AdaptivePhysics)
    response = residual_response(estimator, signals, np.arange(len(signals)))
    rate = 0.2 * np.sin(np.arange(len(signals)) / 30.0)
    tracks = []
    for given in (0.0, 1.0):
        rates = np.stack([given * rate, np.zeros(len(rate))], axis=1)
        steps, _ = estimator.physics.run(signals, None, rates)
        tracks.append(np.arctan2(steps.x[:, 1], steps.x[:, 0]))
    expected = tracks[1] - tracks[0]
    assert np.nanmax(np.abs(expected)) > 1e-4
    late = slice(50, None)
    assert np.allclose(response(rate[:, None])[late, 0], expected[late], atol=0.1 * np.nanmax(np.abs(expected)))


def test_beyond_the_taught_speed_it_is_physics(signals):
    car = taught_car(linear_residual(fastest_m_s=10.0))
    physics, hybrid = (track_of(name, car, signals) for name in ("physics", "pd-hef"))
    assert np.array_equal(hybrid.sideslip_rad, physics.sideslip_rad, equal_nan=True)
    assert np.nanmax(hybrid.network_trust) == 0.0


def test_a_residual_belongs_to_the_physics_that_it_was_fitted_on(signals):
    calibration = Posterior(SEDAN)
    for calibrated in (False, True):
        car = taught_car(linear_residual(), calibrated=calibrated)
        plain, of_log = (make_estimator("pd-hef", c) for c in (car, replace(car, self_calibrated=calibration)))
        assert acts(plain) is not calibrated
        assert acts(of_log) is calibrated
        without = of_log if not calibrated else plain
        assert any("residual gain 0" in note for note in without.notes)
    track = track_of(
        "pd-hef", replace(taught_car(linear_residual(), calibrated=True), self_calibrated=calibration), signals
    )
    assert np.nanmax(track.network_trust) == 1.0


def test_a_car_without_a_residual_or_with_a_named_gain_does_not_take_it():
    assert not acts(make_estimator("pd-hef", taught_car(None)))
    assert make_estimator("pd-hef", taught_car(linear_residual())).causal
    with_network = replace(taught_car(linear_residual()), network=random_network())
    assert not acts(make_estimator("pd-hef:gain=1", with_network)) and acts(make_estimator("pd-hef", with_network))
