"""The single-track models of the vehicle filter: motion f and sensor readings h of many states at once.

See docs/method.md#physics.

State, ISO 8855, SI, at the centre of gravity: [v_x, v_y, r, b_ax] and, for the model with axle forces, [f_f, f_r] and
the car's parts [φ, φ̇], [bank], [s], [b_δ], [b_ay, b_r]. f = F_y / m is an axle's lateral force over the vehicle's mass
in m/s². Without axle forces it is the nominal model (:mod:`~pdhef_logtool.car.nominal_model`), in RK4 steps. With them:

- **Lag**: (σ / v_x) ḟ + f = f_ss(α). Without it f is the steady force of the tyres.
- **Roll**: φ̈ = ω² (G a_y − φ) − 2 ζ ω φ̇ with the roll gradient G. The tyres see v_y + h_s φ̇, because the centre of
  gravity is h_s above the roll axis; the accelerometer measures g φ in addition to the forces. Without this part, roll
  is in equilibrium: (1 + g G) Σf.
- **Load transfer** moves the share x = 2 h a_y / (g T) of a wheel's load to the other wheel of the axle; with roll, a_y
  is φ / G, as the springs transfer it. If the force per load of a tyre decreases by the share s_z per relative excess
  of load, the axle force has the factor 1 − s_z x² (Eq 7). A magic formula fitted to an axle already includes this
  factor for steady cornering, at the a_y that corresponds to the axle force: then the ratio of the two is used.
- **Braking** (``ax`` below 0) moves the load a_x h / L to the front and reduces the grip of both axles by the factor
  √(1 − (a_x / μ g)²), for brake forces proportional to the loads. The driven axle is unknown: there is no correction
  for acceleration.
- **Bank**: −g · bank in v̇_y only, an Ornstein-Uhlenbeck process.
- **Force scale**: 1 + s on the tyres' forces, an Ornstein-Uhlenbeck process.

States are the columns of a block: row i has entry i of all states. Each entry has a fixed row, 0 for missing parts.
Loops over the columns, a multiple of ``LANES``, have neither branches nor calls, so that they become vector
instructions. In a step of the model with axle forces the tyres are evaluated once, at the instant t* at which the
exponential kernel of the lag has its centroid, with the initial state extrapolated by its derivative. Velocities use
the mean of the forces at both ends. The method is of second order in the step except for slow quantities (speed in the
lag, bank, force scale, and the load transfer without roll), and stable for any lag.
"""

import math
from typing import NamedTuple

import numpy as np

from pdhef_logtool.car.elementary_functions import arctangent, sine
from pdhef_logtool.car.nominal_model import (
    KINEMATIC_TIME_CONSTANT_S,
    MAX_SUBSTEPS,
    ModelParameters,
    Prepared,
    accelerations,
    dynamic_share,
    planar_lateral_acceleration,
    prepare,
    rk4_step,
    substeps,
)
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.compiled.cache import inline, inner_kernel, kernel, njit
from pdhef_logtool.records.signals import IntArray

#: Rows of a block: one for each entry that a state may have. The first ``CORE`` are those of every model with axle
#: forces, the first four those of every model.
VX, VY, YAW_RATE, AX_BIAS, FRONT, REAR, ROLL, ROLL_RATE, BANK, FORCE_SCALE, STEER_BIAS, AY_BIAS, RATE_BIAS = range(13)
MOTION, CORE, PLACES = 3, 6, 21
#: Rows behind them, with values of a step of the model that one loop leaves to the next.
SPEED, FRONT_TYRES, REAR_TYRES, LEAN, MEAN_VX, MEAN_VY, MEAN_RATE, MEAN_ROLL_RATE = range(RATE_BIAS + 1, PLACES)
#: Sensors.
Z_AY, Z_YAW_RATE, Z_SPEED = range(3)
READINGS = 3
#: Numbers in a vector, and columns of a block: a multiple of it, for two states an entry before the sensor biases and
#: one at the centre.
LANES = 4
WIDTH = 6 * LANES

