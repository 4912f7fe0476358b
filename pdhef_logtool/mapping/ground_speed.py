"""Vehicle speed as the length of a velocity over ground (independent of the frame), without a forward speed sensor."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from pdhef_logtool.logs.drive_log import DriveLog, TopicInfo
from pdhef_logtool.mapping.candidates import anchor_of, anchors_of
from pdhef_logtool.mapping.checking import has_path, stamp_path_of
from pdhef_logtool.mapping.evidence import Pieces, fit, ratio
from pdhef_logtool.mapping.fields import CLEAR, Fields
from pdhef_logtool.mapping.naming import is_command, words_of
from pdhef_logtool.mapping.navigation import side_of
from pdhef_logtool.mapping.path import path_speed
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.records.signals import FloatArray

#: Tolerances of its ratio to the speed from positions, and of its derivative's slope over a_x (slopes, pitching).
NEAR_PATH = 0.08
NEAR_A_X = (0.6, 1.6)
SLOW_M_S = 1.0
#: Note on every speed that is a length.
NEVER_NEGATIVE = "the length of a velocity over ground, which is never negative: in reverse it has the wrong sign"


def length_of(velocity: SignalSource) -> SignalSource:
    """Return the speed from a ground-truth velocity: the length of its horizontal part, of all three axes in ECEF."""
    level = len(velocity.paths) if velocity.name == "ecef_velocity_m_s" else 2
    scale = velocity.scale[:level] if isinstance(velocity.scale, tuple) else (velocity.scale,) * level
    return replace(velocity, name="speed_m_s", field=velocity.paths[:level], scale=scale, offset=0.0, combine="norm")


def speed_over_ground(
    log: DriveLog,
    topics: Sequence[tuple[TopicInfo, str]],
    signals: Mapping[str, SignalSource],
    truth: Mapping[str, SignalSource],
) -> tuple[SignalSource, str] | None:
    """Return a velocity with a length that matches positions or a_x, and the evidence.

    Parameters
    ----------
    topics : each with the struct of a velocity's x and y if the type defines it, else "" to search by names.
    signals, truth : the mapping so far.
    """
    vectors = [v for topic, base in topics for v in _vectors(log, topic, base)]
    references = [s for n, s in signals.items() if n == "ax_m_s2"]
    references += [s for n, s in truth.items() if n in ("lat_deg", "lon_deg", "x_m", "y_m")]
    if not vectors or not references:
        return None
    pieces = Pieces(log)
    requests: dict[str, list[str]] = {}
    for source in (*vectors, *references):
        requests.setdefault(source.topic, []).extend(source.paths)
    read = pieces.read(requests)
    anchors = anchors_of(log, references, read)
    fields = Fields(pieces, {}, [], [f for f in anchors if f.meaning.quantity != "acceleration"])
    path = path_speed(fields)
    ax = next((f for s in references if s.name == "ax_m_s2" and (f := anchor_of(s, anchors)) is not None), None)
    for source in vectors:
        x, y = (read.get((source.topic, p)) for p in source.paths)
        if x is None or y is None or not (x.changes and y.changes):
            continue
        speed = np.hypot(x.cells, y.cells)
        evidence = _evidence(pieces, speed, path, None if ax is None else ax.si)
        if evidence:
            return source, evidence
    return None


def _vectors(log: DriveLog, topic: TopicInfo, base: str) -> Iterator[SignalSource]:
    """Yield the x and y, or north and east, of the velocities of a topic."""
    fields = log.fields(topic.name, quiet=True)
    bases, stamp = [base] if base else [], stamp_path_of(fields)
    sides = {side_of(*i.path.rpartition(".")[::2]): i.path for i in fields if i.kind == "number" and not base}
    if {"n", "e"} <= sides.keys():
        yield SignalSource("speed_m_s", topic.name, (sides["n"], sides["e"]), stamp, (1.0, 1.0), combine="norm")
    for info in () if base else fields:
        struct, _, leaf = info.path.rpartition(".")
        said = {*words_of(struct), *words_of(topic.name)}
        if leaf == "x" and said & {"velocity", "vel"} and not said & {"angular", "gyro", "rate"}:
            bases.append(struct)
    for struct in bases:
        paths = (f"{struct}.x", f"{struct}.y") if struct else ("x", "y")
        if all(has_path(fields, p) for p in paths) and not is_command(topic.name, struct):
            yield SignalSource("speed_m_s", topic.name, paths, stamp, (1.0, 1.0), combine="norm")


def _evidence(pieces: Pieces, speed: FloatArray, path: FloatArray | None, ax: FloatArray | None) -> str:
    times = None if path is None else ratio(path, speed, SLOW_M_S)
    if times is not None:
        return f"positions move {times:.3g} times as fast" if abs(times - 1.0) < NEAR_PATH else ""
    relation = None if ax is None else fit(pieces.smooth(ax), pieces.rate_of(speed))
    if relation is None or relation.correlation < CLEAR or not NEAR_A_X[0] < relation.slope < NEAR_A_X[1]:
        return ""
    return f"a_x is {relation.slope:.2f} times its change, with a correlation of {relation.correlation:.2f}"
