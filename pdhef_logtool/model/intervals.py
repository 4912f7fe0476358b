"""95 % confidence intervals of the estimators of a drive (docs/method.md#intervals).

The variance of sideslip has three sources: the estimator's own, the uncertainty of the parameters, and contradictions
between the sensors:

    s² = χ² s_own² + s_car² + (Σ_i (v_y,i − v_y)² + c² + (s_l r)²) / v_x²,

where v_y,i is the lateral velocity of the physics filter on the vehicle one 1-sigma away in direction i of the
posterior, or of the prior without a fit to the log. s_l is the uncertainty of the distance from the rear axle to the
centre of gravity if no file contains it: the lateral velocity is determined at the rear axle. On a vehicle of the
drive's posterior, χ ≥ 1 is the RMS error of the fit over the assumed one (Birge 1932), and s_car is χ times the model
error of a single track, which is nearly constant within a drive; otherwise s_car is the rear slip angle on a crossfall.
On such a vehicle, m² = (χ² − 1) s_own² of a wrong model is replaced by m² B / (m² + B) with the mean square B of the
drive's sideslip: the error of the estimate 0, which needs no model.
c is the lateral kinematic consistency, as far as it correlates with the driving: of the whole drive if the vehicle was
fitted to it, otherwise as available online (:func:`running_consistency`). The variance of v_y is the same sum as a
velocity. Estimates are unchanged.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.posterior import Posterior
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters, corrected_anew
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.adaptive_physics import CURES
from pdhef_logtool.estimators.algorithm import resolve
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.latency_compensation import PIECE_STEPS
from pdhef_logtool.estimators.presets import ON_FILE, preset_of, uses_calibration
from pdhef_logtool.estimators.vehicle_model import VY
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf, of_car, physics_filter
from pdhef_logtool.evaluation.metrics.lateral_consistency import driven_consistency
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals
from pdhef_logtool.model.priors import coefficients, prior_variations
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.reasons import BURST_AY, DEAD_AY, MISSING_AY, SPIKE_AY, STUCK_AY
from pdhef_logtool.records.signals import S_PER_NS, SIGNAL_COLUMNS, FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import RESTART_GAP_S, release
from pdhef_logtool.records.tracks import StateTrack, scaled_covariance

#: Factor of the consistency of a whole drive, and s_car over χ; from seven simulated cars and real drives of four cars.
DRIVE_SHARE, CAR_STD_RAD = 0.7, math.radians(0.15)
#: χ without a posterior of the drive, where the noise of a filter includes the model error of a_y; tuned on 8 simulated
#: cars, each identified on one drive and evaluated on drives of other manoeuvres.
OWN_SHARE = 0.5
#: Standard deviations of the parameters of an identified car over those of a vehicle file: 8 % of the stiffness of an
#: axle, which changes of the load cause. 1-sigma of the crossfall of a road (usually 2 to 2.5 %), whose effect on a_y
#: equals that of a bias.
IDENTIFIED_SHARE, CROSSFALL_STD_RAD = 0.16, 0.02
#: Smallest χ of parameters from earlier drives: later driving may fit less.
EARLIER_ERROR_SCALE = 2.0
#: Longest step of the filters whose differences count: parameters act slowly.
SLOW_STEP_S = 0.04
#: Largest standard deviation of sideslip.
MAX_SIDESLIP_STD_RAD = 1.0
#: Time constants of the running consistency: leak of the integral, slow mean (bias and bank), and mean of squares.
INTEGRAL_S, SLOW_MEAN_S, MEMORY_S = 0.3, 3.0, 1.0
#: Reason bits of a_y; the bits of the yaw rate are shifted left by one.
_AY_BITS = BURST_AY | SPIKE_AY | STUCK_AY | DEAD_AY | MISSING_AY


@dataclass(slots=True)
class Interval:
    """The interval above for estimators of one car over one drive; all tracks share the runs of its filters.

    Attributes
    ----------
    filters : the physics filter on the vehicle, then on the vehicles one 1-sigma away.
    read_with : vehicle that the signals were read with.
    scale : χ. car_std_rad : s_car. cg_std_m : s_l.
    whole_drive : whether c is of the whole drive.
    """

    filters: tuple[VehicleUkf, ...]
    read_with: VehicleParameters
    scale: float = OWN_SHARE
    car_std_rad: float = 0.0
    cg_std_m: float = 0.0
    whole_drive: bool = False
    _signals: Signals | None = None
    _spread: FloatArray = field(default_factory=lambda: np.empty(0))

    def widen(self, track: StateTrack, signals: Signals) -> StateTrack:
        """Return a track [N] with wider 1-sigmas of sideslip and v_y."""
        if not len(signals):
            return track
        if signals is not self._signals:
            slow, number, block = _in_blocks(signals)
            vy, *varied = (self._lateral_velocity(f, slow, number) for f in self.filters)
            self._signals, self._spread = signals, np.append(spread(vy, varied), 0.0)[block]
        vehicle = self.filters[0].vehicle
        slow_m_s = vehicle.low_speed_blend_m_s
        if self.whole_drive:
            calibrated = CalibratedSignals(corrected_anew(signals, self.read_with, vehicle), vehicle)
            added: FloatArray | float = DRIVE_SHARE * driven_consistency(track, calibrated, slow_m_s)
        else:
            added = running_consistency(track, signals, vehicle.roll_gradient_rad_per_m_s2)
        added = np.hypot(np.nan_to_num(added), self.car_std_rad * track.vx_m_s)
        added = np.hypot(added, self.cg_std_m * track.yaw_rate_rad_s)
        return widened(track, np.hypot(np.nan_to_num(added), self._spread), slow_m_s, self._own_share(track, slow_m_s))

    def _own_share(self, track: StateTrack, slow_m_s: float) -> FloatArray | float:
        """Return the factor on a track's own 1-sigma, [N] for a whole drive: χ, bounded as described above."""
        drives = track.valid & (np.abs(track.vx_m_s) > slow_m_s)
        if not self.whole_drive or not drives.any():
            return self.scale
        misfit, variance = self.scale**2 - 1.0, track.sideslip_std_rad**2
        square = float(np.mean((track.sideslip_rad**2 + variance)[drives]))
        return np.asarray(np.sqrt(1.0 + misfit * square / (misfit * variance + square)))

    def _lateral_velocity(self, physics: VehicleUkf, signals: Signals, number: int) -> FloatArray:
        """Return v_y [N] of a filter, on means of ``number`` samples as its vehicle corrects them.

        It is v_y of the newest step that has arrived: over the latency the differences change little. A friction of
        the log is relative.
        """
        physics = replace(physics, r_std=tuple(physics.measurement_std / math.sqrt(number)))
        friction = physics.vehicle.assumed_friction / self.filters[0].vehicle.assumed_friction
        read = corrected_anew(signals, self.read_with, physics.vehicle)
        read, state, vy = replace(read, friction=friction * read.friction), None, np.empty(len(signals))
        for piece in (slice(k, k + PIECE_STEPS) for k in range(0, len(signals), PIECE_STEPS)):
            steps, state = physics.run(read.rows(piece.start, piece.stop).copy(), state)
            vy[piece] = np.where(steps.valid, steps.x[:, VY], np.nan)
        released = release(signals.ready_ns, signals.stamps_ns)
        return np.where(released.arrived, vy[released.step], np.nan)