#: Time constant with which the force scale returns to 0, s (docs/method.md#physics).
FORCE_SCALE_TIME_S = 2.0
#: Time constant with which the bank returns to 0 (docs/method.md#physics).
BANK_TIME_S = 5.0
#: Spread of the bank, rad: a crowned road has 0.02-0.03, motorway bends to 0.07. Spread of the force scale
#: (docs/method.md#adaptation).
BANK_STD, FORCE_SCALE_STD = 0.02, 0.05
#: Speed process noise where the log has no longitudinal accelerometer: the speed is then a random walk
#: (docs/method.md#frame).
NO_AX_Q_STD = 3.0
#: Largest product of step and the roll mode's frequency; longer steps are divided.
_MAX_ROLL_STEP = 0.5
#: Minimum share of the grip that braking leaves for lateral forces; minimum factor on forces by their scale.
_LEAST_GRIP, LEAST_FORCE = 0.2, 0.1
#: Below this roll gradient, rad/(m/s²), roll does not indicate load transfer, which then follows the acceleration.
LEAST_ROLL_GRADIENT = 1e-3


class Layout(NamedTuple):
    """Index of each part in a state [n]; −1 if the model lacks the part."""

    size: int
    changing: int  # entries before the sensor biases, which the model neither changes nor depends on
    forces: int  # f_f, and f_r behind it
    roll: int  # φ, and φ̇ behind it
    bank: int
    force_scale: int
    steer_bias: int
    sensor_bias: int  # of a_y, then of the yaw rate

    @property
    def places(self) -> IntArray:
        """Row in a block of each entry of a state, [n]."""
        rows = [VX, VY, YAW_RATE, AX_BIAS]
        for index, part in zip(self[2:], _ROWS_OF_PARTS, strict=True):
            rows += part if index >= 0 else ()
        return np.array(rows, dtype=np.uint8)

    @property
    def named(self) -> dict[str, int]:
        """Indices of the states with a column in a track, by column name."""
        columns = {
            "roll_rad": self.roll,
            "bank_rad": self.bank,
            "force_scale": self.force_scale,
            "steer_bias_rad": self.steer_bias if self.sensor_bias >= 0 else -1,
            "ay_bias_m_s2": self.sensor_bias,
            "yaw_rate_bias_rad_s": self.sensor_bias + 1 if self.sensor_bias >= 0 else -1,
        }
        return {name: index for name, index in columns.items() if index >= 0}


_ROWS_OF_PARTS = ((FRONT, REAR), (ROLL, ROLL_RATE), (BANK,), (FORCE_SCALE,), (STEER_BIAS,), (AY_BIAS, RATE_BIAS))
#: The layout of the nominal model.
NOMINAL = Layout(4, 4, -1, -1, -1, -1, -1, -1)


def layout_of(vehicle: VehicleParameters) -> Layout:
    """Return the layout of the model with axle forces: the parts of a car, and a steering bias."""
    parts, size, indices = vehicle.physics, AX_BIAS + 1, []
    has = (True, parts.roll, parts.bank, parts.force_scale, True, parts.biases)
    for there, rows in zip(has, _ROWS_OF_PARTS, strict=True):
        indices.append(size if there else -1)
        size += len(rows) if there else 0
    return Layout(size, indices[-1] if parts.biases else size, *indices)


class PhysicsParameters(NamedTuple):
    """Parameters of the compiled model in addition to :class:`~pdhef_logtool.car.nominal_model.ModelParameters`."""

    relaxation_length_m: float  # 0: no lag
    load_sensitivity: float  # s_z; 0: no load transfer
    transfer_per_ay: float  # x over a_y, s²/m
    front_share: float  # m_f / m
    rear_share: float
    front_holds_transfer: bool  # the formula was fitted with the load transfer of steady cornering in it
    rear_holds_transfer: bool
    front_load_per_ax: float  # relative change of the axle's load over a_x when braking, s²/m; 0: braking is no part
    rear_load_per_ax: float
    roll_gradient: float  # G in rad/(m/s²); 0: neither roll nor its share of a_y
    roll_frequency_rad_s: float
    roll_damping: float
    swing_m: float  # h_s


