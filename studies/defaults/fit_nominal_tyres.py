"""Fit nominal axle tyres to slow ramp steers of the simulated vehicle; write the vehicle files of the samples.

    python -m studies.defaults.fit_nominal_tyres [sample_logs]

The nominal model (docs/method.md#model) has one slip angle per axle, from the mean steering angle and the motion of
the CG. So load transfer, compliance and both wheels of an axle go into its magic formula. Forces follow from Newton and
Euler as they would from measured accelerations: F_f = (l_r m a_y + I_z dr/dt) / (L cos d), F_r = m a_y - F_f cos d.

One curve serves all roads: by similarity (Pacejka 2012, section 4.2) the force over friction is a function of the slip
angle over friction, so that the peak follows friction and the stiffness stays. The fit is to both roads at once, with
``reference_friction = 1``; fitted on one road alone the rear axle, which never reaches its peak there, was wrong on the
other.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from pdhef_logtool.car.vehicle import AxleTyre, VehicleParameters
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.storage.templates import template
from studies.pages import options
from truthsim.manoeuvres import GRAVITY_M_S2, MANOEUVRES, Request
from truthsim.motion import Motion, simulate_motion
from truthsim.sensors import SensorNoise
from truthsim.vehicle import Vehicle

CAR = Vehicle()
NOISE = SensorNoise()
#: One file a road, with the same tyres: the friction of a vehicle file applies to logs without friction.
ROADS = {
    "vehicle.toml": ("truthsim saloon", 0.85),
    "vehicle_mu03.toml": ("truthsim saloon on a road of friction 0.3", 0.3),
}
SPEED_KM_H = 80.0
#: Steering amplitude as a multiple of the default ramp manoeuvre, well into the plateau of the front axle.
SCALE = 2.5
#: Below this the ramp is the linear range, in which roll is proportional to lateral acceleration.
LINEAR_A_Y_M_S2 = 4.0


#: Columns of :func:`axle_curves`.
MOTION = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "steer_rad", "ay_m_s2", "yaw_acceleration_rad_s2")


def axle_curves(
    motion: Iterable[FloatArray], car: Vehicle | VehicleParameters = CAR
) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Return slip angle (rad) and lateral force (N) of both axles over a motion: the columns [N] of :data:`MOTION`."""
    lf, lr = car.cg_to_front_axle_m, car.cg_to_rear_axle_m
    v_x, v_y, r, steer, a_y, yaw_acceleration = motion
    force = car.mass_kg * a_y
    front = (lr * force + car.yaw_inertia_kg_m2 * yaw_acceleration) / (lf + lr)
    return {
        "front": (steer - np.arctan2(v_y + lf * r, v_x), front / np.cos(steer)),
        "rear": (-np.arctan2(v_y - lr * r, v_x), force - front),
    }


def magic_formula(alpha: FloatArray, b: float, c: float, d: float, e: float) -> FloatArray:
    """F = D sin(C atan(B a - E (B a - atan(B a)))); E = 1 - exp(e) keeps E below 1."""
    x = b * alpha
    curvature = 1.0 - np.exp(e)
    return np.asarray(d * np.sin(c * np.arctan(x - curvature * (x - np.arctan(x)))))


def fit_axle(alpha: FloatArray, force: FloatArray, load_n: float) -> AxleTyre:
    """Fit a magic formula at friction 1 to slip angle and force, both over friction, by least squares.

    The rear axle of an understeering car never reaches its peak in a ramp: the static load bounds it.
    """
    top = float(force.max())
    start = [10.0, 1.3, 1.01 * top, 0.0]
    bounds = ([3.0, 1.05, 1.0 * top, -2.0], [40.0, 1.7, max(load_n, 1.02 * top), 1.1])
    solution = least_squares(
        lambda p: (magic_formula(alpha, *p) - force) / top, start, bounds=bounds, x_scale=[10.0, 1.0, top, 1.0]
    )
    b, c, d, e = solution.x
    return AxleTyre(B=b, C=c, D_n=d, E=1.0 - float(np.exp(e)), reference_friction=1.0)


def fit_axles(motions: dict[float, Motion]) -> dict[str, AxleTyre]:
    """Fit both axles to one motion a friction."""
    curves = {friction: axle_curves(map(motion.column, MOTION)) for friction, motion in motions.items()}
    return {
        axle: fit_axle(
            np.concatenate([curve[axle][0] / friction for friction, curve in curves.items()]),
            np.concatenate([curve[axle][1] / friction for friction, curve in curves.items()]),
            load_n,
        )
        for axle, load_n in axle_loads_n(CAR).items()
    }


def axle_loads_n(car: Vehicle) -> dict[str, float]:
    """Return the static load of both axles."""
    wheelbase = car.cg_to_front_axle_m + car.cg_to_rear_axle_m
    arms = {"front": car.cg_to_rear_axle_m, "rear": car.cg_to_front_axle_m}
    return {axle: car.mass_kg * GRAVITY_M_S2 * arm / wheelbase for axle, arm in arms.items()}


def roll_gradient_rad_per_m_s2(motion: Motion, linear_m_s2: float = LINEAR_A_Y_M_S2) -> float:
    """Return the roll angle per planar lateral acceleration in the linear range."""
    a_y, roll = motion.column("ay_m_s2"), motion.column("roll_rad")
    small = np.abs(a_y) < linear_m_s2
    return float(np.polyfit(a_y[small], roll[small], 1)[0])


def ramp(friction: float, car: Vehicle = CAR) -> Motion:
    """Return the slow ramp steer that everything is fitted to."""
    manoeuvre = MANOEUVRES["ramp-steer"]
    duration_s = manoeuvre.default_duration_s(SPEED_KM_H / 3.6)
    request = Request(SPEED_KM_H / 3.6, friction, seed=0, duration_s=duration_s, scale=SCALE)
    return simulate_motion(manoeuvre.plan(request), friction, vehicle=car)


def vehicle_text(motion: Motion, fits: dict[str, AxleTyre], *, name: str, friction: float) -> str:
    """Return a vehicle file."""
    about = {"name": name, "friction": friction, "roads": [road for _, road in ROADS.values()], "tyres": fits}
    about |= {"car": CAR, "noise": NOISE, "speed_km_h": SPEED_KM_H}
    file = template(Path(__file__).with_name("nominal_vehicle.txt"))
    return file.render(about, roll_gradient=roll_gradient_rad_per_m_s2(motion))


def main(folder: Path) -> None:
    """Fit, and write the vehicle files."""
    motions = {friction: ramp(friction) for _, friction in ROADS.values()}
    fits = fit_axles(motions)
    for file, (name, friction) in ROADS.items():
        text = vehicle_text(motions[max(motions)], fits, name=name, friction=friction)
        (folder / file).write_text(text, encoding="utf-8")


if __name__ == "__main__":
    parser = options("defaults.fit_nominal_tyres", __doc__)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("sample_logs"))
    main(parser.parse_args().folder)
