"""The interval of an identified car: parameter uncertainty after identification, and sensor residuals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from reference_car import drive, slalom, with_noise

from pdhef_logtool.car.car import NO_INTERVALS, Car
from pdhef_logtool.car.parts import (
    PHYSICS,
    FilterNoise,
    Fit,
    FittedPhysics,
    FittedValues,
    IntervalEntry,
    Intervals,
    physics_sha256,
)
from pdhef_logtool.car.toml_files import part_toml, vehicle_toml
from pdhef_logtool.car.vehicle import PhysicsParts, corrected_anew, default_vehicle
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.calibration.joint import prior_variations
from pdhef_logtool.estimators.drive_signals import calibrated_signals
from pdhef_logtool.estimators.error_features import TERMS, error_terms
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.posterior_band import OWN_SHARE, posterior_band
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.estimators.vehicle_ukf import physics_filter
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.estimating import calibrator
from tests.estimators.made_inflation import make_inflation

OWN = default_vehicle()
PARTS = PhysicsParts(lag=True, force_scale=True)
VALUES = FittedValues(yaw_inertia_kg_m2=1700.0, relaxation_length_m=0.6, physics=PARTS)
NOISE = FilterNoise(r_std={"ay_m_s2": 1.0})


def identified(share: float = 0.1) -> Car:
    """Return a car with uncertain parameters: rear stiffness by ``share``, steering offset by 0.05 ``share`` rad."""
    rear = OWN.tyres.rear
    assert rear.B is not None
    softer = OWN.tyres.model_copy(update={"rear": rear.model_copy(update={"B": rear.B * (1.0 - share)})})
    varied = (FittedValues(tyres=softer), FittedValues(steer_offset_rad=0.05 * share))
    found = FittedPhysics(values=VALUES, noise=NOISE, varied=varied)
    return Car.of(OWN, fitted_physics=found).with_noise(PHYSICS, NOISE)


@pytest.fixture(scope="module")
def signals() -> Signals:
    s = with_noise(drive(slalom(0.03, 0.5), 3.0, speed=22.0).signals, seed=3)
    return replace(s, friction=np.full(len(s), 0.85))


def banded(car: Car, signals: Signals, name: str = "physics") -> tuple[StateTrack, StateTrack]:
    """Return the track of an estimator, and the same with its band."""
    estimator = make_estimator(name, car)
    track = run_estimator(estimator, calibrated_signals(signals, car))
    return track, calibrator(car, [estimator]).apply(track, signals)


def test_the_band_is_the_sum_of_its_parts(signals: Signals) -> None:
    """The filter runs on the varied vehicles without the states that would compensate the variation."""
    car = identified()
    plain, wide = banded(car, signals)
    bare = {"physics": PARTS.model_copy(update={"force_scale": False})}
    vehicles = [v.model_copy(update=bare) for v in (car.physics_vehicle, *car.varied_physics)]
    assert vehicles[1].tyres.rear != OWN.tyres.rear
    assert vehicles[2].steer_offset_rad == pytest.approx(0.005)
    assert {v.yaw_inertia_kg_m2 for v in vehicles} == {1700.0}
    read = [(physics_filter(v, NOISE), corrected_anew(signals, OWN, v)) for v in vehicles]
    middle, *others = (run_estimator(f, s).vy_m_s for f, s in read)
    terms = error_terms(plain, signals, car.physics_vehicle.roll_gradient_rad_per_m_s2)
    seen = terms[:, TERMS.index("kinematic")] * plain.vx_m_s
    expected = (OWN_SHARE * plain.vy_std_m_s) ** 2 + seen**2 + sum((vy - middle) ** 2 for vy in others)
    fast = plain.vx_m_s > OWN.low_speed_blend_m_s
    np.testing.assert_allclose(wide.vy_std_m_s[fast] ** 2, expected[fast], rtol=1e-9)


def test_a_file_that_no_drive_has_shown_to_be_right_has_the_interval_of_its_prior() -> None:
    """Errors of a file with a wrong rear axle are inside; an identified car's interval contains its posterior only."""
    true = with_noise(drive(slalom(0.03, 0.5), 6.0, speed=22.0).signals, seed=3)
    signals = replace(true, friction=np.full(len(true), 0.85))
    right, wrong = Car.of(OWN), Car.of(OWN.with_stiffness(1.0, 0.6))
    (truth, _), (plain, wide) = (banded(car, signals) for car in (right, wrong))
    error = np.abs(plain.sideslip_rad - truth.sideslip_rad)[50:]
    assert np.mean(error <= 1.96 * plain.sideslip_std_rad[50:]) < 0.5
    assert np.mean(error <= 1.96 * wide.sideslip_std_rad[50:]) > 0.95
    assert np.mean(1.96 * wide.sideslip_std_rad[50:]) < 0.03
    np.testing.assert_array_equal(wide.sideslip_rad, plain.sideslip_rad)
    nominal, nominal_wide = banded(wrong, signals, name="phy-ukf")
    assert np.median(nominal_wide.sideslip_std_rad / nominal.sideslip_std_rad) > 2.0
    found = FittedPhysics(values=VALUES, noise=NOISE)
    assert posterior_band(Car.of(OWN, fitted_physics=found).with_noise(PHYSICS, NOISE)) is None
    assert len({vehicle.model_dump_json() for vehicle in (OWN, *prior_variations(OWN))}) == 7


def test_calibrated_intervals_come_first(signals: Signals) -> None:
    car = identified()
    estimator = make_estimator("physics", car)
    track = run_estimator(estimator, signals)
    inflation = make_inflation((0.0, 9.0, *(0.0,) * (len(TERMS) - 2)), (9.0,) * 3)
    entry = IntervalEntry(estimator="physics", algorithm=resolve(estimator), inflation=inflation)
    intervals = Intervals(car="c", physics_sha256="ab" * 32, roll_gradient_rad_per_m_s2=0.0, entries=(entry,))
    wide = calibrator(replace(car, intervals=intervals), [estimator]).apply(track, signals)
    np.testing.assert_allclose(wide.sideslip_std_rad, np.minimum(9.0 * track.sideslip_std_rad, 1.0))


def test_a_file_keeps_the_posterior_and_a_wrong_car_stays_wrong(tmp_path: Path) -> None:
    car, file = identified(), tmp_path
    fit = Fit(physics_sha256=physics_sha256(OWN), physics=car.fitted_physics)
    (file / "vehicle.toml").write_text(vehicle_toml(OWN), encoding="utf-8")
    (file / "fit.toml").write_text(part_toml(fit, "Written by a test."), encoding="utf-8")
    again = Car.load(file)
    assert again.intervals is None, "those of the shipped car are another car's"
    assert again.varied_physics == car.varied_physics
    assert calibrator(Car.load(file, network="none", intervals=NO_INTERVALS), []).posterior == {}
    heavy = OWN.model_copy(update={"yaw_inertia_kg_m2": 2000.0, "steer_offset_rad": 0.1})
    wrong = car.with_vehicle(heavy)
    assert {v.yaw_inertia_kg_m2 for v in wrong.varied_physics} == {2000.0}
    assert {v.steer_offset_rad for v in wrong.varied_physics} == {0.1}
