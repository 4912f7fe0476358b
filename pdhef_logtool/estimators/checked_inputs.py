"""Common inputs of filters with fault handling: weighted samples, and the residual computed from them.

The parallel filter runs on the sound samples, and the residual model receives the filter's prediction in place of a
sample in a burst of noise. Without a model there is no parallel filter and no residual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.plug_ins import contained, package_of
from pdhef_logtool.estimators.vehicle_ukf import FilterState, VehicleUkf
from pdhef_logtool.records.signals import FloatArray, IntArray, Signals
from pdhef_logtool.residual_model.interface import Residual, ResidualModel, checked_residual


@dataclass(frozen=True, slots=True, eq=False)
class InputState:
    """State of the parallel filter and the residual model between windows; None for a missing part."""

    physics: FilterState | None = None
    model: Any = None


@dataclass(frozen=True, slots=True, eq=False)
class SensorFaults:
    """Faults of a_y and yaw rate at each step, as the drive found them.

    Attributes
    ----------
    extra_r : [N, 2], variance in excess of the usual one, m²/s⁴ and rad²/s²; 0 without a fault.
    reason : int64 [N], reported faults, bits of :mod:`pdhef_logtool.records.reasons`.
    network : signals for the network's features, without samples of a burst.
    """

    extra_r: FloatArray
    reason: IntArray
    network: Signals

    @classmethod
    def of(cls, signals: Signals) -> SensorFaults:
        """Return the faults of the signals [N]."""
        extra, names = np.nan_to_num(signals.extra_variance), ("ay_m_s2", "yaw_rate_rad_s")
        seen: dict[str, Any] = {
            n: np.where(extra[:, i] > 0.0, np.nan, getattr(signals, n)) for i, n in enumerate(names)
        }
        return cls(extra, np.nan_to_num(signals.faults).astype(np.int64), replace(signals, **seen))


@dataclass(frozen=True, slots=True, eq=False)
class CheckedInputs:
    """Faults of the sensors, and the residual of the steps."""

    faults: SensorFaults
    residual: Residual

    @property
    def rate(self) -> FloatArray:
        """Rates of v_y and r within the model's region of validity, [N, 2], m/s² and rad/s²."""
        return self.residual.gain[:, None] * self.residual.rate


def check_inputs(
    physics: VehicleUkf, model: ResidualModel | None, signals: Signals, state: InputState | None
) -> tuple[CheckedInputs, InputState]:
    """Run parallel filter and residual model on the samples of one window.

    Without a model the residual is 0. Joined windows give the same bits as one call over the whole log.
    """
    faults = SensorFaults.of(signals)
    if model is None:
        return CheckedInputs(faults, Residual.zero(len(signals))), InputState()
    before = state.physics if state else None
    features, dt_s, _, after = run_features(physics, signals, before, seen=faults.network, extra_r=faults.extra_r)
    package = package_of(model)
    with contained(f"residual model {type(model).__name__}", package):
        residual, said = model.residual(features, dt_s, state.model if state else None)
        if package:
            residual = checked_residual(residual, len(signals))
    return CheckedInputs(faults, residual), InputState(after, said)


def r_scale(extra_r: FloatArray, r_std: FloatArray) -> FloatArray:
    """Return the larger factor on R of a_y or yaw rate by the detector, [N], for a filter's 1-sigmas [≥2]."""
    factor: FloatArray = 1.0 + (extra_r / np.square(r_std[:2])).max(axis=1, initial=0.0)
    return factor
