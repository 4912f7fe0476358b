"""Find the three axes of an accelerometer and a gyro, starting from one mapped axis."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping.checking import has_path
from pdhef_logtool.mapping.records import Mapping, SignalSource
from pdhef_logtool.records.signals import FloatArray

#: Words for the axes of a rate, x first.
_RATE_WORDS = ("roll", "pitch", "yaw")
#: Temporary names of the components; they differ from all signal names.
ACCELERATIONS = tuple(f"triad.acceleration.{axis}" for axis in "xyz")
RATES = tuple(f"triad.rate.{axis}" for axis in "xyz")
#: Rows of a mounting: forward and left from the accelerometer, up from the gyro.
MOUNTED = ("ax_m_s2", "ay_m_s2", "yaw_rate_rad_s")


@dataclass(frozen=True, slots=True)
class Triad:
    """Three fields of one message, x first, and their common factor to SI."""

    source: SignalSource
    paths: tuple[str, str, str]
    unit: float

    def components(self, names: tuple[str, ...]) -> dict[str, SignalSource]:
        """Return the three fields as separate sources."""
        return {
            n: replace(self.source, name=n, field=p, scale=self.unit, offset=0.0, valid_min=None, valid_max=None)
            for n, p in zip(names, self.paths, strict=True)
        }

    def row(self, source: SignalSource) -> FloatArray:
        """Return the direction [3] of a mapped signal in the triad's axes."""
        scales = source.scale if isinstance(source.scale, tuple) else (source.scale,) * len(source.paths)
        row = np.zeros(3)
        for path, scale in zip(source.paths, scales, strict=True):
            row[self.paths.index(path)] += scale / self.unit
        return row

    def turned(self, source: SignalSource, row: FloatArray) -> SignalSource:
        """Return the source of a signal in a direction [3] of the triad; a single field if the direction is an axis."""
        used = [i for i in range(3) if abs(row[i]) > 1e-9]
        scales = tuple(float(np.round(row[i], 6)) * self.unit for i in used)
        if len(used) == 1:
            return replace(source, field=self.paths[used[0]], scale=scales[0])
        return replace(source, field=tuple(self.paths[i] for i in used), scale=scales)


def find_triads(log: DriveLog, mapping: Mapping) -> tuple[Triad | None, Triad | None]:
    """Return the triads of accelerations and of rates with an axis in the mapping; None for a missing triad."""
    triads = [_triad(log, mapping, names) for names in (("ay_m_s2", "ax_m_s2"), ("yaw_rate_rad_s",))]
    return triads[0], triads[1]


def _triad(log: DriveLog, mapping: Mapping, names: tuple[str, ...]) -> Triad | None:
    sources = [mapping.signals[n] for n in names if n in mapping.signals]
    if not sources or any(s.can_signal is not None for s in sources):
        return None
    first = sources[0]
    fields = log.fields(first.topic)
    for paths in _siblings(first.paths):
        inside = all(s.topic == first.topic and s.stamp == first.stamp and set(s.paths) <= set(paths) for s in sources)
        if inside and all(has_path(fields, p) for p in paths):
            scales = first.scale if isinstance(first.scale, tuple) else (first.scale,)
            unit = float(np.linalg.norm(scales))
            # Rows of a rotation have length 1, so that the length of the scales is the unit.
            return Triad(first, paths, unit)
    return None


def _siblings(paths: tuple[str, ...]) -> Iterator[tuple[str, str, str]]:
    """Yield possible triples of paths that contain a path."""
    path = paths[0]
    if index := re.fullmatch(r"(.*)\[(\d+)\]", path):
        start = int(index[2]) - int(index[2]) % 3
        yield f"{index[1]}[{start}]", f"{index[1]}[{start + 1}]", f"{index[1]}[{start + 2}]"
    leaf = path.rfind(".") + 1
    for word in _RATE_WORDS:
        position = path.lower().find(word, leaf)
        if position >= 0:
            written = [w.capitalize() if path[position].isupper() else w for w in _RATE_WORDS]
            a, b, c = (path[:position] + w + path[position + len(word) :] for w in written)
            yield a, b, c
    for position in range(len(path) - 1, leaf - 1, -1):
        if path[position] in "xyzXYZ":
            axes = "XYZ" if path[position].isupper() else "xyz"
            a, b, c = (path[:position] + axis + path[position + 1 :] for axis in axes)
            yield a, b, c
