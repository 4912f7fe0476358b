"""A single-track car in plain Python, written from docs/method.md, and drives of it for the estimator tests.

It shares no code with ``pdhef_logtool.car.nominal_model``: it is the reference for the compiled model.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.car.vehicle import AxleTyre, Tyres, VehicleParameters
from pdhef_logtool.records.signals import SIGNAL_COLUMNS, Signals

MASS_KG, YAW_INERTIA, FRONT_M, REAR_M = 1440.0, 1523.0, 1.16, 1.71
WHEELBASE_M = FRONT_M + REAR_M
#: B, C, D in N at friction 1, E.
FRONT_TYRE = (12.3, 1.41, 7600.0, 0.30)
REAR_TYRE = (15.4, 1.17, 6110.0, 0.20)
FRICTION = 0.85
START_NS = 1_600_000_000_000_000_000

Force = Callable[[float, float, bool], float]


def magic_tyre(alpha: float, mu: float, front: bool) -> float:
    """Eq 2, axle force in N."""
    b, c, d, e = FRONT_TYRE if front else REAR_TYRE
    inner = b * alpha - e * (b * alpha - math.atan(b * alpha))
    return mu * d * math.sin(c * math.atan(inner))


def tanh_tyre(alpha: float, mu: float, front: bool) -> float:
    """Another tyre than the estimators assume: stiffness independent of friction, softer approach to the peak."""
    stiffness = 105_000.0 if front else 96_000.0
    peak = mu * MASS_KG * 9.81 * (REAR_M if front else FRONT_M) / WHEELBASE_M
    return peak * math.tanh(stiffness * alpha / peak)


def forces(vx: float, vy: float, r: float, steer: float, mu: float, tyre: Force = magic_tyre) -> tuple[float, float]:
    """Lateral acceleration and yaw acceleration of Eq 1-4."""
    alpha_f = steer - math.atan((vy + FRONT_M * r) / vx)
    alpha_r = -math.atan((vy - REAR_M * r) / vx)
    front = tyre(alpha_f, mu, True) * math.cos(steer)
    rear = tyre(alpha_r, mu, False)
    return (front + rear) / MASS_KG, (FRONT_M * front - REAR_M * rear) / YAW_INERTIA


def derivative(s: np.ndarray, steer: float, ax: float, mu: float, tyre: Force = magic_tyre) -> np.ndarray:
    """d/dt of [v_x, v_y, r] above the low-speed blend."""
    vx, vy, r = s
    ay, r_dot = forces(vx, vy, r, steer, mu, tyre)
    return np.array([ax + vy * r, ay - vx * r, r_dot])


def runge_kutta(
    s: np.ndarray, steer: float, ax: float, mu: float, dt: float, n: int = 1, tyre: Force = magic_tyre
) -> np.ndarray:
    for _ in range(n):
        s = runge_kutta_step(lambda y, _t: derivative(y, steer, ax, mu, tyre), s, 0.0, dt / n)
    return s


def runge_kutta_step(f: Callable[[np.ndarray, float], np.ndarray], s: np.ndarray, t: float, h: float) -> np.ndarray:
    """Return the state after a step of ``h`` seconds of ds/dt = f(s, t)."""
    k1 = f(s, t)
    k2 = f(s + h / 2 * k1, t + h / 2)
    k3 = f(s + h / 2 * k2, t + h / 2)
    k4 = f(s + h * k3, t + h)
    return s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


@dataclass(frozen=True)
class Drive:
    """Signals and the true state at their stamps."""

    signals: Signals
    vx: np.ndarray
    vy: np.ndarray
    r: np.ndarray
    ay: np.ndarray

    @property
    def time_s(self) -> np.ndarray:
        return (self.signals.stamps_ns - self.signals.stamps_ns[0]) * 1e-9

    @property
    def sideslip(self) -> np.ndarray:
        return np.arctan2(self.vy, self.vx)


def make_signals(dt: np.ndarray, delay_ns: int | np.ndarray = 0, **columns: np.ndarray) -> Signals:
    """Columns on stamps that start at START_NS and are ``dt`` apart; omitted columns are missing."""
    stamps = START_NS + np.concatenate([[0], np.cumsum(np.round(dt * 1e9).astype(np.int64))])
    return signals_at(stamps, np.maximum.accumulate(stamps + delay_ns), **columns)


def signals_at(stamps: np.ndarray, ready: np.ndarray | None = None, **columns: float | np.ndarray) -> Signals:
    """Columns on stamps, which arrive at once if not ``ready``; a number is each value, omitted columns are missing."""
    names = ("steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s", "friction")
    return Signals(
        stamps_ns=stamps,
        ready_ns=stamps if ready is None else ready,
        wheel_speed_m_s=np.full((len(stamps), 4), np.nan),
        available=frozenset(columns),
        **{c: np.full(len(stamps), columns.get(c, np.nan), dtype=float) for c in names},
    )


def drive(
    steer: Callable[[float], float],
    duration_s: float = 10.0,
    speed: float = 25.0,
    acceleration: Callable[[float], float] = lambda _t: 0.0,
    *,
    step_s: float | np.ndarray = 0.01,
    mu: float = FRICTION,
    tyre: Force = magic_tyre,
    speed_every: int = 2,
    delay_ns: int | np.ndarray = 0,
    side_pull_m_s2: float = 0.0,
) -> Drive:
    """Drive with inputs that are held from stamp to stamp, noise-free sensors at the centre of gravity.

    ``side_pull_m_s2`` is the part of gravity that pulls to the left on a banked road; no accelerometer feels it.
    """
    dt = np.full(round(duration_s / step_s), step_s) if np.isscalar(step_s) else np.asarray(step_s)
    dt = np.round(dt * 1e9) * 1e-9
    n = len(dt) + 1
    t = np.concatenate([[0.0], np.cumsum(dt)])
    state = np.zeros((n, 3))
    state[0, 0] = speed
    delta, ax, ay = np.empty(n), np.empty(n), np.empty(n)
    for k in range(n):
        delta[k] = steer(t[k])
        ax[k] = acceleration(t[k]) - state[k, 1] * state[k, 2]  # the driver holds the speed
        ay[k] = forces(*state[k], delta[k], mu, tyre)[0]
        if k + 1 < n:
            state[k + 1] = runge_kutta(state[k], delta[k], ax[k], mu, dt[k], 2, tyre)
            state[k + 1, 1] += side_pull_m_s2 * dt[k]
    measured_speed = np.where(np.arange(n) % speed_every == 0, state[:, 0], np.nan)
    signals = make_signals(
        dt, delay_ns, steer_rad=delta, ax_m_s2=ax, ay_m_s2=ay, yaw_rate_rad_s=state[:, 2], speed_m_s=measured_speed
    )
    return Drive(signals, state[:, 0], state[:, 1], state[:, 2], ay)


def rolling_drive(
    speed: Callable[[np.ndarray], np.ndarray], steer: Callable[[np.ndarray], np.ndarray], duration_s: float
) -> Drive:
    """Drive at parking speed, where wheels roll without slip: r = v tan δ / L, v_y = l_r r; 100 Hz."""
    n = round(duration_s * 100) + 1
    t = np.arange(n) * 0.01
    v, delta = speed(t), steer(t)
    r = v * np.tan(delta) / WHEELBASE_M
    vy = REAR_M * r
    ax, ay = np.gradient(v, t) - vy * r, np.gradient(vy, t) + v * r
    columns = {"steer_rad": delta, "ax_m_s2": ax, "ay_m_s2": ay, "yaw_rate_rad_s": r}
    signals = make_signals(np.full(n - 1, 0.01), speed_m_s=np.where(np.arange(n) % 2 == 0, v, np.nan), **columns)
    return Drive(signals, v, vy, r, ay)


def on_axles(vehicle: VehicleParameters, front: float, rear: float) -> VehicleParameters:
    """Return a vehicle file that states no tyres but the cornering stiffness of both axles, N/rad."""
    front_tyre, rear_tyre = (AxleTyre(cornering_stiffness_n_per_rad=c) for c in (front, rear))
    return vehicle.model_copy(update={"tyres": Tyres(front=front_tyre, rear=rear_tyre)})


def slalom(amplitude: float = 0.03, frequency_hz: float = 0.4) -> Callable[[float], float]:
    return lambda t: amplitude * math.sin(2 * math.pi * frequency_hz * t)


def with_noise(signals: Signals, seed: int, scale: float = 1.0) -> Signals:
    """Add the sensor noise of docs/method.md#sensors (Gaussian)."""
    rng = np.random.default_rng(seed)
    n = len(signals)

    def noisy(column: np.ndarray, std: float) -> np.ndarray:
        return column + scale * std * rng.standard_normal(n)

    stds = {"steer_rad": 0.0008, "ax_m_s2": 0.12, "ay_m_s2": 0.12, "yaw_rate_rad_s": 0.004, "speed_m_s": 0.08}
    return replace(signals, **{name: noisy(getattr(signals, name), std) for name, std in stds.items()})


def rough_drive(seed: int, count: int, noise_seed: int) -> Signals:
    """Return a noisy slalom on irregular stamps, with missing samples and messages that arrive late and bunched."""
    rng = np.random.default_rng(seed)
    driven = drive(slalom(0.035, 0.5), speed=22.0, step_s=rng.uniform(0.004, 0.022, count))
    s = with_noise(driven.signals, noise_seed)
    for column in (s.steer_rad, s.ax_m_s2, s.ay_m_s2, s.yaw_rate_rad_s):
        column[rng.random(len(s)) < 0.05] = np.nan
    return replace(s, ready_ns=np.maximum.accumulate(s.stamps_ns + rng.integers(0, 45_000_000, len(s))))


def keep(signals: Signals, mask: np.ndarray) -> Signals:
    """Only the stamps of ``mask``: a recorder that lost the others."""
    return replace(signals, **{name: getattr(signals, name)[mask] for name in SIGNAL_COLUMNS})
