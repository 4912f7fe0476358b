"""Readings that no ground vehicle can have."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np

from pdhef_logtool.records.signals import BoolArray, Signals
from pdhef_logtool.records.tracks import StateTrack

#: Magnitudes beyond which a reading is no motion of a ground vehicle (10 g; eight turns a second; 540 km/h; wheels
#: across): an input has no innovation that a gate could judge, and one such value would end a filter.
POSSIBLE_MAGNITUDE = {
    "steer_rad": 0.5 * math.pi,
    "ax_m_s2": 100.0,
    "ay_m_s2": 100.0,
    "yaw_rate_rad_s": 50.0,
    "speed_m_s": 150.0,
}
#: The same of an estimate: such a state is divergence for any status of the estimator.
POSSIBLE_STATE = {"vx_m_s": 150.0, "vy_m_s": 60.0, "yaw_rate_rad_s": 50.0}
#: Friction below ice or above any tyre is no friction.
POSSIBLE_FRICTION = (0.01, 5.0)


def impossible_readings(signals: Signals) -> dict[str, BoolArray]:
    """Return by column where a reading is one that no vehicle can have, [N]; columns without any are left out."""
    bad = {c: ~(np.abs(getattr(signals, c)) <= limit) for c, limit in POSSIBLE_MAGNITUDE.items()}
    low, high = POSSIBLE_FRICTION
    bad["friction"] = ~((signals.friction >= low) & (signals.friction <= high))
    read = {c: mask & ~np.isnan(getattr(signals, c)) for c, mask in bad.items()}
    return {c: mask for c, mask in read.items() if mask.any()}


def without_impossible(signals: Signals) -> Signals:
    """Return the signals with impossible readings as missing; the same object where there are none."""
    changed: dict[str, Any] = {
        c: np.where(mask, np.nan, getattr(signals, c)) for c, mask in impossible_readings(signals).items()
    }
    return replace(signals, **changed) if changed else signals


def without_impossible_states(track: StateTrack) -> StateTrack:
    """Return the track with impossible states as invalid and diverged; the same object where there are none."""
    bad = np.zeros(len(track), np.bool_)
    for name, limit in POSSIBLE_STATE.items():
        column = getattr(track, name)
        bad |= ~(np.abs(column) <= limit) & ~np.isnan(column)
    return replace(track, valid=track.valid & ~bad, diverged=track.diverged | bad) if bad.any() else track
