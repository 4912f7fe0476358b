"""What the sideslip error of ``physics`` on a drive may come from, in hindsight: one cause at a time, regressed out.

On the blocks of :mod:`~pdhef_logtool.runs.drive_sample` the filter runs again with each parameter of a cause moved a
little. The change of its error by the parameter is the sensitivity, and a regression of the error on the sensitivities
of a cause, held back by what a car's file is usually wrong by, states how far its parameters are off. The filter then
runs with them moved so far, and the RMSE that is left is measured.

The blocks are in two halves. What is left of one is always measured with what the other one states, so that a cause
takes off what is constant over the drive, and chance takes off nothing; a cause can leave more than there was. Causes
overlap: the shares do not add up, and the first one need not be the true one. It reads the ground truth: an estimate of
nothing, and fed to none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pdhef_logtool.car.vehicle import AxleTyre, VehicleParameters
from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.readings import POSSIBLE_FRICTION
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.drive_sample import DriveSample, bare_filter

#: Seconds of scored driving below which nothing is given.
LEAST_S = 10.0
#: Errors stay alike for this long, s.
_ALIKE_S = 1.0
#: Share of its spread by which a parameter is moved for its sensitivity, and most that it is accepted to be off.
_STEP, _MOST_SPREADS = 0.2, 3.0
#: Roll gradient that is left to a car whose model rolls, rad/(m/s²).
_LEAST_ROLL = 0.001
#: Rad: a parameter whose spread moves the sideslip by less RMS is not shown by the drive.
_SHOWN_RAD = math.radians(0.005)


@dataclass(frozen=True, slots=True)
class _Parameter:
    """One thing that may be wrong: its unit, what it is usually wrong by, and the same blocks with it moved."""

    name: str
    unit: str
    spread: float
    moved: Callable[[_Case, float], _Case]
    least: Callable[[_Case], float] = lambda _case: -math.inf

    def by(self, case: _Case, spreads: float) -> float:
        """Return what so many spreads are, as far as the parameter can be moved."""
        return max(spreads * self.spread, self.least(case))


@dataclass(frozen=True, slots=True, eq=False)
class _Case:
    """The filter, what it is given, what it is held against, and the stamps [M] that count; ``ran``: what it stated."""

    physics: AdaptivePhysics
    signals: Signals
    truth: StateTrack
    counts: BoolArray
    low_speed_m_s: float
    ran: StateTrack | None = None

    @property
    def vehicle(self) -> VehicleParameters:
        return self.physics.physics.vehicle

    def error(self) -> FloatArray:
        """Return the sideslip error [M] in rad, NaN where it is not scored."""
        error = signal_error(self.estimate(), self.truth, "sideslip_rad", self.low_speed_m_s)
        return np.where(self.counts, error, np.nan)

    def estimate(self) -> StateTrack:
        """Return what the filter states; it runs where it has not."""
        return run_window(self.physics, self.signals)[0] if self.ran is None else self.ran

    def with_vehicle(self, **changes: Any) -> _Case:
        """Return the case with entries of the filter's vehicle changed; its signals stay."""
        filter_ = self.physics.physics
        vehicle = filter_.vehicle.model_copy(update=changes)
        moved = replace(filter_, vehicle=vehicle)
        return replace(self, physics=replace(self.physics, physics=moved), ran=None)

    def with_signals(self, **columns: Any) -> _Case:
        """Return the case with columns of the signals changed."""
        return replace(self, signals=replace(self.signals, **columns), ran=None)


@dataclass(frozen=True, slots=True)
class MovedParameter:
    """How far a parameter is off by all blocks; ``unit`` 1 is a share of it."""

    name: str
    unit: str
    value: float


@dataclass(frozen=True, slots=True)
class Cause:
    """What one cause takes off: the RMSE that is left, in rad, NaN with the ``reason`` where nothing can be given."""

    name: str
    rmse_left_rad: float
    moved: tuple[MovedParameter, ...]
    reason: str = ""


@dataclass(frozen=True, slots=True)
class ErrorBudget:
    """The causes of one drive, and the RMSE of ``physics`` on the blocks; none of it where there is a ``reason``."""

    reason: str
    seconds: float
    rmse_rad: float
    causes: tuple[Cause, ...]


