"""Common inputs of filters with fault handling: checked signals, and the residual computed from them.

The detector checks the window; the parallel filter runs on the accepted samples, and the residual model receives the
filter's prediction in place of a bad sample. Without a model there is no parallel filter and no residual.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.plug_ins import contained, package_of
from pdhef_logtool.estimators.sensor_faults import FaultState, SensorFaults, find_faults, no_faults
from pdhef_logtool.estimators.vehicle_ukf import FilterState, VehicleUkf
from pdhef_logtool.records.signals import FloatArray, Signals
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
    physics: VehicleUkf, model: ResidualModel | None, signals: Signals, state: InputState | None, *, detects: bool
) -> tuple[CheckedInputs, InputState]:
    """Detect faults in one window, and run parallel filter and residual model on the accepted samples.

    Without the detector (``detects``) all samples are accepted; without a model the residual is 0. Joined windows give
    the same bits as one call over the whole log.
    """
    faults, fault_state = no_faults(signals), None
    if detects:
        faults, fault_state = find_faults(signals, physics.vehicle, state.faults if state else None)
    if model is None:
        return CheckedInputs(faults, Residual.zero(len(signals))), InputState(fault_state)
    before = state.physics if state else None
    features, dt_s, _, after = run_features(
        physics, faults.filtered, before, seen=faults.network, extra_r=faults.extra_r
    )
    package = package_of(model)
    with contained(f"residual model {type(model).__name__}", package):
        residual, said = model.residual(features, dt_s, state.model if state else None)
        if package:
            residual = checked_residual(residual, len(signals))
    return CheckedInputs(faults, residual), InputState(fault_state, after, said)


def r_scale(extra_r: FloatArray, r_std: FloatArray) -> FloatArray:
    """Return the larger factor on R of a_y or yaw rate by the detector, [N], for a filter's 1-sigmas [≥2]."""
    factor: FloatArray = 1.0 + (extra_r / np.square(r_std[:2])).max(axis=1, initial=0.0)
    return factor
