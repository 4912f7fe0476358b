"""Possible uses of a log, and the signals that sideslip estimation still needs."""

from __future__ import annotations

from collections.abc import Mapping as MappingABC

from pdhef_logtool.estimators.presets import preset_of
from pdhef_logtool.estimators.table import SPECS, all_specs
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.records.signals import WHEELS

#: Plain names of the signals that the estimator of sideslip needs.
_WORDS = {
    "steer_rad": "a steering angle",
    "ax_m_s2": "a longitudinal acceleration",
    "ay_m_s2": "a lateral acceleration",
    "yaw_rate_rad_s": "a yaw rate",
    "speed_m_s": "a speed or wheel speeds",
}
#: The estimator that the sentence is about.
_MAIN = next(spec for spec in SPECS if spec.name == "physics")


def usable_signals(mapping: Mapping) -> frozenset[str]:
    """Return the aligned signals that a mapping gives: a steering wheel steers, and wheels have a speed."""
    have = set(mapping.signals)
    if "steering_wheel_rad" in have:
        have.add("steer_rad")
    if any(f"wheel_speed_{w}_{unit}" in have for w in WHEELS for unit in ("m_s", "rad_s")):
        have.add("speed_m_s")
    return frozenset(have)


def possible_uses(mapping: Mapping) -> str:
    """Return the possible uses of a log with this mapping."""
    have = usable_signals(mapping)
    uses = []
    if not _MAIN.lacking(have):
        uses.append(f"estimate sideslip ({_MAIN.name} and others){_scored(mapping)}")
    elif have and (names := _estimators_with(have)):
        uses.append(f"run {', '.join(names[:3])}{_scored(mapping)}")
    elif mapping.truth:
        uses.append("plot the ground truth")
    if have:
        uses.append("export its signals to Rerun or MCAP")
    return "; ".join(uses) or "list its topics and fields (--fields)"


def _estimators_with(have: frozenset[str]) -> list[str]:
    """Return the presets that need neither further signals nor a network nor noise parameters of the car."""
    specs = (s for s in all_specs() if not s.lacking(have) and not s.network and not s.needs_noise)
    return list(dict.fromkeys(preset_of(s.name) for s in specs))


def missing_for_sideslip(mapping: Mapping) -> str:
    """Return the signals that sideslip still needs or would gain most from; empty if none is missing."""
    wanted = _MAIN.needs | {"steer_rad"}
    lacking = sorted(wanted - usable_signals(mapping), key=list(_WORDS).index)
    return ", ".join(_WORDS.get(n, n) for n in lacking)


def uses_of(mapping: Mapping) -> MappingABC[str, str]:
    """Return both sentences by name, as ``pdhef inspect --json`` prints them."""
    return {"can": possible_uses(mapping), "sideslip_needs": missing_for_sideslip(mapping)}


def _scored(mapping: Mapping) -> str:
    truth = set(mapping.truth)
    place = {"x_m", "lat_deg", "ecef_position_m", "enu_velocity_m_s", "ecef_velocity_m_s"} & truth
    if {"vx_m_s", "vy_m_s"} <= truth or "sideslip_rad" in truth or (place and {"quat_wxyz", "yaw_rad"} & truth):
        return " and score it against ground truth"
    if place or {"course_rad", "vx_m_s"} & truth:
        return ", and compare speed or course with ground truth, which contains no sideslip"
    return "; without ground truth it has no score"