def no_budget(reason: str) -> ErrorBudget:
    """Return the error decomposition of a drive that has none."""
    return ErrorBudget(reason, 0.0, float("nan"), ())


def _too_short(seconds: float) -> str:
    return f"{seconds:.0f} s of scored driving are too little, {LEAST_S:.0f} s are needed"


def error_budget(estimator: Estimator, sample: DriveSample, low_speed_m_s: float) -> ErrorBudget:
    """Return what may have caused the error of ``physics`` on the blocks of a drive with ground truth.

    Parameters
    ----------
    low_speed_m_s : sideslip is scored above this ground truth speed.
    """
    bare, _ = bare_filter(estimator, sample.signals)
    if not isinstance(bare, AdaptivePhysics) or sample.truth is None:
        return no_budget(f"{estimator.name} is no physics filter on a car's model")
    if np.unique(sample.block[sample.block >= 0] % 2).shape[0] < 2:
        return no_budget(_too_short(sample.seconds))
    halves = []
    for part in (sample.half(0), sample.half(1)):
        assert part.truth is not None
        _, signals = bare_filter(estimator, part.signals)
        case = _Case(bare, signals, part.truth, part.block >= 0, low_speed_m_s)
        case = replace(case, ran=case.estimate())
        halves.append(_Half(case, case.error()))
    scored = sum(h.scored for h in halves)
    seconds = sample.seconds * scored / max(1, int(np.count_nonzero(sample.block >= 0)))
    if seconds < LEAST_S or not all(h.scored for h in halves):
        return no_budget(_too_short(seconds))
    causes = tuple(_cause(name, parameters, halves, seconds) for name, parameters in _CAUSES.items())
    return ErrorBudget("", seconds, _rms(np.concatenate([h.error for h in halves])), causes)


@dataclass(frozen=True, slots=True, eq=False)
class _Half:
    """Every second block, and the error [M] as the filter is."""

    case: _Case
    error: FloatArray

    @property
    def scored(self) -> int:
        return int(np.count_nonzero(np.isfinite(self.error)))

    def sensitivity(self, parameter: _Parameter) -> FloatArray:
        """Return the change of the error [M] by a spread of a parameter."""
        return wrap_angle(parameter.moved(self.case, _STEP * parameter.spread).error() - self.error) / _STEP

    def left(self, parameters: Sequence[_Parameter], off: FloatArray) -> FloatArray:
        """Return the error [M] with parameters moved by so many spreads [k]."""
        case = self.case
        for parameter, spreads in zip(parameters, off, strict=True):
            case = parameter.moved(case, parameter.by(case, float(spreads)))
        return case.error()


def _cause(name: str, parameters: Sequence[_Parameter], halves: Sequence[_Half], seconds: float) -> Cause:
    columns = {p: [h.sensitivity(p) for h in halves] for p in parameters}
    shown = [p for p, of_half in columns.items() if _rms(np.concatenate(of_half)) >= _SHOWN_RAD]
    if not shown:
        return Cause(name, float("nan"), (), "nothing in this drive shows it")
    sensitivity = [np.stack([columns[p][i] for p in shown], axis=1) for i in range(2)]
    errors = [h.error for h in halves]
    rate = seconds / _ALIKE_S / sum(h.scored for h in halves)
    of_first, of_second = (_regressed(e, s, rate) for e, s in zip(errors, sensitivity, strict=True))
    # What one half states is tried on the other.
    left = np.concatenate([halves[0].left(shown, of_second), halves[1].left(shown, of_first)])
    before = np.concatenate(errors)
    both = np.isfinite(left) & np.isfinite(before)
    if not both.any() or _rms(before[both]) == 0.0:
        return Cause(name, float("nan"), (), "the filter loses its estimate with it moved")
    ratio = _rms(left[both]) / _rms(before[both])
    whole = _regressed(before, np.concatenate(sensitivity), rate)
    case = halves[0].case
    moved = tuple(MovedParameter(p.name, p.unit, p.by(case, float(o))) for p, o in zip(shown, whole, strict=True))
    return Cause(name, ratio * _rms(before), moved)


