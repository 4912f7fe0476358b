"""A single-track car in plain Python with a residual in closed form on top of the nominal model.

It shares no code with ``pdhef_logtool.car.nominal_model``. The residual is ``A sin(2π f t)`` on v̇_y and another on ṙ,
so that its increments are known exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import numpy as np

from pdhef_logtool.car.vehicle import AxleTyre, Tyres, VehicleParameters
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track

START_NS = 1_700_000_000_000_000_000
FRICTION = 0.9
CAR = VehicleParameters(
    name="test car",
    mass_kg=1500.0,
    yaw_inertia_kg_m2=2500.0,
    cg_to_front_axle_m=1.2,
    cg_to_rear_axle_m=1.5,
    friction=FRICTION,
    tyres=Tyres(front=AxleTyre(B=10.0, C=1.35, D_n=8300.0, E=0.2), rear=AxleTyre(B=16.0, C=1.35, D_n=6700.0, E=0.1)),
)
FRONT, REAR = (10.0, 1.35, 8300.0, 0.2), (16.0, 1.35, 6700.0, 0.1)


@dataclass(frozen=True)
class Wave:
    """A sin(2π f t) and its integral over steps."""

    amplitude: float
    frequency_hz: float

    def __call__(self, t: float) -> float:
        return self.amplitude * math.sin(2 * math.pi * self.frequency_hz * t)

    def increments(self, t: np.ndarray) -> np.ndarray:
        w = 2 * math.pi * self.frequency_hz
        return -np.diff(np.cos(w * t)) * self.amplitude / w


NONE = Wave(0.0, 1.0)


@dataclass(frozen=True)
class Motion:
    """True motion at 100 Hz: time, [v_x, v_y, r], steering, a_x, a_y, and the residual's increments [N − 1, 2]."""

    t: np.ndarray
    state: np.ndarray
    steer: np.ndarray
    ax: np.ndarray
    ay: np.ndarray
    residual: np.ndarray

    @property
    def stamps_ns(self) -> np.ndarray:
        return START_NS + np.round(self.t * 1e9).astype(np.int64)


def _force(alpha: float, tyre: tuple[float, float, float, float]) -> float:
    b, c, d, e = tyre
    return FRICTION * d * math.sin(c * math.atan(b * alpha - e * (b * alpha - math.atan(b * alpha))))


def _accelerations(vx: float, vy: float, r: float, steer: float) -> tuple[float, float]:
    front = _force(steer - math.atan((vy + 1.2 * r) / vx), FRONT) * math.cos(steer)
    rear = _force(-math.atan((vy - 1.5 * r) / vx), REAR)
    return (front + rear) / 1500.0, (1.2 * front - 1.5 * rear) / 2500.0


def drive(seconds: float = 20.0, lateral: Wave = NONE, yaw: Wave = NONE, speed: float = 22.0) -> Motion:
    """Drive a weaving course at 100 Hz, integrated five times finer."""

    def steering(t: float) -> float:
        return 0.03 * math.sin(2 * math.pi * 0.4 * t) + 0.02 * math.sin(2 * math.pi * 0.13 * t + 1.0)

    def rates(t: float, s: np.ndarray) -> np.ndarray:
        vx, vy, r = s
        ay, r_dot = _accelerations(vx, vy, r, steering(t))
        return np.array([0.3 * math.sin(0.5 * t), ay - vx * r + lateral(t), r_dot + yaw(t)])

    n, fine = round(seconds * 100), 5
    h = 0.01 / fine
    t = np.arange(n) * 0.01
    state = np.empty((n, 3))
    s = np.array([speed, 0.0, 0.0])
    for k in range(n):
        state[k] = s
        for i in range(fine):
            at = t[k] + i * h
            k1 = rates(at, s)
            k2 = rates(at + h / 2, s + h / 2 * k1)
            k3 = rates(at + h / 2, s + h / 2 * k2)
            k4 = rates(at + h, s + h * k3)
            s = s + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    steer = np.array([steering(x) for x in t])
    ay = np.array([_accelerations(*state[k], steer[k])[0] + lateral(t[k]) for k in range(n)])
    ax = 0.3 * np.sin(0.5 * t) - state[:, 1] * state[:, 2]
    residual = np.stack([lateral.increments(t), yaw.increments(t)], axis=1)
    return Motion(t, state, steer, ax, ay, residual)


@dataclass(frozen=True)
class Measured:
    """Signals and ground truth at the same stamps."""

    signals: Signals
    truth: StateTrack | None


def window(motion: Motion, seed: int | None = None) -> Measured:
    """The whole drive: sensors (noisy with a seed) and the perfect truth."""
    n = len(motion.t)
    rng = np.random.default_rng(seed)
    scale = 0.0 if seed is None else 1.0

    def noisy(column: np.ndarray, std: float) -> np.ndarray:
        return column + scale * rng.normal(0.0, std, n)

    stamps = motion.stamps_ns
    signals = Signals(
        stamps_ns=stamps,
        ready_ns=stamps,
        steer_rad=noisy(motion.steer, 4e-4),
        ax_m_s2=noisy(motion.ax, 0.05),
        ay_m_s2=noisy(motion.ay, 0.1),
        yaw_rate_rad_s=noisy(motion.state[:, 2], 0.002),
        speed_m_s=np.where(np.arange(n) % 2 == 0, noisy(motion.state[:, 0], 0.05), np.nan),
        friction=np.full(n, np.nan),
        wheel_speed_m_s=np.full((n, 4), np.nan),
        available=frozenset({"steer_rad", "ax_m_s2", "ay_m_s2", "yaw_rate_rad_s", "speed_m_s"}),
    )
    return Measured(signals, truth_of(stamps, motion.state))


def truth_of(stamps: np.ndarray, state: np.ndarray) -> StateTrack:
    return make_track(
        "truth",
        stamps,
        vx_m_s=state[:, 0],
        vy_m_s=state[:, 1],
        yaw_rate_rad_s=state[:, 2],
        valid=np.isfinite(state).all(axis=1),
    )


def pick(whole: Measured, index: np.ndarray | slice) -> Measured:
    """Return only some rows of a drive: a part, or the rows of a recorder that lost the others."""
    signals = replace(
        whole.signals,
        **{f.name: getattr(whole.signals, f.name)[index] for f in fields(Signals) if f.name != "available"},
    )
    truth = whole.truth
    assert truth is not None
    state = np.stack([truth.vx_m_s, truth.vy_m_s, truth.yaw_rate_rad_s], axis=1)[index]
    return Measured(signals, truth_of(signals.stamps_ns, state))
