"""Parts of a drive: boolean masks over the scored stamps, and the same as intervals for the eye.

Lateral acceleration is that of ground truth if it has one, else the sensor's; likewise yaw rate and speed;
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
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.evaluation.blocks import SegmentMasks, blocks_with_halo, median_step_ns, packed, row_blocks
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
#: Rows that are smoothed at once: they stay near the processor.
_NEAR_ROWS = 1 << 12
#: What is further away than this decides nothing: three swings of a slalom, and a corner after it, take 16 s.
HALO_S = 20.0


@dataclass(frozen=True, slots=True)
class Segment:
    """A contiguous part of the drive, [start_ns, end_ns)."""

    name: str
    start_ns: int
    end_ns: int


def segment_masks(signals: Signals, truth: StateTrack | None, vehicle: VehicleParameters) -> SegmentMasks:
    """Return the masks [N] of every segment by name, in the order of this file's table; none is left out when empty.

    Parameters
    ----------
    signals : what the sensors state at the scored stamps. truth : at the same stamps, or None.
    """
    step_ns, of_truth, bits = median_step_ns(signals), known_of(truth), []
    for first, a, b, end in blocks_with_halo(signals, HALO_S, reach_rows(step_ns, MANOEUVRE_SMOOTHING_HZ)):
        part = truth.rows(first, end) if truth else None
        masks = _masks(signals.rows(first, end), part, of_truth, step_ns, vehicle)
        bits.append(packed(masks, end - first).bits[a - first : b - first])
    return SegmentMasks(SEGMENTS, np.concatenate(bits))


def _masks(
    signals: Signals, truth: StateTrack | None, of_truth: frozenset[str], step_ns: float, vehicle: VehicleParameters
) -> dict[str, BoolArray]:
    """Return the masks of a part of a drive, right where it reaches far enough to both sides or to the drive's end."""
    stamps = signals.stamps_ns
    slow = vehicle.low_speed_blend_m_s
    lateral = _taken(signals, truth, of_truth, "ay_m_s2")
    linear, nonlinear = _grip_masks(signals, stamps, lateral, step_ns, vehicle)
    ay = smooth(stamps, lateral, MANOEUVRE_SMOOTHING_HZ, step_ns)
    slalom = _slalom(stamps, ay)
    left = _lasting(stamps, (ay > CORNERING_M_S2) & ~slalom, CORNERING_S)
    right = _lasting(stamps, (ay < -CORNERING_M_S2) & ~slalom, CORNERING_S)
    speed = _speed(signals, truth, of_truth)
    straight = _lasting(stamps, (speed > slow) & (np.abs(ay) < STRAIGHT_M_S2), STRAIGHT_S)
    rate = _taken(signals, truth, of_truth, "yaw_rate_rad_s")
    turning = np.abs(smooth(stamps, rate, MANOEUVRE_SMOOTHING_HZ, step_ns)) < STANDSTILL_YAW_RATE_RAD_S
    standing = _lasting(stamps, (speed < vehicle.standstill_m_s) & turning, STANDSTILL_S)
    moving = ~standing
    ax = smooth(stamps, signals.ax_m_s2, MANOEUVRE_SMOOTHING_HZ, step_ns)
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
    signals: Signals, stamps: IntArray, ay: FloatArray, step_ns: float, vehicle: VehicleParameters
) -> tuple[BoolArray, BoolArray]:
    """Return where the grip is used little and much, [N]."""
    grip = np.abs(smooth(stamps, ay, GRIP_SMOOTHING_HZ, step_ns))
    friction = signals.friction
    grip /= np.where(np.isfinite(friction), friction, vehicle.assumed_friction) * GRAVITY_M_S2
    return grip < LINEAR_SHARE, grip > NONLINEAR_SHARE


def moving_mask(signals: Signals, truth: StateTrack | None, vehicle: VehicleParameters) -> BoolArray:
    """Return where the car is faster than the low-speed blend, [N]; everywhere if its speed is known nowhere.

    ``signals``, ``truth`` as for :func:`segment_masks`.
    """
    of_truth = known_of(truth)
    if "vx_m_s" not in of_truth and not _known_anywhere(signals, "speed_m_s"):
        return np.ones(len(signals), dtype=np.bool_)
    blocks = []
    for first, a, b, end in blocks_with_halo(signals, RUN_GAP_S, 0):
        speed = _speed(signals.rows(first, end), truth.rows(first, end) if truth else None, of_truth)
        blocks.append(speed[a - first : b - first] > vehicle.low_speed_blend_m_s)
    return np.concatenate(blocks)


def known_of(truth: StateTrack | None) -> frozenset[str]:
    """Return what is taken from ground truth: all that it ever has, so that a drive does not mix two sources."""
    if truth is None:
        return frozenset()
    return frozenset(c for c in ("ay_m_s2", "yaw_rate_rad_s", "vx_m_s") if _known_anywhere(truth, c))


def speed_and_ay(signals: Signals, truth: StateTrack | None, of_truth: frozenset[str]) -> tuple[FloatArray, FloatArray]:
    """Return speed in m/s and lateral acceleration in m/s², [N] each; ``of_truth`` from :func:`known_of`."""
    return _speed(signals, truth, of_truth), _taken(signals, truth, of_truth, "ay_m_s2")


def _taken(signals: Signals, truth: StateTrack | None, of_truth: frozenset[str], column: str) -> FloatArray:
    values: FloatArray = getattr(truth if column in of_truth else signals, column)
    return values


