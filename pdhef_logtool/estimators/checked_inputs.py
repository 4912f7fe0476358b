"""Common inputs of filters with fault handling: checked signals, and the residual computed from them.

The detector checks the window; the parallel filter runs on the accepted samples, and the residual model receives the
filter's prediction in place of a bad sample. Without a model there is no parallel filter and no residual.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.plug_ins import contained, package_of
from pdhef_logtool.estimators.sensor_faults import FaultState, SensorFaults, find_faults
from pdhef_logtool.estimators.vehicle_ukf import FilterState, VehicleUkf
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.steps import step_durations_s
from pdhef_logtool.residual_model.interface import Residual, ResidualModel, checked_residual


@dataclass(frozen=True, slots=True, eq=False)
class InputState:
    """State of the detector, the parallel filter and the residual model between windows; None for a missing part."""

    faults: FaultState | None
    physics: FilterState | None = None
    model: Any = None


@dataclass(frozen=True, slots=True, eq=False)
class CheckedInputs:
    """Result of the detector, and the residual of the steps."""

    faults: SensorFaults
    residual: Residual

    @property
    def rate(self) -> FloatArray:
        """Rates of v_y and r within the model's region of validity, [N, 2], m/s² and rad/s²."""
        return self.residual.gain[:, None] * self.residual.rate


def check_inputs(
    physics: VehicleUkf, model: ResidualModel | None, signals: Signals, state: InputState | None
) -> tuple[CheckedInputs, InputState]:
    """Detect faults in one window, and run parallel filter and residual model on the accepted samples.

    Joined windows give the same bits as one call over the whole log.
    """
    faults, fault_carry = find_faults(signals, physics.vehicle, state.faults if state else None)
    residual, carried = residual_of(physics, model, faults.filtered, state, faults)
    return CheckedInputs(faults, residual), replace(carried, faults=fault_carry)


def residual_of(
    physics: VehicleUkf,
    model: ResidualModel | None,
    signals: Signals,
    state: InputState | None,
    faults: SensorFaults | None = None,
) -> tuple[Residual, InputState]:
    """Return the residual of a window's steps; 0 without a model."""
    if model is None:
        return Residual.zero(len(signals)), InputState(None)
    features, steps, after = run_features(
        physics,
        signals,
        state.physics if state else None,
        seen=None if faults is None else faults.network,
        extra_r=None if faults is None else faults.extra_r,
    )
    dt_s = step_durations_s(signals.stamps_ns, state.physics.last_stamp_ns if state and state.physics else None)
    dt_s[~np.isfinite(steps.prior[:, 0])] = np.nan
    package = package_of(model)
    with contained(f"residual model {type(model).__name__}", package):
        residual, said = model.residual(features, dt_s, state.model if state else None)
        if package:
            residual = checked_residual(residual, len(signals))
    return residual, InputState(None, after, said)


def r_scale(extra_r: FloatArray, r_std: FloatArray) -> FloatArray:
    """Return the larger factor on R of a_y or yaw rate by the detector, [N], for a filter's 1-sigmas [≥2]."""
    factor: FloatArray = 1.0 + (extra_r / np.square(r_std[:2])).max(axis=1, initial=0.0)
    return factor
