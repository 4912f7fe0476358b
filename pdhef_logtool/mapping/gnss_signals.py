"""GNSS as a sensor: velocity over ground, position and their quality, of a receiver that has no heading.

What also has a heading (two antennas, INS) or sideslip is ground truth, and never an input of an estimator. Messages
of receivers are recognised by their fields, at any depth, so that types that contain such a message are recognised too.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from pdhef_logtool.mapping.records import SignalSource

_DEGREE = 0.017453292519943295
#: Clockwise from north in degrees to counter-clockwise from east in rad.
_COURSE = (-_DEGREE, 1.5707963267948966)
_EAST, _NORTH = "gnss_velocity_east_m_s", "gnss_velocity_north_m_s"
#: Ground truth with one of these states a heading, or motion that needs one.
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
    """Return one column of a vector as a signal of its own."""
    scale, offset = (value[column] if isinstance(value, tuple) else value for value in (vector.scale, vector.offset))
    return replace(vector, name=name, field=vector.paths[column], scale=scale, offset=offset)


@dataclass(frozen=True, slots=True)
class Receiver:
    """A documented message of a receiver: fields that recognise it, and signal, field, scale and offset of each.

    ``heading``: fields of an attitude: such a message is ground truth.
    """

    fields: frozenset[str]
    signals: tuple[tuple[str, str, float, float], ...]
    heading: frozenset[str] = frozenset()


def _receiver(fields: str, *signals: tuple[str, str, float, float], heading: str = "") -> Receiver:
    return Receiver(frozenset(fields.split()), signals, frozenset(heading.split()))


_SPEED, _COURSE_NAME, _FIX = "gnss_speed_m_s", "gnss_course_rad", "gnss_fix_type"
_LATITUDE, _LONGITUDE = "gnss_latitude_deg", "gnss_longitude_deg"
#: Course of a single antenna beside the heading of two: a sensor, even of an instrument that is ground truth.
RAW_COURSE = "heading_raw"
_VELOCITY_ACCURACY, _POSITION_ACCURACY = "gnss_velocity_accuracy_m_s", "gnss_position_accuracy_m"
#: gps_common/GPSFix; u-blox NAV-PVT in the drivers' spellings, NAV-VELNED, NAV-POSLLH; Piksi VelNed, PosLlh; raw
#: columns of a VBO file; NovAtel BESTVEL in the spellings of its drivers; Septentrio PVTGeodetic; NovAtel INSPVA;
#: sensor_msgs/NavSatFix. Scales as documented: mm/s, cm/s, km/h, 1e-7 deg, deg clockwise from north, mm, uncertainties
#: of 95 % or twice the RMS.
RECEIVERS = (
    _receiver(
        "track speed err_track err_horz",
        (_SPEED, "speed", 1.0, 0.0),
        (_COURSE_NAME, "track", *_COURSE),
        (_LATITUDE, "latitude", 1.0, 0.0),
        (_LONGITUDE, "longitude", 1.0, 0.0),
        (_FIX, "status.status", 1.0, 1.0),
        (_VELOCITY_ACCURACY, "err_speed", 0.5, 0.0),
        (_POSITION_ACCURACY, "err_horz", 0.5, 0.0),
    ),
    _receiver(
        "vel_n vel_e g_speed h_acc",
        (_EAST, "vel_e", 1e-3, 0.0),
        (_NORTH, "vel_n", 1e-3, 0.0),
        (_LATITUDE, "lat", 1e-7, 0.0),
        (_LONGITUDE, "lon", 1e-7, 0.0),
        (_FIX, "fix_type", 1.0, 0.0),
        (_FIX, "gps_fix.fix_type", 1.0, 0.0),
        (_VELOCITY_ACCURACY, "s_acc", 1e-3, 0.0),
        (_POSITION_ACCURACY, "h_acc", 1e-3, 0.0),
    ),
    _receiver(
        "velN velE gSpeed hAcc",
        (_EAST, "velE", 1e-3, 0.0),
        (_NORTH, "velN", 1e-3, 0.0),
        (_LATITUDE, "lat", 1e-7, 0.0),
        (_LONGITUDE, "lon", 1e-7, 0.0),
        (_FIX, "fixType", 1.0, 0.0),
        (_VELOCITY_ACCURACY, "sAcc", 1e-3, 0.0),
        (_POSITION_ACCURACY, "hAcc", 1e-3, 0.0),
    ),
    _receiver(
        "vel_n vel_e g_speed c_acc",
        (_EAST, "vel_e", 1e-2, 0.0),
        (_NORTH, "vel_n", 1e-2, 0.0),
        (_VELOCITY_ACCURACY, "s_acc", 1e-2, 0.0),
    ),
    _receiver(
        "lat lon h_msl h_acc v_acc",
        (_LATITUDE, "lat", 1e-7, 0.0),
        (_LONGITUDE, "lon", 1e-7, 0.0),
        (_POSITION_ACCURACY, "h_acc", 1e-3, 0.0),
    ),
    _receiver(
        "n e d h_accuracy n_sats",
        (_EAST, "e", 1e-3, 0.0),
        (_NORTH, "n", 1e-3, 0.0),
        (_VELOCITY_ACCURACY, "h_accuracy", 1e-3, 0.0),
    ),
    _receiver(
        "lat lon height h_accuracy n_sats",
        (_LATITUDE, "lat", 1.0, 0.0),
        (_LONGITUDE, "lon", 1.0, 0.0),
        (_POSITION_ACCURACY, "h_accuracy", 1e-3, 0.0),
    ),
    _receiver("speed_raw heading_raw", (_SPEED, "speed_raw", 1.0 / 3.6, 0.0), (_COURSE_NAME, RAW_COURSE, *_COURSE)),
    _receiver("hor_speed trk_gnd", (_SPEED, "hor_speed", 1.0, 0.0), (_COURSE_NAME, "trk_gnd", *_COURSE)),
    _receiver("hor_spd trk_gnd", (_SPEED, "hor_spd", 1.0, 0.0), (_COURSE_NAME, "trk_gnd", *_COURSE)),
    _receiver(
        "horizontal_speed track_ground",
        (_SPEED, "horizontal_speed", 1.0, 0.0),
        (_COURSE_NAME, "track_ground", *_COURSE),
    ),
    _receiver(
        "vn ve cog",
        (_EAST, "ve", 1.0, 0.0),
        (_NORTH, "vn", 1.0, 0.0),
        (_LATITUDE, "latitude", 1.0 / _DEGREE, 0.0),
        (_LONGITUDE, "longitude", 1.0 / _DEGREE, 0.0),
        (_FIX, "mode", 1.0, 0.0),
        (_POSITION_ACCURACY, "h_accuracy", 0.005, 0.0),
        heading="heading azimuth",
    ),
    _receiver(
        "north_velocity east_velocity",
        (_EAST, "east_velocity", 1.0, 0.0),
        (_NORTH, "north_velocity", 1.0, 0.0),
        heading="azimuth heading yaw",
    ),
    _receiver(
        "latitude longitude position_covariance_type",
        (_LATITUDE, "latitude", 1.0, 0.0),
        (_LONGITUDE, "longitude", 1.0, 0.0),
        (_FIX, "status.status", 1.0, 1.0),
    ),
)


def receiver_signals(topic: str, stamp: str, paths: Collection[str]) -> dict[str, SignalSource]:
    """Return the GNSS signals of a topic whose fields, below any struct, are those of a receiver; empty if none."""
    there = set(paths)
    for receiver in RECEIVERS:
        leaf = min(receiver.fields)
        for base in sorted(p.removesuffix(leaf) for p in there if p == leaf or p.endswith(f".{leaf}")):
            if not all(f"{base}{name}" in there for name in receiver.fields):
                continue
            if any(f"{base}{name}" in there for name in receiver.heading):
                return {}
            sources = {
                name: SignalSource(name, topic, f"{base}{path}", stamp, scale, offset)
                for name, path, scale, offset in receiver.signals
                if f"{base}{path}" in there
            }
            return _with_covariance(sources, topic, stamp, base) if _is_fix(receiver) else sources
    return {}


def _is_fix(receiver: Receiver) -> bool:
    return "position_covariance_type" in receiver.fields


def _with_covariance(sources: dict[str, SignalSource], topic: str, stamp: str, base: str) -> dict[str, SignalSource]:
    """Add the position's 1-sigma of a NavSatFix: the root of the mean variance to the east and north."""
    paths = tuple(f"{base}position_covariance[{i}]" for i in (0, 4))
    accuracy = SignalSource(_POSITION_ACCURACY, topic, paths, stamp, (0.5, 0.5), combine="root")
    return {**sources, _POSITION_ACCURACY: accuracy}
