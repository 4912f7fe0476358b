"""Calibrated confidence intervals: scaling of an estimator's standard deviations, fitted to drives with ground truth.

The calibrated variance of sideslip is a sum of non-negative contributions (docs/method.md#intervals),

    s² = g² Σ (k_i t_i)²,

with the terms t_i of :mod:`pdhef_logtool.estimators.error_features` and a factor g by grip utilization, so that driving
near the limit determines the intervals there only. ``s`` is the 95 % quantile of the error divided by 1.96: ± 1.96 s
covers 95 % for any distribution of the errors. The yaw rate has the same sum with fewer terms. The standard deviation
of v_y keeps its ratio to that of the sideslip, times a factor. Rows and columns of the covariance are scaled alike, so
that correlations do not change. Estimates never change.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pdhef_logtool.car.parts import (
    Algorithm,
    Inflation,
    IntervalEntry,
    Intervals,
    YawRateCoefficients,
)
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack

#: Terms of the sideslip's variance; terms of the yaw rate's, where ``filter`` is its standard deviation.
SIDESLIP_TERMS = ("floor", "filter", "sideslip", "grip", "grip2", "kinematic", "yaw_rate", "cure", "bank")
YAW_RATE_TERMS = ("floor", "filter", "yaw_rate")
#: Grip utilization at which the factors apply; linear between them, constant beyond.
GRIP_PLACES = (0.2, 0.45, 0.7)
#: Largest standard deviation of sideslip.
MAX_SIDESLIP_STD_RAD = 1.0


#: Function of a track and its signals that returns the track with wider intervals.
Widening = Callable[[StateTrack, Signals], StateTrack]
#: Note for intervals that contain the uncertainty of a car's parameters.
POSTERIOR_NOTE = "intervals: own, parameters and sensors"


@dataclass(slots=True)
class TrackCalibrator:
    """Application of calibrated intervals to the tracks of a drive.

    Attributes
    ----------
    algorithms : by name, the algorithm that ran, then those with intervals that apply to it. Intervals are looked up by
        the identity of the algorithm; differences of noise, parameters and network are reported.
    of_car : whether the intervals were calibrated for this car, not for the shipped one.
    fixed_notes : by name, the note for intervals that are not changed.
    posterior : by name, the function that widens intervals if the car has no intervals.
    """

    intervals: Intervals | None
    algorithms: Mapping[str, Sequence[Algorithm]]
    fixed_notes: Mapping[str, str] = field(default_factory=dict)
    posterior: Mapping[str, Widening] = field(default_factory=dict)
    of_car: bool = True
    _has_interval: set[str] = field(default_factory=set)

    def apply(self, track: StateTrack, signals: Signals) -> StateTrack:
        """Return a track [N] with calibrated intervals; unchanged without an entry."""
        if np.isfinite(track.sideslip_std_rad).any():
            self._has_interval.add(track.name)
        matched = self._found(track.name)
        if self.intervals is None or matched is None:
            return self.posterior[track.name](track, signals) if track.name in self.posterior else track
        from pdhef_logtool.estimators.error_features import error_terms  # compiled

        terms = error_terms(track, signals, self.intervals.roll_gradient_rad_per_m_s2)
        return inflated(track, terms, matched[0].inflation)

    def notes(self, name: str) -> tuple[str, ...]:
        """Return the report's notes on an estimator's intervals; empty without intervals."""
        if name not in self._has_interval:
            return ()
        if name in self.fixed_notes:
            return (self.fixed_notes[name],)
        matched = self._found(name)
        if self.intervals is None or matched is None:
            other = self.mismatch(name)
            return (
                POSTERIOR_NOTE if name in self.posterior else "intervals not calibrated",
                *([other] if other else []),
            )
        made = self.intervals
        of = f"with a spread of {100.0 * made.spread:g} %" if made.spread > 0.0 else "as given"
        then, now = matched[0].algorithm, matched[1]
        others = [
            what
            for what, differs in (
                ("physics", then.physics_sha256 not in (None, now.physics_sha256)),
                ("filter noise", then.noise != now.noise),
                ("network", then.network_sha256 not in (None, now.network_sha256)),
                ("sensors (with or without the speed)", then.use_speed != now.use_speed),
            )
            if differs
        ]
        but = f", but with other {' and '.join(others)}" if others else ""
        return (f"intervals calibrated on {made.car} for friction and vehicle {of}{but}",)

    @property
    def warning(self) -> str:
        """Names of the car's intervals that are not applied, with the reason; empty if all are."""
        return "; ".join(filter(None, map(self.mismatch, self.algorithms)))

    def mismatch(self, name: str) -> str:
        """Return why the car's intervals for an estimator are not applied to it; empty if they are."""
        ran = self.algorithms.get(name)
        if self.intervals is None or not self.of_car or not ran or self._found(name) is not None:
            return ""
        made = [e.algorithm.identity for e in self.intervals.entries if e.estimator == name]
        if not made:
            return ""
        return f"the calibrated intervals of {name} are not applied: expected {made[0]}, got {ran[0].identity}"

    def _found(self, name: str) -> tuple[IntervalEntry, Algorithm] | None:
        """Return the entry for a name and the algorithm that it belongs to."""
        entries = {} if self.intervals is None else {e.algorithm.identity: e for e in self.intervals.entries}
        for algorithm in self.algorithms.get(name, ()):
            if algorithm.identity in entries:
                return entries[algorithm.identity], algorithm
        return None


