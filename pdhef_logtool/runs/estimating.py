"""The one way to estimate: estimators over a drive, with divergence, intervals and poses."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numba
import numpy as np

from pdhef_logtool.car.car import SHOWN_DIGITS, Car
from pdhef_logtool.car.parts import Algorithm
from pdhef_logtool.drive.reading import Drive, WholeDrive
from pdhef_logtool.drive.sensor_changes import SensorChange
from pdhef_logtool.drive.truth import valid_as_a_whole
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.causality_check import CausalityCheck
from pdhef_logtool.estimators.divergence import watched_track
from pdhef_logtool.estimators.drive_signals import DriveSignals
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.plug_ins import package_of
from pdhef_logtool.estimators.table import Options, Skipped, runnable
from pdhef_logtool.evaluation.manoeuvres import MANOEUVRES, find_manoeuvres
from pdhef_logtool.evaluation.metrics import EvaluatedDrive, MetricRow, evaluate_drive
from pdhef_logtool.evaluation.segments import find_intervals, moving_mask, segment_masks
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.model.intervals import DriveIntervals, drive_intervals, spread, widened
from pdhef_logtool.records import processes
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.records.geometry import dead_reckon
from pdhef_logtool.records.processes import release_memory
from pdhef_logtool.records.readings import without_impossible_states
from pdhef_logtool.records.signals import ALIGNED_SIGNALS, BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results.sink import Event
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.referencing import DriveReference, reference_of
from pdhef_logtool.runs.selection import default_names

_MAP_THEM = "map the missing signals (pdhef inspect LOG --write-mapping mapping.toml)"


@dataclass(frozen=True, slots=True, eq=False)
class PreparedDrive:
    """A drive, its model, and the estimators that run on it; ``failed``: reasons of those without a result, by name."""

    drive: Drive
    config: RunConfig
    model: DriveModel
    reference: DriveReference | None
    estimators: Sequence[Estimator]
    skipped: Sequence[Skipped]
    intervals: DriveIntervals
    failed: Mapping[str, str]

    @property
    def names(self) -> list[str]:
        """Names of the estimators."""
        return [e.name for e in self.estimators]

    @property
    def car(self) -> Car:
        """The car of the model."""
        return self.model.car


def prepare(drive: Drive, config: RunConfig) -> PreparedDrive:
    """Fit the model of the drive, make the reference, choose the estimators.

    Raises EstimatorError if no requested estimator can run.
    """
    model = DriveModel.fit(drive)
    car = model.car
    estimators, skipped = choose(drive, config.estimators, car, gnss=config.gnss == "auto")
    if not estimators:
        raise EstimatorError(
            expected="at least one estimator that can run",
            got="; ".join(f"{s.name}: {s.reason}" for s in skipped),
            where=str(drive.path),
            remedy=next((f"{reason} (or --waive it)" for reason in drive.plan.refused.values()), _MAP_THEM),
        )
    reference = reference_of(drive, model, config)
    if reference is not None and reference.estimator is not None:
        estimators = [*estimators, reference.estimator]
    intervals, failed = drive_intervals(car, estimators), {s.name: s.reason for s in skipped if s.is_error}
    return PreparedDrive(drive, config, model, reference, estimators, skipped, intervals, failed)


def choose(
    drive: Drive, names: Sequence[str] | None = None, car: Car | None = None, *, gnss: bool = True
) -> tuple[list[Estimator], list[Skipped]]:
    """Return the estimators that can run on a drive and a car, and the skipped ones with the reasons.

    Parameters
    ----------
    names : of estimators, ``["all"]`` or ``["peers"]``; None: those that a run chooses. car : by default the drive's.
    gnss : whether filters may use GNSS velocity.
    """
    car = drive.car if car is None else car
    names = default_names(car, drive.available) if names is None else names
    options = Options(drive.options.use_speed, gnss=gnss)
    return runnable(names, car, drive.available, options, drive.plan.refused)


@dataclass(frozen=True, slots=True, eq=False)
class Estimated:
    """A drive with the tracks of all estimators by name, in order, and the algorithms of those that ran."""

    drive: WholeDrive
    tracks: dict[str, StateTrack]
    algorithms: Mapping[str, Algorithm] = field(default_factory=dict)

    @property
    def signals(self) -> Signals:
        """The signals of the drive."""
        return self.drive.signals

    @property
    def truth(self) -> StateTrack | None:
        """The ground truth for scores."""
        return self.drive.truth

    @property
    def drawn(self) -> list[StateTrack]:
        """The tracks for outputs, with poses: ground truth, valid where it is complete, then the estimators."""
        plan, drawn = self.drive.plan, [self.posed(track) for track in self.tracks.values()]
        if self.truth is not None:
            truth = self.truth if plan.has_truth_pose else self.posed(self.truth)
            drawn.insert(0, valid_as_a_whole(truth, plan.derivation, plan.vehicle.standstill_m_s))
        return drawn

    def posed(self, track: StateTrack) -> StateTrack:
        """Return a track with its pose, dead-reckoned from the first pose of the ground truth."""
        vx, vy = track.vx_m_s, track.vy_m_s
        if not np.isfinite(vy).any():
            vy = np.where(np.isfinite(vx), 0.0, np.nan)  # no claim on v_y: drawn along the heading
        x, y, yaw = dead_reckon(track.stamps_ns, vx, vy, track.yaw_rate_rad_s, _first_pose(self.truth))
        return replace(track, x_m=x, y_m=y, yaw_rad=yaw)


def estimate_drive(
    drive: WholeDrive,
    corrected: DriveSignals,
    estimators: Sequence[Estimator],
    *,
    intervals: DriveIntervals | None = None,
    causality: CausalityCheck | None = None,
    progress: Callable[[float], None] = lambda _share: None,
) -> Estimated:
    """Run estimators over a drive, side by side in threads: compiled filters let other threads run.

    A worker process uses one thread, the command itself ``NUMBA_NUM_THREADS``, by default all cores.

    Parameters
    ----------
    corrected : signals of the drive, corrected for the two vehicles of its car.
    intervals : None leaves them as the estimators give them.
    causality : collects the estimators that fail, or declare themselves causal and look ahead: they have no track.
        None does not check, and a failure is raised.
    progress : called with the share of the estimators that is done.
    """
    signals, vehicle = drive.signals, drive.plan.vehicle
    tracks: list[StateTrack] = []

    def run(estimator: Estimator) -> tuple[StateTrack, list[FloatArray]]:
        given = corrected.of_estimator(estimator.name)
        track = run_estimator(estimator, given, causality)
        release_memory(len(track))
        return track, _varied(estimator, given, drive.changes)

    algorithms = {e.name: resolve(e) for e in estimators}
    # Estimators that compute the same have the same key: without a network ``pd-hef`` is ``physics``.
    keys = (e.name if package_of(e) else algorithms[e.name].sha256 for e in estimators)
    computations = [(key, id(corrected.of_estimator(e.name))) for key, e in zip(keys, estimators, strict=True)]
    first: dict[tuple[str, int], Estimator] = {}
    for estimator, computation in zip(estimators, computations, strict=True):
        first.setdefault(computation, estimator)
    processes.share_memory()
    pool = ThreadPoolExecutor(1 if processes.worker_number else numba.config.NUMBA_NUM_THREADS)
    try:
        running = {computation: pool.submit(run, estimator) for computation, estimator in first.items()}
        for number, (estimator, computation) in enumerate(zip(estimators, computations, strict=True)):
            progress(number / len(estimators))
            computed = running.pop(computation)
            if computation in computations[number + 1 :]:
                running[computation] = computed
            try:
                track, varied = computed.result()
            except EstimatorError as error:
                if causality is None:
                    raise
                causality.failed[estimator.name] = f"failed: {error}"
                continue
            if causality is not None and (reason := causality.failed.get(first[computation].name)):
                causality.failed[estimator.name] = reason
                continue
            track = without_impossible_states(replace(track, name=estimator.name))
            track = watched_track(track, signals, vehicle, corrected.noise)
            track = track if intervals is None else intervals.apply(track, signals)
            if varied:
                track = widened(track, spread(track.vy_m_s, varied), vehicle.low_speed_blend_m_s, 1.0)
            tracks.append(track.without_sideslip_below(vehicle.standstill_m_s))
            release_memory(len(track))
    finally:
        pool.shutdown(cancel_futures=True)
    return Estimated(drive, {t.name: t for t in tracks}, {t.name: algorithms[t.name] for t in tracks})


def _varied(estimator: Estimator, given: Signals, changes: Sequence[SensorChange]) -> list[FloatArray]:
    """Return v_y [N] of an estimator for each corrected sensor, with the correction changed by its 1-sigma."""
    varied = (c for c in changes if math.isfinite(c.std))
    away = (c.removed(given, c.known_ns, -c.std) for c in varied)
    return [run_estimator(estimator, signals).vy_m_s for signals in away]


def _first_pose(truth: StateTrack | None) -> tuple[float, float, float]:
    """Return the first known pose x, y, yaw of the ground truth; the origin without one."""
    if truth is not None:
        posed = np.flatnonzero(np.isfinite(truth.x_m) & np.isfinite(truth.y_m) & np.isfinite(truth.yaw_rad))
        if posed.size:
            i = int(posed[0])
            return float(truth.x_m[i]), float(truth.y_m[i]), float(truth.yaw_rad[i])
    return 0.0, 0.0, 0.0


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
    digests = {name: algorithm.sha256[:SHOWN_DIGITS] for name, algorithm in estimated.algorithms.items()}
    scored = EvaluatedDrive(drive.name, tracks, truth, signals, masks, slow, calibrated, dependent, digests)
    # The whole drive and ``linear`` are no events.
    spans = (s for s in find_intervals(signals, masks) if s.name not in ("all", "linear", *MANOEUVRES))
    events = in_order([*spans, *manoeuvres, *divergences(tracks.values())])
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


def divergences(tracks: Iterable[StateTrack]) -> Iterator[Event]:
    """Yield the intervals in which an estimator reports divergence."""
    for track in tracks:
        for s in find_intervals(track, {"diverged": track.diverged}):
            yield Event(f"{track.name} diverged", s.start_ns, s.end_ns, "the estimator reports its own divergence")


def in_order(events: Iterable[Event]) -> list[Event]:
    """Return events in order of time."""
    return sorted(events, key=lambda e: (e.start_ns, e.end_ns, e.name))