def _known_anywhere(record: Signals | StateTrack, column: str) -> bool:
    return any(np.isfinite(getattr(record.rows(a, b), column)).any() for a, b in row_blocks(len(record)))


def _speed(signals: Signals, truth: StateTrack | None, of_truth: frozenset[str]) -> FloatArray:
    """Return the speed [N] in m/s, of one source."""
    if truth is not None and "vx_m_s" in of_truth:
        return np.abs(truth.vx_m_s)
    return _last_known(signals.stamps_ns, signals.speed_m_s)


def find_intervals(stamped: Signals | StateTrack, masks: Mapping[str, BoolArray]) -> list[Segment]:
    """Turn masks [N] into intervals in order of time; a step of more than ``RUN_GAP_S`` ends an interval.

    ``end_ns`` is one past the last stamp inside.
    """
    masks = packed(masks, len(stamped))
    by_name: dict[str, list[Segment]] = {name: [] for name in masks}
    for a, b in row_blocks(len(stamped)):
        # From the last row of the block before on: what goes across the border overlaps there.
        start = max(a - 1, 0)
        stamps = stamped.rows(start, b).stamps_ns
        for name, mask in masks.rows(start, b).items():
            for i, j in _runs(stamps, mask):
                new = Segment(name, int(stamps[i]), int(stamps[j - 1]) + 1)
                if by_name[name] and new.start_ns < by_name[name][-1].end_ns:
                    new = replace(new, start_ns=by_name[name].pop().start_ns)
                by_name[name].append(new)
    return sorted((s for spans in by_name.values() for s in spans), key=lambda s: (s.start_ns, s.end_ns, s.name))


def reach_rows(step_ns: float, cutoff_hz: float) -> int:
    """Return how many rows to each side :func:`smooth` takes."""
    return int(4.0 * _sigma_rows(step_ns, cutoff_hz) + 0.5)


def _sigma_rows(step_ns: float, cutoff_hz: float) -> float:
    sigma_s = np.sqrt(np.log(2.0)) / (2.0 * np.pi * cutoff_hz)
    return float(sigma_s / (step_ns * 1e-9))


def smooth(stamps_ns: IntArray, values: FloatArray, cutoff_hz: float, step_ns: float | None = None) -> FloatArray:
    """Smooth [N] without phase by a Gaussian whose gain is 1/√2 at ``cutoff_hz``; NaN stays, but does not spread.

    The Gaussian runs over samples of the median step, cut off at 4 σ, and does not reach across steps of more than
    ``RUN_GAP_S``. ``step_ns``: the median step, of the whole drive for a part of it.
    """
    out = np.full(values.shape, np.nan)
    if values.shape[0] < 2:
        return values.astype(np.float64)
    sigma = _sigma_rows(float(np.median(np.diff(stamps_ns))) if step_ns is None else step_ns, cutoff_hz)
    finite = np.isfinite(values)
    for a, b in _runs(stamps_ns, np.ones(values.shape[0], dtype=np.bool_)):
        here = finite[a:b]
        if here.all():
            out[a:b] = _gaussian(values[a:b], sigma) / _gaussian_of_ones(b - a, sigma)
        else:
            weight = _gaussian(here.astype(np.float64), sigma)
            total = _gaussian(np.where(here, values[a:b], 0.0), sigma)
            out[a:b][here] = total[here] / weight[here]
    return out


def _gaussian(values: FloatArray, sigma_rows: float) -> FloatArray:
    """Return values [N], 0 beyond their ends, under a Gaussian cut off at 4 σ.

    The same sums in the same order as SciPy's ``gaussian_filter1d``, which takes longer to load than a short log.
    """
    reach = int(4.0 * sigma_rows + 0.5)
    weights = np.exp(-0.5 / (sigma_rows * sigma_rows) * np.arange(-reach, reach + 1) ** 2)
    weights /= weights.sum()
    n = len(values)
    padded = np.concatenate([np.zeros(reach), values, np.zeros(reach)])
    out: FloatArray = values * weights[reach]
    for a in range(0, n, _NEAR_ROWS):
        b = min(a + _NEAR_ROWS, n)
        part, beside = out[a:b], np.empty(b - a)
        for first in range(reach):
            last = 2 * reach - first
            np.add(padded[a + first : b + first], padded[a + last : b + last], out=beside)
            beside *= weights[first]
            part += beside
    return out


def _gaussian_of_ones(n: int, sigma_rows: float) -> FloatArray:
    """Return :func:`_gaussian` of n ones, which is the same everywhere but near the ends."""
    reach = int(4.0 * sigma_rows + 0.5)
    if n <= 2 * reach:
        return _gaussian(np.ones(n), sigma_rows)
    ends = _gaussian(np.ones(2 * reach + 1), sigma_rows)
    return np.concatenate([ends[:reach], np.full(n - 2 * reach, ends[reach]), ends[reach + 1 :]])


def _last_known(stamps_ns: IntArray, values: FloatArray) -> FloatArray:
    """Carry measurements, which are at one stamp only, forward for up to ``RUN_GAP_S``."""
    finite = np.isfinite(values)
    last = np.maximum.accumulate(np.where(finite, np.arange(values.shape[0]), -1))
    fresh = (last >= 0) & (stamps_ns - stamps_ns[np.maximum(last, 0)] <= RUN_GAP_S * 1e9)
    return np.where(fresh, values[np.maximum(last, 0)], np.nan)


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
