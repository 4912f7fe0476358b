"""GNSS signals of a receiver without heading: velocity over ground, position and their quality.

A source that also has a heading (two antennas, INS) or sideslip is ground truth, and never an input of an estimator.
Messages of receivers are recognised by their fields at any depth, so that nested messages are recognised, too.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.mapping.vendors import Vendors, load_vendors

_EAST, _NORTH = "gnss_velocity_east_m_s", "gnss_velocity_north_m_s"
_POSITION_ACCURACY = "gnss_position_accuracy_m"
#: Ground truth with one of these contains a heading, or motion that needs one.
HEADING = frozenset({"quat_wxyz", "yaw_rad", "vy_m_s", "sideslip_rad"})


def has_heading(truth: Collection[str]) -> bool:
    """Return whether ground truth contains a heading, or motion that needs one."""
    return bool(HEADING & set(truth))


def gnss_signals(signals: Mapping[str, SignalSource], truth: Mapping[str, SignalSource]) -> dict[str, SignalSource]:
    """Return the GNSS signals that mapped ground truth contains: a velocity, or speed and course of one topic."""
    if has_heading(truth):
        return {}
    if (velocity := truth.get("enu_velocity_m_s")) is not None:
        return {name: component(velocity, name, i) for i, name in enumerate((_EAST, _NORTH))}
    course = truth.get("course_rad")
    speeds = [s for s in (signals.get("speed_m_s"), truth.get("vx_m_s")) if s is not None]
    if course is None or not any(s.topic == course.topic for s in speeds):
        return {}
    speed = next(s for s in speeds if s.topic == course.topic)
    return {
        name: replace(source, name=name) for name, source in (("gnss_speed_m_s", speed), ("gnss_course_rad", course))
    }


def component(vector: SignalSource, name: str, column: int) -> SignalSource:
    """Return one column of a vector as a separate signal."""
    scale, offset = (value[column] if isinstance(value, tuple) else value for value in (vector.scale, vector.offset))
    return replace(vector, name=name, field=vector.paths[column], scale=scale, offset=offset)


#: Course of a single antenna in addition to a heading from two antennas: a sensor, even of a ground-truth instrument.
RAW_COURSE = "heading_raw"


def receiver_signals(
    topic: str, stamp: str, paths: Collection[str], vendors: Vendors | None = None
) -> dict[str, SignalSource]:
    """Return the GNSS signals of a topic if it contains, at any depth, the fields of a receiver; empty otherwise."""
    there = set(paths)
    for receiver in (vendors or load_vendors()).receivers:
        leaf = min(receiver.has)
        for base in sorted(p.removesuffix(leaf) for p in there if p == leaf or p.endswith(f".{leaf}")):
            if not all(f"{base}{name}" in there for name in receiver.has):
                continue
            if any(f"{base}{name}" in there for name in receiver.without):
                return {}
            sources = {
                f.name: SignalSource(f.name, topic, f"{base}{path}", stamp, f.scale, f.offset)
                for path, f in receiver.fields.items()
                if f"{base}{path}" in there
            }
            if "position_covariance_type" in receiver.has:  # 1 sigma: the root of the mean variance east and north
                squared = tuple(f"{base}position_covariance[{i}]" for i in (0, 4))
                accuracy = SignalSource(_POSITION_ACCURACY, topic, squared, stamp, (0.5, 0.5), combine="root")
                sources[_POSITION_ACCURACY] = accuracy
            return sources
    return {}
