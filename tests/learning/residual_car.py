"""A single-track car in plain Python with a residual in closed form on top of the nominal model.

The car is that of ``reference_car``. The residual is ``A sin(2π f t)`` on v̇_y and another on ṙ,
so that its increments are known exactly.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from reference_car import (
    FRONT_M,
    FRONT_TYRE,
    MASS_KG,
    REAR_M,
    REAR_TYRE,
    START_NS,
    YAW_INERTIA,
    forces,
    keep,
    signals_at,
    with_noise,
)  # fmt: skip

from pdhef_logtool.car.vehicle import AxleTyre, Tyres, VehicleParameters
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack, make_track

FRICTION = 0.9
CAR = VehicleParameters(
    name="test car",
    mass_kg=MASS_KG,
    yaw_inertia_kg_m2=YAW_INERTIA,
    cg_to_front_axle_m=FRONT_M,
    cg_to_rear_axle_m=REAR_M,
    friction=FRICTION,
    tyres=Tyres(
        **{
            axle: AxleTyre(**dict(zip(("B", "C", "D_n", "E"), tyre, strict=True)))
            for axle, tyre in (("front", FRONT_TYRE), ("rear", REAR_TYRE))
        }
    ),
)


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


def drive(seconds: float = 20.0, lateral: Wave = NONE, yaw: Wave = NONE, speed: float = 22.0) -> Motion:
    """Drive a weaving course at 100 Hz, integrated five times finer."""

    def steering(t: float) -> float:
        return 0.03 * math.sin(2 * math.pi * 0.4 * t) + 0.02 * math.sin(2 * math.pi * 0.13 * t + 1.0)

    def rates(t: float, s: np.ndarray) -> np.ndarray:
        vx, vy, r = s
        ay, r_dot = forces(vx, vy, r, steering(t), FRICTION)
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
    ay = np.array([forces(*state[k], steer[k], FRICTION)[0] + lateral(t[k]) for k in range(n)])
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
    signals = signals_at(
        motion.stamps_ns,
        steer_rad=motion.steer,
        ax_m_s2=motion.ax,
        ay_m_s2=motion.ay,
        yaw_rate_rad_s=motion.state[:, 2],
        speed_m_s=np.where(np.arange(len(motion.t)) % 2 == 0, motion.state[:, 0], np.nan),
    )
    noisy = signals if seed is None else with_noise(signals, seed, 0.5)
    return Measured(noisy, truth_of(motion.stamps_ns, motion.state))


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
    signals = keep(whole.signals, index)
    truth = whole.truth
    assert truth is not None
    state = np.stack([truth.vx_m_s, truth.vy_m_s, truth.yaw_rate_rad_s], axis=1)[index]
    return Measured(signals, truth_of(signals.stamps_ns, state))