@dataclass(slots=True)
class DriveIntervals:
    """Intervals of the estimators of a drive by name; ``notes_of_own`` : notes on intervals that estimators provide."""

    by_name: dict[str, Interval]
    notes_of_own: dict[str, str]
    _has_interval: set[str] = field(default_factory=set)

    def apply(self, track: StateTrack, signals: Signals) -> StateTrack:
        """Return a track [N] with its interval; ``signals`` : as read with the vehicle file."""
        if np.isfinite(track.sideslip_std_rad).any():
            self._has_interval.add(track.name)
        interval = self.by_name.get(track.name)
        return track if interval is None else interval.widen(track, signals)

    def notes(self, name: str) -> tuple[str, ...]:
        """Return the report's notes on an estimator's intervals; empty without intervals."""
        if name not in self._has_interval:
            return ()
        summed = "intervals: own, parameters and sensors"
        return (summed if name in self.by_name else self.notes_of_own.get(name, "intervals not calibrated"),)


def drive_intervals(car: Car, estimators: Sequence[Estimator]) -> DriveIntervals:
    """Return the intervals of estimators that are on a car; filters of other models and peers keep their own."""
    notes = {e.name: note for e in estimators if (note := getattr(e, "intervals_note", ""))}
    use_speed = all(resolve(e).use_speed for e in estimators)
    of_file = _of_file(car, 1.0, use_speed=use_speed)
    calibrated = of_file if car.fitted_physics is None else _of_file(car, IDENTIFIED_SHARE, use_speed=use_speed)
    if car.self_calibrated is not None:
        calibrated = _of_drive(car, car.self_calibrated)
    names = [e.name for e in estimators if e.name not in notes]
    by_name = {name: calibrated for name in names if uses_calibration(name)}
    return DriveIntervals(by_name | {name: of_file for name in names if preset_of(name) == ON_FILE}, notes)


def _of_drive(car: Car, posterior: Posterior) -> Interval:
    """Return the interval on the vehicle of the drive's posterior."""
    filters = tuple(physics_filter(v, posterior.noise) for v in (posterior.vehicle, *posterior.varied))
    scale = max(posterior.error_scale, EARLIER_ERROR_SCALE) if posterior.causal else posterior.error_scale
    return Interval(filters, car.vehicle, scale, scale * CAR_STD_RAD, car.cg_std_m, whole_drive=not posterior.causal)


