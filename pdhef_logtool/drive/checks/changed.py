"""``SIGNAL.change``: jumps of a sensor's bias, and frozen values, in mid-drive."""

from __future__ import annotations

import math
from collections.abc import Iterable

from pdhef_logtool.drive.checks.kind import CheckKind
from pdhef_logtool.drive.sensor_changes import SensorChange
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import SIGNAL_UNITS

CHANGE_SUFFIX = ".change"


def change_checks(changes: Iterable[SensorChange], start_ns: int) -> list[Check]:
    """Return a failed check for each signal with changes; their times are in s from the log's start."""
    texts: dict[str, list[str]] = {}
    for c in changes:
        start, decided, end = ((t - start_ns) * 1e-9 for t in (c.start_ns, c.known_ns, c.end_ns))
        unit = SIGNAL_UNITS[c.sensor]
        if c.kind == "jump":
            text = (
                f"its bias jumps by {c.size:.3f} +- {c.std:.3f} {unit} at {start:.2f} s, corrected from {decided:.2f} s"
            )
        else:
            instead = (
                "missing" if math.isnan(c.std) else f"replaced by the steering of the yaw rate (+- {c.std:.4f} rad)"
            )
            text = f"it is stuck at {c.size:.4f} {unit} from {start:.2f} to {end:.2f} s, {instead} from {decided:.2f} s"
        texts.setdefault(c.sensor, []).append(text)
    return [CHANGE.failed("; ".join(text), name, waive=name) for name, text in texts.items()]


CHANGE = CheckKind(
    f"SIGNAL{CHANGE_SUFFIX}",
    compares="steering, gyro, accelerometer and speed with one another over the whole drive",
    fails="the bias of one jumps, or its value freezes, in mid-drive; the run corrects it and widens the interval",
    remedy="look at the sensor and its cable; --waive {waive}.change keeps its readings",
)
CHECKS = (CHANGE,)
