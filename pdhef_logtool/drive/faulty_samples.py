"""IMU samples with sensor faults, which are excluded from the relations between signals.

:mod:`~pdhef_logtool.drive.sensor_faults` finds them. A dead channel with noise may also be in another unit: it counts
only if it repeats its value.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.alignment import SURVEY_S, align, has_imu, plan_alignment
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.reasons import BURST_AY, STUCK_AY
from pdhef_logtool.records.signals import BoolArray, Channel, FloatArray, IntArray

#: Time excluded on both sides of a faulty sample: a fault starts before its detection, and the low pass spreads it.
BESIDE_S = 0.3
#: A burst begins this long before it is reported.
BURST_S = 1.5

_OTHER = {"ay_m_s2": "yaw_rate_rad_s", "yaw_rate_rad_s": "ay_m_s2"}


def without_faulty_samples(
    signals: Mapping[str, Channel], vehicle: VehicleParameters
) -> tuple[dict[str, Channel], dict[str, float]]:
    """Return the channels without the samples that are stuck or in a burst of noise.

    Returns
    -------
    channels : without the faulty samples. shares : for each shortened channel, the share of the drive's motion during
        its silent samples.
    """
    from pdhef_logtool.drive.sensor_faults import without_faults  # loads the compiler

    sound = dict(signals)
    if any(n not in signals or not len(signals[n]) for n in _OTHER):
        return sound, {}
    gyro = signals["yaw_rate_rad_s"]
    middle, reach = int(np.median(gyro.stamps_ns)), round(0.5e9 * SURVEY_S)
    signals = {n: c.between(middle - reach, middle + reach) for n, c in signals.items()}
    if not has_imu(signals):
        return sound, {}
    aligned, _ = align(signals, plan_alignment(signals, vehicle))
    checked = without_faults(without_impossible(aligned), vehicle)
    shares: dict[str, float] = {}
    for i, (name, other) in enumerate(_OTHER.items()):
        finite, faults = np.isfinite(getattr(aligned, name)), checked.faults.astype(np.int64) >> i
        silent = finite & (faults & STUCK_AY > 0)
        # Rough roads raise the noise too: only reported bursts count.
        reported = aligned.stamps_ns[faults & BURST_AY > 0]
        bursts = finite & (checked.extra_variance[:, i] > 0.0) & _beside(aligned.stamps_ns, reported, BURST_S)
        if not (bursts | silent).any():
            continue
        shares[name] = _share_of_motion(getattr(aligned, other), silent)
        sound[name] = _without(sound[name], aligned.stamps_ns[bursts | silent])
        if "ax_m_s2" in sound and _topic(sound["ax_m_s2"]) == _topic(sound[name]):
            sound["ax_m_s2"] = _without(sound["ax_m_s2"], aligned.stamps_ns[bursts])
    return sound, shares


def _topic(channel: Channel) -> str:
    return channel.source.split(".")[0]


def _share_of_motion(other: FloatArray, faulty: BoolArray) -> float:
    finite = np.isfinite(other)
    power = np.where(finite, (other - (np.mean(other[finite]) if finite.any() else 0.0)) ** 2, 0.0)
    return float(power[faulty].sum() / max(power.sum(), 1e-12))


def _without(channel: Channel, faulty_ns: IntArray) -> Channel:
    return channel.take(~_beside(channel.stamps_ns, faulty_ns, BESIDE_S))


def _beside(stamps_ns: IntArray, others_ns: IntArray, within_s: float) -> BoolArray:
    """Return which stamps are within a time of one of the others (ascending)."""
    within = round(within_s * 1e9)
    first = np.searchsorted(others_ns, stamps_ns - within)
    return np.asarray(first < np.searchsorted(others_ns, stamps_ns + within, side="right"))
