"""Reported faults of a_y and yaw rate: the bits of a track's ``reason``, and their names.

The bits are written to estimates.parquet and ``pdhef_msgs/VehicleStateEstimate``; their meaning must not change.
"""

from dataclasses import dataclass

# The bits of the yaw rate are the bits of a_y, shifted left by one.
BURST_AY = 1
SPIKE_AY = 4
STUCK_AY, STUCK_YAW_RATE = 16, 32
DEAD_AY, DEAD_YAW_RATE = 64, 128
MISSING_AY, MISSING_YAW_RATE = 256, 512


@dataclass(frozen=True, slots=True)
class Reason:
    """One bit, its identifier, and its text for display."""

    bit: int
    name: str
    text: str


_SENSORS = (("ay", "a_y"), ("yaw_rate", "gyro"))
_FAULTS = {BURST_AY: "noise burst", SPIKE_AY: "spike", STUCK_AY: "stuck", DEAD_AY: "dead", MISSING_AY: "missing"}
#: All reasons in order of their bits.
REASONS = tuple(
    Reason(bit << i, f"{text.removeprefix('noise ')}_{name}", f"{sensor} {text}")
    for bit, text in _FAULTS.items()
    for i, (name, sensor) in enumerate(_SENSORS)
)
