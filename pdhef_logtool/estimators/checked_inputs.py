"""What filters that heed sensor faults start from: checked signals, and the network's residual made of them.

The detector looks at the window, the parallel filter runs on what it leaves, and the network sees that filter's
prediction in place of a bad sample. No noise of the filters that take the result changes it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pdhef_logtool.estimators.hybrid import HybridUkf
from pdhef_logtool.estimators.parallel_physics import parallel_filter, run_features
from pdhef_logtool.estimators.physics import FilterCarry
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.residual_model.service import NetworkCarry
from pdhef_logtool.watches.sensor_faults import FaultCarry, SensorFaults, find_faults


@dataclass(frozen=True, slots=True, eq=False)
class InputCarry:
    """What the detector, the parallel filter and the network take from window to window."""

    faults: FaultCarry
    physics: FilterCarry
    network: NetworkCarry


@dataclass(frozen=True, slots=True, eq=False)
class CheckedInputs:
    """What the detector found, and the network's residual rate [N, 2] in m/s² and rad/s², trust not yet applied."""

    faults: SensorFaults
    rate: FloatArray

    @property
    def nbytes(self) -> int:
        """Memory that this takes beside the signals it was made of."""
        f = self.faults
        arrays = [self.rate, f.extra_r, f.noise_std, f.usual_std, f.reason]
        arrays += [x for s in (f.filtered, f.network) for x in (s.ay_m_s2, s.yaw_rate_rad_s)]
        return sum(a.nbytes for a in arrays)

    def cut(self, first: int, end: int) -> CheckedInputs:
        """Return the steps ``first`` to ``end`` (exclusive)."""
        parts = {f.name: getattr(self.faults, f.name) for f in fields(self.faults)}
        cut: dict[str, Any] = {
            n: x.rows(first, end) if isinstance(x, Signals) else x[first:end] for n, x in parts.items()
        }
        return CheckedInputs(SensorFaults(**cut), self.rate[first:end])


def check_inputs(hybrid: HybridUkf, signals: Signals, carry: InputCarry | None) -> tuple[CheckedInputs, InputCarry]:
    """Look for faults in one window, and run parallel filter and network on what they leave.

    Joined windows give the same bits as one call over the whole log.
    """
    faults, fault_carry = find_faults(signals, hybrid.vehicle, carry.faults if carry else None)
    features, steps, physics = run_features(
        parallel_filter(hybrid.vehicle, use_speed=hybrid.use_speed, slip_gate=hybrid.slip_gate),
        faults.filtered,
        carry.physics if carry else None,
        seen=faults.network,
        extra_r=faults.extra_r,
    )
    starts = ~np.isfinite(steps.prior[:, 0])
    rate, network = hybrid.network.run(features, starts, carry.network if carry else None)
    return CheckedInputs(faults, rate), InputCarry(fault_carry, physics, network)


def r_scale(extra_r: FloatArray, r_std: tuple[float, float]) -> FloatArray:
    """Return the larger factor by which the detector raised R of a_y or yaw rate, [N], at a filter's ``r_std``."""
    factor: FloatArray = 1.0 + (extra_r / np.square(r_std)).max(axis=1, initial=0.0)
    return factor
