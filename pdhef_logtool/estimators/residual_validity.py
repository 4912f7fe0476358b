"""Residual gain by the consistency of the filter with its residual (docs/method.md#validity).

The car's filter runs with the residual at gain 1. Its force scale s and road bank φ, if the car has these parts, stay
small where the residual belongs to the vehicle; with other stiffness, friction or mass and on banked roads the filter
needs them. With d² = low-pass((s / σ_s)² + (φ / σ_φ)²), the gain is 1 up to :data:`FULL_WITHIN` and 0 from
:data:`NONE_BEYOND` on. Constants were chosen on simulated drives that no table contains.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdhef_logtool.estimators.vehicle_ukf import BANK_STD, FORCE_SCALE_STD, FilterState, VehicleUkf
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.steps import step_durations_s
from pdhef_logtool.residual_model.low_pass import low_pass

#: Consistency d up to which the gain is 1, and from which it is 0; time constant of its low-pass filter, s.
FULL_WITHIN, NONE_BEYOND, TIME_S = 0.4, 0.8, 1.0


@dataclass(frozen=True, slots=True, eq=False)
class ValidityState:
    """State of the filter at gain 1 and of the low pass between windows."""

    filter: FilterState
    memory: FloatArray


def consistent_gain(
    physics: VehicleUkf,
    signals: Signals,
    rate: FloatArray,
    extra_r: FloatArray,
    state: ValidityState | None,
) -> tuple[FloatArray, ValidityState | None]:
    """Return the gain of each step [K] and the state; 1 for a car without a force scale.

    ``rate`` : residual at gain 1, [K, 2]. ``extra_r`` : as of the filter.
    """
    layout, count = physics.layout, len(signals)
    if layout.force_scale < 0:
        return np.ones(count), None
    parts = [(layout.force_scale, FORCE_SCALE_STD), *([(layout.bank, BANK_STD)] if layout.bank >= 0 else [])]
    steps, after = physics.run(signals, None if state is None else state.filter, rate, extra_r)
    squares = np.sum([np.square(steps.x[:, place] / std) for place, std in parts], axis=0)
    dt_s = step_durations_s(signals.stamps_ns, None if state is None else state.filter.last_stamp_ns)
    dt_s[~np.isfinite(steps.prior[:, 0])] = np.nan
    memory = np.zeros(1) if state is None else state.memory.copy()
    slow = np.empty((count, 1))
    low_pass(np.where(steps.valid, squares, np.nan)[:, None], dt_s, 1.0 / (2.0 * np.pi * TIME_S), memory, slow)
    distance = np.sqrt(np.nan_to_num(slow[:, 0], nan=NONE_BEYOND**2))
    gain = np.clip((NONE_BEYOND - distance) / (NONE_BEYOND - FULL_WITHIN), 0.0, 1.0)
    return gain, ValidityState(after, memory)
