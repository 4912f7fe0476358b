"""``physics`` plus the trained residual of its car (:mod:`pdhef_logtool.residual_model.ladder`) at the output.

The filter runs without the residual, and its steps provide the features, so that there is no feedback. Each step has
its residual; a scored stamp uses the residual of the newest available step.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics, AdaptiveState, MixtureSteps
from pdhef_logtool.estimators.vehicle_model import FRONT, REAR, VX, VY, YAW_RATE
from pdhef_logtool.estimators.vehicle_ukf import U_STEER, PosteriorSteps
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.reasons import BURST_AY, DEAD_AY, MISSING_AY, SPIKE_AY, STUCK_AY
from pdhef_logtool.records.signals import FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import RESTART_GAP_S, ExtendedSteps, Extrapolation, last_stamp_ns, step_durations_s
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.slow_features import SlowFeatures, slow_features

if TYPE_CHECKING:
    from pdhef_logtool.residual_model.ladder import LadderModel

_BAD_AY = BURST_AY | SPIKE_AY | STUCK_AY | DEAD_AY | MISSING_AY


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedSteps(ExtendedSteps):
    """Steps of ``physics``, and for each step [K] the residual with its 1-sigma, rad, both times the gain; the gain."""

    residual_rad: FloatArray
    std_rad: FloatArray
    gain: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class CorrectedState:
    """State of ``physics``, memory of the features, and the last stamp, between windows."""

    physics: AdaptiveState
    memory: FloatArray
    last_stamp_ns: int | None


def features_of(
    steps: MixtureSteps, signals: Signals, memory: FloatArray | None, before_ns: int | None
) -> tuple[SlowFeatures, FloatArray]:
    """Return the features of a window's steps [K] and the memory for the next window.

    A missing or faulty a_y is replaced by the model's.
    """
    weights = np.where(np.stack([s.valid for s in steps.filters], axis=1), steps.weights, 0.0)
    filters = [np.where(w[:, None] > 0.0, w[:, None] * s.x[:, : REAR + 1], 0.0) for w, s in _pairs(weights, steps)]
    x = np.sum(filters, axis=0)
    measured = without_impossible(signals)
    good = np.isfinite(measured.ay_m_s2) & (np.bitwise_and(steps.reason, _BAD_AY) == 0)
    sideslip = x[:, VY] / np.maximum(x[:, VX], 1.0)  # m/s
    columns = [
        steps.filters[0].inputs[:, U_STEER],
        x[:, YAW_RATE],
        np.where(good, measured.ay_m_s2, x[:, FRONT] + x[:, REAR]),
        sideslip,
        x[:, VX],
        np.where(np.isfinite(measured.ax_m_s2), measured.ax_m_s2, 0.0),
    ]
    inputs = np.stack(columns, axis=1)
    inputs[~steps.valid] = np.nan
    dt_s = step_durations_s(signals.stamps_ns, before_ns)
    return slow_features(inputs, np.where(dt_s <= RESTART_GAP_S, dt_s, np.nan), memory)


def _pairs(weights: FloatArray, steps: MixtureSteps) -> zip[tuple[FloatArray, PosteriorSteps]]:
    return zip(weights.T, steps.filters, strict=True)


@dataclass(frozen=True, slots=True)
class CorrectedPhysics:
    """The estimator of this file.

    Parameters
    ----------
    physics : the filter. model : the residual model. notes : for the report.
    """

    algorithm = "corrected-physics"
    version = 1
    options = ("physics",)

    physics: AdaptivePhysics
    model: LadderModel
    name: str = "pd-hef"
    causal: bool = True
    notes: tuple[str, ...] = ()

    def run(self, signals: Signals, state: CorrectedState | None) -> tuple[CorrectedSteps, CorrectedState]:
        """Process one window (see :class:`~.base.Estimator`)."""
        before_ns = None if state is None else state.last_stamp_ns
        steps, after = self.physics.run(signals, None if state is None else state.physics)
        features, memory = features_of(steps, signals, None if state is None else state.memory, before_ns)
        residual, std, gain = self.model.evaluate(features)
        corrected = CorrectedSteps(steps, gain * residual, gain * std, gain)
        return corrected, CorrectedState(after, memory, last_stamp_ns(signals.stamps_ns, before_ns))

    def predict(self, steps: CorrectedSteps, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Extrapolate the filter's steps and add their residual (see :class:`~.base.ModelPredictor`)."""
        track = self.physics.predict(steps.steps, ahead, stamps_ns)
        residual, std, gain = (c[ahead.step] for c in (steps.residual_rad, steps.std_rad, steps.gain))
        active = track.valid & (gain > 0.0)
        sideslip = np.where(active, track.sideslip_rad + residual, track.sideslip_rad)
        vy = np.where(active, track.vx_m_s * np.tan(sideslip), track.vy_m_s)
        covariance = track.covariance.copy()
        covariance[active, 1, 1] += (track.vx_m_s * std)[active] ** 2
        return replace(
            track,
            name=self.name,
            vy_m_s=vy,
            sideslip_rad=sideslip,
            sideslip_std_rad=np.where(active, np.hypot(track.sideslip_std_rad, std), track.sideslip_std_rad),
            covariance=covariance,
            network_trust=np.where(track.valid, gain, np.nan),
        )
