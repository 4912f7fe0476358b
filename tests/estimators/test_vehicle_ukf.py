"""The vehicle filter: equal to filterpy on the same models; gate, standstill, gaps, divergence and likelihood."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import reference_car as car
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from physics_oracle import ALL_PARTS, G, Oracle, parts, vehicle
from reference_car import drive, rolling_drive, slalom, with_noise
from scipy.stats import multivariate_normal

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.nominal_model import model_parameters
from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators import stepwise, vehicle_ukf
from pdhef_logtool.estimators.filter_steps import U_SPEED, PosteriorSteps
from pdhef_logtool.estimators.kinematic import Kinematic
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.open_loop import OpenLoop
from pdhef_logtool.estimators.speed_slip import TIMEOUT_S, believable
from pdhef_logtool.estimators.table import Options, make_estimator
from pdhef_logtool.estimators.vehicle_model import LANES, PLACES, WIDTH, HeldInputs, advance, physics_parameters
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf, nominal_filter
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import Signals

VEHICLE = default_vehicle()
UKF = nominal_filter(VEHICLE)
#: The drives of reference_car.py have no roll.
PHYSICS = VehicleUkf(vehicle(roll_gradient_rad_per_m_s2=0.0))
CHANNELS = ("ay_m_s2", "yaw_rate_rad_s", "speed_m_s")
DEGREE = math.radians(1.0)
models = pytest.mark.parametrize("estimator", [UKF, PHYSICS], ids=["nominal", "forces"])


def posteriors(signals: Signals, estimator: VehicleUkf = UKF) -> PosteriorSteps:
    return estimator.run(signals, None)[0]


def edited(signals: Signals, column: str, where, value) -> Signals:
    values = getattr(signals, column).copy()
    values[where] = value
    return replace(signals, **{column: values})


def rejected(steps) -> np.ndarray:
    """Whether a finite innovation of a step was not used."""
    return np.isfinite(steps.innovation).sum(axis=1) > steps.nis_dof


# --- filterpy --------------------------------------------------------------------------------------------------------

#: Moves a state by dt s: state, that of the first sigma point, dt, inputs (steer, a_x, friction).
Motion = Callable[[np.ndarray, np.ndarray, float, list[float]], np.ndarray]
#: The reading of the accelerometer in a state, with steering angle and friction.
Sensor = Callable[[np.ndarray, float, float], float]


def nominal_models() -> tuple[VehicleUkf, Motion, Sensor]:
    def motion(x, _, dt, u):
        steer, ax, mu = u
        return np.append(car.runge_kutta(x[:3], steer, ax - x[3], mu, dt), x[3])

    return UKF, motion, lambda x, steer, mu: car.forces(x[0], x[1], x[2], steer, mu)[0]


def force_models(*names: str) -> tuple[VehicleUkf, Motion, Sensor]:
    """Motion is the compiled model of test_vehicle_model.py; its steps depend on the speed of the first sigma point."""
    oracle = Oracle(parts(*names), imu=(0.4, -0.2))
    estimator = VehicleUkf(oracle.as_vehicle())
    layout, p, f = estimator.layout, model_parameters(estimator.vehicle), physics_parameters(estimator.vehicle)

    def motion(x, first, dt, u):
        block = np.zeros((PLACES, WIDTH))
        block[layout.places] = first[:, None]
        block[layout.places, 1] = x
        advance(block.ravel(), LANES, HeldInputs(*u[:2], True, u[2]), dt, layout, p, f)
        return block[layout.places, 1]

    return estimator, motion, lambda x, steer, _: oracle.sensed_ay(x, steer)


def filterpy_run(signals, estimator, motion, sensor, residual_rate, extra_r):
    """Return the columns of LinkedSteps by filterpy.

    An entry without variance is no state of filterpy. Its two sigma points are at the first one, to which κ gives their
    weights.
    """
    layout, tuning = estimator.layout, estimator.tuning
    start = posteriors(signals, estimator).x[0]
    free = np.flatnonzero(tuning.initial_std)
    scale_of = lambda x: 1.0 + x[layout.force_scale] if layout.force_scale >= 0 else 1.0  # noqa: E731
    lean = 1.0 if layout.roll >= 0 or layout.forces < 0 else 1.0 + G * estimator.vehicle.roll_gradient_rad_per_m_s2
    moved = []

    def whole(x):
        full = np.zeros(layout.size)
        full[free] = x
        return full

    def fx(x, dt, u, rate):
        x, half = whole(x), 0.5 * dt * rate
        x[1:3] += half * scale_of(x)
        x = motion(x, whole(ukf.x), dt, u)
        x[1:3] += half * scale_of(x)
        moved.append(x[free])
        return x[free]

    def hx(x, steer, mu, rate, use):
        x = whole(x)
        ay = sensor(x, steer, mu) + lean * scale_of(x) * rate[0]
        return np.array([ay, x[2] + (x[-1] if layout.sensor_bias >= 0 else 0.0), x[0]])[use]

    points = MerweScaledSigmaPoints(len(free), alpha=1.0, beta=2.0, kappa=layout.size - len(free))
    ukf = UnscentedKalmanFilter(len(free), 3, 0.01, hx, fx, points)
    ukf.x, ukf.P = start[free], np.diag(tuning.initial_std[free] ** 2)
    rows = {name: [] for name in ("x", "P", "nis", "log_likelihood", "prior", "predicted_P", "cross")}
    for k in range(1, len(signals)):
        dt = (signals.stamps_ns[k] - signals.stamps_ns[k - 1]) * 1e-9
        q = tuning.q_std**2 * dt
        if layout.bank >= 0:
            q[layout.bank] += 0.02**2 * (1.0 - math.exp(-2.0 * dt / 5.0))
        if layout.force_scale >= 0:
            q[layout.force_scale] += 0.05**2 * (1.0 - math.exp(-2.0 * dt / 2.0))
        ukf.Q = np.diag(q[free])
        before, rate = points.sigma_points(ukf.x, ukf.P) - ukf.x, residual_rate[k - 1]
        moved.clear()
        inputs = (signals.steer_rad, signals.ax_m_s2, signals.friction)
        ukf.predict(dt=dt, u=[0.5 * (c[k - 1] + c[k]) for c in inputs], rate=rate)
        rows["prior"].append(ukf.x.copy())
        rows["predicted_P"].append(ukf.P.copy())
        rows["cross"].append(before.T @ np.diag(points.Wc) @ (np.array(moved) - ukf.x))
        z = np.array([getattr(signals, c)[k] for c in CHANNELS])
        use = np.isfinite(z)
        nis, log_likelihood = np.nan, 0.0
        if use.any():
            R = np.diag((estimator.measurement_std**2 + [*extra_r[k], 0.0])[use])
            ukf.update(z[use], R=R, steer=signals.steer_rad[k], mu=signals.friction[k], rate=rate, use=use)
            nis = ukf.y @ np.linalg.solve(ukf.S, ukf.y)
            log_likelihood = multivariate_normal(cov=ukf.S).logpdf(ukf.y)
        for name, value in (("x", ukf.x), ("P", ukf.P), ("nis", nis), ("log_likelihood", log_likelihood)):
            rows[name].append(np.copy(value))
    return {name: np.array(values) for name, values in rows.items()}, free


@pytest.fixture(scope="module")
def irregular():
    """Drive to 0.6 g on irregular stamps, with missing samples and a change of friction."""
    rng = np.random.default_rng(7)
    dt = rng.uniform(0.002, 0.03, 400)
    made = car.drive(lambda t: 0.045 * np.sin(2.4 * t), speed=24.0, step_s=dt, acceleration=lambda t: np.cos(0.7 * t))
    s = car.with_noise(made.signals, seed=3)
    s.ay_m_s2[rng.random(len(s)) < 0.1] = np.nan
    s.yaw_rate_rad_s[1:][rng.random(len(s) - 1) < 0.1] = np.nan
    s.ay_m_s2[77::50] = s.yaw_rate_rad_s[77::50] = np.nan
    s.friction[:] = np.where(np.arange(len(s)) < 300, 0.85, 0.78)
    assert np.isnan([getattr(s, c) for c in CHANNELS]).all(axis=0).any(), "a step must have no measurement at all"
    return s


@pytest.mark.slow
@pytest.mark.parametrize(
    "made",
    [nominal_models(), *(force_models(*names) for names in ((), ("lag",), ("lag", "roll", "biases"), ALL_PARTS))],
    ids=["nominal", "forces", "lag", "lag+roll+biases", "all parts"],
)
def test_it_is_the_unscented_kalman_filter_of_filterpy(made, irregular):
    """Also with a residual in the sigma points (Eq 19), and with more variance of a_y and yaw rate at times."""
    estimator, motion, sensor = made
    t = (irregular.stamps_ns - irregular.stamps_ns[0]) * 1e-9
    rate = np.column_stack([0.3 * np.sin(t), 0.1 * np.cos(3.0 * t)])
    extra_r = np.where(t[:, None] < 4.0, 0.0, [0.1, 1e-4])
    links, _ = estimator.linked_steps(irregular, None, rate, extra_r)
    steps = links.posterior
    turning = irregular.yaw_rate_rad_s[0] * np.array([car.REAR_M, 1])
    assert steps.x[0, :3] == pytest.approx([irregular.speed_m_s[0], *turning])
    want, free = filterpy_run(irregular, estimator, motion, sensor, rate, extra_r)
    assert np.nanmax(want["nis"]) < 36.0, "the drive must stay inside the gate, which filterpy does not have"
    assert np.ptp(want["x"][:, 1]) > 0.5, "the drive must excite the lateral motion"

    sd = np.sqrt(np.einsum("kii->ki", want["P"]))
    assert (np.abs(steps.x[1:, free] - want["x"]) / sd).max() < 1e-9
    assert (np.abs(steps.prior[1:, free] - want["prior"]) / sd).max() < 1e-9
    for matrix, reference in ((steps.P, "P"), (links.predicted_P, "predicted_P"), (links.cross, "cross")):
        difference = matrix[1:][:, free[:, None], free] - want[reference]
        assert np.abs(difference / (sd[:, :, None] * sd[:, None])).max() < 1e-9
        assert not np.delete(matrix, free, axis=1)[1:].any(), "an entry without variance stays known"
    np.testing.assert_allclose(steps.nis[1:], want["nis"], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(steps.log_likelihood[1:], want["log_likelihood"], rtol=1e-8, atol=1e-8)
    np.testing.assert_array_equal(links.linked, np.arange(len(irregular)) > 0)


@pytest.fixture(scope="module")
def good():
    made = car.drive(car.slalom(0.03, 0.5), 8.0)
    return replace(made, signals=car.with_noise(made.signals, 4))


# --- gate ------------------------------------------------------------------------------------------------------------


@models
@pytest.mark.parametrize("column", CHANNELS)
def test_a_single_spike_is_as_if_the_sample_were_missing(column, estimator, good):
    at = 400
    spike = edited(good.signals, column, at, getattr(good.signals, column)[at] - 40.0)
    missing = edited(good.signals, column, at, np.nan)
    a, b = posteriors(spike, estimator), posteriors(missing, estimator)
    assert rejected(a)[at]
    np.testing.assert_array_equal(a.x, b.x)
    np.testing.assert_array_equal(a.P, b.P)
    assert not np.array_equal(b.x, posteriors(good.signals, estimator).x)


@pytest.mark.parametrize(("column", "offset"), [("ay_m_s2", 12.0), ("yaw_rate_rad_s", 0.5), ("speed_m_s", 8.0)])
def test_the_gate_holds_for_a_fifth_of_a_second_and_never_longer(column, offset, good, monkeypatch):
    # The check of wheel slip would remove speeds that change as no car's do.
    monkeypatch.setattr(vehicle_ukf, "believable", lambda signals, _sensors, memory: (signals, memory))
    late = good.time_s >= 4.0
    changed = replace(good.signals, **{column: getattr(good.signals, column) + np.where(late, offset, 0.0)})
    steps, undisturbed = posteriors(changed), posteriors(good.signals)
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
    assert np.diff(steps.stamps_ns[has_sample & ~rejected(steps)]).max() <= 0.25e9
    assert rejected(steps)[late].mean() < 0.98


# --- standstill ------------------------------------------------------------------------------------------------------


def stop_and_go(steer: float = 0.15) -> car.Drive:
    """Drive at 6 m/s, stand from 5 to 9 s with the wheels turned, drive on."""

    def speed(t):
        return np.clip(6.0 - 2.0 * np.clip(t - 2.0, 0, None), 0.0, None) + np.clip(1.5 * (t - 9.0), 0.0, 6.0)

    return car.rolling_drive(speed, lambda t: np.full_like(t, steer), 14.0)


def still_noise(signals: Signals, still: np.ndarray) -> Signals:
    noisy = car.with_noise(signals, 8)
    wheels = np.where(still & np.isfinite(noisy.speed_m_s), 0.0, noisy.speed_m_s)  # wheel pulses: exactly zero
    return replace(noisy, speed_m_s=wheels)


@models
@pytest.mark.parametrize("bias", [0.0, 0.02])
def test_standstill_holds_and_lets_go(bias, estimator):
    made = stop_and_go()
    signals = still_noise(made.signals, (made.time_s >= 5.0) & (made.time_s <= 9.0))
    signals = replace(signals, yaw_rate_rad_s=signals.yaw_rate_rad_s + bias)
    steps = posteriors(signals, estimator)
    standing, going = (made.time_s > 5.45) & (made.time_s <= 9.0), made.time_s > 9.5
    assert (steps.x[standing, :3] == 0.0).all()
    assert (steps.x[(made.time_s > 2) & (made.time_s < 4.9), 0] > 0.05).all()
    assert np.abs(steps.x[going, 0] - made.vx[going]).max() < 0.3
    assert np.abs(steps.x[going, 2] - made.r[going]).max() < 0.05 + bias
    assert steps.valid.all()


# --- gaps and missing channels ---------------------------------------------------------------------------------------


def test_esp_suite_ignores_the_speed_after_the_start(good):
    esp = make_estimator("phy-ukf", Car(VEHICLE), Options(use_speed=False))
    garbled = edited(good.signals, "speed_m_s", slice(1, None), 3.0)
    a, b = run_estimator(esp, good.signals), run_estimator(esp, garbled)
    np.testing.assert_array_equal(a.vx_m_s, b.vx_m_s)
    np.testing.assert_array_equal(a.covariance, b.covariance)
    assert a.valid.all()
    other_start = edited(good.signals, "speed_m_s", 0, 20.0)
    assert abs(run_estimator(esp, other_start).vx_m_s[5] - 20.0) < 0.5
    assert np.abs(a.vx_m_s - good.vx).max() < 3.0
    full = run_estimator(make_estimator("phy-ukf", Car(VEHICLE)), good.signals)
    assert a.vx_std_m_s[-1] > 3 * full.vx_std_m_s[-1]


def test_friction_comes_from_the_log_where_it_is_known():
    made = car.drive(car.slalom(0.03, 0.5), 6.0, mu=0.4)
    known = replace(made.signals, friction=np.full(len(made.signals), 0.4))
    settled = made.time_s > 1

    def error(signals):
        steps = posteriors(signals)
        return np.abs(np.arctan2(steps.x[:, 1], steps.x[:, 0]) - made.sideslip)[settled].max()

    assert error(known) < 0.02 * DEGREE
    assert error(made.signals) > 10 * error(known)
    sparse = edited(known, "friction", np.arange(len(known)) % 100 != 0, np.nan)  # the last value is kept
    assert error(sparse) < 0.02 * DEGREE
    assert (run_estimator(UKF, sparse).friction[1:] == 0.4).all()
    assert (run_estimator(UKF, made.signals).friction == car.FRICTION).all()


# --- divergence and consistency --------------------------------------------------------------------------------------


@pytest.mark.parametrize("amplitude", [0.0, 0.03, 0.05])
def test_a_good_drive_is_not_flagged(amplitude):
    made = car.drive(car.slalom(amplitude, 0.5), 10.0, tyre=car.tanh_tyre)
    track = run_estimator(UKF, car.with_noise(made.signals, 6))
    assert not track.diverged.any()


@pytest.mark.parametrize("column", ["steer_rad", "yaw_rate_rad_s"])
def test_a_hopelessly_wrong_model_is_flagged(column):
    made = car.drive(car.slalom(0.05, 0.5), 10.0)
    signals = car.with_noise(made.signals, 6)
    track = run_estimator(UKF, replace(signals, **{column: -getattr(signals, column)}))
    assert track.diverged[300:].mean() > 0.6


def test_standstill_determines_the_biases_of_the_sensors():
    made = stop_and_go()
    signals = still_noise(made.signals, (made.time_s >= 5.0) & (made.time_s <= 9.0))
    signals = replace(signals, ax_m_s2=signals.ax_m_s2 + 0.5)  # 3 degrees of grade
    assert posteriors(signals).x[850, 3] == pytest.approx(0.5, abs=0.15)
    with_biases = VehicleUkf(vehicle("biases", "roll", "lag"))
    signals = replace(signals, yaw_rate_rad_s=signals.yaw_rate_rad_s + 0.004)
    steps, layout = posteriors(signals, with_biases), with_biases.layout
    assert steps.x[880, layout.sensor_bias + 1] == pytest.approx(0.004, abs=0.0012)
    contained = [0, 1, 2, 4, 5, layout.roll, layout.roll + 1]
    assert (steps.x[550:900, contained] == 0.0).all()


def test_with_axle_forces_a_lost_steering_angle_is_a_state(good):
    """The rear axle, a_y and yaw rate determine v_y; without them too, the filter waits for its steering."""
    lost = (good.time_s > 3.0) & (good.time_s < 6.0)
    signals = edited(good.signals, "steer_rad", lost, np.nan)
    steps, bias = posteriors(signals, PHYSICS), PHYSICS.layout.steer_bias
    unknown, known = (good.time_s > 3.215) & (good.time_s < 6.0), (good.time_s < 3.195) | (good.time_s >= 6.0)
    assert steps.valid.all()
    assert (steps.P[unknown, bias, bias] > 0.0).all() and (steps.P[known, bias, bias] == 0.0).all()
    error = np.arctan2(steps.x[:, 1], steps.x[:, 0]) - good.sideslip
    assert np.abs(error[unknown]).max() < 0.5 * DEGREE
    for column in ("ay_m_s2", "yaw_rate_rad_s"):
        signals = edited(signals, column, lost, np.nan)
    blind = posteriors(signals, PHYSICS).valid
    assert not blind[(good.time_s > 4.5) & (good.time_s < 6.0)].any() and blind[good.time_s > 6.05].all()


# ---- Speed gating: the filters receive no speed from spinning or locked wheels, but every other speed ----

SENSORS = VEHICLE.sensors
FILTERS = (nominal_filter(VEHICLE), VehicleUkf(VEHICLE))
ESTIMATORS = (Kinematic(VEHICLE), OpenLoop(VEHICLE), *FILTERS)


def start_and_stop(t: np.ndarray) -> np.ndarray:
    """Stand for 1 s, start with 1.5 m/s² up to 9 m/s, brake with 2 m/s² to a standstill."""
    return np.clip(np.minimum(1.5 * (t - 1.0), 9.0 - 2.0 * (t - 10.0)), 0.0, 9.0)


def spin(t: np.ndarray, at: float = 2.0, length: float = 2.5, size: float = 10.0) -> np.ndarray:
    """Return the excess speed of spinning wheels, m/s: one half sine."""
    return size * np.sin(np.pi * np.clip((t - at) / length, 0.0, 1.0)) ** 2


@pytest.fixture(scope="module")
def rolling():
    made = rolling_drive(start_and_stop, lambda t: 0.004 * np.sin(t), 20.0)
    return replace(made, signals=with_noise(made.signals, 3))


def believed(signals: Signals, **options) -> np.ndarray:
    return believable(signals, SENSORS, None, **options)[0].speed_m_s


def test_a_drive_without_slip_is_left_alone(rolling):
    assert believable(rolling.signals, SENSORS, None)[0] is rolling.signals
    made = drive(slalom(0.06, 0.7), 12.0, acceleration=lambda t: -6.0 if 4.0 < t < 6.0 else 0.0)
    noisy = with_noise(made.signals, 5)
    assert believable(noisy, SENSORS, None)[0] is noisy


@pytest.mark.parametrize("size", [10.0, 20.0])
def test_spinning_wheels_are_not_believed(rolling, size):
    slipping = replace(rolling.signals, speed_m_s=rolling.signals.speed_m_s + spin(rolling.time_s, size=size))
    out = believed(slipping)
    error = np.abs(out - rolling.vx)
    assert np.nanmax(error) < 2.0  # the bound plus the growth of the tolerance
    lasts = (rolling.time_s > 2.8) & (rolling.time_s < 3.8)
    assert np.isnan(out[lasts & np.isfinite(slipping.speed_m_s)]).all()
    away = (rolling.time_s < 2.0) | (rolling.time_s > 5.5)
    np.testing.assert_array_equal(out[away], slipping.speed_m_s[away])
    dead_reckoned = believed(slipping, reckoned=True)
    np.testing.assert_array_equal(np.isfinite(dead_reckoned), np.isfinite(slipping.speed_m_s))
    assert np.nanmax(np.abs(dead_reckoned - rolling.vx)) < 2.0


@pytest.mark.parametrize("estimator", ESTIMATORS, ids=lambda e: e.name)
@pytest.mark.slow
def test_all_estimators_heed_it(rolling, estimator, monkeypatch):
    slipping = replace(rolling.signals, speed_m_s=rolling.signals.speed_m_s + spin(rolling.time_s))
    gated, undisturbed = (run_estimator(estimator, s) for s in (slipping, rolling.signals))
    for module in (stepwise, vehicle_ukf):
        monkeypatch.setattr(module, "believable", lambda signals, _sensors, memory, **_: (signals, memory))
    plain, same = (run_estimator(estimator, s) for s in (slipping, rolling.signals))

    def worst(track):
        return np.nanmax(np.abs(track.vx_m_s - rolling.vx)[rolling.time_s > 0.5])

    assert worst(gated) < 1.5
    assert worst(plain) > 5.0
    assert gated.valid.sum() >= plain.valid.sum()
    np.testing.assert_array_equal(undisturbed.vy_m_s, same.vy_m_s)


def test_locked_wheels_are_not_believed_however_long_it_takes():
    """All wheels stand while the car slides from 20 m/s at 2 m/s²; then it stands, and that is believed."""
    made = rolling_drive(lambda t: np.clip(20.0 - 2.0 * np.clip(t - 2.0, 0, None), 0.0, None), np.zeros_like, 16.0)
    signals = with_noise(made.signals, 7)
    lock = np.clip((made.time_s - 2.0) / 0.3, 0.0, 1.0)
    locked = replace(signals, speed_m_s=np.maximum(signals.speed_m_s * (1.0 - lock), 0.0))
    out = believed(locked)
    sliding = (made.time_s > 2.5) & (made.vx > 4.0)
    assert made.time_s[sliding][-1] - 2.0 > TIMEOUT_S + 2.0
    assert np.isnan(out[sliding & np.isfinite(locked.speed_m_s)]).all()
    stands = made.time_s > 14.0
    np.testing.assert_array_equal(out[stands], locked.speed_m_s[stands])
    track = run_estimator(FILTERS[0], locked)
    assert np.abs(track.vx_m_s - made.vx)[sliding].max() < 1.0
    assert np.abs(track.vx_m_s[-100:]).max() < 0.02


def test_a_standstill_and_the_floor_of_the_pulses_are_no_slip(rolling):
    """No pulses below 0.8 m/s, with a start of 5 m/s²: the speed jumps, and stops dead."""
    made = rolling_drive(
        lambda t: np.clip(np.minimum(5.0 * (t - 1.0), 5.0 * (8.0 - t)), 0.0, 10.0), np.zeros_like, 12.0
    )
    signals = with_noise(made.signals, 8)
    read = np.where(signals.speed_m_s < 0.8, np.where(np.isfinite(signals.speed_m_s), 0.0, np.nan), signals.speed_m_s)
    floor = replace(signals, speed_m_s=read)
    assert believable(floor, SENSORS, None)[0] is floor


def test_a_speed_that_lasts_is_believed_in_the_end(rolling):
    jumped = replace(rolling.signals, speed_m_s=rolling.signals.speed_m_s + np.where(rolling.time_s > 4.0, 6.0, 0.0))
    out = believed(jumped)
    assert np.isnan(out[(rolling.time_s > 5.0) & (rolling.time_s < 8.0) & np.isfinite(jumped.speed_m_s)]).all()
    late = rolling.time_s > 4.0 + TIMEOUT_S + 0.5
    np.testing.assert_array_equal(out[late], jumped.speed_m_s[late])


def test_without_an_accelerometer_nothing_is_gated(rolling):
    blind = replace(rolling.signals, ax_m_s2=np.full(len(rolling.signals), np.nan))
    blind = replace(blind, speed_m_s=blind.speed_m_s + spin(rolling.time_s))
    assert believable(blind, SENSORS, None)[0] is blind


@pytest.mark.parametrize("estimator", FILTERS, ids=lambda e: e.name)
@pytest.mark.slow
def test_an_estimate_that_runs_backwards_against_the_speed_is_not_valid(estimator, rolling):
    """The accelerometer says braking, the speed sensor falls silent: v_x runs below zero."""
    silent = rolling.time_s > 9.0
    signals = without_impossible(rolling.signals)
    speed, ax = np.where(silent, np.nan, signals.speed_m_s), np.where(silent, -4.0, signals.ax_m_s2)
    signals = replace(signals, speed_m_s=speed, ax_m_s2=ax)
    steps, _ = estimator.run(signals, None)
    back = steps.x[:, 0] < 0.0
    assert back[-500:].all()
    assert (steps.inputs[back & silent, U_SPEED] > 0.5).all()
    track = run_estimator(estimator, signals)
    assert not track.valid[back & silent].any()
    assert track.valid[~back & (rolling.time_s > 0.5)].all()


@pytest.mark.parametrize("slope", [-2.0, 2.0])
def test_a_steep_hill_is_no_slip(rolling, slope):
    hill = replace(rolling.signals, ax_m_s2=rolling.signals.ax_m_s2 + slope)
    assert believable(hill, SENSORS, None)[0] is hill
