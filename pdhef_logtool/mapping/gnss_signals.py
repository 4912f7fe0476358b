"""GNSS velocity as a sensor: of a receiver that has a velocity over ground and no heading.

What also has a heading (two antennas, INS) or sideslip is ground truth, and never an input of an estimator.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from pdhef_logtool.mapping.records import SignalSource

_EAST, _NORTH = "gnss_velocity_east_m_s", "gnss_velocity_north_m_s"
#: Ground truth with one of these states a heading, or motion that needs one.
HEADING = frozenset({"quat_wxyz", "yaw_rad", "vy_m_s", "sideslip_rad"})


def gnss_signals(signals: Mapping[str, SignalSource], truth: Mapping[str, SignalSource]) -> dict[str, SignalSource]:
    """Return the GNSS signals that mapped ground truth contains: a velocity, or speed and course of one topic."""
    if HEADING & set(truth):
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
    """Return one column of a vector as a signal of its own."""
    scale, offset = (value[column] if isinstance(value, tuple) else value for value in (vector.scale, vector.offset))
    return replace(vector, name=name, field=vector.paths[column], scale=scale, offset=offset)