def physics_parameters(vehicle: VehicleParameters) -> PhysicsParameters:
    """Return the parameters of a car's parts for the compiled model."""
    parts, height = vehicle.physics, vehicle.cg_height_m
    front, rear = vehicle.cg_to_front_axle_m, vehicle.cg_to_rear_axle_m
    moved = height / GRAVITY_M_S2 if parts.braking else 0.0
    return PhysicsParameters(
        relaxation_length_m=vehicle.relaxation_length_m if parts.lag else 0.0,
        load_sensitivity=vehicle.load_sensitivity if parts.load_transfer else 0.0,
        transfer_per_ay=2.0 * height / (GRAVITY_M_S2 * vehicle.track_m),
        front_share=rear / vehicle.wheelbase_m,
        rear_share=front / vehicle.wheelbase_m,
        front_holds_transfer=vehicle.tyres.front.cornering_stiffness_n_per_rad is None,
        rear_holds_transfer=vehicle.tyres.rear.cornering_stiffness_n_per_rad is None,
        front_load_per_ax=-moved / rear,
        rear_load_per_ax=moved / front,
        roll_gradient=vehicle.roll_gradient_rad_per_m_s2,
        roll_frequency_rad_s=vehicle.roll_frequency_rad_s,
        roll_damping=vehicle.roll_damping,
        swing_m=vehicle.cg_over_roll_axis_m,
    )


class Model(NamedTuple):
    """Arguments of the compiled models."""

    layout: Layout
    places: IntArray
    p: ModelParameters
    f: PhysicsParameters


class HeldInputs(NamedTuple):
    """Inputs over a step: the mean of its two ends."""

    steer: float
    ax: float
    ax_known: bool
    friction: float


class _Step(NamedTuple):
    """Constants of a step of the model with axle forces, common to all points.

    Those of an axle are B, C, E and D of its tyres, B over friction where it needs that, and D over the mass with the
    factor by braking; s_z if the formula contains the transfer of steady cornering, else 0; its share of the mass.
    """

    nominal: Prepared
    ax: float
    kept: float  # share of an axle's initial force that remains at the end of the step
    tyre_s: float  # t*: time from the step's start to the evaluation of the tyres
    front: tuple[float, ...]
    rear: tuple[float, ...]


@inline
def columns_of(points):  # type: ignore[no-untyped-def]
    """Return the number of columns of a block for a centre and ``points`` others, rounded up to whole vectors."""
    return (points + LANES) // LANES * LANES


@njit(cache=True)
def step_count(vx, dt, friction, layout, p, f):  # type: ignore[no-untyped-def]
    """Return the number of substeps for ``dt``, by the nominal model and by the roll mode."""
    n = substeps(vx, dt, friction, p)
    if layout.roll >= 0:
        n = max(n, math.ceil(dt * f.roll_frequency_rad_s / _MAX_ROLL_STEP))
    return min(n, MAX_SUBSTEPS)


@njit(cache=True)
def grip_under_braking(ax, friction, load_per_ax):  # type: ignore[no-untyped-def]
    """Return the factor on an axle's lateral force by its change of load and by the grip used for braking."""
    if ax >= 0.0 or load_per_ax == 0.0:
        return 1.0
    used = ax / (friction * GRAVITY_M_S2)
    left = math.sqrt(max(1.0 - used * used, _LEAST_GRIP * _LEAST_GRIP))
    return max(1.0 + load_per_ax * ax, _LEAST_GRIP) * left


@inline
def _prepare(vx, h, steer, ax, friction, p, f):  # type: ignore[no-untyped-def]
    """Return the constants of a step of ``h`` s at a speed of about ``vx``."""
    kept, tyre_s = 0.0, h
    if f.relaxation_length_m > 0.0:
        x = h * max(vx, p.blend_low_m_s) / f.relaxation_length_m
        kept = math.exp(-x)
        tyre_s = h * (1.0 - (1.0 - x * kept / (1.0 - kept)) / x) if x > 1e-3 else h * (0.5 + x / 12.0)
    c, held = prepare(steer, friction, p), f.load_sensitivity
    front = grip_under_braking(ax, friction, f.front_load_per_ax)
    rear = grip_under_braking(ax, friction, f.rear_load_per_ax)
    return _Step(
        c, ax, kept, tyre_s,
        (c.b_front, p.front_C, p.front_E, front * c.peak_front, f.front_holds_transfer * held, f.front_share),
        (c.b_rear, p.rear_C, p.rear_E, rear * c.peak_rear, f.rear_holds_transfer * held, f.rear_share),
    )  # fmt: skip


@inline
def force_factor(scale):  # type: ignore[no-untyped-def]
    """Return the factor on the tyres' forces by their scale."""
    return max(LEAST_FORCE, 1.0 + scale)


