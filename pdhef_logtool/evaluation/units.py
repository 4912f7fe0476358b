"""Scored signals with their labels and units, and the units for display and input."""

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
#: All signals of metrics.parquet, with their units. ``state``: the complete state of an estimate.
SIGNALS: dict[str, str] = {**SCORED_SIGNALS, "position_m": "m", "lateral_1s_m": "m", "state": "1"}
#: Definition of a_y for estimates and ground truth; a ground truth without a_y is not scored.
AY_NOTE = (
    "a_y is the lateral specific force at the CG in the road plane, the axles' forces over the mass: "
    "v̇_y + v_x r + g sin(bank)"
)
#: Names of the signals for display, in the order of tables.
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
#: Unit for display and factor to it, by unit of metrics.parquet.
_READ = {u: (u.replace("rad", "°").replace("*", "·"), DEGREES) for u in ("rad", "rad/s", "rad*s")}
_READ |= {"m/s^2": ("m/s²", 1.0), "s": ("ms", 1e3), "1": ("", 1.0)}


def read_unit(unit: str) -> tuple[str, float]:
    """Return the unit for display and the factor to it, for a unit of metrics.parquet."""
    return _READ.get(unit, (unit, 1.0))


def share_of(text: str) -> float | None:
    """Return the share that ``5%`` or ``0.05`` represents; None for other texts and for values above 10."""
    try:
        share = float(text.strip().removesuffix("%")) / (100.0 if text.strip().endswith("%") else 1.0)
    except ValueError:
        return None
    return share if math.isfinite(share) and 0.0 <= share <= 10.0 else None
