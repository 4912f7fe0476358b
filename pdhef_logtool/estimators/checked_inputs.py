"""Common inputs of filters with fault handling: weighted samples, and the residual computed from them.

The parallel filter runs on the sound samples, and the residual model receives the filter's prediction in place of a
sample in a burst of noise. Without a model there is no parallel filter and no residual.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.plug_ins import contained, package_of
from pdhef_logtool.estimators.vehicle_ukf import FilterState, VehicleUkf
from pdhef_logtool.records.signals import FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import StepColumns
from pdhef_logtool.residual_model.interface import Residual, ResidualModel, checked_residual


@dataclass(frozen=True, slots=True, eq=False)
class InputState:
    """State of the parallel filter and the residual model between windows; None for a missing part."""

    physics: FilterState | None = None
    model: Any = None


@dataclass(frozen=True, slots=True, eq=False)
class CheckedInputs(StepColumns):
    """Faults of a_y and yaw rate as the drive found them, and the residual of the steps.

    Attributes
    ----------
    extra_r : [N, 2], variance in excess of the usual one, m²/s⁴ and rad²/s²; 0 without a fault.
    reason : int64 [N], reported faults, bits of :mod:`pdhef_logtool.records.reasons`.
    rate : [N, 2], of v_y and r within the model's region of validity, m/s² and rad/s².
    gain : [N], 1 inside this region, 0 outside.
    """

    extra_r: FloatArray
    reason: IntArray
    rate: FloatArray
    gain: FloatArray


def without_bursts(signals: Signals) -> Signals:
    """Return the signals for the network's features, without samples of a burst of noise."""
    burst, names = np.nan_to_num(signals.extra_variance) > 0.0, ("ay_m_s2", "yaw_rate_rad_s")
    seen: dict[str, Any] = {n: np.where(burst[:, i], np.nan, getattr(signals, n)) for i, n in enumerate(names)}
    return replace(signals, **seen)


def check_inputs(
    physics: VehicleUkf, model: ResidualModel | None, signals: Signals, state: InputState | None
) -> tuple[CheckedInputs, InputState]:
    """Run parallel filter and residual model on the samples of one window.

    Without a model the residual is 0. Joined windows give the same bits as one call over the whole log.
    """
    extra_r, reason = np.nan_to_num(signals.extra_variance), np.nan_to_num(signals.faults).astype(np.int64)
    residual, after = Residual.zero(len(signals)), InputState()
    if model is not None:
        before, seen = state or InputState(), without_bursts(signals)
        features, dt_s, _, of_filter = run_features(physics, signals, before.physics, seen=seen, extra_r=extra_r)
        package = package_of(model)
        with contained(f"residual model {type(model).__name__}", package):
            residual, of_model = model.residual(features, dt_s, before.model)
            if package:
                residual = checked_residual(residual, len(signals))
        after = InputState(of_filter, of_model)
    return CheckedInputs(extra_r, reason, residual.gain[:, None] * residual.rate, residual.gain), after