@inline
def _transfer_factor(ay, sensitivity, f):  # type: ignore[no-untyped-def]
    """Return 1 − s_z x² of an axle at lateral acceleration ``ay``; x is limited to 1, where the inner wheel lifts."""
    x = min(1.0, abs(f.transfer_per_ay * ay))
    return 1.0 - sensitivity * x * x


# positional: as advance.
@inline
def _tyre_forces(points, columns, row, angle, axle, f):  # type: ignore[no-untyped-def]
    """Replace the velocity across an axle, in its ``row``, by the tyres' steady force over the mass in m/s².

    ``angle`` is the front wheels' steering angle, which the rear ones do not have. Loops of a few operations each
    process several columns at the same time, which one long chain of operations does not.
    """
    stiffness, shape, curvature, peak, held, share = axle
    for j in range(columns):
        steer = angle - points[STEER_BIAS * WIDTH + j] if row == FRONT_TYRES else 0.0
        points[row * WIDTH + j] = stiffness * (steer - arctangent(points[row * WIDTH + j], points[SPEED * WIDTH + j]))
    for j in range(columns):
        slip = points[row * WIDTH + j]
        points[row * WIDTH + j] = slip - curvature * (slip - arctangent(slip, 1.0))
    for j in range(columns):
        points[row * WIDTH + j] = shape * arctangent(points[row * WIDTH + j], 1.0)
    for j in range(columns):
        steady, scale = peak * sine(points[row * WIDTH + j]), force_factor(points[FORCE_SCALE * WIDTH + j])
        factor = _transfer_factor(points[LEAN * WIDTH + j], f.load_sensitivity, f)
        points[row * WIDTH + j] = steady * scale * factor / _transfer_factor(steady / share, held, f)


# positional: numbers and records of numbers, which are free of cost in compiled calls.
@kernel
def advance(points, columns, over, dt, layout, p, f):  # type: ignore[no-untyped-def]
    """Advance the first ``columns`` of a block [PLACES · WIDTH], a multiple of ``LANES``, by ``dt`` s; all are finite.

    ``over`` has steering angle, accelerometer's a_x and friction, which are constant. The speed of the first column
    determines the number of substeps.
    """
    vx = points[VX * WIDTH]
    if layout.forces >= 0:
        n = step_count(vx, dt, over.friction, layout, p, f)
        _advance_forces(points, columns, vx, over, dt, n, layout, p, f)
    else:
        _advance_nominal(points, columns, over, dt, substeps(vx, dt, over.friction, p), p)


