"""Reported faults of a_y and yaw rate: the bits of a track's ``reason``, and their names.

The bits are written to estimates.parquet and ``pdhef_msgs/VehicleStateEstimate``; their meaning must not change.
"""

from __future__ import annotations

from dataclasses import dataclass

# The bits of the yaw rate are the bits of a_y, shifted left by one.
BURST_AY, BURST_YAW_RATE = 1, 2
SPIKE_AY, SPIKE_YAW_RATE = 4, 8
STUCK_AY, STUCK_YAW_RATE = 16, 32
DEAD_AY, DEAD_YAW_RATE = 64, 128
MISSING_AY, MISSING_YAW_RATE = 256, 512


@dataclass(frozen=True, slots=True)
class Reason:
    """One bit, its identifier, and its text for display."""

    bit: int
    name: str
    text: str


#: All reasons in order of their bits.
REASONS = (
    Reason(BURST_AY, "burst_ay", "a_y noise burst"),
    Reason(BURST_YAW_RATE, "burst_yaw_rate", "gyro noise burst"),
    Reason(SPIKE_AY, "spike_ay", "a_y spike"),
    Reason(SPIKE_YAW_RATE, "spike_yaw_rate", "gyro spike"),
    Reason(STUCK_AY, "stuck_ay", "a_y stuck"),
    Reason(STUCK_YAW_RATE, "stuck_yaw_rate", "gyro stuck"),
    Reason(DEAD_AY, "dead_ay", "a_y dead"),
    Reason(DEAD_YAW_RATE, "dead_yaw_rate", "gyro dead"),
    Reason(MISSING_AY, "missing_ay", "a_y missing"),
    Reason(MISSING_YAW_RATE, "missing_yaw_rate", "gyro missing"),
)
