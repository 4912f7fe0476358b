"""The paper's filter against plain numpy, its norm, and its place in the table."""

import math
from dataclasses import replace

import numpy as np
import pytest
from made_models import full_network, random_network
from reference_car import drive, forces, make_signals, on_axles, runge_kutta, signals_at, slalom, with_noise
from scipy.integrate import solve_ivp

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import VehicleParameters, default_vehicle
from pdhef_logtool.estimators.hybrid_paper import Constants, PaperHybridUkf
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.peers.single_track import single_track
from pdhef_logtool.estimators.table import PEERS, all_names, make_estimator
from pdhef_logtool.estimators.vehicle_ukf import nominal_filter
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.residual_model.bundle import ModelBundle
from pdhef_logtool.residual_model.features import FEATURES, PAPER_FEATURES
from pdhef_logtool.residual_model.linear_model import LinearModel

pytestmark = pytest.mark.slow

VEHICLE = default_vehicle()
GRAVITY = 9.80665


def make_bundle(names: tuple[str, ...] = PAPER_FEATURES) -> ModelBundle:
    return random_network(3, names, layers=2, head=(8,), scales=(3.0, 2.0))


TOPS = (0.3, 1.0, 2.5), (0.3, 0.6, 0.85)
CONSTANTS = Constants(0.95, 3.0, *TOPS, 0.1)


def paper_filter(**options: object) -> PaperHybridUkf:
    return PaperHybridUkf(VEHICLE, make_bundle(), **{"constants": CONSTANTS, **options})


@pytest.fixture(scope="module")
def weaving():
    """A noisy slalom to the limit, with a burst of noise on a_y, missing samples and messages that come late."""
    made = drive(slalom(0.055, 0.5), 4.0, speed=23.0, step_s=np.random.default_rng(4).uniform(0.008, 0.012, 400))
    s = with_noise(made.signals, seed=8)
    s.ay_m_s2[200:260] += 3.0 * np.random.default_rng(5).standard_normal(60)
    s.ay_m_s2[120:124] = np.nan
    s.yaw_rate_rad_s[300] = np.nan
    s.ax_m_s2[50:52] = np.nan
    s.friction[:200] = 0.85
    s.friction[200:] = 0.8
    return replace(s, ready_ns=s.stamps_ns + 25_000_000)


def test_the_undisturbed_norm_is_the_papers():
    assert np.linalg.norm(paper_filter().measurement_variance) == pytest.approx(0.1, rel=0.01)


# --- the whole filter ------------------------------------------------------------------------------------------------