# positional: as advance.
@inner_kernel
def _advance_forces(points, columns, vx, over, dt, n, layout, p, f):  # type: ignore[no-untyped-def]
    """Advance states of the model with axle forces in ``n`` steps."""
    h = dt / n
    c = _prepare(vx, h, over.steer, over.ax, over.friction, p, f)
    nominal = c.nominal
    per_kinematic = 1.0 / KINEMATIC_TIME_CONSTANT_S
    frequency = f.roll_frequency_rad_s if layout.roll >= 0 else 0.0
    stiffness, damping = frequency**2, 2.0 * f.roll_damping * frequency
    leans = layout.roll >= 0 and abs(f.roll_gradient) > LEAST_ROLL_GRADIENT
    per_gradient, follows = (1.0 / f.roll_gradient, 0.0) if leans else (0.0, 1.0)
    bank_kept = math.exp(-h / BANK_TIME_S) if layout.bank >= 0 else 1.0
    scale_kept = math.exp(-h / FORCE_SCALE_TIME_S) if layout.force_scale >= 0 else 1.0
    t, half = c.tyre_s, 0.5 * h
    for _ in range(n):
        # from the start to t*: the velocities across the axles, and what the lean transfers
        for j in range(columns):
            vx, vy, r = points[VX * WIDTH + j], points[VY * WIDTH + j], points[YAW_RATE * WIDTH + j]
            phi, phi_dot = points[ROLL * WIDTH + j], points[ROLL_RATE * WIDTH + j]
            w = min(1.0, max(0.0, (vx - p.blend_low_m_s) * nominal.per_blend))
            follow = (1.0 - w) * per_kinematic
            ffc, fr = points[FRONT * WIDTH + j] * nominal.cos, points[REAR * WIDTH + j]
            r_kin = vx * nominal.r_kin_per_vx
            slope = GRAVITY_M_S2 * points[BANK * WIDTH + j]
            vy_dot = w * (ffc + fr - slope - vx * r) + follow * (p.rear_m * r_kin - vy)
            r_dot = w * nominal.inertia * (p.front_m * ffc - p.rear_m * fr) + follow * (r_kin - r)
            vx_dot = c.ax - points[AX_BIAS * WIDTH + j] + r * r * p.imu_x_m + vy * r + r_dot * p.imu_y_m
            ay = w * (ffc + fr) + (1.0 - w) * vx * r
            roll_acc = stiffness * (f.roll_gradient * ay - phi) - damping * phi_dot
            across, turn = vy + t * vy_dot + f.swing_m * (phi_dot + t * roll_acc), r + t * r_dot
            points[SPEED * WIDTH + j] = max(vx + t * vx_dot, p.blend_low_m_s)
            points[FRONT_TYRES * WIDTH + j] = across + p.front_m * turn
            points[REAR_TYRES * WIDTH + j] = across - p.rear_m * turn
            points[LEAN * WIDTH + j] = (phi + t * phi_dot) * per_gradient + follows * ay
            points[MEAN_VX * WIDTH + j] = vx + half * vx_dot
            points[MEAN_VY * WIDTH + j] = vy + half * vy_dot
            points[MEAN_RATE * WIDTH + j] = r + half * r_dot
            points[MEAN_ROLL_RATE * WIDTH + j] = phi_dot + half * roll_acc
        _tyre_forces(points, columns, FRONT_TYRES, over.steer, c.front, f)
        _tyre_forces(points, columns, REAR_TYRES, over.steer, c.rear, f)
        # the step, with the mean of the forces at both ends
        for j in range(columns):
            vx, vy, r = points[VX * WIDTH + j], points[VY * WIDTH + j], points[YAW_RATE * WIDTH + j]
            phi, phi_dot = points[ROLL * WIDTH + j], points[ROLL_RATE * WIDTH + j]
            mx, my, rate = points[MEAN_VX * WIDTH + j], points[MEAN_VY * WIDTH + j], points[MEAN_RATE * WIDTH + j]
            w = min(1.0, max(0.0, (vx - p.blend_low_m_s) * nominal.per_blend))
            follow = (1.0 - w) * per_kinematic
            ff, fr = points[FRONT * WIDTH + j], points[REAR * WIDTH + j]
            sf, sr = points[FRONT_TYRES * WIDTH + j], points[REAR_TYRES * WIDTH + j]
            ff1, fr1 = sf + (ff - sf) * c.kept, sr + (fr - sr) * c.kept
            mfc, mr = 0.5 * (ff + ff1) * nominal.cos, 0.5 * (fr + fr1)
            r_kin = mx * nominal.r_kin_per_vx
            r_dot = w * nominal.inertia * (p.front_m * mfc - p.rear_m * mr) + follow * (r_kin - rate)
            rate = r + half * r_dot
            slope = GRAVITY_M_S2 * points[BANK * WIDTH + j]
            vy_dot = w * (mfc + mr - slope - mx * rate) + follow * (p.rear_m * r_kin - my)
            my = vy + half * vy_dot
            ay = w * (mfc + mr) + (1.0 - w) * mx * rate
            vx_dot = c.ax - points[AX_BIAS * WIDTH + j] + r_dot * p.imu_y_m + rate * rate * p.imu_x_m + my * rate
            middle, speed = phi + half * phi_dot, points[MEAN_ROLL_RATE * WIDTH + j]
            roll_acc = stiffness * (f.roll_gradient * ay - middle) - damping * speed
            points[VX * WIDTH + j] = vx + h * vx_dot
            points[VY * WIDTH + j] = vy + h * vy_dot
            points[YAW_RATE * WIDTH + j] = r + h * r_dot
            points[FRONT * WIDTH + j] = ff1
            points[REAR * WIDTH + j] = fr1
            points[ROLL * WIDTH + j] = phi + h * speed
            points[ROLL_RATE * WIDTH + j] = phi_dot + h * roll_acc
            points[BANK * WIDTH + j] *= bank_kept
            points[FORCE_SCALE * WIDTH + j] *= scale_kept


