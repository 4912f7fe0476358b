"""Intervals of the reasons for which an estimator did not use its sensors as usual.

Stamps with the bit of a reason that are at most ``RUN_GAP_S`` apart form one interval: a gyro that is stuck for
seconds gives one interval, even if single samples change.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pdhef_logtool.evaluation.smoothing import runs
from pdhef_logtool.records.reasons import REASONS
from pdhef_logtool.records.signals import S_PER_NS
from pdhef_logtool.records.tracks import StateTrack

#: Largest number of intervals in a list of faults.
LISTED_INTERVALS = 50
#: Signal by the ending of a reason's name.
_SENSORS = {"ay": "ay_m_s2", "yaw_rate": "yaw_rate_rad_s"}


@dataclass(frozen=True, slots=True)
class Interval:
    """A part of the drive, [start_ns, end_ns)."""

    start_ns: int
    end_ns: int


def sensor_fault(sensor: str, kind: str, intervals: Sequence[Interval]) -> dict[str, Any]:
    """Return a fault of one sensor over a drive, as an entry of report.json.

    Parameters
    ----------
    kind : ``burst``, ``spike``, ``stuck``, ``dead``, ``missing``, ``jump`` (of its bias) or ``gain``.
    intervals : all; the entry has up to :data:`LISTED_INTERVALS` of the longest, in order of time.
    """
    seconds = sum(i.end_ns - i.start_ns for i in intervals) * S_PER_NS
    longest = sorted(intervals, key=lambda i: (i.start_ns - i.end_ns, i.start_ns))[:LISTED_INTERVALS]
    listed = sorted(longest, key=lambda i: i.start_ns)
    return {"sensor": sensor, "kind": kind, "count": len(intervals), "seconds": seconds, "intervals": listed}


def reason_intervals(track: StateTrack) -> dict[str, list[Interval]]:
    """Return the intervals of each reason in order of time; reasons that never apply are left out."""
    intervals = {}
    for reason in REASONS if len(track.reason) == len(track) else ():
        stamps_ns = track.stamps_ns[track.reason & reason.bit != 0]
        if spans := runs(stamps_ns, np.ones(len(stamps_ns), dtype=np.bool_)):
            intervals[reason.name] = [Interval(int(stamps_ns[a]), int(stamps_ns[b - 1]) + 1) for a, b in spans]
    return intervals


def sensor_faults(track: StateTrack) -> list[dict[str, Any]] | None:
    """Return the sensor faults that an estimator detected; None if the source provides no reasons."""
    if not len(track.reason) == len(track) > 0:
        return None
    named = ((name.partition("_"), intervals) for name, intervals in reason_intervals(track).items())
    faults = (sensor_fault(_SENSORS[sensor], kind, intervals) for (kind, _, sensor), intervals in named)
    return sorted(faults, key=lambda f: str(f["sensor"]))
