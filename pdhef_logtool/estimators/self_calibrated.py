"""Estimators on the vehicle that their log has calibrated: they see their signals as that vehicle reads them.

What a whole log says of its car is known only at its end: none of them is causal.

Their variance of sideslip is their own, what the parameters leave open, and what the sensors contradict (METHOD §17):

    s² = (k_o s_own)² + (Σ_i (v_y,i − v_y)² + (k_d d2)²) / v_x²,

where v_y,i is that of the physics filter on the vehicle one posterior 1-sigma away in direction i, and d2 is that of
the whole log as far as it goes with the driving. Their own counts less, for the noise of a calibrated car takes in what
the model leaves of a_y; where d2 cannot be told it counts as it is. That of v_y is the same sum as a velocity.
Estimates themselves do not change.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.car.car import WithoutTruth
from pdhef_logtool.car.vehicle import VehicleParameters, corrected_anew
from pdhef_logtool.estimators.base import Estimator, look_ahead_of, notes_of, run_window
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.watches.intervals import MAX_SIDESLIP_STD_RAD

if TYPE_CHECKING:
    from pdhef_logtool.estimators.physics import FilterCarry
    from pdhef_logtool.estimators.physics_ukf import PhysicsFilter

#: Names that run on ``physics``: they take the calibrated vehicle where there is one, the others the file as it stands.
SELF_CALIBRATED = frozenset(
    {
        "physics",
        "pd-hef",
        "pd-hef-fixed-r",
        "pd-hef-smoothed",
        "pd-hef-trust1",
    }
)
#: What runs on the file runs once more on the calibrated vehicle under this name.
OPEN_LOOP = "open-loop-calibrated"
#: k_o and k_d above, chosen on 16 simulated cars with wrong files, whose parameters' posterior held as it is.
OWN_SHARE, D2_SHARE = 0.25, 0.5


@dataclass(frozen=True, slots=True)
class Carry:
    """That of the estimator, and those of the physics filter on the vehicles that the band compares."""

    estimator: Any
    compared: tuple[FilterCarry, ...]


class Compared:
    """The filters that a band compares, run once a window for all estimators of a calibration that share them."""

    def __init__(self) -> None:
        self._asked: tuple[Signals, tuple[FilterCarry, ...] | None, tuple[PhysicsFilter, ...]] | None = None
        self._answer: tuple[list[FloatArray], tuple[FilterCarry, ...]] = ([], ())

    def run(
        self,
        filters: tuple[PhysicsFilter, ...],
        window: Signals,
        signals: Signals,
        carry: tuple[FilterCarry, ...] | None,
    ) -> tuple[list[FloatArray], tuple[FilterCarry, ...]]:
        """Return v_y of each filter [N] and the carries; ``window``, carry and filters tell if it was asked before."""
        asked = self._asked
        if asked is None or asked[0] is not window or asked[1] is not carry or asked[2] != filters:
            runs = [f.run(signals, c) for f, c in zip(filters, carry or [None] * len(filters), strict=True)]
            self._asked = window, carry, filters
            self._answer = [t.vy_m_s for t, _ in runs], tuple(c for _, c in runs)
        return self._answer


@dataclass(frozen=True)
class SelfCalibrated:
    """An estimator on the calibrated vehicle.

    Parameters
    ----------
    estimator : on the calibrated vehicle. calibration : where that comes from.
    read_with : the vehicle that the drive's signals were read with.
    compared : what the band compares, where several estimators of one calibration share it.
    """

    algorithm = "self-calibrated"
    version = 1
    options = ("estimator",)

    estimator: Estimator
    calibration: WithoutTruth
    read_with: VehicleParameters
    causal: bool = False
    compared: Compared | None = field(default=None, compare=False)

    @property
    def name(self) -> str:
        """That of the estimator."""
        return self.estimator.name

    @property
    def notes(self) -> tuple[str, ...]:
        """What the report says of it."""
        return (*notes_of(self.estimator), self.calibration.note)

    @property
    def look_ahead_s(self) -> float:
        """What the estimator must see of what follows a window."""
        return look_ahead_of(self.estimator)

    @property
    def intervals_note(self) -> str:
        """What its intervals are made of: none that was calibrated on driving of another car."""
        parts = ["own", *(["parameters"] if self.calibration.varied else [])]
        parts += ["d2"] if math.isfinite(self.calibration.driven_d2_m_s) else []
        return f"intervals: {', '.join(parts[:-1])} and {parts[-1]}" if len(parts) > 1 else "intervals not calibrated"

    def run(self, signals: Signals, carry: Carry | None, ahead: Signals | None = None) -> tuple[StateTrack, Carry]:
        """Process one window (see :class:`~.base.Estimator`)."""
        window, signals = signals, self._of_friction(signals)
        track, after = run_window(
            self.estimator,
            self._read(signals),
            None if carry is None else carry.estimator,
            None if ahead is None else self.given(ahead),
        )
        if self.name == OPEN_LOOP:  # it gives no interval
            return track, Carry(after, ())
        compared, before = self.compared or Compared(), None if carry is None else carry.compared
        vy, carried = compared.run(self._filters, window, signals, before)
        slow, d2 = self.calibration.vehicle.low_speed_blend_m_s, self.calibration.driven_d2_m_s
        told = math.isfinite(d2)
        seen = np.full(len(track), D2_SHARE * d2 if told else 0.0)
        return widened(track, vy, seen, slow, own_share=OWN_SHARE if told else 1.0), Carry(after, carried)

    @cached_property
    def _filters(self) -> tuple[PhysicsFilter, ...]:
        """The physics filter on the vehicle and on those away from it; none where there are none of those."""
        from pdhef_logtool.estimators.physics_ukf import physics_filter

        found = self.calibration
        vehicles = (found.vehicle, *found.varied) if found.varied else ()
        return tuple(replace(physics_filter(v, found.noise), read_with=self.read_with) for v in vehicles)

    def given(self, signals: Signals) -> Signals:
        """Return what the estimator is given of signals that were read with the other vehicle."""
        return self._read(self._of_friction(signals))

    def _read(self, signals: Signals) -> Signals:
        return corrected_anew(signals, self.read_with, self.calibration.vehicle)

    def _of_friction(self, signals: Signals) -> Signals:
        if self.calibration.told_friction:
            return signals
        return replace(signals, friction=np.full(len(signals), np.nan))


def widened(
    track: StateTrack, compared: Sequence[FloatArray], seen_m_s: FloatArray, slow_m_s: float, *, own_share: float
) -> StateTrack:
    """Return a track [N] with wider 1-sigmas of sideslip and v_y; NaN stays NaN.

    Parameters
    ----------
    compared : v_y of the physics filter [N], first on the vehicle, then on those away from it.
    seen_m_s : what the sensors contradict, as a velocity [N].
    slow_m_s : a velocity tells of sideslip no more below this speed than there.
    own_share : of the track's own 1-sigma that counts.
    """
    added = np.where(np.isfinite(seen_m_s), seen_m_s, 0.0) ** 2
    for vy in compared[1:]:
        away = vy - compared[0]
        added += np.where(np.isfinite(away), away**2, 0.0)
    speed = np.abs(track.vx_m_s)
    added = added / np.maximum(speed, slow_m_s) ** 2
    std = np.minimum(np.sqrt((own_share * track.sideslip_std_rad) ** 2 + added), MAX_SIDESLIP_STD_RAD)
    covariance = track.covariance
    if covariance.shape[0]:
        scale = np.ones((len(track), 3))  # row and column alike, so that correlations stay
        own = covariance[:, 1, 1]
        positive = own > 0.0
        scale[positive, 1] = np.sqrt(own_share**2 + (added * speed**2)[positive] / own[positive])
        covariance = covariance * scale[:, :, None] * scale[:, None, :]
    return replace(track, sideslip_std_rad=std, covariance=covariance)
