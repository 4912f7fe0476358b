"""The truth vehicle beyond the gates: forces and accelerations, braking, wheel lift, other simulators."""

from __future__ import annotations

import numpy as np
import pytest

from truthsim.manoeuvres import Plan
from truthsim.motion import Motion, simulate_motion
from truthsim.vehicle import Vehicle

CAR = Vehicle()
LF, LR, L, M, IZ, TRACK, H_CG = 1.16, 1.71, 2.87, 1440.0, 1523.0, 1.57, 0.64  # the paper's Table 3


def open_loop(speed: float, steer: np.ndarray) -> Plan:
    return Plan(speed, (steer.shape[0] - 1) * 1e-3, steer_rad=steer)


def loads(motion: Motion) -> np.ndarray:
    return np.stack([motion.column(f"fz_{w}_n") for w in ("fl", "fr", "rl", "rr")], axis=1)


def test_a_wheel_leaves_the_road_and_comes_back() -> None:
    # A tall car thrown into a bend on a grippy road lifts its inner wheels, and stands on all four afterwards.
    steer = np.concatenate([np.linspace(0.0, 0.14, 300), np.full(400, 0.14), np.linspace(0.14, 0.0, 300)])
    steer = np.concatenate([steer, np.zeros(3001)])
    tall = CAR._replace(cg_height_m=0.92)
    motion = simulate_motion(open_loop(22.0, steer), 1.1, vehicle=tall, period_s=0.001)
    assert np.isfinite(motion.observed).all()
    fz = loads(motion)
    assert fz.min() == 0.0 and fz[-1].min() > 2000.0
    lifted = fz[:, 2] == 0.0
    assert lifted.sum() > 50
    for name in ("fx_rl_n", "fy_rl_n"):
        assert np.all(motion.column(name)[lifted] == 0.0)
    # In the air, only its weight and its links act on a wheel, so the suspension extends.
    assert motion.column("suspension_rl_m")[lifted].min() < -0.04


def against_another_simulator(shared_dir, run: str, friction: float, car: Vehicle, *, gain: float = 1.0) -> dict:
    """Ratio of peaks and correlation by quantity, same steering in both."""
    import polars as pl

    other = pl.read_parquet(shared_dir / "data" / "independent_sim" / f"ocd_v1__{run}.parquet")
    t = other["t"].to_numpy() - other["t"][0]
    steer = gain * np.interp(np.arange(0.0, t[-1], 1e-3), t, other["steer"].to_numpy())
    motion = simulate_motion(open_loop(float(other["vx"][0]), steer), friction, vehicle=car)
    found = {}
    for column, mine in (
        ("ay", motion.column("ay_m_s2")),
        ("yaw_rate", motion.column("yaw_rate_rad_s")),
        ("beta", np.arctan2(motion.column("vy_m_s"), motion.column("vx_m_s"))),
        ("roll", motion.column("roll_rad")),
    ):
        theirs = np.interp(motion.times_s, t, other[column].to_numpy())
        found[column] = (float(np.abs(mine).max() / np.abs(theirs).max()), float(np.corrcoef(mine, theirs)[0, 1]))
    return found


def check_bands(found: dict, bands: dict[str, tuple[float, float, float]]) -> None:
    for column, (low, high, alike) in bands.items():
        ratio, correlation = found[column]
        assert low < ratio < high, (column, ratio)
        assert correlation > alike, (column, correlation)


#: The sedan with the known values of the other car: no bars, short relaxation, no compliance, its axle stiffness.
LIKE_THE_OTHER = CAR._replace(
    front_anti_roll_n_m_per_rad=0.0,
    rear_anti_roll_n_m_per_rad=0.0,
    pitch_centre_height_m=0.05,
    front_compliance_rad_per_n=0.0,
    rear_compliance_rad_per_n=0.0,
    ackermann=0.0,
    front_tyre=CAR.front_tyre._replace(
        stiffness_peak=15.80, stiffness_friction_power=0.0, lateral_relaxation_m=0.2, lateral_relaxation_min_m=0.2
    ),
    rear_tyre=CAR.rear_tyre._replace(
        stiffness_peak=20.81, stiffness_friction_power=0.0, lateral_relaxation_m=0.2, lateral_relaxation_min_m=0.2
    ),
)
CLOSE = {
    "ay": (0.94, 1.03, 0.999),
    "yaw_rate": (0.96, 1.06, 0.999),
    "beta": (1.05, 1.20, 0.99),
    "roll": (1.02, 1.14, 0.998),
}


def test_with_the_other_s_values_the_difference_goes(shared_dir) -> None:
    step = ("step_100kmh_mu100", 1.0)
    check_bands(against_another_simulator(shared_dir, *step, LIKE_THE_OTHER), CLOSE)
    for run, friction in (("sinesweep_0p6_1Hz_60kmh_mu030", 0.3), ("sinesweep_0p5_2Hz_100kmh_mu100", 1.0)):
        found = against_another_simulator(shared_dir, run, friction, LIKE_THE_OTHER)
        check_bands(found, {"ay": (0.95, 1.05, 0.97), "yaw_rate": (1.0, 1.12, 0.995), "roll": (1.0, 1.15, 0.95)})
    # The bands see a steering 10 % too strong, one the wrong way round, and a car that yaws against its moments.
    for gain, car in ((1.1, LIKE_THE_OTHER), (-1.0, LIKE_THE_OTHER), (1.0, CAR._replace(yaw_inertia_kg_m2=-IZ))):
        with pytest.raises(AssertionError), np.errstate(all="ignore"):
            check_bands(against_another_simulator(shared_dir, *step, car, gain=gain), CLOSE)
