"""Estimators on a car that its log has calibrated, and their intervals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from reference_car import drive, slalom, with_noise

from pdhef_logtool.car.assumed_values import DEFAULT_CG_SPREAD, FRONT_WEIGHT_SHARE, FRONT_WEIGHT_SHARE_SPREAD
from pdhef_logtool.car.car import Car, WithoutTruth
from pdhef_logtool.car.parts import FilterNoise, IntervalEntry, Intervals
from pdhef_logtool.car.toml_files import vehicle_of_entries
from pdhef_logtool.car.vehicle import VehicleParameters, corrected_anew, default_vehicle
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.calibrated_band import D2_SHARE
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.presets import OPEN_LOOP
from pdhef_logtool.estimators.table import all_names, make_estimator
from pdhef_logtool.estimators.vehicle_ukf import physics_filter
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.estimating import calibrator
from tests.estimators.made_inflation import make_inflation

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


def with_band(share: float = 0.1, d2_m_s: float = 0.1) -> Car:
    """Return a calibrated car with uncertain rear stiffness (``share``) and steering offset (0.05 ``share`` rad)."""
    rear = FOUND.tyres.rear
    assert rear.B is not None
    softer = FOUND.tyres.model_copy(update={"rear": rear.model_copy(update={"B": rear.B * (1.0 - share)})})
    varied = (
        FOUND.model_copy(update={"steer_offset_rad": FOUND.steer_offset_rad + 0.05 * share}),
        FOUND.model_copy(update={"tyres": softer}),
    )
    found = WithoutTruth(FOUND, NOISE, True, NOTE, varied=varied, driven_d2_m_s=d2_m_s)
    return replace(Car.of(OWN), self_calibrated=found)


@pytest.fixture(scope="module")
def signals() -> Signals:
    s = with_noise(drive(slalom(0.03, 0.5), 3.0, speed=22.0).signals, seed=3)
    return replace(s, friction=np.full(len(s), 0.85))


def track_of(name: str, car: Car, signals: Signals) -> StateTrack:
    """Return the track of an estimator with its intervals."""
    estimator = make_estimator(name, car)
    return calibrator(car, [estimator]).apply(run_estimator(estimator, calibrated_signals(signals, car)), signals)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["physics", "pd-hef"])
def test_an_estimator_on_a_car_calibrated_by_the_whole_log_is_not_causal(name: str) -> None:
    if name.startswith("pd-hef"):
        pytest.importorskip("torch")
        if Car.load().network is None:
            pytest.skip("no network is shipped")
    car = replace(calibrated(), network=Car.load().network)
    estimator = make_estimator(name, car)
    assert not estimator.causal
    assert estimator.name == name
    assert resolve(estimator).physics_sha256 == car.calibrated_car.physics_sha256


@pytest.mark.parametrize("name", ["zero", "kinematic", "open-loop", "phy-ukf"])
def test_what_does_not_take_it_is_as_without(name: str) -> None:
    estimator = make_estimator(name, calibrated())
    assert estimator.causal
    assert resolve(estimator) == resolve(make_estimator(name, Car.of(OWN)))


def test_the_open_loop_model_runs_once_more_only_on_a_calibrated_car() -> None:
    assert OPEN_LOOP in all_names(calibrated())
    assert OPEN_LOOP not in all_names(Car.of(OWN))
    with pytest.raises(UsageError, match="has not calibrated"):
        make_estimator(OPEN_LOOP, Car.of(OWN))


def test_an_estimated_friction_is_not_taken(signals: Signals) -> None:
    told = track_of(OPEN_LOOP, calibrated(told_friction=False), replace(signals, friction=signals.friction * 0.5))
    own = track_of(OPEN_LOOP, calibrated(), signals)
    np.testing.assert_array_equal(told.vy_m_s, own.vy_m_s)


def test_the_band_changes_no_estimate(signals: Signals) -> None:
    plain, banded = (track_of("physics", car, signals) for car in (calibrated(), with_band()))
    for column in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "sideslip_rad", "nis"):
        np.testing.assert_array_equal(getattr(banded, column), getattr(plain, column))
    np.testing.assert_array_equal(banded.yaw_rate_std_rad_s, plain.yaw_rate_std_rad_s)
    assert (np.linalg.eigvalsh(banded.covariance[10:]) > 0.0).all()


def test_the_band_is_the_sum_of_its_parts(signals: Signals) -> None:
    """The parameter part is the spread of the filter over the varied vehicles; the d2 part is a velocity."""
    plain, alone, both = (
        track_of("physics", car, signals) for car in (calibrated(), with_band(d2_m_s=0.0), with_band(d2_m_s=0.1))
    )
    found = with_band().self_calibrated
    assert found is not None
    read = [corrected_anew(signals, OWN, v) for v in (FOUND, *found.varied)]
    filters = [physics_filter(v, NOISE) for v in (FOUND, *found.varied)]
    middle, *others = (run_estimator(f, s).vy_m_s for f, s in zip(filters, read, strict=True))
    away = sum((vy - middle) ** 2 for vy in others)
    expected = plain.vy_std_m_s**2 + away
    fast = plain.vx_m_s > OWN.low_speed_blend_m_s
    np.testing.assert_allclose(alone.vy_std_m_s[fast] ** 2, expected[fast], rtol=1e-9)
    np.testing.assert_allclose((both.vy_std_m_s**2 - alone.vy_std_m_s**2)[fast], (0.1 * D2_SHARE) ** 2, rtol=1e-6)


def test_without_d2_its_own_interval_counts_as_it_is(signals: Signals) -> None:
    plain, banded = (track_of("physics", car, signals) for car in (calibrated(), with_band(0.0, math.nan)))
    np.testing.assert_array_equal(banded.sideslip_std_rad, plain.sideslip_std_rad)
    car = with_band(0.0, math.nan)
    assert calibrator(car, [make_estimator("physics", car)]).fixed_notes["physics"] == "intervals: own and parameters"


def test_intervals_of_other_driving_are_not_taken(signals: Signals) -> None:
    estimator = make_estimator("physics", with_band())
    inflation = make_inflation((9.0,) * 9, (9.0,) * 3)
    entries = (IntervalEntry(estimator="e", algorithm=resolve(estimator), inflation=inflation),)
    intervals = Intervals(car="c", physics_sha256="ab" * 32, roll_gradient_rad_per_m_s2=0.0, entries=entries)
    track = run_estimator(estimator, signals)
    applied = calibrator(replace(with_band(), intervals=intervals), [estimator])
    without = calibrator(with_band(), [estimator]).apply(track, signals)
    np.testing.assert_array_equal(applied.apply(track, signals).sideslip_std_rad, without.sideslip_std_rad)
    assert (without.sideslip_std_rad != track.sideslip_std_rad).any()
    assert applied.notes(estimator.name) == ("intervals: own, parameters and d2",)


def test_the_interval_contains_where_the_centre_of_gravity_is_only_assumed(signals: Signals) -> None:
    """At a yaw rate r the rear axle determines v_y up to the error of its distance times r."""
    known = with_band()
    assert known.self_calibrated is not None
    assumed = replace(known, self_calibrated=replace(known.self_calibrated, cg_std_m=0.3))
    narrow, wide = track_of("physics", known, signals), track_of("physics", assumed, signals)
    added = wide.sideslip_std_rad**2 - narrow.sideslip_std_rad**2
    expected = (0.3 * wide.yaw_rate_rad_s / wide.vx_m_s) ** 2
    fast = wide.valid & (wide.vx_m_s > OWN.low_speed_blend_m_s)
    np.testing.assert_allclose(added[fast], expected[fast], rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(wide.sideslip_rad, narrow.sideslip_rad)


def test_the_centre_of_gravity_is_assumed_without_a_file_or_weight_split() -> None:
    assert Car.of(default_vehicle()).cg_std_m == pytest.approx(DEFAULT_CG_SPREAD * 1.71)
    assert Car.of(OWN.model_copy(update={"name": "mine"})).cg_std_m == 0.0
    given = vehicle_of_entries({"name": "mine", "mass_kg": 1500.0, "wheelbase_m": 2.7}, where="test")
    car = Car.of(given.vehicle, assumed=given.assumed)
    assert car.cg_std_m == pytest.approx(FRONT_WEIGHT_SHARE_SPREAD * 2.7 * FRONT_WEIGHT_SHARE)
