"""Credibility gates of the truth vehicle (docs/method.md#simulator), each with proof that it can fail.

A gate is a function of a simulator and a car. It asserts a result of physics or linear theory for the car of Table 3.
Each gate must pass on the unmodified simulator. It must fail with every injected error: a wrong sign or a gain error of
10 % in a value of the car, in the slope of the road or in a recorded quantity.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from truthsim import linear_theory
from truthsim.manoeuvres import MANOEUVRES, Plan, Request
from truthsim.motion import Motion, simulate_motion
from truthsim.vehicle import OBSERVED, Vehicle

pytestmark = pytest.mark.slow

G = 9.80665
CAR = Vehicle()
LF, LR, L, M, TRACK, H_CG, RADIUS = 1.16, 1.71, 2.87, 1440.0, 1.57, 0.64, 0.30  # the paper's Table 3
UNSPRUNG = 140.0
SPRUNG = M - UNSPRUNG
#: Of the sprung mass's CG above the roll axis.
ARM = (M * H_CG - UNSPRUNG * RADIUS) / SPRUNG - 0.10
WHEELS = ("fl", "fr", "rl", "rr")
DRY = 0.85

Simulate = Callable[..., Motion]
Gate = Callable[[Simulate, Vehicle], None]


def near(value: object, wanted: float, *, rel: float = 0.0, within: float = 0.0) -> None:
    """Assert that all elements of a value are close to a number; NaN fails."""
    got = np.asarray(value, dtype=float)
    assert np.all(np.abs(got - wanted) <= rel * abs(wanted) + within), (got, wanted)


def open_loop(speed: float, steer: np.ndarray) -> Plan:
    return Plan(speed, (steer.shape[0] - 1) * 1e-3, steer_rad=steer)


def frictionless(car: Vehicle) -> Vehicle:
    """Linear theory knows no traction."""
    return car._replace(drag_area_m2=0.0, rolling_resistance=0.0)


def lane_change_plan() -> Plan:
    m = MANOEUVRES["dlc"]
    return m.plan(Request(speed_m_s=100.0 / 3.6, friction=DRY, seed=1, duration_s=m.duration_s, scale=0.76))


def straight_path(speed: float, metres: float) -> np.ndarray:
    x = np.arange(0.0, metres, 0.5)
    return np.stack([x, 0.0 * x, 0.0 * x, 0.0 * x + speed], axis=1)


def steady_road(bank: float, grade: float) -> np.ndarray:
    return np.array([[DRY, DRY, bank, grade]] * 3)


def loads(motion: Motion) -> np.ndarray:
    return np.stack([motion.column(f"fz_{w}_n") for w in WHEELS], axis=1)


def weight_is_carried(simulate: Simulate, car: Vehicle) -> None:
    """ΣF_z = m g at rest, each wheel with its share, and on average over a drive."""
    still = loads(simulate(open_loop(0.0, np.zeros(2001)), DRY, vehicle=car))[-1]
    near(still[:2], 0.5 * M * G * LR / L, rel=1e-6)
    near(still[2:], 0.5 * M * G * LF / L, rel=1e-6)
    total = loads(simulate(lane_change_plan(), DRY, vehicle=car)).sum(axis=1)
    near(total.mean(), M * G, rel=2e-4)


def left_is_right(simulate: Simulate, car: Vehicle) -> None:
    """The mirrored course gives the mirrored drive."""
    plan = lane_change_plan()
    here = simulate(plan, DRY, vehicle=car)
    there = simulate(replace(plan, path=plan.path * np.array([1.0, -1.0, -1.0, 1.0])), DRY, vehicle=car)
    same = ("x_m", "vx_m_s", "ax_m_s2", "pitch_rad", "pitch_rate_rad_s", "heave_m")
    opposite = ("y_m", "yaw_rad", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2", "roll_rad", "roll_rate_rad_s", "steer_rad")
    for name in same:
        near(there.column(name) - here.column(name), 0.0, within=1e-7)
    for name in opposite:
        near(there.column(name) + here.column(name), 0.0, within=1e-7)
    near(loads(there)[:, [1, 0, 3, 2]] - loads(here), 0.0, within=1e-3)


def steps_are_fine_enough(simulate: Simulate, car: Vehicle) -> None:
    """A quarter of the step changes results by less than 1e-4, and the path is the integral of the velocity."""
    steer = 0.02 * np.sin(2.0 * np.pi * np.arange(0.0, 4.0, 1e-3))
    coarse = simulate(open_loop(25.0, steer), DRY, vehicle=car, period_s=0.001)
    fine = simulate(open_loop(25.0, steer), DRY, vehicle=car, period_s=0.001, substeps=4)
    for name in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2", "roll_rad", "pitch_rad", "y_m", "fz_fl_n"):
        near(coarse.column(name) - fine.column(name), 0.0, within=1e-4 * np.abs(fine.column(name)).max())
    yaw, v_x, v_y = (coarse.column(name) for name in ("yaw_rad", "vx_m_s", "vy_m_s"))
    east = v_x * np.cos(yaw) - v_y * np.sin(yaw)
    near(coarse.column("x_m")[-1], 0.5e-3 * (east[1:] + east[:-1]).sum(), rel=1e-6)


def forces_lag_by_the_relaxation_length(simulate: Simulate, car: Vehicle) -> None:
    """F + τ dF/dt = C α at small slip, with τ = σ/v_x."""
    for speed in (10.0, 40.0):
        t = np.arange(0.0, 2.0, 1e-3)
        motion = simulate(open_loop(speed, 0.002 * np.sin(4.0 * np.pi * t)), DRY, vehicle=car, period_s=0.001)
        force = motion.column("fy_fl_n") + motion.column("fy_fr_n")
        alpha = 0.5 * (motion.column("slip_angle_fl_rad") + motion.column("slip_angle_fr_rad"))
        assert np.isfinite(force).all()
        basis = np.stack([alpha, -np.gradient(force, 1e-3)], axis=1)[300:-2]
        (stiffness, tau), *_ = np.linalg.lstsq(basis, force[300:-2], rcond=None)
        near(stiffness, linear_theory.axle_stiffness_n_per_rad(CAR, DRY)[0], rel=0.01)
        near(tau * speed, 0.65, rel=0.02)


def acceleration_is_that_of_the_velocities(simulate: Simulate, car: Vehicle) -> None:
    """a_y = dv_y/dt + v_x r and a_x = dv_x/dt - v_y r, with a_y and a_x from the forces."""
    motion = simulate(lane_change_plan(), DRY, vehicle=car, period_s=0.001)
    v_x, v_y, r = (motion.column(name) for name in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s"))
    inner = slice(2, -2)
    near((np.gradient(v_y, 1e-3) + v_x * r - motion.column("ay_m_s2"))[inner], 0.0, within=5e-3)
    near((np.gradient(v_x, 1e-3) - v_y * r - motion.column("ax_m_s2"))[inner], 0.0, within=5e-3)


def slow_ramp(simulate: Simulate, car: Vehicle) -> tuple[Motion, np.ndarray]:
    """Motion over a slow growth of the steering, and which of its rows are linear."""
    motion = simulate(open_loop(25.0, np.linspace(0.0, 0.01, 20_001)), DRY, vehicle=frictionless(car))
    a_y = motion.column("ay_m_s2")
    assert np.isfinite(a_y).all()
    linear = (a_y > 0.1) & (a_y < 0.9)
    assert linear.sum() > 200
    return motion, linear


def slope(motion: Motion, rows: np.ndarray, column: np.ndarray) -> float:
    """Of a quantity over a_y."""
    return float(np.polyfit(motion.column("ay_m_s2")[rows], column[rows], 1)[0])


def load_moves_as_statics_say(simulate: Simulate, car: Vehicle) -> None:
    """Per axle, springs, bars and tyres act in series; the total equals the moment of the CG divided by the track."""
    motion, linear = slow_ramp(simulate, car)
    front = slope(motion, linear, 0.5 * (motion.column("fz_fr_n") - motion.column("fz_fl_n")))
    rear = slope(motion, linear, 0.5 * (motion.column("fz_rr_n") - motion.column("fz_rl_n")))
    roll = slope(motion, linear, motion.column("roll_rad"))
    near((front + rear) * TRACK, M * H_CG + SPRUNG * ARM * G * roll, rel=2e-3)
    _, (front_theory, rear_theory) = linear_theory.steady_roll(CAR)
    near(front, front_theory, rel=2e-3)
    near(rear, rear_theory, rel=2e-3)


def body_rolls_by_the_closed_form(simulate: Simulate, car: Vehicle) -> None:
    """Springs and bars in series with the tyres; between 3 and 6 degrees per g."""
    motion, linear = slow_ramp(simulate, car)
    gradient = slope(motion, linear, motion.column("roll_rad"))
    near(gradient, linear_theory.steady_roll(CAR)[0], rel=3e-3)
    assert 3.0 < np.degrees(gradient) * G < 6.0


def understeer_is_linear_theory_s(simulate: Simulate, car: Vehicle) -> None:
    """δ - L/R over a_y: m/L (l_r/C_f' - l_f/C_r'); between 1.5 and 4 degrees per g."""
    motion, linear = slow_ramp(simulate, car)
    beyond = motion.column("steer_rad") - L * motion.column("yaw_rate_rad_s") / motion.column("vx_m_s")
    gradient = slope(motion, linear, beyond)
    near(gradient, linear_theory.understeer_gradient_rad_per_m_s2(CAR, DRY), rel=0.01)
    assert 1.5 < np.degrees(gradient) * G < 4.0


def responses_are_linear_theory_s(simulate: Simulate, car: Vehicle) -> None:
    """Yaw rate, a_y and roll per steering angle, 0.3 to 3 Hz: amplitude within 1 %, phase within 0.8 degrees."""
    for frequency in (0.3, 0.7, 1.5, 2.2, 3.0):
        t = np.arange(0.0, 3.0 + 2.0 / frequency, 1e-3)
        steer = 0.002 * np.sin(2 * np.pi * frequency * t)
        motion = simulate(open_loop(25.0, steer), DRY, vehicle=frictionless(car), period_s=0.001)
        rows = t > t[-1] - 2.0 / frequency
        turn = 2 * np.pi * frequency * t[rows]
        basis = np.stack([np.sin(turn), np.cos(turn)], axis=1)
        speed = float(motion.column("vx_m_s")[rows].mean())
        assert np.isfinite(speed)
        theory = linear_theory.frequency_response(frictionless(CAR), frequency, speed, DRY)
        for name, response in zip(("yaw_rate_rad_s", "ay_m_s2", "roll_rad"), theory, strict=True):
            (sine, cosine), *_ = np.linalg.lstsq(basis, motion.column(name)[rows], rcond=None)
            ratio = complex(sine, cosine) / 0.002 / response
            near(abs(ratio), 1.0, within=0.01)
            near(np.degrees(np.angle(ratio)), 0.0, within=0.8)


def a_bank_is_felt(simulate: Simulate, car: Vehicle) -> None:
    """Straight on along a bank: no a_y, the tyres carry g sin(bank), the body leans on, the IMU reads both."""
    bank = 0.06
    motion = simulate(Plan(20.0, 15.0, path=straight_path(20.0, 400.0), road=steady_road(bank, 0.0)), DRY, vehicle=car)
    last = {name: float(motion.column(name)[-1]) for name in OBSERVED}
    near(last["ay_m_s2"], 0.0, within=1e-3)
    near(last["yaw_rate_rad_s"], 0.0, within=1e-4)
    body = last["roll_rad"] - bank
    near(body, linear_theory.steady_roll(CAR)[0] * G * np.sin(bank), rel=0.01)
    near(last["specific_force_y_m_s2"], G * np.sin(bank + body), rel=2e-3)
    near(last["specific_force_z_m_s2"], G * np.cos(bank + body), rel=2e-3)
    near(sum(last[f"fy_{w}_n"] for w in WHEELS), M * G * np.sin(bank), rel=5e-3)
    near(sum(last[f"fz_{w}_n"] for w in WHEELS), M * G * np.cos(bank), rel=1e-4)
    near(last["steer_rad"], linear_theory.understeer_gradient_rad_per_m_s2(CAR, DRY) * G * np.sin(bank), rel=0.1)


def a_banked_bend_presses(simulate: Simulate, car: Vehicle) -> None:
    """Round a bend that leans inwards: ΣF_z = m (g cos b + v²/R sin |b|), and the body-fixed gyros share the turn."""
    bank, radius = -0.12, 150.0
    s = np.arange(0.0, 500.0, 0.5)
    path = np.stack([radius * np.sin(s / radius), radius * (1 - np.cos(s / radius)), s / radius, 0 * s + 22.0], axis=1)
    motion = simulate(Plan(22.0, 15.0, path=path, road=steady_road(bank, 0.0)), DRY, vehicle=car)
    tail = slice(-200, None)
    mean = {name: float(motion.column(name)[tail].mean()) for name in OBSERVED}
    heading_rate = mean["yaw_rate_rad_s"] / np.cos(bank)
    across = heading_rate * mean["vx_m_s"]
    near(across, 22.0**2 / radius, rel=0.03)
    total = sum(mean[f"fz_{w}_n"] for w in WHEELS)
    near(total, M * (G * np.cos(bank) - across * np.sin(bank)), rel=5e-4)
    roll, pitch = mean["roll_rad"], mean["pitch_rad"]
    near(mean["gyro_z_rad_s"], heading_rate * np.cos(roll) * np.cos(pitch), rel=1e-3)
    near(mean["gyro_y_rad_s"], heading_rate * np.sin(roll) * np.cos(pitch), rel=0.02)


def resistance_n(speed: float) -> float:
    return 0.5 * 1.204 * 0.66 * speed**2 + 0.012 * M * G


def pushed(simulate: Simulate, car: Vehicle, speed: float, torque: float, grade: float) -> Motion:
    """Straight on for 3 s under a torque at the wheels, nobody at the pedals."""
    torques = np.tile([max(torque, 0.0), max(-torque, 0.0)], (3001, 1))
    plan = replace(open_loop(speed, np.zeros(3001)), torque_n_m=torques, road=steady_road(0.0, grade))
    motion = simulate(plan, DRY, vehicle=car)
    assert np.isfinite(motion.column("vx_m_s")).all()
    return motion


def slowing_n(motion: Motion) -> tuple[float, float]:
    """Force that slows the rolling mass over the last two seconds, N, and the mean speed."""
    v = motion.column("vx_m_s")
    rolling_mass = M + 2.0 * (1.6 + 1.2) / RADIUS**2  # with the rotating wheels
    return float(rolling_mass * (v[100] - v[-1]) / 2.0), float(v[100:].mean())


def a_hill_pulls(simulate: Simulate, car: Vehicle) -> None:
    """Coasting up and down: m g sin(grade) on top of the resistance; the IMU reads it, the height grows."""
    for grade in (0.06, -0.06):
        motion = pushed(simulate, car, 25.0, 0.0, grade)
        force, speed = slowing_n(motion)
        near(force, resistance_n(speed) + M * G * np.sin(grade), rel=4e-3)
        feels = motion.column("specific_force_x_m_s2")[-1]
        near(feels - motion.column("ax_m_s2")[-1], G * np.sin(-motion.column("pitch_rad")[-1]), within=4e-3)
        near(motion.column("z_m")[-1] / motion.column("x_m")[-1], np.tan(grade), rel=1e-6)


def coasting_is_slowed_by_air_and_tyres(simulate: Simulate, car: Vehicle) -> None:
    """(m + ΣI/R²) dv/dt = -(air + rolling) at town and motorway speed."""
    for start in (10.0, 45.0):
        force, speed = slowing_n(pushed(simulate, car, start, 0.0, 0.0))
        near(force, resistance_n(speed), rel=4e-3)


def torque_becomes_speed(simulate: Simulate, car: Vehicle) -> None:
    """The torque over the radius, less the resistance, drives the mass and the wheels; so it does when braking."""
    for torque in (900.0, -1200.0):
        force, speed = slowing_n(pushed(simulate, car, 25.0, torque, 0.0))
        near(force, resistance_n(speed) - torque / RADIUS, rel=0.015)


def standing_still_is_still(simulate: Simulate, car: Vehicle) -> None:
    """After a bend, the car stops and stays at rest for half a minute."""
    s = np.arange(0.0, 60.0, 0.5)
    speed = np.minimum(np.sqrt(2.0 * 2.0 * np.maximum(20.0 - s, 0.0)), 8.0)
    y = 0.02 * s**2 / 2.0
    path = np.stack([s, y, np.arctan(0.02 * s), speed], axis=1)
    motion = simulate(Plan(8.0, 35.0, path=path, stops=np.array([[20.0, 1000.0]])), DRY, vehicle=car)
    still = slice(1500, None)
    for name in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ax_m_s2", "ay_m_s2", "roll_rate_rad_s", "pitch_rate_rad_s"):
        near(motion.column(name)[still], 0.0, within=1e-5)
    near(np.ptp(motion.column("x_m")[still]), 0.0, within=1e-5)
    # And on a hill that leans, held by the brake: the tyres carry the car's weight down the slope.
    hill = np.array([[DRY, DRY, 0.05, 0.08]] * 3)
    held = Plan(0.0, 30.0, steer_rad=np.zeros(30_001), torque_n_m=np.tile([0.0, 900.0], (30_001, 1)), road=hill)
    motion = simulate(held, DRY, vehicle=car)
    for name in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s"):
        near(motion.column(name)[1000:], 0.0, within=1e-4)
        near(motion.column(name)[-1], 0.0, within=1e-6)
    near(sum(motion.column(f"fx_{w}_n")[-1] for w in WHEELS), M * G * np.sin(0.08), rel=1e-3)
    near(sum(motion.column(f"fy_{w}_n")[-1] for w in WHEELS), M * G * np.sin(0.05) * np.cos(0.08), rel=5e-3)


@dataclass(frozen=True)
class Wrong:
    """An error: factors of values of the car, its tyres, the road that it drives on, or its recorded motion."""

    car: dict[str, float] = field(default_factory=dict)
    tyre: dict[str, float] = field(default_factory=dict)
    road: float = 1.0
    motion: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        factors = {**self.car, **self.tyre, **self.motion, "road": self.road}
        return "-".join(f"{factor:g}_{name}" for name, factor in factors.items() if factor != 1.0)

    def spoilt_car(self) -> Vehicle:
        tyre = CAR.front_tyre._replace(**{n: f * getattr(CAR.front_tyre, n) for n, f in self.tyre.items()})
        values = {n: f * getattr(CAR, n) for n, f in self.car.items()}
        return CAR._replace(**values, front_tyre=tyre, rear_tyre=tyre)

    def simulate(self, plan: Plan, friction: float, **options: Any) -> Motion:
        road = plan.road * np.array([1.0, 1.0, self.road, self.road]) if plan.road.size else plan.road
        motion = simulate_motion(replace(plan, road=road), friction, **options)
        for name, factor in self.motion.items():
            motion.column(name)[:] *= factor
        return motion


def times(factor: float, *names: str) -> Wrong:
    return Wrong(car=dict.fromkeys(names, factor))


def tyres(factor: float, name: str) -> Wrong:
    return Wrong(tyre={name: factor})


def recorded(factor: float, name: str) -> Wrong:
    return Wrong(motion={name: factor})


COMPLIANCES = ("front_compliance_rad_per_n", "rear_compliance_rad_per_n")

GATES: dict[Gate, tuple[Wrong, ...]] = {
    weight_is_carried: (times(1.1, "cg_to_front_axle_m"), times(1.1, "mass_kg")),
    left_is_right: (recorded(1.1, "fz_fl_n"), recorded(-1.0, "fz_rr_n")),
    steps_are_fine_enough: (recorded(1.1, "x_m"), recorded(-1.0, "vy_m_s")),
    forces_lag_by_the_relaxation_length: (tyres(1.1, "lateral_relaxation_m"), tyres(1.1, "stiffness_peak")),
    acceleration_is_that_of_the_velocities: tuple(recorded(1.1, n) for n in ("ax_m_s2", "ay_m_s2", "yaw_rate_rad_s")),
    load_moves_as_statics_say: (times(1.1, "cg_height_m"), times(1.1, "front_anti_roll_n_m_per_rad")),
    body_rolls_by_the_closed_form: (times(1.1, "front_spring_n_per_m"), times(1.1, "tyre_vertical_n_per_m")),
    understeer_is_linear_theory_s: (times(1.1, COMPLIANCES[0]), times(-1.0, COMPLIANCES[1])),
    responses_are_linear_theory_s: (
        times(1.1, "yaw_inertia_kg_m2"),
        times(1.1, "front_damper_n_s_per_m", "rear_damper_n_s_per_m"),
    ),
    a_bank_is_felt: (Wrong(road=-1.0), Wrong(road=1.1)),
    a_banked_bend_presses: (Wrong(road=-1.0), Wrong(road=1.1)),
    a_hill_pulls: (Wrong(road=-1.0), Wrong(road=1.1)),
    coasting_is_slowed_by_air_and_tyres: (times(1.1, "drag_area_m2"), times(1.1, "rolling_resistance")),
    torque_becomes_speed: (times(1.1, "wheel_radius_m"), times(0.9, "mass_kg")),
    standing_still_is_still: (tyres(-1.0, "longitudinal_damping_s_per_m"), tyres(-1.0, "lateral_damping_s_per_m")),
}


@pytest.mark.parametrize("gate", GATES, ids=lambda g: g.__name__)
def test_gate(gate):
    gate(simulate_motion, CAR)


@pytest.mark.parametrize(
    ("gate", "wrong"), [pytest.param(g, w, id=f"{g.__name__}-{w}") for g, all_wrong in GATES.items() for w in all_wrong]
)
def test_gate_sees_the_error(gate, wrong):
    with pytest.raises(AssertionError), np.errstate(all="ignore"):
        gate(wrong.simulate, wrong.spoilt_car())
