"""Scored signals with their labels and units, and the units in which people read and type figures: the one place."""

from __future__ import annotations

import math

from pdhef_logtool.records.geometry import DEGREES

#: Signals compared sample by sample, with their unit.
SCORED_SIGNALS: dict[str, str] = {
    "vx_m_s": "m/s",
    "vy_m_s": "m/s",
    "yaw_rate_rad_s": "rad/s",
    "sideslip_rad": "rad",
    "ay_m_s2": "m/s^2",
}
#: Every signal of metrics.parquet, with its unit. ``state``: all of an estimate.
SIGNALS: dict[str, str] = {**SCORED_SIGNALS, "position_m": "m", "lateral_1s_m": "m", "state": "1"}
#: The definition of a_y of estimates and ground truth; a ground truth without it is not scored.
AY_NOTE = (
    "a_y is the lateral specific force at the CG in the road plane, the axles' forces over the mass: "
    "v̇_y + v_x r + g sin(bank)"
)
#: What people call them, in the order of tables.
LABELS = {
    "sideslip_rad": "sideslip",
    "vy_m_s": "v_y",
    "yaw_rate_rad_s": "yaw rate",
    "vx_m_s": "v_x",
    "ay_m_s2": "a_y",
    "position_m": "position",
    "lateral_1s_m": "1 s lateral",
    "state": "state",
}
#: By unit of metrics.parquet: the unit that people read, and the factor to it.
_READ = {"rad": ("°", DEGREES), "rad/s": ("°/s", DEGREES), "m/s^2": ("m/s²", 1.0), "s": ("ms", 1e3), "1": ("", 1.0)}
#: The same in letters, as people type it.
_TYPED = {"rad": ("deg", DEGREES), "rad/s": ("deg/s", DEGREES), "s": ("ms", 1e3), "1": ("%", 100.0)}


def read_unit(unit: str) -> tuple[str, float]:
    """Return the unit that people read for one of metrics.parquet, and the factor to it."""
    return _READ.get(unit, (unit, 1.0))


def typed_unit(unit: str) -> tuple[str, float]:
    """Return the unit that people type for one of metrics.parquet, and the factor to it."""
    return _TYPED.get(unit, (unit, 1.0))


def share_of(text: str) -> float | None:
    """Return the share that ``5%`` or ``0.05`` represents; None for what is none, or above 10."""
    try:
        share = float(text.strip().removesuffix("%")) / (100.0 if text.strip().endswith("%") else 1.0)
    except ValueError:
        return None
    return share if math.isfinite(share) and 0.0 <= share <= 10.0 else None
