"""IMU samples with sensor faults, which are excluded from the relations between signals.

The filters' detector (:mod:`pdhef_logtool.estimators.sensor_faults`) finds them. It cannot distinguish a dead channel
from a channel in another unit; this module can, because the whole drive is available.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.alignment import SURVEY_S, align, has_imu, plan_alignment
from pdhef_logtool.records.reasons import BURST_AY
from pdhef_logtool.records.signals import BoolArray, Channel, FloatArray, IntArray

#: Time excluded on both sides of a faulty sample: a fault starts before its detection, and the low pass spreads it.
BESIDE_S = 0.3
#: Averaging time, s. A silent channel's averages change by no more than this share of its usual change.
MEAN_S = 0.25
SILENT = 0.2
#: A burst begins this long before it is reported.
BURST_S = 1.5

_OTHER = {"ay_m_s2": "yaw_rate_rad_s", "yaw_rate_rad_s": "ay_m_s2"}


def without_faulty_samples(
    signals: Mapping[str, Channel], vehicle: VehicleParameters
) -> tuple[dict[str, Channel], dict[str, float]]:
    """Return the channels without the samples that are stuck, dead, a spike or in a burst of noise.

    Returns
    -------
    channels : without the faulty samples. shares : for each shortened channel, the share of the drive's motion during
        its silent samples.
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
    aligned, _ = align(signals, plan)
    faults, _ = find_faults(aligned, vehicle, None)
    shares: dict[str, float] = {}
    for i, (name, other) in enumerate(_OTHER.items()):
        finite = np.isfinite(getattr(aligned, name))
        silent = finite & ~np.isfinite(getattr(faults.filtered, name))
        # Rough roads raise the noise too: only reported bursts count.
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
    """Return whether a channel changes in its silent samples as much as elsewhere: it is weak, not silent."""
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
    """Return which stamps are within a time of one of the others (ascending)."""
    within = round(within_s * 1e9)
    first = np.searchsorted(others_ns, stamps_ns - within)
    return np.asarray(first < np.searchsorted(others_ns, stamps_ns + within, side="right"))
