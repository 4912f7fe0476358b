"""What ``--no-position`` keeps out of the outputs: poses of tracks, and copied topics that may contain a place."""

from __future__ import annotations

import re
from collections.abc import Container, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.mapping.can_frames import holds_frames
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.sink import Event, Sink

#: Words of a field's path that state a place, and starts and ends of types that contain one.
_WORDS = frozenset({
    "lat", "lon", "long", "lng", "latitude", "longitude", "lati", "longi", "position", "pose", "poses", "ecef", "utm",
    "easting", "northing", "geohash", "mgrs", "lla", "llh", "gga", "rmc", "gll", "nmea", "sentence", "tf", "transform",
    "transforms", "translation", "map", "odom", "place", "location",
})  # fmt: skip
_TYPES = ("NavSatFix", "GPSFix", "Odometry", "Path", "TFMessage", "OccupancyGrid", "MarkerArray", "Marker", "Sentence")
#: A position of these is none of the car.
_OF_CONTROLS = frozenset(
    {"steering", "steer", "pedal", "throttle", "brake", "gear", "rack", "lever", "clutch", "accelerator", "wheel"}
)
_PACKAGES = ("geographic_msgs/", "nmea_msgs/", "foxglove.LocationFix", "foxglove.Pose", "foxglove.FrameTransform")


class WithoutPosition(Sink):
    """A sink that gets all tracks without place and heading."""

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self.lost = sink.lost

    def append_signals(self, signals: Signals) -> None:
        """Take what the estimators saw in this window, without GNSS positions."""
        self._sink.append_signals(replace(signals, gnss_position_deg=np.full((len(signals), 2), np.nan)))

    def append(self, track: StateTrack) -> None:
        """Take one track of this window."""
        nowhere = np.full(len(track), np.nan)
        self._sink.append(track.with_pose(nowhere, nowhere, nowhere))

    def finish(self, report: Mapping[str, Any], events: Sequence[Event] = ()) -> None:
        """Finish the output."""
        self._sink.finish(report, events)

    def abort(self) -> None:
        """Remove what was written."""
        self._sink.abort()


def topics_with_position(log: DriveLog, mapped: Container[str]) -> frozenset[str]:
    """Return the topics that may contain a place: ``mapped`` as one, by type or fields, and those that are not decoded.

    Raw CAN frames are among them: without a DBC their content is unknown.
    """
    return frozenset(t.name for t in log.topics if t.name in mapped or _may_contain_place(log, t))


def _may_contain_place(log: DriveLog, topic: TopicInfo) -> bool:
    kind = topic.type_name.replace("/msg/", "/")
    if kind.startswith(_PACKAGES) or kind.rpartition("/")[2].rpartition(".")[2] in _TYPES:
        return True
    fields = log.fields(topic.name, quiet=True)
    return not fields or holds_frames(topic.name, fields) or any(_is_place(_words(f.path)) for f in fields)


def _is_place(words: frozenset[str]) -> bool:
    return bool(_WORDS & words) and not words & _OF_CONTROLS


def _words(path: str) -> frozenset[str]:
    spaced = re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", path)
    return frozenset(re.split(r"[^a-z]+", spaced.lower()))
