"""The whole physics filter against filterpy's UKF with model functions written from docs/method.md."""

from __future__ import annotations

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from reference_car import REAR_M, drive, forces, runge_kutta, with_noise
from scipy.stats import multivariate_normal

from pdhef_logtool.car.vehicle import default_vehicle
from pdhef_logtool.estimators.phy_ukf import PhysicsUkf

Q_STD = (0.05, 0.3, 0.15, 0.05)
R_STD = (0.12, 0.004, 0.08)
FRICTIONS = (0.85, 0.78)


def filterpy_run(signals):
    """Posterior states, covariances, NIS and log-likelihood of every step after the first."""

    def fx(x, dt, u):
        steer, ax, mu = u
        return np.append(runge_kutta(x[:3], steer, ax - x[3], mu, dt), x[3])

    def hx(x, steer, mu, use):
        return np.array([forces(x[0], x[1], x[2], steer, mu)[0], x[2], x[0]])[use]

    points = MerweScaledSigmaPoints(4, alpha=1.0, beta=2.0, kappa=0.0)
    ukf = UnscentedKalmanFilter(dim_x=4, dim_z=3, dt=0.01, hx=hx, fx=fx, points=points)
    r0 = signals.yaw_rate_rad_s[0]
    ukf.x = np.array([signals.speed_m_s[0], REAR_M * r0, r0, 0.0])
    ukf.P = np.diag(np.array([0.5, 0.5, 0.1, 0.3]) ** 2)
    states, covariances, nis, log_likelihood = [ukf.x.copy()], [ukf.P.copy()], [], []
    mu = signals.friction
    for k in range(1, len(signals)):
        dt = (signals.stamps_ns[k] - signals.stamps_ns[k - 1]) * 1e-9
        ukf.Q = np.diag(np.array(Q_STD) ** 2) * dt
        u = [0.5 * (c[k - 1] + c[k]) for c in (signals.steer_rad, signals.ax_m_s2, mu)]
        ukf.predict(dt=dt, u=u)
        z = np.array([signals.ay_m_s2[k], signals.yaw_rate_rad_s[k], signals.speed_m_s[k]])
        use = np.isfinite(z)
        if use.any():
            ukf.update(z[use], R=np.diag(np.array(R_STD)[use] ** 2), steer=signals.steer_rad[k], mu=mu[k], use=use)
            nis.append(ukf.y @ np.linalg.solve(ukf.S, ukf.y))
            log_likelihood.append(multivariate_normal(cov=ukf.S).logpdf(ukf.y))
        else:
            nis.append(np.nan)
            log_likelihood.append(0.0)
        states.append(ukf.x.copy())
        covariances.append(ukf.P.copy())
    return np.array(states), np.array(covariances), np.array(nis), np.array(log_likelihood)


@pytest.fixture(scope="module")
def noisy_signals():
    """A drive to 0.6 g on irregular stamps, with each channel missing at times and a change of friction."""
    rng = np.random.default_rng(7)
    dt = rng.uniform(0.002, 0.03, 400)
    made = drive(lambda t: 0.045 * np.sin(2.4 * t), speed=24.0, step_s=dt, acceleration=lambda t: np.cos(0.7 * t))
    s = with_noise(made.signals, seed=3)
    s.ay_m_s2[rng.random(len(s)) < 0.1] = np.nan
    s.yaw_rate_rad_s[1:][rng.random(len(s) - 1) < 0.1] = np.nan
    s.ay_m_s2[77::50] = s.yaw_rate_rad_s[77::50] = np.nan
    s.friction[:] = np.where(np.arange(len(s)) < 300, *FRICTIONS)
    none = np.isnan([s.ay_m_s2, s.yaw_rate_rad_s, s.speed_m_s]).all(axis=0)
    assert none.any(), "some steps must have no measurement at all"
    return s


def test_posteriors_agree_with_filterpy(noisy_signals):
    estimator = PhysicsUkf(default_vehicle(), q_std=Q_STD, r_std=R_STD)
    steps, _ = estimator.run(noisy_signals, None)
    x, P, nis, log_likelihood = filterpy_run(noisy_signals)

    assert np.nanmax(nis) < 36.0, "the drive must stay inside the gate, which filterpy does not have"
    assert np.ptp(x[:, 1]) > 0.5, "the drive must excite the lateral motion"
    np.testing.assert_allclose(steps.x, x, rtol=1e-9, atol=1e-10)
    scale = np.sqrt(np.einsum("ki,kj->kij", *[np.einsum("kii->ki", P)] * 2))
    assert np.abs((steps.P - P) / scale).max() < 1e-9
    np.testing.assert_allclose(steps.nis[1:], nis, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(steps.log_likelihood[1:], log_likelihood, rtol=1e-8, atol=1e-8)


def test_sensor_level_noise_comes_from_the_vehicle_file(noisy_signals):
    sensors = default_vehicle().sensors.model_copy(
        update={"ay_std_m_s2": R_STD[0], "yaw_rate_std_rad_s": R_STD[1], "speed_std_m_s": R_STD[2]}
    )
    by_file = PhysicsUkf(default_vehicle().model_copy(update={"sensors": sensors}), q_std=Q_STD)
    given = PhysicsUkf(default_vehicle(), q_std=Q_STD, r_std=R_STD)
    a, b = by_file.run(noisy_signals, None)[0], given.run(noisy_signals, None)[0]
    np.testing.assert_array_equal(a.x, b.x)
    assert by_file.measurement_std.tolist() == list(R_STD)
    louder = PhysicsUkf(default_vehicle(), q_std=Q_STD, r_std=(0.5, 0.004, 0.08))
    assert not np.array_equal(louder.run(noisy_signals, None)[0].x, b.x)
