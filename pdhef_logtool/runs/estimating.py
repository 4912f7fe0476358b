"""The one way to estimate: estimators over the windows of a drive, with divergence, intervals and poses."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.reading import Drive, WholeDrive, no_samples
from pdhef_logtool.drive.truth import valid_as_a_whole
from pdhef_logtool.drive.windows import with_look_ahead
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.base import Estimator, look_ahead_of
from pdhef_logtool.estimators.causality_check import CausalityCheck
from pdhef_logtool.estimators.intervals import TrackCalibrator
from pdhef_logtool.estimators.latency_compensation import WindowState, run_window
from pdhef_logtool.estimators.online_calibrated import OnlineBand, OnlineCalibrated
from pdhef_logtool.estimators.presets import preset_of
from pdhef_logtool.estimators.self_calibrated import SELF_CALIBRATED, CalibratedBand
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.records.geometry import DeadReckoner
from pdhef_logtool.records.readings import without_impossible_states
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import REFERENCE, StateTrack
from pdhef_logtool.residual_model.bundle import NOMINAL_MODEL


@dataclass(frozen=True, slots=True, eq=False)
class Estimated:
    """One window with the tracks of all estimators, in their order.

    ``truth`` is what they are scored against, ``drawn_truth`` is what is written: the same with a pose, and valid where
    all of it is known; None if the log has none.
    """

    signals: Signals
    truth: StateTrack | None
    drawn_truth: StateTrack | None
    tracks: tuple[StateTrack, ...]
    share_done: float


def estimate_windows(
    drive: Drive | WholeDrive,
    estimators: Sequence[Estimator],
    *,
    watched: bool = True,
    drawn: bool = True,
    intervals: TrackCalibrator | None = None,
    causality: CausalityCheck | None = None,
) -> Iterator[Estimated]:
    """Run estimators over a drive window by window; joined, the windows give the same bits as one over all.

    Parameters
    ----------
    watched : complete ``diverged`` by the monitor of wrong branches. drawn : dead-reckon poses.
    intervals : calibrates them; None leaves them as the estimators give them.
    causality : collects the estimators that fail, or declare themselves causal and look ahead: they have no further
        tracks. None does not check, and a failure is raised.

    Raises
    ------
    EstimatorError
        The drive contains no stamp.
    """
    from pdhef_logtool.estimators.divergence import DivergenceWatch

    watch = DivergenceWatch(drive.plan.vehicle) if watched else None
    states: dict[str, WindowState] = {}
    poses = {e.name: DeadReckoning() for e in estimators}
    truth_pose = DeadReckoning()
    start: tuple[float, float, float] | None = None
    look_ahead_s = max(map(look_ahead_of, estimators), default=0.0)
    for window, ahead in with_look_ahead(drive.windows(), look_ahead_s):
        signals, truth = window.signals, window.truth
        if start is None:
            start = first_pose(truth)
        drawn_truth = truth
        if drawn and drawn_truth is not None:
            if not drive.plan.has_truth_pose:
                drawn_truth = truth_pose.add(drawn_truth, start)
            drawn_truth = valid_as_a_whole(drawn_truth, drive.plan.derivation, drive.plan.vehicle.standstill_m_s)
        tracks = []
        for estimator in estimators:
            before = states.get(estimator.name)
            try:
                if causality is not None and estimator.name in causality.failed:
                    continue
                track, states[estimator.name] = run_window(estimator, signals, before, ahead, causality)
            except EstimatorError as error:
                if causality is None:
                    raise
                causality.failed[estimator.name] = f"failed: {error}"
                continue
            track = without_impossible_states(track)
            track = track if watch is None else watch.add(track, signals)
            track = track if intervals is None else intervals.add(track, signals)
            track = track.without_sideslip_below(drive.plan.vehicle.standstill_m_s)
            tracks.append(poses[estimator.name].add(track, start) if drawn else track)
        yield Estimated(signals, truth, drawn_truth, tuple(tracks), window.share_done)
    if start is None:
        raise no_samples(drive.path)


def calibrator(car: Car, estimators: Sequence[Estimator]) -> TrackCalibrator:
    """Return what puts the car's intervals on the tracks of estimators, by what they really are.

    What it has none for gets the confidence interval of what its identification left open of its parameters.
    """
    from pdhef_logtool.estimators.posterior_band import posterior_band

    algorithms, fixed_notes, posterior = {}, {}, {}
    band = posterior_band(car, use_speed=all(resolve(e).use_speed for e in estimators))
    of_log, banded = car.self_calibrated, SELF_CALIBRATED | (set() if car.fitted_physics else {NOMINAL_MODEL})
    calibrated = None if of_log is None else CalibratedBand(of_log, car.vehicle)
    online = None if of_log is None else OnlineBand((*of_log.earlier, of_log), car.vehicle)
    for estimator in estimators:
        if note := getattr(estimator, "intervals_note", ""):
            fixed_notes[estimator.name] = note
            if estimator.name == REFERENCE:
                continue
            applies = online if isinstance(estimator, OnlineCalibrated) else calibrated
            if applies is not None:
                posterior[estimator.name] = applies.add
            continue
        other = getattr(estimator, "calibrated_as", None)
        algorithms[estimator.name] = [resolve(e) for e in (estimator, other) if e is not None]
        if band is not None and preset_of(estimator.name) in banded:
            posterior[estimator.name] = band.add
    of_car = car.intervals is not None and car.intervals.physics_sha256 == car.physics_sha256
    return TrackCalibrator(car.intervals, algorithms, fixed_notes, posterior, of_car=of_car)


class DeadReckoning:
    """Dead-reckons one track from window to window, from the true pose at the start where there is one."""

    def __init__(self) -> None:
        self._reckoner: DeadReckoner | None = None

    def add(self, track: StateTrack, start: tuple[float, float, float]) -> StateTrack:
        """Return the next window of the track with its pose; ``start`` is where the first window begins."""
        if len(track) == 0:
            return track
        vx, vy = track.vx_m_s, track.vy_m_s
        if not np.isfinite(vy).any():
            vy = np.where(np.isfinite(vx), 0.0, np.nan)  # no claim on v_y: drawn along the heading
        self._reckoner = self._reckoner or DeadReckoner(start)
        return track.with_pose(*self._reckoner.add(track.stamps_ns, vx, vy, track.yaw_rate_rad_s))


def first_pose(truth: StateTrack | None) -> tuple[float, float, float]:
    """Return the first known pose x, y, yaw of the ground truth; the origin without one."""
    if truth is not None:
        posed = np.flatnonzero(np.isfinite(truth.x_m) & np.isfinite(truth.y_m) & np.isfinite(truth.yaw_rad))
        if posed.size:
            i = int(posed[0])
            return float(truth.x_m[i]), float(truth.y_m[i]), float(truth.yaw_rad[i])
    return 0.0, 0.0, 0.0
