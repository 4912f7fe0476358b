"""The physics filter's own promises: gate, standstill, restart, missing channels, divergence, likelihood."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from reference_car import (
    FRICTION,
    REAR_M,
    Drive,
    drive,
    forces,
    keep,
    make_signals,
    rolling_drive,
    runge_kutta,
    slalom,
    tanh_tyre,
    with_noise,
)

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.filter_base import sideslip_std
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.phy_ukf import PhysicsUkf
from pdhef_logtool.estimators.physics_filter import PhysicsFilter
from pdhef_logtool.estimators.table import Options, make_estimator
from pdhef_logtool.records.signals import Signals

VEHICLE = default_vehicle()
UKF = PhysicsUkf(VEHICLE)
#: For speeds that change as no car does: they never reach the gate of innovations otherwise.
WITH_SLIP = PhysicsUkf(VEHICLE, slip_gate=False)
CHANNELS = ("ay_m_s2", "yaw_rate_rad_s", "speed_m_s")
DEGREE = math.radians(1.0)


def posteriors(signals: Signals, estimator: PhysicsUkf = UKF):
    return estimator.run(signals, None)[0]


def edited(signals: Signals, column: str, where, value) -> Signals:
    values = getattr(signals, column).copy()
    values[where] = value
    return replace(signals, **{column: values})


def rejected(steps) -> np.ndarray:
    """Whether a finite innovation of a step was not used."""
    return np.isfinite(steps.innovation).sum(axis=1) > steps.nis_dof


def longest(mask: np.ndarray, stamps_ns: np.ndarray) -> float:
    """Longest time, s, from the first to the last stamp of an unbroken run of ``mask``."""
    best, start = 0.0, None
    for k in range(len(mask)):
        start = (k if start is None else start) if mask[k] else None
        if start is not None:
            best = max(best, (stamps_ns[k] - stamps_ns[start]) * 1e-9)
    return best


@pytest.fixture(scope="module")
def good() -> Drive:
    made = drive(slalom(0.03, 0.5), 8.0)
    return replace(made, signals=with_noise(made.signals, 4))


# --- gate ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [20.0, -40.0])
@pytest.mark.parametrize("column", CHANNELS)
@pytest.mark.slow
def test_a_single_spike_is_as_if_the_sample_were_missing(column, size, good):
    at = 400
    spike = edited(good.signals, column, at, getattr(good.signals, column)[at] + size)
    missing = edited(good.signals, column, at, np.nan)
    a, b = posteriors(spike), posteriors(missing)
    assert rejected(a)[at]
    np.testing.assert_array_equal(a.x, b.x)
    np.testing.assert_array_equal(a.P, b.P)
    assert not np.array_equal(b.x, posteriors(good.signals).x)


@pytest.mark.parametrize("column", CHANNELS)
def test_a_single_spike_after_a_long_step_is_rejected_as_well(column, good):
    """The gate opens after 0.2 s of rejected samples, not after one sample that ends a step of 0.25 s."""
    at = 400
    signals = keep(good.signals, ~((np.arange(len(good.signals)) > at - 25) & (np.arange(len(good.signals)) < at)))
    at -= 24
    spike = edited(signals, column, at, 120.0 if column == "speed_m_s" else 30.0)
    steps = posteriors(spike)
    assert (signals.stamps_ns[at] - signals.stamps_ns[at - 1]) == 250_000_000
    assert rejected(steps)[at]
    np.testing.assert_array_equal(steps.x, posteriors(edited(signals, column, at, np.nan)).x)


@pytest.mark.parametrize(("column", "offset"), [("ay_m_s2", 12.0), ("yaw_rate_rad_s", 0.5), ("speed_m_s", 8.0)])
def test_the_gate_holds_for_a_fifth_of_a_second_and_never_longer(column, offset, good):
    late = good.time_s >= 4.0
    changed = replace(good.signals, **{column: getattr(good.signals, column) + np.where(late, offset, 0.0)})
    steps, undisturbed = posteriors(changed, WITH_SLIP), posteriors(good.signals)
    k = {"ay_m_s2": 0, "yaw_rate_rad_s": 1, "speed_m_s": 2}[column]
    first = 400
    while not np.isfinite(steps.innovation[first, k]):
        first += 1
    held = (steps.stamps_ns >= steps.stamps_ns[first]) & (steps.stamps_ns < steps.stamps_ns[first] + 200_000_000)
    has_sample = np.isfinite(steps.innovation[:, k])
    assert rejected(steps)[held & has_sample].all()
    other = 2 if k != 2 else 1  # a state that the other channels keep right while this one is not believed
    drift = np.abs(steps.x - undisturbed.x)[held]
    assert drift[:, other].max() < 0.2
    assert longest(rejected(steps) | ~has_sample, steps.stamps_ns) <= 0.2 + 0.03
    assert rejected(steps)[late].mean() < 0.98


def test_a_lasting_change_of_speed_is_followed(good):
    """Speed sensor wrong at first: the filter comes over to it within a second instead of locking it out."""
    wrong = edited(good.signals, "speed_m_s", 0, 45.0)
    steps = posteriors(wrong)
    assert abs(steps.x[10, 0] - 45.0) < 2.0
    assert np.abs(steps.x[150:, 0] - good.vx[150:]).max() < 0.5


def test_the_gate_counts_time_and_not_samples(good):
    """A slow speed sensor (4 Hz) is heard from its second contradicting sample on."""
    n = np.arange(len(good.signals))
    slow = np.where(n % 25 == 0, good.vx, np.nan)
    slow[n > 390] += 8.0
    steps = posteriors(replace(good.signals, speed_m_s=slow), WITH_SLIP)
    assert rejected(steps)[400]
    assert not rejected(steps)[425]
    assert abs(steps.x[426, 0] - slow[425]) < abs(steps.x[424, 0] - slow[425]) / 4


def test_a_gate_that_opened_closes_again(good):
    late = (good.time_s >= 4.0) & (good.time_s < 4.5)
    changed = replace(good.signals, speed_m_s=good.signals.speed_m_s + np.where(late, 8.0, 0.0))
    steps = posteriors(changed, WITH_SLIP)
    assert not rejected(steps)[600:].any()
    at = 700
    assert rejected(posteriors(edited(changed, "speed_m_s", at, 90.0), WITH_SLIP))[at]


def test_the_gate_holds_anew_after_it_opened(good):
    """Opening lets one sample in; the next one that contradicts has to last for 0.2 s again."""
    changed = replace(good.signals, speed_m_s=good.signals.speed_m_s + np.where(good.time_s >= 4.0, 8.0, 0.0))
    steps = posteriors(changed, WITH_SLIP)
    opened = 400 + int(np.argmax(~rejected(steps)[400:] & np.isfinite(steps.innovation[400:, 2])))
    assert opened > 415
    worse = edited(changed, "speed_m_s", opened + 2, 90.0)
    assert rejected(posteriors(worse, WITH_SLIP))[opened + 2]


# --- standstill ------------------------------------------------------------------------------------------------------


def stop_and_go(steer: float = 0.15) -> Drive:
    """Drive at 6 m/s, stand from 5 to 9 s with the wheels turned, drive on."""

    def speed(t):
        return np.clip(6.0 - 2.0 * np.clip(t - 2.0, 0, None), 0.0, None) + np.clip(1.5 * (t - 9.0), 0.0, 6.0)

    return rolling_drive(speed, lambda t: np.full_like(t, steer), 14.0)


def still_noise(signals: Signals, still: np.ndarray) -> Signals:
    noisy = with_noise(signals, 8)
    wheels = np.where(still & np.isfinite(noisy.speed_m_s), 0.0, noisy.speed_m_s)  # wheel pulses: exactly zero
    return replace(noisy, speed_m_s=wheels)


@pytest.mark.parametrize("bias", [0.0, 0.02])
def test_standstill_holds_and_lets_go(bias):
    made = stop_and_go()
    still = (made.time_s >= 5.0) & (made.time_s <= 9.0)
    signals = still_noise(made.signals, still)
    signals = replace(signals, yaw_rate_rad_s=signals.yaw_rate_rad_s + bias)
    steps = posteriors(signals)
    standing = (made.time_s > 5.45) & (made.time_s <= 9.0)
    assert (steps.x[standing, :3] == 0.0).all()
    assert (steps.x[(made.time_s > 2) & (made.time_s < 4.9), 0] > 0.05).all()
    going = made.time_s > 9.5
    assert np.abs(steps.x[going, 0] - made.vx[going]).max() < 0.3
    assert np.abs(steps.x[going, 2] - made.r[going]).max() < 0.05 + bias
    assert (np.linalg.eigvalsh(steps.P) > 0).all()
    assert steps.valid.all()


@pytest.mark.parametrize("maker", [PhysicsUkf, PhysicsFilter])
@pytest.mark.slow
def test_standstill_can_be_switched_off(maker):
    made = stop_and_go()
    still = (made.time_s >= 5.0) & (made.time_s <= 9.0)
    signals = still_noise(made.signals, still)
    standing = (made.time_s > 5.45) & (made.time_s <= 9.0)
    assert (posteriors(signals, maker(VEHICLE)).x[standing, :3] == 0.0).all()
    assert (posteriors(signals, maker(VEHICLE, standstill=False)).x[standing, 2] != 0.0).all()


def test_standstill_learns_the_bias_of_the_accelerometer():
    made = stop_and_go()
    still = (made.time_s >= 5.0) & (made.time_s <= 9.0)
    signals = still_noise(made.signals, still)
    signals = replace(signals, ax_m_s2=signals.ax_m_s2 + 0.5)  # 3 degrees of grade
    steps = posteriors(signals)
    assert steps.x[850, 3] == pytest.approx(0.5, abs=0.15)


@pytest.mark.parametrize("steer", [0.0, 0.15])
def test_standstill_ends_when_the_speed_sensor_falls_silent(steer):
    """Without a speed sample a car that drives off is not held in place, be it straight on or in a bend."""
    made = stop_and_go(steer)
    still = (made.time_s >= 5.0) & (made.time_s <= 9.0)
    signals = still_noise(made.signals, still)
    signals = edited(signals, "speed_m_s", made.time_s > 7.0, np.nan)
    steps = posteriors(signals)
    assert np.abs(steps.x[-1, 0] - made.vx[-1]) < 2.0
    assert np.abs(steps.x[-1, 2] - made.r[-1]) < 0.1


def test_a_turning_car_does_not_stand():
    """A speed sensor that reads zero while the car yaws is broken: the state is not nailed down."""
    made = drive(lambda _: 0.02, 6.0)
    signals = edited(made.signals, "speed_m_s", made.time_s > 3, 0.0)
    steps = posteriors(signals)
    assert (np.abs(steps.x[350:, 2]) > 0.05).all()


# --- gaps and missing channels ---------------------------------------------------------------------------------------


def test_it_starts_anew_behind_a_gap_and_converges():
    made = drive(slalom(0.03, 0.5), 12.0)
    mask = (made.time_s < 4.0) | (made.time_s > 4.8)
    whole, broken = posteriors(made.signals), posteriors(keep(made.signals, mask))
    restarted = int(np.argmax(mask & (made.time_s > 4.5))) - int((~mask).sum())
    assert broken.x[restarted, 0] == made.vx[mask][restarted]  # the first speed sample as it is
    assert broken.x[restarted, 1] == pytest.approx(REAR_M * made.r[mask][restarted], abs=1e-12)
    beta = [np.arctan2(s.x[:, 1], s.x[:, 0]) for s in (whole, broken)]
    late = made.time_s > 4.8 + 5.0
    difference = np.abs(beta[0][late] - beta[1][late[mask]])
    assert difference.max() < 0.01 * DEGREE
    assert np.abs(beta[0] - made.sideslip)[late].max() < 0.01 * DEGREE


def test_a_short_gap_is_filtered_through():
    made = drive(lambda _: 0.02, 8.0)
    mask = (made.time_s < 4.0) | (made.time_s > 4.45)
    steps = posteriors(keep(made.signals, mask))
    after = made.time_s[mask] > 4.45
    beta = np.arctan2(steps.x[:, 1], steps.x[:, 0])
    # one step of 0.46 s: the process noise that it adds makes the update coarse, yet the filter does not restart
    assert np.abs(beta - made.sideslip[mask])[after].max() < 0.1 * DEGREE
    assert np.abs(beta - made.sideslip[mask])[made.time_s[mask] > 5].max() < 0.01 * DEGREE


def test_nothing_is_claimed_before_speed_and_steering_are_known(good):
    signals = edited(good.signals, "speed_m_s", good.time_s < 1.0, np.nan)
    signals = edited(signals, "steer_rad", good.time_s < 2.0, np.nan)
    track, _ = run_window(UKF, signals)
    assert not track.valid[good.time_s < 1.999].any()
    assert track.valid[good.time_s > 2.02].all()


def test_steering_is_held_for_a_fifth_of_a_second(good):
    signals = edited(good.signals, "steer_rad", (good.time_s > 3.0) & (good.time_s < 3.5), np.nan)
    steps = posteriors(signals)
    held = (good.time_s > 3.0) & (good.time_s < 3.195)
    lost = (good.time_s > 3.215) & (good.time_s < 3.495)
    assert steps.valid[held].all()
    assert not steps.valid[lost].any()
    assert steps.valid[good.time_s > 3.505].all()
    last = good.signals.steer_rad[int(np.argmax(good.time_s > 3.0)) - 1]
    assert (steps.inputs[held, 0] == last).all()


def test_without_longitudinal_acceleration_the_speed_follows_its_sensor():
    made = drive(slalom(0.02, 0.5), 10.0, acceleration=lambda t: 3.0 * np.sin(t))
    signals = replace(with_noise(made.signals, 3), ax_m_s2=np.full(len(made.signals), np.nan))
    steps = posteriors(signals)
    settled = made.time_s > 1.0
    assert steps.valid.all()
    assert np.abs(steps.x[settled, 0] - made.vx[settled]).max() < 0.6
    error = np.arctan2(steps.x[:, 1], steps.x[:, 0]) - made.sideslip
    assert np.abs(error[settled]).max() < 0.3 * DEGREE


def test_the_random_walk_covers_exactly_the_steps_without_acceleration(good):
    """An interval is driven by the samples at its ends: it is a random walk where neither is there."""
    at = 301
    signals = edited(good.signals, "speed_m_s", slice(at - 1, at + 4), np.nan)
    one = posteriors(edited(signals, "ax_m_s2", at, np.nan))
    a, b = posteriors(edited(signals, "ax_m_s2", slice(at, at + 2), np.nan)), posteriors(signals)
    np.testing.assert_allclose(one.P[at + 2], b.P[at + 2], rtol=1e-3, atol=1e-9)
    assert a.P[at, 0, 0] == pytest.approx(b.P[at, 0, 0], rel=1e-3)
    grown = a.P[at + 1, 0, 0] - b.P[at + 1, 0, 0]
    assert grown == pytest.approx((3.0**2 - UKF.q_std[0] ** 2) * 0.01, rel=0.2)
    assert a.P[at + 2, 0, 0] - b.P[at + 2, 0, 0] == pytest.approx(grown, rel=0.2)


def test_a_prediction_without_acceleration_is_as_uncertain_as_its_random_walk(good):
    late = replace(good.signals, ready_ns=good.signals.stamps_ns + 100_000_000)
    blind, _ = run_window(UKF, replace(late, ax_m_s2=np.full(len(late), np.nan)), None)
    now, _ = run_window(UKF, replace(good.signals, ax_m_s2=np.full(len(late), np.nan)), None)
    at = 500
    assert blind.vx_std_m_s[at] ** 2 - now.vx_std_m_s[at - 10] ** 2 == pytest.approx(3.0**2 * 0.1, rel=0.1)


def test_esp_suite_ignores_the_speed_after_the_start(good):
    esp = make_estimator("phy-ukf", Car.of(VEHICLE), Options(use_speed=False))
    garbled = edited(good.signals, "speed_m_s", slice(1, None), 3.0)
    a, b = run_window(esp, good.signals)[0], run_window(esp, garbled)[0]
    np.testing.assert_array_equal(a.vx_m_s, b.vx_m_s)
    np.testing.assert_array_equal(a.covariance, b.covariance)
    assert a.valid.all()
    other_start = edited(good.signals, "speed_m_s", 0, 20.0)
    assert abs(run_window(esp, other_start)[0].vx_m_s[5] - 20.0) < 0.5
    assert np.abs(a.vx_m_s - good.vx).max() < 3.0
    full, _ = run_window(make_estimator("phy-ukf", Car.of(VEHICLE)), good.signals)
    assert a.vx_std_m_s[-1] > 3 * full.vx_std_m_s[-1]


def test_friction_comes_from_the_log_where_it_is_known():
    made = drive(slalom(0.03, 0.5), 6.0, mu=0.4)
    known = replace(made.signals, friction=np.full(len(made.signals), 0.4))
    settled = made.time_s > 1

    def error(signals):
        steps = posteriors(signals)
        return np.abs(np.arctan2(steps.x[:, 1], steps.x[:, 0]) - made.sideslip)[settled].max()

    assert error(known) < 0.02 * DEGREE
    assert error(made.signals) > 10 * error(known)
    sparse = edited(known, "friction", np.arange(len(known)) % 100 != 0, np.nan)  # the last value is kept
    assert error(sparse) < 0.02 * DEGREE
    assert (run_window(UKF, sparse)[0].friction[1:] == 0.4).all()
    assert (run_window(UKF, made.signals)[0].friction == FRICTION).all()


# --- divergence and consistency --------------------------------------------------------------------------------------


@pytest.mark.parametrize("amplitude", [0.0, 0.03, 0.05])
def test_a_good_drive_is_not_flagged(amplitude):
    made = drive(slalom(amplitude, 0.5), 10.0, tyre=tanh_tyre)
    track, _ = run_window(UKF, with_noise(made.signals, 6), None)
    assert not track.diverged.any()


@pytest.mark.parametrize("column", ["steer_rad", "yaw_rate_rad_s"])
def test_a_hopelessly_wrong_model_is_flagged(column):
    made = drive(slalom(0.05, 0.5), 10.0)
    signals = with_noise(made.signals, 6)
    track, _ = run_window(UKF, replace(signals, **{column: -getattr(signals, column)}), None)
    assert track.diverged[300:].mean() > 0.6


def test_the_flag_goes_when_the_fault_has_gone():
    made = drive(slalom(0.05, 0.5), 20.0)
    signals = with_noise(made.signals, 6)
    faulty = replace(signals, steer_rad=np.where(made.time_s < 5, -1, 1) * signals.steer_rad)
    track, _ = run_window(UKF, faulty)
    assert track.diverged[made.time_s < 5].any()
    assert not track.diverged[made.time_s > 12].any()


def test_one_spike_is_no_divergence(good):
    spike = edited(good.signals, "yaw_rate_rad_s", 400, 40.0)
    assert not run_window(UKF, spike)[0].diverged.any()


def simulate_from_the_filters_own_model(q_std, r_std, seconds, seed):
    """Draw a drive with the process noise that the filter assumes: exactly its own statistical model."""
    rng = np.random.default_rng(seed)
    n, dt = round(seconds * 100), 0.01
    state, bias = np.array([22.0, 0.0, 0.0]), 0.0
    rows = np.empty((n, 5))
    for k in range(n):
        steer = 0.02 * math.sin(0.02 * k)
        ax = -state[1] * state[2] + 0.2 * (22.0 - state[0])
        ay, _ = forces(*state, steer, FRICTION)
        z = np.array([ay, state[2], state[0]]) + r_std * rng.standard_normal(3)
        rows[k] = steer, ax + bias, *z
        noise = np.array(q_std) * math.sqrt(dt) * rng.standard_normal(4)
        state = runge_kutta(state, steer, ax, FRICTION, dt) + noise[:3]
        bias += noise[3]
    names = ("steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s")
    return make_signals(np.full(n - 1, dt), **dict(zip(names, rows.T, strict=True)))


def innovation_log_likelihood(estimator: PhysicsUkf, signals: Signals) -> tuple[float, int]:
    """Return the Gaussian log-likelihood of all innovations of a drive and how many scalar innovations it sums.

    A sample beyond the gate counts with the likelihood at the gate: a filter has no benefit from rejecting samples, and
    no single outlier decides.
    """
    steps, _ = estimator.run(signals, None)
    return float(steps.log_likelihood.sum()), int(np.isfinite(steps.innovation).sum())


def test_innovation_likelihood_peaks_at_the_true_process_noise():
    q, r = np.array([0.1, 0.2, 0.1, 0.05]), np.array([0.12, 0.004, 0.08])
    signals = simulate_from_the_filters_own_model(q, r, 25.0, seed=1)
    scales = 2.0 ** np.arange(-4, 5)
    for only in (slice(0, 4), slice(1, 2), slice(2, 3)):

        def likelihood(scale, part=only):
            tried = q.copy()
            tried[part] *= scale
            return innovation_log_likelihood(PhysicsUkf(VEHICLE, tuple(tried), tuple(r)), signals)[0]

        best = scales[np.argmax([likelihood(s) for s in scales])]
        assert 0.5 <= best <= 2.0
    total, count = innovation_log_likelihood(PhysicsUkf(VEHICLE, tuple(q), tuple(r)), signals)
    assert count == 3 * (len(signals) - 1)
    assert math.isfinite(total)


def test_rejecting_a_sample_gains_nothing(good):
    """Beyond the gate an innovation counts as one at the gate, however far it is; none is left out of the count."""
    at = 400

    def likelihood(column, size):
        return innovation_log_likelihood(UKF, edited(good.signals, column, at, size))

    for column in CHANNELS:
        normal, count = innovation_log_likelihood(UKF, good.signals)
        far, farther = likelihood(column, 42.0), likelihood(column, 49.0)
        assert far[1] == farther[1] == count
        assert far[0] == pytest.approx(farther[0], abs=1e-9)
        assert normal - far[0] > 10.0
    # one channel alone: the density at six standard deviations is known
    alone = good.signals
    for column in ("ay_m_s2", "speed_m_s"):
        alone = edited(alone, column, slice(at - 1, at + 1), np.nan)
    spike = posteriors(edited(alone, "yaw_rate_rad_s", at, 40.0))
    normal = posteriors(alone)
    variance = normal.innovation[at, 1] ** 2 / normal.nis[at]
    assert spike.log_likelihood[at] == pytest.approx(-18.0 - 0.5 * math.log(2 * math.pi * variance), rel=1e-9)


def test_innovations_are_consistent_when_the_model_is_right():
    """NIS of the matched filter is chi-square: its mean is its degrees of freedom; NEES covers all states."""
    q, r = np.array([0.1, 0.2, 0.1, 0.05]), np.array([0.12, 0.004, 0.08])
    signals = simulate_from_the_filters_own_model(q, r, 25.0, seed=2)
    steps = posteriors(signals, PhysicsUkf(VEHICLE, tuple(q), tuple(r)))
    ratio = steps.nis[100:] / steps.nis_dof[100:]
    assert ratio.mean() == pytest.approx(1.0, abs=0.06)
    assert not rejected(steps).any()


def test_sideslip_std_is_the_first_order_band():
    """Compare with finite differences of atan2, for a covariance with a significant correlation."""
    vx, vy = np.array([12.0, 9.0]), np.array([4.0, -6.0])
    covariance = np.array([[[0.5, 0.4, 0], [0.4, 0.6, 0], [0, 0, 1]], [[0.5, -0.3, 0], [-0.3, 0.2, 0], [0, 0, 1]]])
    h = 1e-6
    gradient = np.stack(
        [
            (np.arctan2(vy, vx + h) - np.arctan2(vy, vx - h)) / (2 * h),
            (np.arctan2(vy + h, vx) - np.arctan2(vy - h, vx)) / (2 * h),
        ],
        axis=1,
    )
    want = np.sqrt(np.einsum("ki,kij,kj->k", gradient, covariance[:, :2, :2], gradient))
    np.testing.assert_allclose(sideslip_std(vx, vy, covariance), want, rtol=1e-6)


def test_sideslip_band_is_the_delta_method_of_its_covariance(good):
    track, _ = run_window(UKF, good.signals)
    rng = np.random.default_rng(0)
    for k in (300, 555):
        draws = rng.multivariate_normal([track.vx_m_s[k], track.vy_m_s[k]], track.covariance[k, :2, :2], 40_000)
        assert track.sideslip_std_rad[k] == pytest.approx(np.arctan2(draws[:, 1], draws[:, 0]).std(), rel=0.03)
