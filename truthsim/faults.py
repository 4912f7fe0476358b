"""Injected sensor faults: kind, sensor, start and end of each.

A fault is written ``KIND:WHAT:START:END`` with times in seconds of the drive (``end`` for the drive's end):

==============  =====================================================================================================
``burst<F>``    noise of F times the usual sigma (``burst20:yaw_rate:5:8``)
``stuck``       the value at the start is repeated
``dead``        the sensor reads zero
``flip``        the sign is wrong
``bias<B>``     B (in SI units) is added
``dropout``     a field reads NaN; a whole message (``imu``, ``steering``, ``wheels``, ``rtk``) is not there
``delay<MS>``   messages arrive MS milliseconds later
``jump<S>``     the sensor's clock is S seconds ahead: stamps jump, arrivals do not
``float``       the RTK has a float solution only
``lost``        the RTK has no satellites and coasts
==============  =====================================================================================================

What: a message (``imu``, ``steering``, ``wheels``, ``rtk``, ``all`` for the three sensors) or one field of one (``ax``,
``ay``, ``az``, ``roll_rate``, ``pitch_rate``, ``yaw_rate``, ``steer``, ``wheel_fl`` … ``wheel_rr``). Faults are applied
in the given order to the finished readings; samples outside of a fault's interval and field are unchanged.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import WHEELS, FloatArray
from truthsim.sensors import RTK_FLOAT, RTK_LOST, Outage, SensorChannel, SensorNoise, quantised, student_t

BoolArray: TypeAlias = NDArray[np.bool_]

#: Kinds by their code in ``truthsim_msgs/msg/SensorFault``.
KINDS = ("burst", "stuck", "dead", "flip", "bias", "dropout", "delay", "jump", "float", "lost")
_WITH_VALUE = {"burst": "a factor above 1", "bias": "a number", "delay": "milliseconds", "jump": "seconds"}
_MESSAGE_ONLY = ("delay", "jump")

MESSAGES = ("imu", "steering", "wheels", "rtk")
_SENSORS = ("imu", "steering", "wheels")
#: Fields that may fail individually, with their message.
FIELDS: dict[str, tuple[str, str]] = {
    "ax": ("imu", "ax_m_s2"),
    "ay": ("imu", "ay_m_s2"),
    "az": ("imu", "az_m_s2"),
    "roll_rate": ("imu", "roll_rate_rad_s"),
    "pitch_rate": ("imu", "pitch_rate_rad_s"),
    "yaw_rate": ("imu", "yaw_rate_rad_s"),
    "steer": ("steering", "steer_rad"),
    **{f"wheel_{w}": ("wheels", f"{w}_m_s") for w in WHEELS},
}
#: Messages and fields that a fault may affect, by their code in ``truthsim_msgs/msg/SensorFault``.
TARGETS = (*MESSAGES, "all", *FIELDS)


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault; ``value`` is the factor, the bias, the milliseconds or the seconds of its kind, else 0."""

    kind: str
    target: str
    start_s: float
    end_s: float
    value: float = 0.0

    def __str__(self) -> str:
        """The text that :func:`parse_fault` reads."""
        value = f"{self.value:g}" if self.kind in _WITH_VALUE else ""
        end = "end" if np.isinf(self.end_s) else f"{self.end_s:g}"
        return f"{self.kind}{value}:{self.target}:{self.start_s:g}:{end}"


def parse_fault(text: str) -> Fault:
    """Read a fault written ``KIND[VALUE]:WHAT:START:END``.

    Raises
    ------
    UsageError
        The text is not a valid fault.
    """

    def wrong(expected: str) -> UsageError:
        return UsageError(expected=expected, got=repr(text), where="--fault", remedy="for example burst20:yaw_rate:5:8")

    parts = text.split(":")
    if len(parts) != 4:
        raise wrong("KIND:WHAT:START:END")
    named = re.fullmatch(r"([a-z]+)(-?[0-9.]+(?:e-?[0-9]+)?)?", parts[0])
    if named is None or named[1] not in KINDS:
        raise wrong(f"a kind of {', '.join(KINDS)}")
    kind, target = named[1], parts[1]
    try:
        value = float(named[2]) if named[2] else 0.0
        start_s = float(parts[2])
        end_s = np.inf if parts[3] == "end" else float(parts[3])
    except ValueError:
        raise wrong("numbers for value, START and END") from None
    if (named[2] is not None) != (kind in _WITH_VALUE):
        raise wrong(f"{kind} with {_WITH_VALUE[kind]}" if kind in _WITH_VALUE else f"{kind} without a number")
    if (kind == "burst" and value <= 1.0) or (kind == "delay" and value <= 0.0):
        raise wrong(f"{kind} with {'a factor above 1' if kind == 'burst' else 'a positive number of milliseconds'}")
    if not 0.0 <= start_s < end_s:
        raise wrong("0 <= START < END")
    if kind in ("float", "lost") and target != "rtk":
        raise wrong(f"{kind}:rtk:START:END")
    if target not in TARGETS:
        raise wrong(f"one of {', '.join(TARGETS)}")
    if kind in _MESSAGE_ONLY and target in FIELDS:
        raise wrong(f"a whole message ({', '.join(MESSAGES)}, all) for {kind}")
    if target == "rtk" and kind not in ("dropout", "delay", "jump", "float", "lost"):
        raise wrong("dropout, delay, jump, float or lost for rtk")
    return Fault(kind, target, start_s, end_s, value)