def _of_file(car: Car, share: float, *, use_speed: bool) -> Interval:
    """Return the interval on a vehicle file or an identified vehicle.

    ``share`` : of the standard deviations of a file. The filters lack the states that would compensate an error.
    """
    physics = of_car(car, use_speed=use_speed)
    vehicles = (physics.vehicle, *prior_variations(physics.vehicle, share=share))
    bare = physics.vehicle.physics.model_copy(update=dict.fromkeys(CURES, False))
    filters = tuple(replace(physics, vehicle=v.model_copy(update={"physics": bare})) for v in vehicles)
    return Interval(filters, car.vehicle, car_std_rad=CROSSFALL_STD_RAD / coefficients(physics.vehicle)[1])


def _in_blocks(signals: Signals) -> tuple[Signals, int, IntArray]:
    """Return means over blocks of samples, their number of samples, and by stamp [N] the last complete block, or -1."""
    period_s = float(np.median(np.diff(signals.stamps_ns))) * S_PER_NS if len(signals) > 1 else SLOW_STEP_S
    number = max(1, int(SLOW_STEP_S / period_s))
    count = len(signals) // number

    def blocks(name: str) -> Any:
        column = getattr(signals, name)[: count * number]
        column = column.reshape(count, number, *column.shape[1:])
        if column.dtype.kind != "f":
            return column[:, -1]
        finite = np.isfinite(column)
        total, samples = np.where(finite, column, 0.0).sum(axis=1), finite.sum(axis=1)
        return np.divide(total, samples, out=np.full(total.shape, np.nan), where=samples > 0)

    columns = {name: blocks(name) for name in SIGNAL_COLUMNS}
    return Signals(**columns, available=signals.available), number, (np.arange(len(signals)) + 1) // number - 1


def spread(vy: FloatArray, varied: Sequence[FloatArray]) -> FloatArray:
    """Return the root of the sum of squares of differences from v_y [N]; unknown ones are 0."""
    return np.sqrt(sum((np.nan_to_num(other - vy) ** 2 for other in varied), np.zeros(len(vy))))


def widened(track: StateTrack, added_m_s: FloatArray, slow_m_s: float, own_share: FloatArray | float) -> StateTrack:
    """Return a track [N] with wider 1-sigmas of sideslip and v_y; NaN stays NaN.

    Parameters
    ----------
    added_m_s : further standard deviation of v_y [N].
    slow_m_s : lower limit of the speed in the conversion of velocities to angles.
    own_share : factor on the track's own 1-sigma.
    """
    speed = np.abs(track.vx_m_s)
    added = np.minimum(added_m_s / np.maximum(speed, slow_m_s), MAX_SIDESLIP_STD_RAD)
    std = np.minimum(np.hypot(own_share * track.sideslip_std_rad, added), MAX_SIDESLIP_STD_RAD)
    covariance = track.covariance
    if covariance.shape[0]:
        variance = covariance[:, 1, 1]
        rest = np.full(len(track), 1.0 - own_share**2)
        more = np.divide((added * speed) ** 2, variance, out=rest, where=variance > 0.0)
        covariance = scaled_covariance(covariance, np.sqrt(own_share**2 + more))
    return replace(track, sideslip_std_rad=std, covariance=covariance)


def running_consistency(track: StateTrack, signals: Signals, roll_gradient_rad_per_m_s2: float) -> FloatArray:
    """Return the disagreement of a_y and yaw rate with the changes of an estimated v_y, m/s [N]; 0 before the first.

    It is computed at measurement time; a stamp has the value of the newest sample that has arrived. Samples that the
    estimator reports as faulty are ignored.
    """
    read, none = without_impossible(signals), np.zeros(len(track), dtype=np.int64)
    reason = track.reason if len(track.reason) == len(track) else none
    ay, rate = (
        np.where(np.bitwise_and(reason, bits) == 0, values, np.nan)
        for bits, values in ((_AY_BITS, read.ay_m_s2), (_AY_BITS << 1, read.yaw_rate_rad_s))
    )
    rising = ay / (1.0 + GRAVITY_M_S2 * roll_gradient_rad_per_m_s2) - track.vx_m_s * rate
    running = np.empty(len(track))
    _run(read.steps_s, rising, track.vy_m_s, running)
    released = release(read.ready_ns, read.stamps_ns)
    return np.where(released.arrived, running[released.step], 0.0)


@njit(cache=True)
def _run(dt, rising, vy, out):  # type: ignore[no-untyped-def]
    """Write the RMS over a second of ∫ v̇_y of the sensors minus v_y, both high-passed and without the slow mean."""
    measured = slow = mean = square = 0.0
    started = False
    for k in range(dt.shape[0]):
        step = dt[k]
        if not step <= RESTART_GAP_S:
            measured = mean = square = step = 0.0
            started = False
        if math.isfinite(rising[k]) and math.isfinite(vy[k]):
            if not started:
                slow = vy[k]
                started = True
            gain = 1.0 - math.exp(-step / INTEGRAL_S)
            measured += gain * (rising[k] - measured)
            slow += gain * (vy[k] - slow)
            w = INTEGRAL_S * measured - (vy[k] - slow)
            mean += (1.0 - math.exp(-step / SLOW_MEAN_S)) * (w - mean)
            keep = math.exp(-step / MEMORY_S)
            square = keep * square + (1.0 - keep) * (w - mean) ** 2
        out[k] = math.sqrt(square)
