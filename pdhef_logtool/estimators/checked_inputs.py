"""Common inputs of filters with fault handling: checked signals, and the network's residual computed from them.

The detector checks the window; the parallel filter runs on the accepted samples, and the network receives the filter's
prediction in place of a bad sample. Without a network there is no parallel filter and no residual.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.sensor_faults import FaultState, SensorFaults, find_faults
from pdhef_logtool.estimators.vehicle_ukf import FilterState, VehicleUkf
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.residual_model.service import NetworkCarry, NetworkService


@dataclass(frozen=True, slots=True, eq=False)
class InputState:
    """State of the detector, the parallel filter and the network between windows; None for a missing part."""

    faults: FaultState | None
    physics: FilterState | None = None
    network: NetworkCarry | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CheckedInputs:
    """Result of the detector, and the network's residual rate [N, 2] in m/s² and rad/s², at gain 1."""

    faults: SensorFaults
    rate: FloatArray


def check_inputs(
    physics: VehicleUkf, network: NetworkService | None, signals: Signals, state: InputState | None
) -> tuple[CheckedInputs, InputState]:
    """Detect faults in one window, and run parallel filter and network on the accepted samples.

    Joined windows give the same bits as one call over the whole log.
    """
    faults, fault_carry = find_faults(signals, physics.vehicle, state.faults if state else None)
    rate, carried = residual_rate(physics, network, faults.filtered, state, faults)
    return CheckedInputs(faults, rate), InputState(fault_carry, carried.physics, carried.network)


def residual_rate(
    physics: VehicleUkf,
    network: NetworkService | None,
    signals: Signals,
    state: InputState | None,
    faults: SensorFaults | None = None,
) -> tuple[FloatArray, InputState]:
    """Return the network's residual rate [N, 2] in m/s² and rad/s², at gain 1; 0 without a network."""
    if network is None:
        return np.zeros((len(signals), 2)), InputState(None)
    features, steps, after = run_features(
        physics,
        signals,
        state.physics if state else None,
        seen=None if faults is None else faults.network,
        extra_r=None if faults is None else faults.extra_r,
    )
    starts = ~np.isfinite(steps.prior[:, 0])
    rate, said = network.run(features, starts, state.network if state else None)
    return rate, InputState(None, after, said)


def r_scale(extra_r: FloatArray, r_std: FloatArray) -> FloatArray:
    """Return the larger factor on R of a_y or yaw rate by the detector, [N], for a filter's 1-sigmas [≥2]."""
    factor: FloatArray = 1.0 + (extra_r / np.square(r_std[:2])).max(axis=1, initial=0.0)
    return factor
