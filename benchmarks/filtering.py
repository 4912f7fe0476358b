"""Microseconds per step of ``phy-ukf`` and of the UKF of filterpy, with the same compiled vehicle model and drive.

Both use the same state, noise and measurements on one thread; only the filter around the model differs. The posteriors
are compared first. Our filter also gates, detects divergence and stores the outputs. ``physics`` has all its parts.
"""

from __future__ import annotations

import numpy as np

from benchmarks.measuring import Row, best_seconds
from pdhef_logtool.car.nominal_model import measured_lateral_acceleration, model_parameters, rk4_step, substeps
from pdhef_logtool.car.vehicle import PhysicsParts, default_vehicle
from pdhef_logtool.estimators.filter_base import INITIAL_STD
from pdhef_logtool.estimators.phy_ukf import PHY_UKF_Q_STD, PhysicsUkf
from pdhef_logtool.estimators.physics_filter import PhysicsFilter
from pdhef_logtool.records.signals import FloatArray, Signals

STEPS = 60_000
PEER_STEPS = 2_000
STEP_NS = 10_000_000
R_STD = (0.12, 0.004, 0.08)
FRICTION = 0.85


def drive(n: int) -> Signals:
    """Make a weaving drive to 0.5 g with sensor noise, from the vehicle model itself."""
    vehicle = default_vehicle()
    p = model_parameters(vehicle)
    rng = np.random.default_rng(0)
    stamps_ns = 1_700_000_000_000_000_000 + np.arange(n, dtype=np.int64) * STEP_NS
    t = np.arange(n) * STEP_NS * 1e-9
    steer, ax = 0.025 * np.sin(1.7 * t), 0.5 * np.sin(0.3 * t)
    states = np.empty((n, 3))
    state = (24.0, 0.0, 0.0)
    ay = np.empty(n)
    for k in range(n):
        states[k] = state
        ay[k] = measured_lateral_acceleration(*state, steer[k], FRICTION, p)
        state = rk4_step(*state, steer[k], ax[k], FRICTION, 0.01, 2, p)
    noise = rng.standard_normal((3, n)) * np.array(R_STD)[:, None]
    return Signals(
        stamps_ns=stamps_ns,
        ready_ns=stamps_ns,
        steer_rad=steer,
        ax_m_s2=ax,
        ay_m_s2=ay + noise[0],
        yaw_rate_rad_s=states[:, 2] + noise[1],
        speed_m_s=states[:, 0] + noise[2],
        friction=np.full(n, FRICTION),
        wheel_speed_m_s=np.full((n, 4), np.nan),
        available=frozenset({"steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s", "friction"}),
    )


def run_filterpy(signals: Signals, x: FloatArray, n: int) -> FloatArray:
    """Run filterpy's UKF over the first ``n`` samples from the state ``x`` at the first; returns states [n, 4]."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    p = model_parameters(default_vehicle())

    def fx(x, dt, u):  # type: ignore[no-untyped-def]
        steer, ax = u
        moved = rk4_step(x[0], x[1], x[2], steer, ax - x[3], FRICTION, dt, substeps(x[0], dt, FRICTION, p), p)
        return np.array([*moved, x[3]])

    def hx(x, steer):  # type: ignore[no-untyped-def]
        return np.array([measured_lateral_acceleration(x[0], x[1], x[2], steer, FRICTION, p), x[2], x[0]])

    points = MerweScaledSigmaPoints(4, alpha=1.0, beta=2.0, kappa=0.0)
    ukf = UnscentedKalmanFilter(dim_x=4, dim_z=3, dt=0.01, hx=hx, fx=fx, points=points)
    ukf.x = x.copy()
    ukf.P = np.diag(np.square(INITIAL_STD))
    ukf.R = np.diag(np.square(R_STD))
    ukf.Q = np.diag(np.square(PHY_UKF_Q_STD)) * 0.01
    z = np.stack([signals.ay_m_s2, signals.yaw_rate_rad_s, signals.speed_m_s], axis=1)
    states = np.empty((n, 4))
    states[0] = ukf.x
    for k in range(1, n):
        steer, ax = (0.5 * (u[k - 1] + u[k]) for u in (signals.steer_rad, signals.ax_m_s2))
        ukf.predict(dt=0.01, u=(steer, ax))
        ukf.update(z[k], steer=signals.steer_rad[k])
        states[k] = ukf.x
    return states


def rows() -> list[Row]:
    """Measure."""
    signals = drive(STEPS)
    estimator = PhysicsUkf(default_vehicle(), q_std=PHY_UKF_Q_STD, r_std=R_STD)
    steps, _ = estimator.run(signals, None)
    theirs = run_filterpy(signals, steps.x[0], PEER_STEPS)
    if not np.allclose(steps.x[:PEER_STEPS], theirs, rtol=1e-4, atol=1e-4):
        worst = np.abs(steps.x[:PEER_STEPS] - theirs).max(axis=0)
        raise SystemExit(f"the two filters disagree: {worst}")
    parts = PhysicsParts(**dict.fromkeys(PhysicsParts.model_fields, True))
    whole = PhysicsFilter(default_vehicle().model_copy(update={"physics": parts}), r_std=R_STD)
    seconds = best_seconds(
        {
            "ours": lambda: estimator.run(signals, None),
            "filterpy": lambda: run_filterpy(signals, steps.x[0], PEER_STEPS),
            "physics": lambda: whole.run(signals, None),
        }
    )
    ours, peer = 1e6 * seconds["ours"] / STEPS, 1e6 * seconds["filterpy"] / PEER_STEPS
    return [
        Row("phy-ukf", ours, "µs/step", peers={"filterpy": peer / ours}),
        Row("physics, all parts on", 1e6 * seconds["physics"] / STEPS, "µs/step", 6.0),
    ]
