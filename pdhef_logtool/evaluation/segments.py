"""Parts of a drive: boolean masks over the scored stamps, and the same as intervals for the eye.

Lateral acceleration is the truth's where the truth has one, else the sensor's; likewise yaw rate and speed;
longitudinal acceleration is always the sensor's. Accelerations and yaw rate are smoothed without phase (Gaussian, over
at most the gap-free run around a stamp): to 4 Hz for ``linear`` and ``nonlinear``, to 1 Hz for manoeuvres. μ is the
log's friction, else the vehicle file's, else 1.

====================  ==================================================================================================
``all``               every stamp
``linear``            abs a_y < 0.3 μ g
``nonlinear``         abs a_y > 0.5 μ g
``standstill``        speed below a tenth of the low-speed blend and abs yaw rate below 0.05 rad/s, for 0.5 s
``straight``          above the low-speed blend, abs a_y < 0.5 m/s², for 2 s
``cornering-left``    a_y > 1 m/s² for 1.5 s, outside slaloms
``cornering-right``   a_y < −1 m/s² for 1.5 s, outside slaloms
``slalom``            three or more swings of a_y of alternating sign, peaks beyond 1.5 m/s² and at most 2.5 s apart; a
                      swing is the time beyond 0.5 m/s², at most 2.5 s; from the first one's beginning to the last's end
``braking``           a_x < −1.5 m/s² for 0.5 s, moving
``accelerating``      a_x > 1 m/s² for 0.5 s, moving
====================  ==================================================================================================
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.tracks import StateTrack

SEGMENTS = (
    "all",
    "linear",
    "nonlinear",
    "standstill",
    "straight",
    "cornering-left",
    "cornering-right",
    "slalom",
    "braking",
    "accelerating",
)
LINEAR_SHARE, NONLINEAR_SHARE = 0.3, 0.5
GRIP_SMOOTHING_HZ, MANOEUVRE_SMOOTHING_HZ = 4.0, 1.0
#: A longer step between stamps ends every run and every interval.
RUN_GAP_S = 0.5
STANDSTILL_YAW_RATE_RAD_S, STANDSTILL_S = 0.05, 0.5
STRAIGHT_M_S2, STRAIGHT_S = 0.5, 2.0
CORNERING_M_S2, CORNERING_S = 1.0, 1.5
SWING_M_S2, SLALOM_M_S2, SLALOM_PEAKS, SLALOM_SPACING_S = 0.5, 1.5, 3, 2.5
BRAKING_M_S2, ACCELERATING_M_S2, PEDAL_S = -1.5, 1.0, 0.5


@dataclass(frozen=True, slots=True)
class Segment:
    """A contiguous part of the drive, [start_ns, end_ns)."""

    name: str
    start_ns: int
    end_ns: int


def segment_masks(signals: Signals, truth: StateTrack | None, vehicle: VehicleParameters) -> dict[str, BoolArray]:
    """Return the masks [N] of every segment by name, in the order of this file's table; none is left out when empty.

    Parameters
    ----------
    signals : what the sensors say at the scored stamps. truth : at the same stamps, or None.
    """
    # One quantity after the other: of hours of driving a column takes tens of megabytes.
    stamps = signals.stamps_ns
    slow = vehicle.low_speed_blend_m_s
    lateral = truth.ay_m_s2 if truth else None
    linear, nonlinear = _grip_masks(signals, stamps, _preferred(lateral, signals.ay_m_s2), vehicle)
    ay = smooth(stamps, _preferred(lateral, signals.ay_m_s2), MANOEUVRE_SMOOTHING_HZ)
    del lateral
    slalom = _slalom(stamps, ay)
    left = _lasting(stamps, (ay > CORNERING_M_S2) & ~slalom, CORNERING_S)
    right = _lasting(stamps, (ay < -CORNERING_M_S2) & ~slalom, CORNERING_S)
    speed = _speed(signals, truth)
    straight = _lasting(stamps, (speed > slow) & (np.abs(ay) < STRAIGHT_M_S2), STRAIGHT_S)
    standing = speed < vehicle.standstill_m_s
    del ay, speed
    rate = _preferred(truth.yaw_rate_rad_s if truth else None, signals.yaw_rate_rad_s)
    rate = smooth(stamps, rate, MANOEUVRE_SMOOTHING_HZ)
    standing = _lasting(stamps, standing & (np.abs(rate) < STANDSTILL_YAW_RATE_RAD_S), STANDSTILL_S)
    moving = ~standing
    del rate
    ax = smooth(stamps, signals.ax_m_s2, MANOEUVRE_SMOOTHING_HZ)
    return {
        "all": np.ones(len(signals), dtype=np.bool_),
        "linear": linear,
        "nonlinear": nonlinear,
        "standstill": standing,
        "straight": straight,
        "cornering-left": left,
        "cornering-right": right,
        "slalom": slalom,
        "braking": _lasting(stamps, (ax < BRAKING_M_S2) & moving, PEDAL_S),
        "accelerating": _lasting(stamps, (ax > ACCELERATING_M_S2) & moving, PEDAL_S),
    }


def _grip_masks(
    signals: Signals, stamps: IntArray, ay: FloatArray, vehicle: VehicleParameters
) -> tuple[BoolArray, BoolArray]:
    """Return where the grip is used little and much, [N]."""
    grip = np.abs(smooth(stamps, ay, GRIP_SMOOTHING_HZ))
    friction = signals.friction
    grip /= np.where(np.isfinite(friction), friction, vehicle.assumed_friction) * GRAVITY_M_S2
    return grip < LINEAR_SHARE, grip > NONLINEAR_SHARE


def moving_mask(signals: Signals, truth: StateTrack | None, vehicle: VehicleParameters) -> BoolArray:
    """Return where the car is faster than the low-speed blend, [N]; everywhere if its speed is known nowhere.

    ``signals``, ``truth`` as for :func:`segment_masks`.
    """
    speed = _speed(signals, truth)
    known = np.isfinite(speed).any()
    return np.asarray(speed > vehicle.low_speed_blend_m_s if known else np.ones(len(signals)), dtype=np.bool_)


def _speed(signals: Signals, truth: StateTrack | None) -> FloatArray:
    """Return the speed [N] in m/s, of one source."""
    return _preferred(np.abs(truth.vx_m_s) if truth else None, _last_known(signals.stamps_ns, signals.speed_m_s))


def find_intervals(stamps_ns: IntArray, masks: Mapping[str, BoolArray]) -> list[Segment]:
    """Turn masks [N] into intervals in order of time; a step of more than ``RUN_GAP_S`` ends an interval.

    ``end_ns`` is one past the last stamp inside.
    """
    found = [
        Segment(name, int(stamps_ns[a]), int(stamps_ns[b - 1]) + 1)
        for name, mask in masks.items()
        for a, b in _runs(stamps_ns, mask)
    ]
    return sorted(found, key=lambda s: (s.start_ns, s.end_ns, s.name))


def smooth(stamps_ns: IntArray, values: FloatArray, cutoff_hz: float) -> FloatArray:
    """Smooth [N] without phase by a Gaussian whose gain is 1/√2 at ``cutoff_hz``; NaN stays, but does not spread.

    The Gaussian runs over samples of the median step, cut off at 4 σ, and does not reach across steps of more than
    ``RUN_GAP_S``.
    """
    from scipy.ndimage import gaussian_filter1d

    out = np.full(values.shape, np.nan)
    if values.shape[0] < 2:
        return values.astype(np.float64)
    sigma_s = np.sqrt(np.log(2.0)) / (2.0 * np.pi * cutoff_hz)
    sigma = sigma_s / (float(np.median(np.diff(stamps_ns))) * 1e-9)
    known = np.isfinite(values)
    for a, b in _runs(stamps_ns, np.ones(values.shape[0], dtype=np.bool_)):
        weight = gaussian_filter1d(known[a:b].astype(np.float64), sigma, mode="constant")
        total = gaussian_filter1d(np.where(known[a:b], values[a:b], 0.0), sigma, mode="constant")
        here = known[a:b]
        out[a:b][here] = total[here] / weight[here]
    return out


def _preferred(first: FloatArray | None, second: FloatArray) -> FloatArray:
    """Take the first source wherever it has any value at all: two sources are not mixed within a drive."""
    return second if first is None or not np.isfinite(first).any() else first


def _last_known(stamps_ns: IntArray, values: FloatArray) -> FloatArray:
    """Carry measurements, which stand at one stamp only, forward for up to ``RUN_GAP_S``."""
    known = np.isfinite(values)
    at = np.maximum.accumulate(np.where(known, np.arange(values.shape[0]), -1))
    fresh = (at >= 0) & (stamps_ns - stamps_ns[np.maximum(at, 0)] <= RUN_GAP_S * 1e9)
    return np.where(fresh, values[np.maximum(at, 0)], np.nan)


def _runs(stamps_ns: IntArray, mask: BoolArray) -> list[tuple[int, int]]:
    """Return [a, b) of the gap-free runs where the mask is True."""
    n = mask.shape[0]
    if n == 0:
        return []
    joined = mask[1:] & mask[:-1] & (np.diff(stamps_ns) <= RUN_GAP_S * 1e9)
    starts = np.flatnonzero(mask & ~np.concatenate([[False], joined]))
    ends = np.flatnonzero(mask & ~np.concatenate([joined, [False]])) + 1
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def _lasting(stamps_ns: IntArray, mask: BoolArray, least_s: float) -> BoolArray:
    out = np.zeros_like(mask)
    for a, b in _runs(stamps_ns, mask):
        out[a:b] = stamps_ns[b - 1] - stamps_ns[a] >= least_s * 1e9
    return out


def _slalom(stamps_ns: IntArray, ay_m_s2: FloatArray) -> BoolArray:
    """Join swings that alternate and follow closely."""
    swings: list[tuple[int, int, int, int]] = []  # start, end, place of the peak, sign
    for sign in (1, -1):
        for a, b in _runs(stamps_ns, sign * ay_m_s2 > SWING_M_S2):
            peak = a + int(np.argmax(sign * ay_m_s2[a:b]))
            short = stamps_ns[b - 1] - stamps_ns[a] <= SLALOM_SPACING_S * 1e9
            if short and sign * ay_m_s2[peak] > SLALOM_M_S2:
                swings.append((a, b, peak, sign))
    swings.sort()
    out = np.zeros(ay_m_s2.shape[0], dtype=np.bool_)
    chain: list[tuple[int, int, int, int]] = []
    for swing in [*swings, None]:
        if swing is not None and chain and _follows(stamps_ns, chain[-1], swing):
            chain.append(swing)
            continue
        if len(chain) >= SLALOM_PEAKS:
            out[chain[0][0] : chain[-1][1]] = True
        chain = [] if swing is None else [swing]
    return out


def _follows(stamps_ns: IntArray, before: tuple[int, int, int, int], after: tuple[int, int, int, int]) -> bool:
    close = stamps_ns[after[2]] - stamps_ns[before[2]] <= SLALOM_SPACING_S * 1e9
    return bool(close and after[3] == -before[3])
