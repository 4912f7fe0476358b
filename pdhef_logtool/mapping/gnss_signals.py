"""GNSS signals of a receiver without heading: velocity over ground, position and their quality.

A source that also has a heading (two antennas, INS) or sideslip is ground truth, and never an input of an estimator.
Messages of receivers are recognised by their fields at any depth, so that nested messages are recognised, too.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from pdhef_logtool.mapping.records import SignalSource

_DEGREE = 0.017453292519943295
#: Clockwise from north in degrees to counter-clockwise from east in rad.
_COURSE = (-_DEGREE, 1.5707963267948966)
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


@dataclass(frozen=True, slots=True)
class Receiver:
    """A documented message of a receiver: fields that identify it, and signal, field, scale and offset of each.

    ``heading``: fields of an attitude. A message with one of them is ground truth.
    """

    fields: frozenset[str]
    signals: tuple[tuple[str, str, float, float], ...]
    heading: frozenset[str] = frozenset()


#: Signals by letter in the table below.
_LETTERS = {
    "E": _EAST, "N": _NORTH, "V": "gnss_speed_m_s", "C": "gnss_course_rad", "F": "gnss_fix_type",
    "A": "gnss_latitude_deg", "O": "gnss_longitude_deg", "v": "gnss_velocity_accuracy_m_s", "p": _POSITION_ACCURACY,
}  # fmt: skip
#: Course of a single antenna in addition to a heading from two antennas: a sensor, even of a ground-truth instrument.
RAW_COURSE = "heading_raw"
#: One receiver per line: fields that identify it, signals as letter=field*scale+offset, fields of a heading. Scales as
#: documented: mm/s, cm/s, km/h, 1e-7 deg, rad, mm, uncertainties of 95 % or twice the RMS; courses are in deg clockwise
#: from north. gps_common/GPSFix; u-blox NAV-PVT in two spellings, NAV-VELNED, NAV-POSLLH; Piksi VelNed, PosLlh; raw
#: columns of a VBO file; NovAtel BESTVEL in three spellings; Septentrio PVTGeodetic; NovAtel INSPVA; NavSatFix.
_TABLE = f"""
track speed err_track err_horz | V=speed C=track A=latitude O=longitude F=status.status*1+1 v=err_speed*0.5 \
p=err_horz*0.5
vel_n vel_e g_speed h_acc | E=vel_e*1e-3 N=vel_n*1e-3 A=lat*1e-7 O=lon*1e-7 F=fix_type F=gps_fix.fix_type v=s_acc*1e-3 \
p=h_acc*1e-3
velN velE gSpeed hAcc | E=velE*1e-3 N=velN*1e-3 A=lat*1e-7 O=lon*1e-7 F=fixType v=sAcc*1e-3 p=hAcc*1e-3
vel_n vel_e g_speed c_acc | E=vel_e*1e-2 N=vel_n*1e-2 v=s_acc*1e-2
lat lon h_msl h_acc v_acc | A=lat*1e-7 O=lon*1e-7 p=h_acc*1e-3
n e d h_accuracy n_sats | E=e*1e-3 N=n*1e-3 v=h_accuracy*1e-3
lat lon height h_accuracy n_sats | A=lat O=lon p=h_accuracy*1e-3
speed_raw {RAW_COURSE} | V=speed_raw*{1.0 / 3.6} C={RAW_COURSE}
hor_speed trk_gnd | V=hor_speed C=trk_gnd
hor_spd trk_gnd | V=hor_spd C=trk_gnd
horizontal_speed track_ground | V=horizontal_speed C=track_ground
vn ve cog | E=ve N=vn A=latitude*{1.0 / _DEGREE} O=longitude*{1.0 / _DEGREE} F=mode p=h_accuracy*0.005 | heading azimuth
north_velocity east_velocity | E=east_velocity N=north_velocity | azimuth heading yaw
latitude longitude position_covariance_type | A=latitude O=longitude F=status.status*1+1
"""


def _receiver(line: str) -> Receiver:
    fields, signals, heading = f"{line} |".split("|")[:3]
    pairs = [entry.split("=") for entry in signals.split()]
    return Receiver(
        frozenset(fields.split()),
        tuple((_LETTERS[letter], *_scaled(letter, *text.partition("*")[::2])) for letter, text in pairs),
        frozenset(heading.split()),
    )


def _scaled(letter: str, path: str, factor: str) -> tuple[str, float, float]:
    scale, _, offset = factor.partition("+")
    return (path, *_COURSE) if letter == "C" else (path, float(scale or 1.0), float(offset or 0.0))


RECEIVERS = tuple(map(_receiver, _TABLE.strip().splitlines()))


def receiver_signals(topic: str, stamp: str, paths: Collection[str]) -> dict[str, SignalSource]:
    """Return the GNSS signals of a topic if it contains, at any depth, the fields of a receiver; empty otherwise."""
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
            if "position_covariance_type" in receiver.fields:  # 1 sigma: the root of the mean variance east and north
                squared = tuple(f"{base}position_covariance[{i}]" for i in (0, 4))
                accuracy = SignalSource(_POSITION_ACCURACY, topic, squared, stamp, (0.5, 0.5), combine="root")
                sources[_POSITION_ACCURACY] = accuracy
            return sources
    return {}