def _regressed(error: FloatArray, sensitivity: FloatArray, rate: float) -> FloatArray:
    """Return how far parameters are off [k], in spreads, by errors [M] and their changes by a spread [M, k].

    ``rate``: samples that count as one error each, for neighbours are alike.
    """
    usable = np.isfinite(error) & np.isfinite(sensitivity).all(axis=1)
    if not usable.any():
        return np.zeros(sensitivity.shape[1])
    error, sensitivity = error[usable], sensitivity[usable]
    weight = rate / max(float(np.mean(error**2)), 1e-12)
    normal = weight * sensitivity.T @ sensitivity + np.eye(sensitivity.shape[1])
    coefficients = np.linalg.solve(normal, -weight * sensitivity.T @ error)
    return np.clip(coefficients, -_MOST_SPREADS, _MOST_SPREADS)


def _rms(values: FloatArray) -> float:
    finite = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else 0.0


def _friction(case: _Case, share: float) -> _Case:
    friction_signal = case.signals.friction
    friction = np.where(np.isfinite(friction_signal), friction_signal, case.vehicle.assumed_friction) * (1.0 + share)
    return case.with_signals(friction=np.clip(friction, *POSSIBLE_FRICTION))


def _stiffer(tyre: AxleTyre, share: float) -> AxleTyre:
    entry = "B" if tyre.B is not None else "cornering_stiffness_n_per_rad"
    return tyre.model_copy(update={entry: getattr(tyre, entry) * max(0.05, 1.0 + share)})


def _tyre(axle: str) -> Callable[[_Case, float], _Case]:
    def moved(case: _Case, share: float) -> _Case:
        tyres = case.vehicle.tyres
        return case.with_vehicle(tyres=tyres.model_copy(update={axle: _stiffer(getattr(tyres, axle), share)}))

    return moved


def _bias(column: str) -> Callable[[_Case, float], _Case]:
    return lambda case, off: case.with_signals(**{column: getattr(case.signals, column) - off})


def _roll(case: _Case, off: float) -> _Case:
    return case.with_vehicle(roll_gradient_rad_per_m_s2=case.vehicle.roll_gradient_rad_per_m_s2 + off)


def _least_roll(case: _Case) -> float:
    """Springs that carry load are divided by the gradient."""
    vehicle = case.vehicle
    return min(0.0, _LEAST_ROLL - vehicle.roll_gradient_rad_per_m_s2) if vehicle.physics.roll else -math.inf


def _late_steering(case: _Case, delay_s: float) -> _Case:
    steer, stamps = case.signals.steer_rad, case.signals.stamps_ns
    is_finite = np.isfinite(steer)
    if not is_finite.any():
        return case
    time_s = (stamps - stamps[0]) * 1e-9
    earlier = np.interp(time_s + delay_s, time_s[is_finite], steer[is_finite])
    return case.with_signals(steer_rad=np.where(is_finite, earlier, np.nan))


def _late_truth(case: _Case, delay_s: float) -> _Case:
    truth = case.truth
    time_s = (truth.stamps_ns - truth.stamps_ns[0]) * 1e-9
    is_finite = np.isfinite(truth.sideslip_rad)
    if not is_finite.any():
        return case
    moved = np.interp(time_s + delay_s, time_s[is_finite], np.unwrap(truth.sideslip_rad[is_finite]))
    return replace(case, truth=replace(truth, sideslip_rad=np.where(is_finite, moved, np.nan)))


#: Spreads: friction that is given or estimated, and the priors' about a vehicle file and a car's sensors.
_CAUSES: dict[str, tuple[_Parameter, ...]] = {
    "friction": (_Parameter("friction", "1", 0.2, _friction),),
    "tyres": (
        _Parameter("front cornering stiffness", "1", 0.25, _tyre("front")),
        _Parameter("rear cornering stiffness", "1", 0.25, _tyre("rear")),
    ),
    "bias": (
        _Parameter("a_y", "m/s^2", 0.1, _bias("ay_m_s2")),
        _Parameter("yaw rate", "rad/s", 0.002, _bias("yaw_rate_rad_s")),
        _Parameter("steering", "rad", math.radians(0.2), _bias("steer_rad")),
    ),
    "roll": (_Parameter("roll gradient", "rad/(m/s^2)", 0.003, _roll, _least_roll),),
    "delay": (
        _Parameter("steering", "s", 0.02, _late_steering),
        _Parameter("truth", "s", 0.02, _late_truth),
    ),
}