@inline
def _advance_nominal(points, columns, over, dt, n, p):  # type: ignore[no-untyped-def]
    """Advance states of the nominal model in ``n`` RK4 steps."""
    c = prepare(over.steer, over.friction, p)
    for _ in range(n):
        for j in range(columns):
            x, y, r = points[VX * WIDTH + j], points[VY * WIDTH + j], points[YAW_RATE * WIDTH + j]
            x, y, r = rk4_step(x, y, r, over.ax - points[AX_BIAS * WIDTH + j], over.steer, dt / n, c, p)
            points[VX * WIDTH + j], points[VY * WIDTH + j], points[YAW_RATE * WIDTH + j] = x, y, r


# positional: as advance.
@kernel
def push(points, columns, vx, rate, dt, p):  # type: ignore[no-untyped-def]
    """Add the increments of a residual of v̇_y and ṙ over ``dt`` s, times the force scale of each state.

    A residual counts in the dynamic range of the model, not in the kinematic one.
    """
    share = dynamic_share(vx, p) * dt
    for j in range(columns):
        force = share * force_factor(points[FORCE_SCALE * WIDTH + j])
        points[VY * WIDTH + j] += force * rate[0]
        points[YAW_RATE * WIDTH + j] += force * rate[1]


# positional: as advance.
@kernel
def read_ay(points, columns, steer, friction, rate_vy, layout, p, f, out):  # type: ignore[no-untyped-def]
    """Write the accelerometer's lateral reading in the states of a block to ``out`` [WIDTH], without its bias.

    ``rate_vy`` is the residual of v̇_y, which the accelerometer feels as it does the tyres' forces.
    """
    nominal = prepare(steer, friction, p)
    forces = layout.forces >= 0
    tilt = p.ay_roll_gain if not forces else 0.0 if layout.roll >= 0 else GRAVITY_M_S2 * f.roll_gradient
    c, inertia = math.cos(steer), p.mass_kg / p.yaw_inertia_kg_m2
    for j in range(columns):
        vx, vy, r = points[VX * WIDTH + j], points[VY * WIDTH + j], points[YAW_RATE * WIDTH + j]
        w = min(1.0, max(0.0, (vx - p.blend_low_m_s) * nominal.per_blend))
        if forces:
            front, rear = points[FRONT * WIDTH + j] * c, points[REAR * WIDTH + j]
            ay, turn = front + rear, inertia * (p.front_m * front - p.rear_m * rear)
        else:
            ay, turn = accelerations(vx, vy, r, steer, nominal, p)
        ay = w * (ay + force_factor(points[FORCE_SCALE * WIDTH + j]) * rate_vy) + (1.0 - w) * vx * r
        ay = (1.0 + tilt) * ay + w * turn * p.imu_x_m - r * r * p.imu_y_m + GRAVITY_M_S2 * points[ROLL * WIDTH + j]
        out[j] = ay


# positional: as advance.
@inline
def quadratic_ay(x, P, steer, rate_vy, layout, places, p, f, slope, Pxz):  # type: ignore[no-untyped-def]
    """Write the covariance of the accelerometer's reading with the state to P_xz [3, n]; return its mean and variance.

    They are those of the sigma points of :func:`read_ay` where all are in the dynamic range of a model with axle
    forces: it is linear except for r². ``slope`` [WIDTH] is overwritten.
    """
    turn, curve, n = p.mass_kg / p.yaw_inertia_kg_m2 * p.imu_x_m, -p.imu_y_m, x.shape[0]
    tilt = 1.0 if layout.roll >= 0 else 1.0 + GRAVITY_M_S2 * f.roll_gradient
    slope[:] = 0.0
    slope[FRONT], slope[REAR] = math.cos(steer) * (tilt + turn * p.front_m), tilt - turn * p.rear_m
    slope[ROLL], slope[FORCE_SCALE] = GRAVITY_M_S2, tilt * rate_vy
    rate, variance = x[YAW_RATE], P[YAW_RATE, YAW_RATE]
    slope[YAW_RATE] = 2.0 * curve * rate
    # The points have the fourth powers of the row of r in the root of the covariance, here its squares.
    of_vx = P[YAW_RATE, VX] ** 2 / P[VX, VX]
    of_vy = (P[YAW_RATE, VY] - P[VY, VX] * P[YAW_RATE, VX] / P[VX, VX]) ** 2 / (P[VY, VY] - P[VY, VX] ** 2 / P[VX, VX])
    of_rate = variance - of_vx - of_vy
    s = curve * curve * (variance * variance + n * (of_vx * of_vx + of_vy * of_vy + of_rate * of_rate))
    mean = tilt * rate_vy + curve * (variance - rate * rate)
    Pxz[Z_AY, :] = 0.0
    for i in range(n):
        along = slope[places[i]]
        mean += along * x[i]
        for a in range(Pxz.shape[1]):
            Pxz[Z_AY, a] += along * P[i, a]
    for i in range(n):
        s += Pxz[Z_AY, i] * slope[places[i]]
    return mean, s