def inflated(track: StateTrack, terms: FloatArray, inflation: Inflation) -> StateTrack:
    """Scale a track's standard deviations and covariance; ``terms`` [N, 9]. NaN stays NaN."""
    from pdhef_logtool.estimators.error_features import grip_share

    sideslip_std = track.sideslip_std_rad
    sideslip = combined(terms, _ordered(inflation.sideslip, SIDESLIP_TERMS))
    sideslip = np.minimum(sideslip * grip_factor(grip_share(terms), inflation.grip_factors), MAX_SIDESLIP_STD_RAD)
    sideslip = np.where(np.isfinite(sideslip_std), sideslip, np.nan)
    covariance = track.covariance
    if covariance.shape[0]:
        rate_std = track.yaw_rate_std_rad_s
        rate = combined(yaw_rate_terms(terms, rate_std), _ordered(inflation.yaw_rate, YAW_RATE_TERMS))
        of_vy = inflation.vy_factor * _ratio(sideslip, sideslip_std)
        covariance = scaled_covariance(covariance, of_vy, _ratio(rate, rate_std))
    return replace(track, sideslip_std_rad=sideslip, covariance=covariance)


def scaled_covariance(covariance: FloatArray, of_vy: FloatArray, of_rate: FloatArray | float = 1.0) -> FloatArray:
    """Return covariances [N, 3, 3] with factors [N] on the 1-sigma of v_y and yaw rate; correlations stay."""
    scale = np.ones(covariance.shape[:2])
    scale[:, 1], scale[:, 2] = of_vy, of_rate
    scaled: FloatArray = covariance * scale[:, :, None]
    scaled *= scale[:, None, :]
    return scaled


def combined(terms: FloatArray, coefficients: tuple[float, ...]) -> FloatArray:
    """Return √ Σ (k_i t_i)² of terms [N, m], [N]."""
    total = np.zeros(terms.shape[0])
    for i, k in enumerate(coefficients):
        total += (k * terms[:, i]) ** 2
    return np.sqrt(total)


def grip_factor(share: FloatArray, factors: Sequence[float]) -> FloatArray:
    """Interpolate the ``factors`` at :data:`GRIP_PLACES` at grip utilizations [N]; return [N]."""
    return np.interp(share, GRIP_PLACES, factors)


def yaw_rate_terms(terms: FloatArray, rate_std: FloatArray) -> FloatArray:
    """Return the yaw rate's terms [N, 3] from the sideslip's terms and the estimator's standard deviation [N]."""
    finite_std = np.where(np.isfinite(rate_std), rate_std, 0.0)
    return np.stack([terms[:, 0], finite_std, terms[:, SIDESLIP_TERMS.index("yaw_rate")]], axis=1)


def _ratio(new: FloatArray, old: FloatArray) -> FloatArray:
    """Return new / old where both are finite and old is positive, else 1."""
    good = np.isfinite(new) & np.isfinite(old) & (old > 0.0)
    return np.where(good, new / np.where(good, old, 1.0), 1.0)


def _ordered(coefficients: YawRateCoefficients, terms: Sequence[str]) -> tuple[float, ...]:
    return tuple(getattr(coefficients, term) for term in terms)
