"""Readings that are impossible for a ground vehicle."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from pdhef_logtool.records.signals import BoolArray, Signals
from pdhef_logtool.records.tracks import StateTrack

#: Largest possible magnitudes for a ground vehicle (10 g; eight turns per second; 540 km/h; wheels at right angles).
#: Inputs have no innovation for a gate, and one impossible value would make a filter diverge.
POSSIBLE_MAGNITUDE = {
    "steer_rad": 0.5 * math.pi,
    "ax_m_s2": 100.0,
    "ay_m_s2": 100.0,
    "yaw_rate_rad_s": 50.0,
    "speed_m_s": 150.0,
}
#: The same for an estimate; beyond them it is diverged, for any status of the estimator.
POSSIBLE_STATE = {"vx_m_s": 150.0, "vy_m_s": 60.0, "yaw_rate_rad_s": 50.0}
#: Range of possible frictions, from ice to racing tyres.
POSSIBLE_FRICTION = (0.01, 5.0)


def impossible_readings(signals: Signals) -> dict[str, BoolArray]:
    """Return the masks [N] of impossible readings by column; columns without any are omitted."""
    bad = {c: np.abs(getattr(signals, c)) > limit for c, limit in POSSIBLE_MAGNITUDE.items()}
    low, high = POSSIBLE_FRICTION
    bad["friction"] = (signals.friction < low) | (signals.friction > high)
    return {c: mask for c, mask in bad.items() if mask.any()}


def without_impossible(signals: Signals) -> Signals:
    """Return the signals with impossible readings as missing; the same object without any."""
    bad = impossible_readings(signals)
    changed: dict[str, Any] = {c: np.where(mask, np.nan, getattr(signals, c)) for c, mask in bad.items()}
    return replace(signals, **changed) if changed else signals


def without_impossible_states(track: StateTrack) -> StateTrack:
    """Return the track with impossible states as invalid and diverged; the same object without any."""
    bad = np.zeros(len(track), np.bool_)
    for name, limit in POSSIBLE_STATE.items():
        bad |= np.abs(getattr(track, name)) > limit
    return replace(track, valid=track.valid & ~bad, diverged=track.diverged | bad) if bad.any() else track
