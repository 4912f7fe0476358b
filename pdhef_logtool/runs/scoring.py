"""The figures and events of one drive."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.evaluation.manoeuvres import MANOEUVRES, Manoeuvre, find_manoeuvres
from pdhef_logtool.evaluation.metrics import EvaluatedDrive, MetricRow, evaluate_drive
from pdhef_logtool.evaluation.segments import find_intervals, moving_mask, segment_masks
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.records.signals import ALIGNED_SIGNALS, BoolArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.sink import Event
from pdhef_logtool.runs.estimating import Estimated


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The figures of one drive.

    Attributes
    ----------
    drive : the scored tracks and signals. rows, events : figures, and events in order of time.
    silent : why estimators have no valid row although the car moves. moves : whether it does.
    """

    drive: EvaluatedDrive
    rows: list[MetricRow]
    events: list[Event]
    silent: dict[str, str]
    moves: bool


def evaluate(
    drive: Drive, estimated: Estimated, model: DriveModel, dependent: Mapping[str, str] | None = None
) -> Evaluation:
    """Score the tracks of a drive; ``dependent`` : as in :class:`EvaluatedDrive`, by default from the drive's plan."""
    signals, truth, vehicle = estimated.signals, estimated.truth, drive.car.vehicle
    manoeuvres = find_manoeuvres(drive.recorded().signals, vehicle)
    masks = segment_masks(signals, truth, vehicle, manoeuvres)
    moving = moving_mask(signals, truth, vehicle)
    tracks, slow, calibrated = estimated.tracks, vehicle.low_speed_blend_m_s, model.calibrated(signals)
    dependent = drive.plan.dependent if dependent is None else dependent
    scored = EvaluatedDrive(drive.name, tracks, truth, signals, masks, slow, calibrated, dependent)
    events = _events(signals, masks, manoeuvres, [*tracks.values()])
    moves = bool(moving.any())
    silent = {
        name: why_silent(signals, moving)
        for name, track in tracks.items()
        if moves and not (moving & track.valid & track.something_known).any()
    }
    return Evaluation(scored, evaluate_drive(scored), events, silent, moves)


def why_silent(signals: Signals, moving: BoolArray) -> str:
    """Return why an estimator has no valid row where the car moves (``moving`` [N])."""
    read = [name for name in ALIGNED_SIGNALS if name in signals.available]
    if lost := [name for name in read if not np.isfinite(getattr(signals, name)[moving]).any()]:
        return f"no samples of {', '.join(lost)} while it does"
    return "its signals are there, but the estimator marks none as valid"


def _events(
    stamped: Signals | StateTrack,
    masks: Mapping[str, BoolArray],
    manoeuvres: Sequence[Manoeuvre],
    tracks: Sequence[StateTrack],
) -> list[Event]:
    """Return segments, manoeuvres with their peaks, and intervals in which an estimator reports divergence, in order.

    The whole drive and ``linear`` are no events.
    """
    spans = [s for s in find_intervals(stamped, masks) if s.name not in ("all", "linear", *MANOEUVRES)]
    return in_order([*spans, *manoeuvres, *divergences(tracks)])


def divergences(tracks: Iterable[StateTrack]) -> Iterator[Event]:
    """Yield the intervals in which an estimator reports divergence."""
    for track in tracks:
        for s in find_intervals(track, {"diverged": track.diverged}):
            yield Event(f"{track.name} diverged", s.start_ns, s.end_ns, "the estimator reports its own divergence")


def in_order(events: Iterable[Event]) -> list[Event]:
    """Return events in order of time."""
    return sorted(events, key=lambda e: (e.start_ns, e.end_ns, e.name))