def numpy_reference(signals: Signals, bundle: ModelBundle, constants: Constants) -> dict[str, np.ndarray]:
    """Compute Eq 19-26 in plain numpy, predicted to the stamps, from the package's parallel filter and network."""
    features, dt_s, physics, _ = run_features(nominal_filter(VEHICLE), signals, None)
    rate, _ = bundle.run(features, np.isnan(dt_s), None)
    signals = without_impossible(signals)
    q = np.array([0.089, 0.31, 0.062, 0.021])
    theta, gamma, deviation_tops, intensity_tops, ay_variance = constants
    r0 = np.array([ay_variance, 0.004**2, 0.08**2])
    wm = np.array([0.0] + [1 / 8] * 8)
    wc = wm + np.array([2.0] + [0.0] * 8)

    def points(x, P):
        root = np.linalg.cholesky(4.0 * P)
        return np.vstack([x, x + root.T, x - root.T])

    def moments(rows):
        mean = wm @ rows
        return mean, (rows - mean).T @ (wc[:, None] * (rows - mean))

    def predict(x, P, steer, ax, mu, dt, residual, beta, has_ax):
        moved = np.array([np.append(runge_kutta(c[:3], steer, ax - c[3], mu, dt), c[3]) for c in points(x, P)])
        moved[:, 1:3] += beta * residual * dt
        x, P = moments(moved)
        std = q.copy()
        if not has_ax:
            std[0] = 3.0
        return x, P + np.diag(std**2 * dt * (1 + gamma * beta))

    n = len(signals)
    t = (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9
    steer, ax, ay = signals.steer_rad, signals.ax_m_s2, signals.ay_m_s2
    steps = []
    x, P = physics.x[0].copy()[:4], np.diag([0.5, 0.5, 0.1, 0.3]) ** 2
    beta, C, r_scale = 0.1, np.full(3, np.nan), 1.0
    steps.append((x, P, beta, r_scale))
    for k in range(1, n):
        mu = signals.friction[k]
        if np.isfinite(ay[k]):
            nominal = forces(*physics.prior[k, :3], steer[k], mu)[0]
            e, i = abs(ay[k] - nominal), abs(ay[k]) / (mu * GRAVITY)
            columns = [np.interp(e, deviation_tops, v) for v in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
            rows = [np.interp(i, intensity_tops, v) for v in ((1, 0, 0), (0, 1, 0), (0, 0, 1))]
            strength = np.minimum.outer(rows, columns)
            table = np.array([[0.1, 0.2, 0.3], [0.3, 0.5, 0.7], [0.5, 0.8, 0.9]])
            beta = (strength * table).sum() / strength.sum()
        known = [a for a in (ax[k - 1], ax[k]) if np.isfinite(a)]
        mean_mu = (signals.friction[k - 1] + mu) / 2
        x, P = predict(
            x, P, (steer[k - 1] + steer[k]) / 2, np.mean(known) if known else 0.0, mean_mu, t[k] - t[k - 1],
            rate[k - 1], beta, bool(known),
        )  # fmt: skip
        chi = points(x, P)
        zeta = np.array([[forces(*c[:3], steer[k], mu)[0] + beta * rate[k - 1, 0], c[2], c[0]] for c in chi])
        z_hat, Pzz = moments(zeta)
        Pxz = (chi - x).T @ (wc[:, None] * (zeta - z_hat))
        z = np.array([ay[k], signals.yaw_rate_rad_s[k], signals.speed_m_s[k]])
        nu = z - z_hat
        seen = np.isfinite(nu)
        fresh = seen & np.isnan(C)
        C[fresh] = (np.diag(Pzz) + r0)[fresh]
        C[seen] = theta * C[seen] + (1 - theta) * nu[seen] ** 2
        R = np.fmax(r0, C - np.diag(Pzz))
        r_scale = R[0] / r0[0]
        S = (Pzz + np.diag(R))[np.ix_(seen, seen)]
        K = Pxz[:, seen] @ np.linalg.inv(S)
        x = x + K @ nu[seen]
        P = P - K @ S @ K.T
        steps.append((x, P, beta, r_scale))
    out = {c: np.full(n, np.nan) for c in ("vx", "vy", "r", "beta", "r_scale", "ay", "vy_var")}
    for m in range(n):
        k = int(np.searchsorted(signals.ready_ns, signals.stamps_ns[m], side="right")) - 1
        if k < 0:
            continue
        x, P, beta, r_scale = steps[k]
        has_ax = bool(np.isfinite(ax[k]))
        mu = signals.friction[k]
        x, P = predict(x, P, steer[k], ax[k] if has_ax else 0.0, mu, t[m] - t[k], rate[k], beta, has_ax)
        out["vx"][m], out["vy"][m], out["r"][m] = x[:3]
        out["beta"][m], out["r_scale"][m], out["vy_var"][m] = beta, r_scale, P[1, 1]
        out["ay"][m] = forces(*x[:3], steer[k], mu)[0] + beta * rate[k, 0]
    return out


@pytest.mark.parametrize("constants", [CONSTANTS, Constants(0.9, 1.5, (0.2, 0.7, 2.0), (0.25, 0.5, 0.9), 0.05)])
def test_it_is_the_papers_equations_in_plain_numpy(weaving, constants):
    bundle = make_bundle()
    want = numpy_reference(weaving, bundle, constants)
    track = run_estimator(PaperHybridUkf(VEHICLE, bundle, constants=constants), weaving)
    got = {
        "vx": track.vx_m_s, "vy": track.vy_m_s, "r": track.yaw_rate_rad_s, "beta": track.network_trust,
        "r_scale": track.r_scale, "ay": track.ay_m_s2, "vy_var": track.vy_std_m_s**2,
    }  # fmt: skip
    for name, values in want.items():
        rtol = 1e-6 if name in ("beta", "r_scale") else 1e-9  # kept in single precision, for files
        np.testing.assert_allclose(got[name], values, rtol=rtol, atol=1e-9, err_msg=name)
    assert np.ptp(want["beta"][5:]) > 0.5  # the drive covers the whole table
    assert np.nanmax(want["r_scale"]) > 5.0


def test_it_says_when_the_network_is_not_the_papers():
    assert paper_filter().notes == ()
    other = PaperHybridUkf(VEHICLE, make_bundle(FEATURES))
    assert "not the paper's 6" in other.notes[0]
    assert "physics_vy_m_s" in other.notes[0]


# --- the table -------------------------------------------------------------------------------------------------------


MODEL = full_network()


def test_pure_lstm_says_what_its_network_says_and_predicts_it_over_the_delay():
    """The network output is constant, 0.25 m/s. Latency compensation adds the latency times the measured v̇_y."""
    lstm = MODEL.pure_lstm
    weights = {k: np.zeros_like(v) for k, v in lstm.weights.items()}
    constant = max(k for k in weights if k.endswith("bias") and k.startswith("head"))
    weights[constant][:] = 0.25
    model = replace(MODEL, pure_lstm=replace(lstm, weights=weights))
    made = drive(slalom(0.02, 0.5), 4.0)
    gain = 1.0 + 9.80665 * VEHICLE.roll_gradient_rad_per_m_s2
    on_time = replace(made.signals, ay_m_s2=gain * made.ay)
    track = run_estimator(make_estimator("pure-lstm", Car(VEHICLE, network=model)), on_time)
    np.testing.assert_allclose(track.vy_m_s, 0.25, rtol=1e-6)
    np.testing.assert_array_equal(track.yaw_rate_rad_s, made.r)
    np.testing.assert_allclose(track.ay_m_s2, made.ay, rtol=1e-12, atol=1e-12)
    late = replace(on_time, ready_ns=on_time.stamps_ns + 20_000_000)
    track = run_estimator(make_estimator("pure-lstm", Car(VEHICLE, network=model)), late)
    expected = 0.25 + 0.02 * (made.ay - made.vx * made.r)[:-2]
    np.testing.assert_allclose(track.vy_m_s[2:], expected, atol=1e-3)
    assert np.ptp(track.vy_m_s[2:]) > 0.01


def test_linear_regression_is_its_equation():
    """At constant features the low-pass has no say."""
    n = 1500
    values = {"steer_rad": 0.02, "ax_m_s2": 0.0, "ay_m_s2": 3.0, "yaw_rate_rad_s": 0.15, "speed_m_s": 20.0}
    signals = make_signals(np.full(n - 1, 0.01), **{name: np.full(n, value) for name, value in values.items()})
    model = replace(MODEL, linear_regression=LinearModel(("ay_m_s2", "yaw_rate_rad_s"), (-0.01, 0.2), 0.004, 2.0))
    track = run_estimator(make_estimator("linear-regression", Car(VEHICLE, network=model)), signals)
    assert track.sideslip_rad[-1] == pytest.approx(0.004 - 0.03 + 0.03, abs=1e-9)
    step = replace(signals, ay_m_s2=np.where(np.arange(n) < 1000, 3.0, 1.0))
    after = run_estimator(make_estimator("linear-regression", Car(VEHICLE, network=model)), step)
    share = 1.0 - math.exp(-2.0 * math.pi * 2.0 * 0.01 * 8)  # eight steps behind the jump
    assert after.sideslip_rad[1007] == pytest.approx(0.004 + 0.02 * share, abs=1e-9)


# ---- Peers recover a simulated car within what their equations allow ----

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
