"""``truth.x_m.scale``, ``truth.y_m.scale``: whether ground-truth positions move as fast as its velocity."""

from __future__ import annotations

import math
from collections.abc import Iterator

from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind
from pdhef_logtool.drive.relations import is_misscaled, position_factors
from pdhef_logtool.records.checks import Check


def _checks(drive: CheckedDrive) -> Iterator[Check]:
    if drive.wrong & {"truth.vx_m_s", "truth.vy_m_s"}:
        return
    for name, factor in zip(drive.measured.positions, position_factors(drive.measured.columns), strict=True):
        evidence = f"the ground-truth velocity is {factor:.3g} times the derivative of its positions along this axis"
        scale = drive.measured.scales.get(name)
        line = f", scale = {scale * factor:.3g}" if isinstance(scale, float | int) else ""
        if not math.isnan(factor):
            yield SCALE.judged(not is_misscaled(factor), evidence, name, factor=factor, line=line)


SCALE = CheckKind(
    "SIGNAL.scale",
    compares="the speed of the ground-truth positions along each axis with the ground-truth velocity",
    fails="they are 1.7 times apart",
    remedy="multiply its scale in the mapping by {factor:.3g}{line}",
    function=_checks,
)
CHECKS = (SCALE,)