def rtk_outages(faults: Sequence[Fault]) -> list[Outage]:
    """Return the outages of the RTK fix by faults, for ``truthsim.sensors.sense``."""
    quality = {"float": RTK_FLOAT, "lost": RTK_LOST}
    return [Outage(f.start_s, f.end_s, quality[f.kind]) for f in faults if f.kind in quality]


def apply_faults(
    channels: Mapping[str, SensorChannel], faults: Sequence[Fault], noise: SensorNoise, seed: int
) -> dict[str, SensorChannel]:
    """Return the channels with the faults applied; channels without faults are returned unchanged."""
    faulty = dict(channels)
    for i, fault in enumerate(faults):
        rng = np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=(200, i)))
        for name in _hit(fault):
            faulty[name] = _spoil(faulty[name], fault, noise, rng)
    return faulty


def _hit(fault: Fault) -> tuple[str, ...]:
    if fault.target in FIELDS:
        return (FIELDS[fault.target][0],)
    if fault.target == "rtk":
        return ("rtk", "fix")
    return _SENSORS if fault.target == "all" else (fault.target,)


def _spoil(channel: SensorChannel, fault: Fault, noise: SensorNoise, rng: np.random.Generator) -> SensorChannel:
    inside = (channel.times_s >= fault.start_s) & (channel.times_s < fault.end_s)
    if fault.kind in ("float", "lost") or not inside.any():
        return channel
    if fault.kind == "delay":
        # Messages keep their order: messages after the fault are delayed until its last message.
        late = np.maximum.accumulate(channel.arrival_s + np.where(inside, 1e-3 * fault.value, 0.0))
        return SensorChannel(channel.times_s, late, channel.fields)
    if fault.kind == "jump":
        shifted = channel.times_s + np.where(inside, fault.value, 0.0)
        return SensorChannel(shifted, channel.arrival_s, channel.fields)
    if fault.kind == "dropout" and fault.target not in FIELDS:
        kept = ~inside
        return SensorChannel(
            channel.times_s[kept], channel.arrival_s[kept], {k: v[kept] for k, v in channel.fields.items()}
        )
    names = [FIELDS[fault.target][1]] if fault.target in FIELDS else list(channel.fields)
    fields = dict(channel.fields)
    for name in names:
        fields[name] = np.where(
            inside, _fault_value(channel.fields[name], name, inside, fault, noise, rng), fields[name]
        )
    if "steer_rad" in names and "steering_wheel_rad" in fields:
        fields["steering_wheel_rad"] = _steering_wheel(channel, fields["steer_rad"], inside)
    return SensorChannel(channel.times_s, channel.arrival_s, fields)


def _steering_wheel(channel: SensorChannel, steer: FloatArray, inside: BoolArray) -> FloatArray:
    """Return the steering wheel's angle for a road-wheel angle, as one sensor provides both."""
    before, wheel = channel.fields["steer_rad"], channel.fields["steering_wheel_rad"]
    turned = np.abs(before) > 0.0
    ratio = float(np.median(wheel[turned] / before[turned])) if turned.any() else 1.0
    return np.where(inside, ratio * steer, wheel)


def _fault_value(
    values: FloatArray, name: str, inside: BoolArray, fault: Fault, noise: SensorNoise, rng: np.random.Generator
) -> FloatArray:
    if fault.kind == "stuck":
        return np.full_like(values, values[int(np.argmax(inside))])
    if fault.kind == "dead":
        return np.zeros_like(values)
    if fault.kind == "flip":
        return np.asarray(-values)
    if fault.kind == "dropout":
        return np.full_like(values, np.nan)
    if fault.kind == "bias":
        return _as_read(values + fault.value, name, noise)
    # Add independent noise, so that the total has the requested sigma.
    more = _sigma(name, noise) * np.sqrt(fault.value**2 - 1.0)
    return _as_read(values + student_t(rng, more, values.shape[0]), name, noise)


def _sigma(name: str, noise: SensorNoise) -> float:
    if name.startswith("steer"):
        return noise.steer_rad
    if name in {f"{w}_m_s" for w in WHEELS}:
        return noise.wheel_speed_m_s
    return noise.acceleration_m_s2 if name.endswith("m_s2") else noise.yaw_rate_rad_s


def _as_read(values: FloatArray, name: str, noise: SensorNoise) -> FloatArray:
    """Apply the resolution and full scale of the sensor to faulty values."""
    if name.endswith("m_s2"):
        return quantised(values, noise.acceleration_range_m_s2)
    if name.endswith("rate_rad_s"):
        return quantised(values, noise.rate_range_rad_s)
    if name in {f"{w}_m_s" for w in WHEELS}:
        return np.maximum(np.round(values * 2.0**8) / 2.0**8, 0.0)
    return values