@njit(cache=True, _nrt=True)
def settle_forces(x, steer, ax, friction, layout, p, f):  # type: ignore[no-untyped-def]
    """Set the axle forces of a state [n] to the steady tyre forces at their lateral acceleration; without roll."""
    steer -= x[layout.steer_bias]
    c, points = _prepare(x[VX], 0.01, steer, ax, friction, p, f), np.zeros(PLACES * WIDTH)
    points[SPEED * WIDTH : (SPEED + 1) * WIDTH] = max(x[VX], p.blend_low_m_s)
    points[FORCE_SCALE * WIDTH] = x[layout.force_scale] if layout.force_scale >= 0 else 0.0
    x[FRONT], x[REAR] = 0.0, 0.0
    for _ in range(3):  # converges fast
        points[LEAN * WIDTH] = x[FRONT] * c.nominal.cos + x[REAR]
        for row, entry, arm, axle in ((FRONT_TYRES, FRONT, p.front_m, c.front), (REAR_TYRES, REAR, -p.rear_m, c.rear)):
            points[row * WIDTH] = x[VY] + arm * x[YAW_RATE]
            _tyre_forces(points, LANES, row, steer, axle, f)
            x[entry] = points[row * WIDTH]
    if layout.roll >= 0:
        w = dynamic_share(x[VX], p)
        ay = w * (x[FRONT] * c.nominal.cos + x[REAR]) + (1.0 - w) * x[VX] * x[YAW_RATE]
        x[layout.roll] = f.roll_gradient * ay


@njit(cache=True)
def planar_ay(x, steer, friction, rate_vy, layout, p):  # type: ignore[no-untyped-def]
    """Return the lateral acceleration at the centre of gravity in state x [n], m/s², without the bank's part."""
    w = dynamic_share(x[VX], p)
    if layout.forces < 0:
        return planar_lateral_acceleration(x[VX], x[VY], x[YAW_RATE], steer, friction, p) + w * rate_vy
    force = force_factor(x[layout.force_scale]) if layout.force_scale >= 0 else 1.0
    forces = x[FRONT] * math.cos(steer) + x[REAR]
    return w * (forces + force * rate_vy) + (1.0 - w) * x[VX] * x[YAW_RATE]


# positional: to hand structures of arrays on at every step would cost as much as the step.
@inline
def move(points, columns, over, rate, dt, early, layout, p, f):  # type: ignore[no-untyped-def]
    """Move the states of a block by the model and the residual, as :func:`predict` describes."""
    given, vx = rate[0] != 0.0 or rate[1] != 0.0, points[VX * WIDTH]
    if given:
        push(points, columns, vx, rate, early * dt, p)
    advance(points, columns, over, dt, layout, p, f)
    if given:
        push(points, columns, vx, rate, (1.0 - early) * dt, p)


@inline
def process_noise(q_std, ax_known, dt, layout, q):  # type: ignore[no-untyped-def]
    """Write the variance [n] that ``dt`` s add to each entry; without a_x the speed is a random walk too."""
    for i in range(q.shape[0]):
        q[i] = q_std[i] * q_std[i] * dt
    if not ax_known:
        q[VX] = NO_AX_Q_STD**2 * dt
    if layout.force_scale >= 0:
        q[layout.force_scale] += FORCE_SCALE_STD**2 * (1.0 - math.exp(-2.0 * dt / FORCE_SCALE_TIME_S))
    if layout.bank >= 0:
        q[layout.bank] += BANK_STD**2 * (1.0 - math.exp(-2.0 * dt / BANK_TIME_S))
