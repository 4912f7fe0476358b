"""Peers recover a simulated car within what their equations allow."""

from dataclasses import replace

import numpy as np
import pytest
from reference_car import on_axles, signals_at
from scipy.integrate import solve_ivp

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.peers.single_track import single_track
from pdhef_logtool.estimators.table import PEERS, all_names, make_estimator

pytestmark = pytest.mark.slow

SPEED_M_S, STEP_S, SECONDS = 20.0, 0.01, 30.0
#: Sideslip RMSE in degrees on the simulated linear car, with a sideslip RMS of 0.37°.
BOUNDS_DEG = {
    "linear-kf": 0.001,
    "linear-kf:open-loop": 0.001,
    "learned-single-track": 0.16,  # stationary: sideslip lags behind steering
    "slip-ukf": 0.1,  # low-passed sensors and a yaw acceleration over 1 s
    "washout": 0.15,  # the stationary solution lags behind steering
}


def linear_sedan() -> VehicleParameters:
    """Return the default sedan with the peak forces so high that its tyres are linear."""
    sedan = default_vehicle()
    car = single_track(sedan)
    return on_axles(sedan, car.front_stiffness, car.rear_stiffness).model_copy(update={"friction": 2.0})


@pytest.fixture(scope="module")
def simulated():
    """Signals of a linear single track on a slow sine of steering, and its sideslip [N]."""
    car = single_track(linear_sedan())

    def steer(t):
        return 0.04 * np.sin(2.0 * np.pi * 0.2 * t)

    def forces(t, x):
        front = car.front_stiffness * (steer(t) - (x[0] + car.front_m * x[1]) / SPEED_M_S)
        return front, -car.rear_stiffness * (x[0] - car.rear_m * x[1]) / SPEED_M_S

    def rates(t, x):
        front, rear = forces(t, x)
        return [(front + rear) / car.mass - SPEED_M_S * x[1], (car.front_m * front - car.rear_m * rear) / car.inertia]

    times = np.arange(0.0, SECONDS, STEP_S)
    vy, r = solve_ivp(rates, (0.0, SECONDS), [0.0, 0.0], t_eval=times, rtol=1e-9, atol=1e-12).y
    front, rear = forces(times, np.array([vy, r]))
    sensed = {"steer_rad": steer(times), "ay_m_s2": (front + rear) / car.mass, "yaw_rate_rad_s": r}
    signals = signals_at(np.round(times * 1e9).astype(np.int64), ax_m_s2=0.0, speed_m_s=SPEED_M_S, **sensed)
    return signals, np.arctan2(vy, SPEED_M_S)


@pytest.mark.parametrize("name", all_names(Car(default_vehicle()), PEERS))
def test_a_peer_recovers_a_linear_car_within_its_bound(name, simulated):
    signals, sideslip = simulated
    track = run_estimator(make_estimator(name, Car(linear_sedan())), signals)
    error = np.degrees(np.sqrt(np.mean((track.sideslip_rad - sideslip) ** 2)))
    assert error < BOUNDS_DEG[name]
    assert np.degrees(np.sqrt(np.mean(sideslip**2))) == pytest.approx(0.37, abs=0.01)


def test_the_learner_learns_an_offset_of_steering(simulated):
    signals, sideslip = simulated
    errors = {}
    for name in ("learned-single-track", "linear-kf:open-loop"):
        estimator = make_estimator(name, Car(linear_sedan()))
        track = run_estimator(estimator, replace(signals, steer_rad=signals.steer_rad + 0.005))
        errors[name] = abs(np.degrees(np.mean((track.sideslip_rad - sideslip)[-1000:])))  # two periods
    assert errors["learned-single-track"] < 0.8 * errors["linear-kf:open-loop"]
