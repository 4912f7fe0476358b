"""The steps of an identification, each on numbers that can be worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from reference_car import drive, slalom

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import FilterNoise, FittedPhysics, FittedValues, TriedParts
from pdhef_logtool.car.vehicle import AxleTyre, PhysicsParts, Sensors, Tyres, default_vehicle
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.phy_ukf import PHY_UKF_Q_STD, PhysicsUkf, physics_ukf_tuned
from pdhef_logtool.estimators.physics_filter import physics_filter
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.learning.car import fit_data, identify
from pdhef_logtool.learning.car.axle_forces import AxleCurve, AxleSamples, axle_samples, fit_axle, usable_stamps
from pdhef_logtool.learning.car.fit_data import FitDrive, load_fit_drive, split_drive
from pdhef_logtool.learning.car.identify import (
    Identification,
    Identified,
    PartScore,
    Prior,
    build_vehicle,
    fit_car,
    make_priors,
    understeer_deg_per_g,
)
from pdhef_logtool.learning.car.physics_fit import PhysicsFit
from pdhef_logtool.learning.drives import DriveRecord, LearnSettings
from pdhef_logtool.learning.engine import learn
from pdhef_logtool.learning.stages import identify as stage
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.records.tracks import make_track
from pdhef_logtool.runs.config import RunConfig

CAR = default_vehicle().model_copy(
    update={
        "tyres": Tyres(
            front=AxleTyre(cornering_stiffness_n_per_rad=110_000.0),
            rear=AxleTyre(cornering_stiffness_n_per_rad=95_000.0),
        )
    }
)
STATIC = PhysicsParts()
PHYSICS = FittedPhysics(
    values=FittedValues(yaw_inertia_kg_m2=1700.0, physics=PhysicsParts(roll=True)),
    noise=FilterNoise(q_std=(0.1,) * 6),
    tried=(
        TriedParts(parts=(), held_out_deg=(0.2, 0.3), taken=True),
        TriedParts(parts=("roll",), held_out_deg=(0.1, 0.2), taken=True),
    ),
)
FITTED: Any = SimpleNamespace(
    priors=(Prior("roll frequency", "rad/s", 9.0, 0.5), Prior("q v_y", "m/s", 1.0, 0.5, tuning=True)),
    theta=np.array([1.0, 0.0]),
    std=np.array([0.9, 0.9]),
)
NO_SAMPLES = AxleSamples(*(np.empty(0) for _ in range(4)))


def fit_drive(seconds: float = 6.0, period_s: float = 0.01, **changes: Any) -> FitDrive:
    made = drive(slalom(), seconds, step_s=period_s)
    stamps = made.signals.stamps_ns
    truth = make_track(
        "truth", stamps, vx_m_s=made.vx, vy_m_s=made.vy, yaw_rate_rad_s=made.r, ay_m_s2=made.ay, valid=made.vx > 0
    )
    return replace(FitDrive("made", made.signals, truth, True, int(stamps[0]) - 2_000_000_000), **changes)


DRIVE = fit_drive()


# ---- the parts of a drive ----


def test_a_drive_is_loaded_without_what_the_file_takes_off(monkeypatch: pytest.MonkeyPatch) -> None:
    sensors = Sensors(ax_bias_m_s2=0.1, ay_bias_m_s2=0.2, yaw_rate_bias_rad_s=0.01, ay_std_m_s2=0.3)
    car = Car.of(CAR.model_copy(update={"steer_offset_rad": 0.02, "sensors": sensors}))
    asked: list[Any] = []

    def load(_log: Any, used: Car, _mapping: Any, options: ReadOptions) -> tuple[DriveRecord, Any]:
        asked.append((used.vehicle, options))
        plan = SimpleNamespace(dependent=dependent, mapping=SimpleNamespace(signals=mapped), placed=None)
        return DriveRecord("a", "a.mcap"), SimpleNamespace(
            signals=DRIVE.signals, truth=truth, plan=plan, log_start_ns=7
        )

    monkeypatch.setattr(fit_data, "load_drive", load)
    dependent, mapped, truth = {"yaw_rate_rad_s": "it is the gyro"}, {"steer_rad": 1}, DRIVE.truth
    record, found = load_fit_drive(LogInput(Path("a.mcap"), "a"), car, None, ReadOptions(friction="0.5"))
    assert found is not None
    assert (record.name, found.name, found.log_start_ns) == ("a", "a", 7)
    assert (found.independent_yaw_rate, found.steering_wheel) == (False, False)
    assert found.signals is DRIVE.signals and found.truth is DRIVE.truth
    ((vehicle, options),) = asked
    plain = sensors.model_copy(update={"ax_bias_m_s2": 0.0, "ay_bias_m_s2": 0.0, "yaw_rate_bias_rad_s": 0.0})
    assert vehicle == car.vehicle.model_copy(update={"steer_offset_rad": 0.0, "sensors": plain})
    assert options.friction is None
    dependent, mapped = {}, {"steering_wheel_rad": 1}
    _, found = load_fit_drive(LogInput(Path("a.mcap"), "a"), car, None, ReadOptions())
    assert found is not None and found.independent_yaw_rate and found.steering_wheel
    truth = None
    assert load_fit_drive(LogInput(Path("a.mcap"), "a"), car, None, ReadOptions())[1] is None


def test_span_and_parts_of_a_drive() -> None:
    long = fit_drive(25.0, 0.05)
    assert long.span_s == pytest.approx((2.0, 27.0))
    assert long.duration_s == pytest.approx(25.0)
    first, second = split_drive(replace(long, steering_wheel=True), 0.4)
    assert second is not None
    assert first.span_s == pytest.approx((2.0, 16.95))  # the cut itself, at 17 s, is not in it
    assert second.span_s == pytest.approx((22.0, 27.0))
    assert second.steering_wheel
    for part, rows in ((first, slice(0, 300)), (second, slice(400, None))):
        np.testing.assert_array_equal(part.truth.vy_m_s, long.truth.vy_m_s[rows])
        np.testing.assert_array_equal(part.signals.steer_rad, long.signals.steer_rad[rows])
        assert part.truth.name == "truth" and part.truth.covariance.shape == (0, 3, 3)
    assert split_drive(long, 0.1)[1] is None  # all of it is guard
    assert replace(long, signals=replace(long.signals, stamps_ns=np.empty(0, dtype=np.int64))).duration_s == 0.0


# ---- axle forces ----


def test_only_known_tame_and_fast_enough_driving_is_used() -> None:
    n = len(DRIVE.truth)
    vx, vy, valid = DRIVE.truth.vx_m_s.copy(), np.zeros(n), np.ones(n, dtype=bool)
    vx[:2] = 5.9, 6.1  # twice the low-speed limit of 3 m/s
    vy[10:12] = vx[10] * math.tan(math.radians(8.1)), -vx[10] * math.tan(math.radians(7.9))
    valid[20] = False
    yaw_rate, steer = DRIVE.truth.yaw_rate_rad_s.copy(), DRIVE.signals.steer_rad.copy()
    yaw_rate[30], steer[40] = np.nan, np.nan
    beta = np.arctan2(vy, vx)
    truth = replace(DRIVE.truth, vx_m_s=vx, vy_m_s=vy, sideslip_rad=beta, yaw_rate_rad_s=yaw_rate, valid=valid)
    use = usable_stamps(replace(DRIVE, truth=truth, signals=replace(DRIVE.signals, steer_rad=steer)), CAR)
    assert np.flatnonzero(~use).tolist() == [0, 10, 20, 30, 40]


def test_axle_forces_follow_from_newton_and_euler() -> None:
    """A steady turn-in: v_x and v_y constant, r growing by 0.1 rad/s², a_y constant."""
    n = 400
    stamps = 10**18 + np.arange(n, dtype=np.int64) * 10_000_000
    full = np.full(n, 1.0)
    r = 0.1 * np.arange(n) * 0.01
    truth = make_track("t", stamps, vx_m_s=20 * full, vy_m_s=-0.4 * full, yaw_rate_rad_s=r, ay_m_s2=3.0 * full)
    signals = replace(fit_drive(3.99).signals, stamps_ns=stamps, steer_rad=0.2 * full)
    samples = axle_samples([FitDrive("t", signals, truth, True, 0)] * 2, CAR)
    assert samples.front_force_n.size == 2 * n
    at = slice(100, 300)  # away from the ends of the smoothing
    lf, lr, m, iz = 1.16, 1.71, 1440.0, 1523.0
    # Newton: F_f cos δ + F_r = m a_y. Euler: l_f F_f cos δ − l_r F_r = I_z ṙ.
    forward, rear = samples.front_force_n[at] * math.cos(0.2), samples.rear_force_n[at]
    np.testing.assert_allclose(forward + rear, m * 3.0, rtol=1e-9)
    np.testing.assert_allclose(lf * forward - lr * rear, iz * 0.1, rtol=1e-4)
    np.testing.assert_allclose(samples.front_slip_rad[at], 0.2 - np.arctan((-0.4 + lf * r[at]) / 20), atol=1e-9)
    np.testing.assert_allclose(samples.rear_slip_rad[at], -np.arctan((-0.4 - lr * r[at]) / 20), atol=1e-9)
    two = replace(signals, **{k: getattr(signals, k)[:2] for k in ("stamps_ns", "steer_rad", "friction")})
    short = make_track("t", stamps[:2], **{k: getattr(truth, k)[:2] for k in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s")})
    assert axle_samples([FitDrive("t", two, short, True, 0)], CAR).front_force_n.size == 0


def test_forces_at_another_friction_are_those_of_one_curve() -> None:
    """Similarity: force over friction by slip over friction; without it, or without a friction, as they are."""
    n = len(DRIVE.signals)
    plain = axle_samples([DRIVE], CAR)
    icy = replace(DRIVE, signals=replace(DRIVE.signals, friction=np.full(n, 0.34)))
    one = axle_samples([icy], CAR, similar=True)
    grip = 0.34 / 0.85
    for name in ("front_slip_rad", "front_force_n", "rear_slip_rad", "rear_force_n"):
        np.testing.assert_allclose(getattr(one, name), getattr(plain, name) / grip)
        np.testing.assert_array_equal(getattr(axle_samples([icy], CAR), name), getattr(plain, name))
        np.testing.assert_array_equal(getattr(axle_samples([DRIVE], CAR, similar=True), name), getattr(plain, name))


def test_the_curve_is_the_magic_formula() -> None:
    curve = AxleCurve(100_000.0, 8000.0, 1.3)
    assert curve.force_n(np.array([1e-6]))[0] == pytest.approx(0.1)
    assert curve.force_n(np.array([0.05]))[0] == pytest.approx(8000 * math.sin(1.3 * math.atan(0.05 * 1e5 / 10_400)))


@pytest.mark.parametrize("count", [300, 9000])
def test_the_fit_minimises_the_cost_of_method_14(count: int) -> None:
    """Its cost is written out here once more: no curve beside the one that is returned has a lower one."""
    slip = np.linspace(-0.06, 0.08, count)
    prior = AxleCurve(70_000.0, 6500.0, 1.35)
    force = AxleCurve(100_000.0, 5200.0, 1.25).force_n(slip) + 400.0 * np.sin(300 * slip)
    found = fit_axle(slip, force, prior=prior, mass_kg=1500.0, independent=40.0)
    used = slice(None, None, max(1, count // 4000))
    least = 1.1 * float(np.percentile(np.abs(force[used]), 99.5))
    centre = np.array([math.log(70_000.0), math.log(max(6500.0, least)), 1.35])

    def cost(theta: np.ndarray) -> float:
        error = AxleCurve(math.exp(theta[0]), math.exp(theta[1]), theta[2]).force_n(slip[used]) - force[used]
        return 40.0 * np.mean((error / (0.35 * 1500.0)) ** 2) + np.sum(((theta - centre) / [0.25, 0.10, 0.10]) ** 2)

    at = np.array([math.log(found.stiffness_n_per_rad), math.log(found.peak_n), found.shape])
    assert at[1] > math.log(least) and 1.0 < at[2] < 1.9
    for i, sign in ((i, s) for i in range(3) for s in (-1, 1)):
        aside = at.copy()
        aside[i] += sign * 2e-3
        assert cost(aside) > cost(at)


def test_a_peak_stays_above_what_was_seen_and_few_samples_say_nothing() -> None:
    slip = np.linspace(-0.2, 0.2, 2000)
    flat = 6000.0 * np.tanh(slip / 0.02)
    found = fit_axle(slip, flat, prior=AxleCurve(90_000.0, 5000.0, 1.35), mass_kg=1500.0, independent=1e6)
    assert found.peak_n == pytest.approx(6600.0, rel=1e-3)
    assert 1.0 <= found.shape <= 1.9
    prior = AxleCurve(90_000.0, 5000.0, 1.35)
    assert fit_axle(slip[:9], flat[:9], prior=prior, mass_kg=1500.0, independent=9.0) is prior
    assert fit_axle(slip[:10], flat[:10], prior=prior, mass_kg=1500.0, independent=9.0) != prior


# ---- priors ----


def test_a_prior_counts_in_standard_deviations_of_its_own_scale() -> None:
    linear, log = Prior("a", "1", 3.0, 0.5), Prior("b", "1", 3.0, 0.5, log=True)
    assert linear.value(2.0) == 4.0
    assert log.value(2.0) == pytest.approx(3.0 * math.e)
    for prior in (linear, log):
        assert prior.theta(prior.value(-1.7)) == pytest.approx(-1.7)


def test_the_priors_are_those_of_method_14() -> None:
    sensors = Sensors(ay_bias_m_s2=0.03, yaw_rate_bias_rad_s=0.001, ay_std_m_s2=0.2, yaw_rate_std_rad_s=0.005)
    car = CAR.model_copy(update={"sensors": sensors, "steer_offset_rad": 0.002})
    priors = make_priors(NO_SAMPLES, car, 0.0, steering_wheel=True)
    load = {axle: 1440.0 * 9.81 * arm / 2.87 * 0.85 for axle, arm in (("front", 1.71), ("rear", 1.16))}
    tyres = [
        row
        for axle, stiffness in (("front", 110_000.0), ("rear", 95_000.0))
        for row in (
            (f"{axle} cornering stiffness", stiffness, 0.125, True, None),
            (f"{axle} peak force", load[axle], 0.05, True, None),
            (f"{axle} shape", 1.35, 0.05, False, 1.0),
        )
    ]
    expected = [
        *tyres,
        ("yaw inertia", 1523.0, 0.20, True, None),
        ("steering offset", 0.002, math.radians(0.2), False, None),
        ("roll gradient", 0.0105, 0.004, False, None),
        ("a_y bias", 0.03, 0.10, False, None),
        ("yaw rate bias", 0.001, 0.002, False, None),
        ("steering ratio", 16.0, 0.05, True, None),
        ("q v_y", PHY_UKF_Q_STD[1], 0.5, True, None),
        ("q yaw rate", PHY_UKF_Q_STD[2], 0.5, True, None),
        ("r a_y", 1.0, 0.5, True, None),
        ("r yaw rate", 0.005, 0.5, True, None),
    ]
    assert [(p.name, p.log, p.low, p.tuning) for p in priors] == [
        (name, log, low, name[:2] in ("q ", "r ")) for name, _, _, log, low in expected
    ]
    np.testing.assert_allclose([(p.mean, p.std) for p in priors], [row[1:3] for row in expected], rtol=1e-3)
    without = make_priors(NO_SAMPLES, car, 0.0, steering_wheel=False)
    assert [p.name for p in without] == [p.name for p in priors if p.name != "steering ratio"]


def test_no_peak_lies_below_a_force_that_was_seen() -> None:
    slip = np.linspace(-0.1, 0.1, 1000)
    rear = 9000.0 * np.tanh(slip / 0.03)
    samples = AxleSamples(slip, 2000.0 * np.tanh(slip / 0.03), slip, rear)
    by_name = {p.name: p for p in make_priors(samples, CAR, 100.0, steering_wheel=False)}
    least = 1.1 * float(np.percentile(np.abs(rear), 99.5))
    assert by_name["rear peak force"].low == pytest.approx(least)
    assert by_name["rear peak force"].mean >= least * (1 - 1e-6)
    assert by_name["front peak force"].mean > by_name["front peak force"].low
    assert by_name["rear cornering stiffness"].mean > by_name["front cornering stiffness"].mean
    low = identify._low_theta([by_name["rear peak force"], by_name["rear shape"], by_name["yaw inertia"]])
    assert low[0] == pytest.approx(by_name["rear peak force"].theta(least))
    assert low[1] == pytest.approx(max(-6.0, (1.0 - by_name["rear shape"].mean) / 0.05))
    assert low[2] == identify._low_theta([Prior("far", "1", 2.0, 0.1, low=1.0)])[0] == -6.0


def test_the_vehicle_has_the_values_of_the_parameters() -> None:
    priors = make_priors(NO_SAMPLES, CAR, 0.0, steering_wheel=True)
    names = [p.name for p in priors]
    theta = np.linspace(-1.0, 1.0, len(priors))
    value = dict(zip(names, (p.value(t) for p, t in zip(priors, theta, strict=True)), strict=True))
    vehicle, noise = build_vehicle(CAR, priors, theta)
    assert vehicle.yaw_inertia_kg_m2 == value["yaw inertia"]
    assert vehicle.steer_offset_rad == value["steering offset"]
    assert vehicle.steering_ratio == value["steering ratio"]
    assert vehicle.roll_gradient_rad_per_m_s2 == value["roll gradient"]
    assert (vehicle.sensors.ay_bias_m_s2, vehicle.sensors.yaw_rate_bias_rad_s) == (
        value["a_y bias"],
        value["yaw rate bias"],
    )
    assert vehicle.friction == 0.85
    for axle, front in (("front", True), ("rear", False)):
        assert vehicle.cornering_stiffness_n_per_rad(front, 0.85) == pytest.approx(value[f"{axle} cornering stiffness"])
        _, shape, peak, curvature = vehicle.magic_formula(front, 0.85)
        assert (shape, peak, curvature) == pytest.approx((value[f"{axle} shape"], value[f"{axle} peak force"], 0.0))
    assert noise.q_std == (PHY_UKF_Q_STD[0], value["q v_y"], value["q yaw rate"], PHY_UKF_Q_STD[3])
    assert noise.r_std == {"ay_m_s2": value["r a_y"], "yaw_rate_rad_s": value["r yaw rate"], "speed_m_s": 0.08}
    short, _ = build_vehicle(CAR, priors, theta, digits=3)
    assert short.yaw_inertia_kg_m2 == float(f"{value['yaw inertia']:.3g}")
    assert float(f"{short.tyres.front.B:.3g}") == short.tyres.front.B
    fixed = [p for p in priors if p.name != "steering ratio"]
    assert build_vehicle(CAR, fixed, np.zeros(len(fixed)))[0].steering_ratio == 16.0


# ---- the fit ----


def test_the_robust_residual_is_the_error_when_small_and_grows_like_its_root_when_large() -> None:
    found = identify._pseudo_huber(np.array([1e-4, -1e-4, 3.0, -3e6]))
    np.testing.assert_allclose(found[:2], [1e-4, -1e-4], rtol=1e-6)
    assert found[2] == pytest.approx(3.0 * math.sqrt(2.0 * (math.sqrt(2.0) - 1.0)))
    assert found[3] == pytest.approx(-math.sqrt(2.0 * 3.0 * 3e6), rel=1e-3)


def test_errors_are_the_filters_at_20_hz_after_it_has_settled() -> None:
    priors = make_priors(NO_SAMPLES, CAR, 0.0, steering_wheel=False)
    theta = np.zeros(len(priors))
    beta = DRIVE.truth.sideslip_rad.copy()
    beta[510] = np.nan
    steps = replace(DRIVE, truth=replace(DRIVE.truth, sideslip_rad=beta))
    ((error, weight),) = identify._sideslip_errors([steps], CAR, priors, theta)
    vehicle, noise = build_vehicle(CAR, priors, theta)
    track = run_window(physics_ukf_tuned(vehicle, noise), DRIVE.signals)[0]
    expected = (track.sideslip_rad - DRIVE.truth.sideslip_rad)[::5]
    used = np.arange(0, 601, 5) > 300  # 3 s
    used[102] = False
    np.testing.assert_allclose(error[used], expected[used], atol=1e-12)
    assert not error[~used].any()
    # One second of neighbouring samples counts as one.
    np.testing.assert_allclose(weight, np.where(used, math.sqrt(0.05), 0.0))
    coarse = fit_drive(6.0, 0.04)
    ((error, weight),) = identify._sideslip_errors([coarse], CAR, priors, theta)
    assert len(error) == len(coarse.truth)
    assert np.flatnonzero(weight)[0] == 76  # 3.04 s
    assert weight[-1] == pytest.approx(0.2)


def test_signals_are_read_with_the_ratio_offset_and_biases_that_are_tried() -> None:
    sensors = Sensors(ax_bias_m_s2=0.1, ay_bias_m_s2=0.2, yaw_rate_bias_rad_s=0.01)
    tried = CAR.model_copy(update={"steering_ratio": 20.0, "steer_offset_rad": 0.003, "sensors": sensors})
    found = fit_data.signals_of(DRIVE, CAR, tried)
    np.testing.assert_allclose(found.steer_rad, DRIVE.signals.steer_rad * 16.0 / 20.0 - 0.003)
    np.testing.assert_allclose(found.ay_m_s2, DRIVE.signals.ay_m_s2 - 0.2)
    np.testing.assert_allclose(found.yaw_rate_rad_s, DRIVE.signals.yaw_rate_rad_s - 0.01)


def test_a_linear_error_is_minimised_in_closed_form(monkeypatch: pytest.MonkeyPatch) -> None:
    """Bayesian linear regression: a prior of unit normals, each drive with the 1-sigma that it is believed to leave."""
    rng = np.random.default_rng(3)
    priors = [Prior(str(i), "1", 0.0, 1.0) for i in range(4)]
    maps, offsets = rng.normal(size=(2, 30, 4)), rng.normal(size=(2, 30))
    weights = [rng.uniform(0.1, 0.3, 30), np.where(np.arange(30) < 20, 0.2, 0.0)]
    sigma, active, first = np.array([40.0, 60.0]), np.array([True, True, False, True]), np.array([0.0, 0.1, 0.7, 0.0])

    def errors(_drives: Any, start: Any, known: Any, theta: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
        assert start is CAR and known is priors
        return [(m @ theta + o, w) for m, o, w in zip(maps, offsets, weights, strict=True)]

    monkeypatch.setattr(identify, "_sideslip_errors", errors)
    theta, std, rmse = identify._minimise([DRIVE, DRIVE], CAR, priors, first, active, sigma)
    rows = np.concatenate([w[:, None] * m / s for m, w, s in zip(maps, weights, sigma, strict=True)])
    offset = np.concatenate(
        [w * (m @ (first * ~active) + o) / s for m, o, w, s in zip(maps, offsets, weights, sigma, strict=True)]
    )
    normal = rows[:, active].T @ rows[:, active] + np.eye(3)
    np.testing.assert_allclose(theta[active], -np.linalg.solve(normal, rows[:, active].T @ offset), atol=1e-5)
    assert theta[2] == 0.7
    np.testing.assert_allclose(std[active], np.sqrt(np.diag(np.linalg.inv(normal))), rtol=1e-4)
    assert std[2] == 1.0
    left = [m @ theta + o for m, o in zip(maps, offsets, strict=True)]
    np.testing.assert_allclose(rmse, [np.sqrt(np.mean(left[0] ** 2)), np.sqrt(np.sum(left[1] ** 2) / 20)])


def test_a_linear_problem_takes_few_derivatives_and_a_hopeless_one_ends() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(8, 3)), rng.normal(size=8)
    asked: list[int] = []

    def jacobian(_x: np.ndarray) -> np.ndarray:
        asked.append(1)
        return a

    found, jac = identify._projected_levenberg_marquardt(lambda x: a @ x - b, jacobian, np.zeros(3), np.full(3, -9.0))
    np.testing.assert_allclose(found, np.linalg.lstsq(a, b, rcond=None)[0], atol=1e-4)
    assert jac is a
    assert len(asked) <= 4
    tried: list[int] = []

    def constant(_x: np.ndarray) -> np.ndarray:
        tried.append(1)
        return np.ones(8)

    stuck, _ = identify._projected_levenberg_marquardt(constant, lambda _x: a, np.full(3, 0.5), np.full(3, -9.0))
    assert stuck.tolist() == [0.5] * 3
    assert len(tried) == 1 + 6
    # No step is longer than two prior standard deviations.
    walked: list[float] = []
    identify._projected_levenberg_marquardt(
        lambda x: (walked.append(float(x[0])), x - 100.0)[1], lambda _x: np.eye(1), np.zeros(1), np.full(1, -9.0)
    )
    assert max(np.diff(walked)) <= 2.0 and walked[-1] == pytest.approx(30.0)


# ---- from start to end, without the filter ----


def _identification(monkeypatch: pytest.MonkeyPatch, std: dict[str, float], **named: Any) -> tuple[Any, ...]:
    """Run ``fit_car`` with a minimiser that finds θ = 1 for what is active; return the result, its calls and texts."""
    calls: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    told: list[tuple[str, float]] = []

    def minimise(drives: Any, _s: Any, priors: Any, theta: np.ndarray, active: np.ndarray, sigma: np.ndarray) -> Any:
        calls.append((theta, active.copy(), sigma))
        found = np.where(active, 1.0, theta)
        return found, np.array([std.get(p.name, 0.5) for p in priors]), np.full(len(drives), 1e-5)

    monkeypatch.setattr(identify, "_minimise", minimise)
    monkeypatch.setattr(identify, "axle_samples", lambda *_: NO_SAMPLES)

    def score(part: str, drives: Any, start: Any, vehicle: Any, noise: Any, physics: Any) -> PartScore:
        assert start is CAR and noise.q_std and vehicle.tyres.front.B and physics is FITTED
        return PartScore(part, len(drives), 3.0, 2.0, 1.0, 0.5)

    def find(drives: Any, start: Any, *, steering_wheel: bool, parts: Any, progress: Any) -> tuple[Any, FittedPhysics]:
        assert (len(drives), start, steering_wheel, parts) == (1, CAR, named.get("steering_wheel", False), None)
        progress("finding physics", 0.5)
        return FITTED, PHYSICS

    def smoothing(drives: Any, start: Any, physics: Any) -> tuple[float, float]:
        assert (len(drives), start, physics) == (1, CAR, FITTED)
        return 0.5, 2.0

    monkeypatch.setattr(identify, "_score", score)
    monkeypatch.setattr(identify, "find_physics", find)
    monkeypatch.setattr(identify, "fit_smoothing", smoothing)
    found = fit_car(
        [fit_drive(25.0, 0.05)], named.pop("held_out", []), CAR, progress=lambda *x: told.append(x), **named
    )
    return found, calls, told


def test_what_is_not_excited_goes_back_to_its_prior_and_the_rest_is_fitted_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wide = {"yaw inertia": 0.81, "a_y bias": 0.8, "roll gradient": 0.79, "q v_y": 0.99}
    found, calls, told = _identification(monkeypatch, wide, held_out=[DRIVE])
    by_name = {p.name: p for p in found.parameters}
    assert {n for n, p in by_name.items() if not p.excited} == {"yaw inertia", "a_y bias"}  # never the filter's own
    assert by_name["yaw inertia"].value == by_name["yaw inertia"].prior == 1523.0
    assert by_name["roll gradient"].value == pytest.approx(0.0105 + 0.004)
    assert by_name["roll gradient"].low == pytest.approx(0.0105 + 0.004 * (1 - 1.96 * 0.79))
    assert by_name["roll gradient"].high == pytest.approx(0.0105 + 0.004 * (1 + 1.96 * 0.79))
    assert by_name["q v_y"].tuning and not by_name["roll gradient"].tuning
    assert found.vehicle.roll_gradient_rad_per_m_s2 == 0.0145
    tyre = found.vehicle.tyres.front
    assert [float(f"{x:.6g}") for x in (tyre.B, tyre.D_n)] == [tyre.B, tyre.D_n]  # six digits are written
    assert len(calls) == 3
    assert not calls[0][0].any() and calls[0][1].all()
    np.testing.assert_allclose(calls[0][2], math.radians(0.4))
    np.testing.assert_allclose(calls[1][2], math.radians(0.05))  # no less is believed
    assert calls[1][1].all() and (~calls[2][1]).sum() == 2
    assert [(s.part, s.seconds) for s in found.scores] == [("fit", 1), ("held out", 1)]
    fitting = "fitting the filter's sideslip to the ground truth"
    assert told == [
        (fitting, 0.0), (fitting, pytest.approx(0.1)), (fitting, pytest.approx(0.2)), ("finding physics", 0.6),
        ("fitting the smoother's sideslip to the ground truth", 0.9), ("scoring", 0.95),
    ]  # fmt: skip
    assert found.physics == PHYSICS.model_copy(update={"smoothing": (0.5, 2.0)})
    frequency, noise = found.physics_parameters
    assert (frequency.value, frequency.low) == (pytest.approx(9.5), pytest.approx(9.5 - 1.96 * 0.45))
    assert (frequency.excited, noise.excited) == (False, True)  # noise is the filter's: no prior to go back to
    assert found.notes[-1] == "physics has roll, by driving that its fits had not seen"
    given = PHYSICS.model_copy(update={"values": FittedValues(physics=STATIC), "tried": ()})
    assert identify._told(given) == "physics has none of its parts, as asked for, or for want of driving"


def test_an_all_excited_fit_ends_after_two_passes(monkeypatch: pytest.MonkeyPatch) -> None:
    found, calls, told = _identification(monkeypatch, {}, steering_wheel=True)
    assert len(calls) == 2
    assert all(p.excited for p in found.parameters)
    assert "steering ratio" in {p.name for p in found.parameters}
    assert [s.part for s in found.scores] == ["fit"]
    assert told[-1] == ("scoring", 0.95)


def test_twenty_seconds_of_usable_driving_are_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(identify, "axle_samples", lambda *_: pytest.fail("it was taken"))
    with pytest.raises(EstimatorError, match=r"got 19\.9 s"):
        fit_car([fit_drive(9.9, 0.05), fit_drive(9.9, 0.05)], [], CAR)
    monkeypatch.undo()
    assert _identification(monkeypatch, {})[0].notes[0] == "25 s of usable driving in 1 drive"


def test_scores_are_over_all_stamps_of_all_drives() -> None:
    other = fit_drive(4.0)
    identified = CAR.model_copy(update={"steer_offset_rad": 0.002, "steering_ratio": 15.0})
    noise = FilterNoise(q_std=(0.1, 0.2, 0.3), r_std={"ay_m_s2": 0.5})
    strongest = PhysicsFit(
        CAR.model_copy(update={"steer_offset_rad": 0.003, "steering_ratio": 14.0, "physics": PhysicsParts(lag=True)}),
        FilterNoise(q_std=(0.1,) * 6, r_std={"ay_m_s2": 0.4}), (), np.empty(0), np.empty(0), 0.0, 0.0,
    )  # fmt: skip
    score = identify._score("fit", [DRIVE, other], CAR, identified, noise, strongest)

    def rmse(*tracks: Any) -> float:
        errors = [signal_error(t, d.truth, "sideslip_rad", 3.0) for t, d in zip(tracks, (DRIVE, other), strict=True)]
        known = np.concatenate(errors)
        return math.degrees(float(np.sqrt(np.nanmean(known**2))))

    drives = (DRIVE, other)
    assert score.zero_deg == pytest.approx(rmse(*(replace(d.truth, sideslip_rad=0 * d.truth.vx_m_s) for d in drives)))
    assert score.start_file_deg == pytest.approx(rmse(*(run_window(PhysicsUkf(CAR), d.signals)[0] for d in drives)))
    tuned = physics_ukf_tuned(identified, noise)
    seen = [replace(d.signals, steer_rad=d.signals.steer_rad * 16 / 15 - 0.002) for d in drives]
    assert score.identified_deg == pytest.approx(rmse(*(run_window(tuned, s)[0] for s in seen)))
    seen = [replace(d.signals, steer_rad=d.signals.steer_rad * 16 / 14 - 0.003) for d in drives]
    physics = physics_filter(strongest.vehicle, strongest.noise)
    assert score.physics_deg == pytest.approx(rmse(*(run_window(physics, s)[0] for s in seen)))
    assert score.seconds == pytest.approx(10.0)
    rounded = PartScore("fit", 1.23456, 2.00004, 3.00006, 4.123449, 0.12344).to_dict()
    assert rounded == {"seconds": 1.2346, "zero_deg": 2.0, "starting_car_deg": 3.0001, "identified_deg": 4.1234,
                       "physics_deg": 0.1234}  # fmt: skip


def _parameter(name: str = "yaw inertia", **changes: Any) -> Identified:
    values = {"unit": "1", "value": 2.0, "low": 1.5, "high": 2.5, "prior": 2.0, "excited": True, "tuning": False}
    return Identified(name=name, **{**values, **changes})


def test_notes_say_what_the_drives_could_not_tell() -> None:
    plain = identify._notes([_parameter()], [DRIVE, DRIVE], 61.6)
    assert plain == ("62 s of usable driving in 2 drives",)
    gyro = replace(DRIVE, independent_yaw_rate=False)
    parameters = [
        _parameter("kept", excited=False, prior=9.0),
        _parameter("below", prior=1.4),
        _parameter("above", prior=2.6),
        _parameter("at the edge", prior=2.5),
        _parameter("filter", prior=9.0, tuning=True),
    ]
    notes = identify._notes(parameters, [gyro], 20.0)[1:]
    gyro_said = "its bias is known through the sideslip alone"
    assert [n.rpartition(": ")[2] for n in notes] == ["kept", gyro_said, "below, above"]
    assert len(identify._notes(parameters, [gyro, DRIVE], 20.0)) == 3


def test_understeer_is_told_in_degrees_of_road_wheel_angle_per_g() -> None:
    lf, lr, front, rear = 1.16, 1.71, 110_000.0, 95_000.0
    gradient = 1440.0 * (lr * rear - lf * front) / (2.87 * front * rear)
    assert understeer_deg_per_g(CAR) == pytest.approx(math.degrees(gradient) * 9.81, rel=1e-3)


# ---- the command ----

NAMES = [f"{axle} {what}" for axle in ("front", "rear") for what in ("cornering stiffness", "peak force", "shape")]
PARAMETERS = (
    *(_parameter(n, value=5000.4, low=4000.0, high=6000.0, prior=5500.0) for n in NAMES),
    _parameter("yaw inertia", excited=False),
    _parameter("a_y bias", prior=0.0, value=0.05, low=-0.01, high=0.11),
    _parameter("q v_y", tuning=True, low=0.123456, high=1.0),
)
FOUND = Identification(
    CAR.model_copy(update={"yaw_inertia_kg_m2": 1600.0}),
    FilterNoise(q_std=(0.1, 0.2, 0.3)),
    PHYSICS,
    PARAMETERS,
    (),
    (PartScore("fit", 60.0, 3.0, 2.0, 1.0, 0.5), PartScore("held out", 20.0, 3.5, 2.5, 1.5, 0.75)),
    ("a note",),
)


def test_intervals_are_said_in_words_beside_their_entries() -> None:
    said = stage._comments(FOUND)
    interval = "95 %: 4000 to 6000, prior 5500"
    assert said == {
        "yaw_inertia_kg_m2": "kept at its prior: the sideslip shows no more about it",
        "sensors.ay_bias_m_s2": "95 %: -0.01 to 0.11, prior 0",
        "tyres.front.C": interval,
        "tyres.rear.C": interval,
        **{
            f"tyres.{axle}.{entry}": text
            for axle in ("front", "rear")
            for entry, text in (
                ("B", f"cornering stiffness 5000 N/rad, {interval}"),
                ("D_n", f"peak 5000 N at the friction above, {interval}"),
            )
        },
    }
    assert stage.describe(PARAMETERS[-1]) == "95 %: 0.123 to 1"
    assert "the fit to the axle forces" in stage.describe(_parameter("rear shape", excited=False))


def test_the_command_tells_its_progress_and_remembers_what_it_learnt_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "logs"
    folder.mkdir()
    for name in "abc":
        (folder / f"{name}.mcap").write_bytes(b"")
    cut = replace(DRIVE, log_start_ns=int(DRIVE.signals.stamps_ns[0]) - 1_234_567_890)
    made = {"a": (cut, ""), "b": (None, "no true sideslip"), "c": (replace(cut, name="c", steering_wheel=True), "")}
    asked: list[Any] = []

    def load(log: LogInput, car: Car, *_: Any) -> Any:
        one, why = made[log.stem]
        return DriveRecord(log.stem, log.path.name, sha256=f"{'abc'.index(log.stem)}" * 64, left_out=why), one

    def fit(drives: Any, held_out: Any, start: Any, *, steering_wheel: bool, progress: Any) -> Identification:
        asked.append((len(drives), len(held_out), start, steering_wheel))
        progress("fitting", 0.5)
        return FOUND

    monkeypatch.setattr(stage, "load_fit_drive", load)
    monkeypatch.setattr(stage, "fit_car", fit)
    told: list[tuple[str, float]] = []
    warned: list[str] = []
    settings = LearnSettings(config=RunConfig(), stages=("identify",), holdout=0.1)
    result = learn(
        [str(folder)], tmp_path / "car", settings, reporter=Reporter(lambda *x: told.append(x), warned.append)
    )
    shares = {"reading a": 0.0, "reading b": 0.2 / 3, "reading c": 0.4 / 3, "fitting": 0.6, "done": 1.0}
    assert dict(told) == pytest.approx(shares)
    assert warned == [
        "no --car: mass, geometry and priors are those of the default sedan",
        "b is left out: no true sideslip",
    ]
    assert asked == [(2, 0, default_vehicle(), True)]
    car = Car.load(tmp_path / "car")
    # To the hundredth of a second, which is what two slices are compared by.
    assert [(d.name, d.sha256[0], d.start_s, d.end_s) for d in car.learnt_on] == [
        ("made", "0", 1.23, 6.62),
        ("c", "2", 1.23, 6.62),
    ]
    assert car.vehicle.yaw_inertia_kg_m2 == 1600.0
    assert result.to_dict()["exit_code"] == 3
    document = result.figures
    assert document["parameters"][0] == {
        "name": "front cornering stiffness", "unit": "1", "value": 5000.4, "low95": 4000.0, "high95": 6000.0,
        "prior": 5500.0, "excited": True, "noise": False,
    }  # fmt: skip
    assert document["sideslip_rmse_deg"][1] == {
        "part": "held out", "seconds": 20.0, "zero": 3.5, "phy-ukf, starting file": 2.5,
        "phy-ukf:tuned, identified file": 1.5, "physics": 0.75,
    }  # fmt: skip
    assert document["physics"] == PHYSICS.model_dump(mode="json", exclude_none=True)
    assert car.fitted_physics == PHYSICS
    assert dict(car.noise)["physics"] == PHYSICS.noise
    assert (car.physics_vehicle.yaw_inertia_kg_m2, car.physics_vehicle.physics.names) == (1700.0, ("roll",))
    assert document["notes"] == ["a note"]
    made.update(a=(None, "x"), c=(None, "x"))
    with pytest.raises(EstimatorError, match="identify"):
        learn([str(folder)], tmp_path / "other", settings)
    with pytest.raises(UsageError, match="holdout"):
        replace(settings, holdout=0.9)
