"""``SIGNAL.magnitude``: values that no vehicle reaches; needs no second signal, and applies to model cars too."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind
from pdhef_logtool.drive.hypotheses import FOREIGN, is_odd, units_of
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import WHEELS

#: Values that no road car, race car or model car exceeds for more than a second: model cars spin at 5 rad/s and corner
#: at 15 m/s²; a body that keeps rolling at 4 rad/s overturns; a wheel of 5 cm radius turns with 600 rad/s at 30 m/s;
#: trucks have five turns of the steering wheel.
MOST = {
    "ax_m_s2": 30.0,
    "ay_m_s2": 30.0,
    "yaw_rate_rad_s": 10.0,
    **dict.fromkeys(("roll_rate_rad_s", "pitch_rate_rad_s"), 4.0),
    "steer_rad": 1.3,
    "steering_wheel_rad": 20.0,
    "speed_m_s": 120.0,
    **{f"wheel_speed_{w}_m_s": 150.0 for w in WHEELS},
    **{f"wheel_speed_{w}_rad_s": 700.0 for w in WHEELS},
    "truth.vx_m_s": 120.0,
    "truth.vy_m_s": 40.0,
    "truth.ay_m_s2": 30.0,
    "truth.yaw_rate_rad_s": 10.0,
    "truth.sideslip_rad": float(np.pi),
}
#: Least share of the low-passed values below the limit: shocks and spins are short.
SHARE = 0.95
#: The same for a wheel, which spins in the air.
WHEEL_SHARE = 0.5


def _checks(drive: CheckedDrive) -> Iterator[Check]:
    columns = drive.measured.columns
    for name, most in MOST.items():
        column = columns.get(name)
        finite = np.abs(column[np.isfinite(column)]) if column is not None else np.empty(0)
        if not finite.size or name in drive.wrong:  # a relation that fails has a better remedy
            continue
        share = WHEEL_SHARE if name.startswith("wheel") else SHARE
        large = float(np.quantile(finite, share))
        evidence = f"{1.0 - share:.0%} of its low-passed values are above {large:.3g}, vehicles reach {most:.3g}"
        if large > most:
            yield MAGNITUDE.failed(evidence, name, remedy=_remedy(drive, name, large, most))


def _remedy(drive: CheckedDrive, name: str, large: float, most: float) -> str:
    scale = drive.measured.scales.get(name, 1.0)
    number = scale if isinstance(scale, float | int) else 1.0
    units = units_of(name.removeprefix("truth."))
    units += [(1.0 / f, f"is off by a factor of {f:.4g}") for f in FOREIGN if not is_odd(name, number / f)]
    units = [(f, words) for f, words in units if large * f < 0.5 * most]
    counts = "these may be raw counts of a converter: multiply by its resolution"
    if not units:
        return f"the field is no {name.removeprefix('truth.')} in SI units; {counts}"
    factor, words = max(units, key=lambda unit: (not is_odd(name, number * unit[0]), unit[0]))
    line = f"scale = {scale * factor:.6g}" if isinstance(scale, float | int) else f"{factor:.6g} times its scale"
    return f"perhaps it {words}: {line} in the mapping; or {counts}"


MAGNITUDE = CheckKind(
    "SIGNAL.magnitude",
    compares="the low-passed values of the signal with the limits of all vehicles, including model cars",
    fails="5 % of them are above (yaw rate 10 rad/s, accelerations 30 m/s², speed 120 m/s, road-wheel angle 1.3 rad)",
    remedy="{remedy}",
    function=_checks,
)
CHECKS = (MAGNITUDE,)
