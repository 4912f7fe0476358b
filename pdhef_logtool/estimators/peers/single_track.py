"""Linear single track over [v_y, r] with the road-wheel angle δ as input (Riekert and Schunck 1940): ẋ = A x + B δ."""

from typing import NamedTuple

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.compiled.cache import njit

#: The model divides by the speed: a car that is slower, or drives backward, rolls without slip.
LEAST_SPEED_M_S = 0.5
#: Longest integration step.
LONGEST_STEP_S = 0.005


class SingleTrack(NamedTuple):
    """Parameters in SI units; stiffness of an axle in N/rad."""

    mass: float
    inertia: float
    front_m: float
    rear_m: float
    front_stiffness: float
    rear_stiffness: float


def single_track(vehicle: VehicleParameters) -> SingleTrack:
    """Return the parameters of a vehicle at the friction of its file."""
    stiffness = (vehicle.cornering_stiffness_n_per_rad(front, vehicle.assumed_friction) for front in (True, False))
    lengths = vehicle.cg_to_front_axle_m, vehicle.cg_to_rear_axle_m
    return SingleTrack(vehicle.mass_kg, vehicle.yaw_inertia_kg_m2, *lengths, *stiffness)


@njit(cache=True, error_model="numpy")
def matrices(vx, p, stiffness=1.0):  # type: ignore[no-untyped-def]
    """Return A (2, 2) and B (2) at a speed, with a factor on the stiffness of both axles."""
    u, cf, cr = max(vx, LEAST_SPEED_M_S), stiffness * p.front_stiffness, stiffness * p.rear_stiffness
    moment = cf * p.front_m - cr * p.rear_m
    of_vy = -(cf + cr) / (p.mass * u), -moment / (p.mass * u) - u
    of_r = -moment / (p.inertia * u), -(cf * p.front_m**2 + cr * p.rear_m**2) / (p.inertia * u)
    return (of_vy, of_r), (cf / p.mass, cf * p.front_m / p.inertia)


@njit(cache=True, error_model="numpy")
def solve(a, b0, b1):  # type: ignore[no-untyped-def]
    """Return the solution (2) of a system (2, 2); stationary driving solves A x = −B δ."""
    (a00, a01), (a10, a11) = a
    determinant = a00 * a11 - a01 * a10
    return (b0 * a11 - b1 * a01) / determinant, (a00 * b1 - a10 * b0) / determinant


@njit(cache=True, error_model="numpy")
def discrete(a, b, h):  # type: ignore[no-untyped-def]
    """Return transition F (two columns) and input G (2) of the trapezoidal rule: (1 − h A / 2) F = 1 + h A / 2."""
    (a00, a01), (a10, a11) = a
    c = 0.5 * h
    left = (1.0 - c * a00, -c * a01), (-c * a10, 1.0 - c * a11)
    columns = solve(left, 1.0 + c * a00, c * a10), solve(left, c * a01, 1.0 + c * a11)
    return columns, solve(left, h * b[0], h * b[1])
