"""Samples of an IMU that a sensor fault has spoilt: relations between signals are looked at without them.

The detector is that of the filters (:mod:`pdhef_logtool.estimators.sensor_faults`). It cannot distinguish a dead
channel from one in another unit; here the whole drive is available.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.alignment import SURVEY_S, align, has_imu, plan_alignment
from pdhef_logtool.records.reasons import BURST_AY
from pdhef_logtool.records.signals import BoolArray, Channel, FloatArray, IntArray

#: Left out with a faulty sample on both sides: a fault shows before it is found, and the low pass reaches as far.
BESIDE_S = 0.3
#: What is silent changes from one such time to the next by no more than this share of what it else does.
MEAN_S = 0.25
SILENT = 0.2
#: A burst begins as long before it is reported.
BURST_S = 1.5

_OTHER = {"ay_m_s2": "yaw_rate_rad_s", "yaw_rate_rad_s": "ay_m_s2"}


def without_faulty_samples(
    signals: Mapping[str, Channel], vehicle: VehicleParameters
) -> tuple[dict[str, Channel], dict[str, float]]:
    """Return the channels without the samples that are stuck, dead, a spike or in a burst of noise.

    Returns
    -------
    channels, and by name of those that lost samples the share of the drive's motion that the silent ones held.
    """
    from pdhef_logtool.estimators.sensor_faults import find_faults  # loads the compiler

    sound = dict(signals)
    if any(n not in signals or not len(signals[n]) for n in _OTHER):
        return sound, {}
    gyro = signals["yaw_rate_rad_s"]
    middle, reach = int(np.median(gyro.stamps_ns)), round(0.5e9 * SURVEY_S)
    signals = {n: c.between(middle - reach, middle + reach) for n, c in signals.items()}
    if not has_imu(signals):
        return sound, {}
    plan = plan_alignment(signals, steering_ratio=vehicle.steering_ratio, wheel_radius_m=vehicle.wheel_radius_m)
    aligned = align(signals, plan, middle - reach, middle + reach)
    faults, _ = find_faults(aligned, vehicle, None)
    shares: dict[str, float] = {}
    for i, (name, other) in enumerate(_OTHER.items()):
        finite = np.isfinite(getattr(aligned, name))
        silent = finite & ~np.isfinite(getattr(faults.filtered, name))
        # Rough road raises the noise too: a burst is one that would be reported.
        reported = aligned.stamps_ns[faults.reason & (BURST_AY << i) > 0]
        bursts = finite & (faults.extra_r[:, i] > 0.0) & _beside(aligned.stamps_ns, reported, BURST_S)
        if silent.any() and _moves(aligned.stamps_ns, getattr(aligned, name), silent):
            silent &= False
        if not (bursts | silent).any():
            continue
        shares[name] = _share_of_motion(getattr(aligned, other), silent)
        sound[name] = _without(sound[name], aligned.stamps_ns[bursts | silent])
        if "ax_m_s2" in sound and _topic(sound["ax_m_s2"]) == _topic(sound[name]):
            sound["ax_m_s2"] = _without(sound["ax_m_s2"], aligned.stamps_ns[bursts])
    return sound, shares


def _topic(channel: Channel) -> str:
    return channel.source.split(".")[0]


def _moves(stamps_ns: IntArray, values: FloatArray, silent: BoolArray) -> bool:
    """Return whether a channel changes in its silent samples as it does in the others: then it is weak, not silent."""
    cells = (stamps_ns - stamps_ns[0]) // round(MEAN_S * 1e9)
    finite = np.isfinite(values)
    count = np.bincount(cells[finite])
    with np.errstate(divide="ignore", invalid="ignore"):
        steps = np.diff(np.bincount(cells[finite], weights=values[finite]) / count)
    quiet = np.bincount(cells[finite], weights=silent[finite]) == count
    within = quiet[1:] & quiet[:-1] & np.isfinite(steps)
    beyond = ~within & np.isfinite(steps)
    if not within.any() or not beyond.any():
        return bool(beyond.any())
    return bool(np.mean(steps[within] ** 2) > SILENT**2 * np.mean(steps[beyond] ** 2))


def _share_of_motion(other: FloatArray, faulty: BoolArray) -> float:
    finite = np.isfinite(other)
    power = np.where(finite, (other - (np.mean(other[finite]) if finite.any() else 0.0)) ** 2, 0.0)
    return float(power[faulty].sum() / max(power.sum(), 1e-12))


def _without(channel: Channel, faulty_ns: IntArray) -> Channel:
    return channel.take(~_beside(channel.stamps_ns, faulty_ns, BESIDE_S))


def _beside(stamps_ns: IntArray, others_ns: IntArray, within_s: float) -> BoolArray:
    """Return which stamps have one of the others, ascending, within a time."""
    within = round(within_s * 1e9)
    first = np.searchsorted(others_ns, stamps_ns - within)
    return np.asarray(first < np.searchsorted(others_ns, stamps_ns + within, side="right"))
