"""Checks: whether mapped signals, ground truth and vehicle file agree with physics and with one another.

One file registers each check; report.json, terminal, pages, ``--waive``, JUnit and documentation use this entry. To add
a check, write a file that exports ``CHECKS`` (:class:`~.kind.CheckKind`) and add its name to ``MODULES`` of
:mod:`~.registry`. Example, ``speed_range.py``::

    from collections.abc import Iterator

    import numpy as np

    from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind
    from pdhef_logtool.records.checks import Check

    MOST_M_S = 100.0


    def _check(drive: CheckedDrive) -> Iterator[Check]:
        if drive.speed is None:
            return
        fastest = float(np.nanmax(drive.speed, initial=0.0))
        evidence = f"the fastest speed is {fastest:.1f} m/s"
        yield SPEED_RANGE.judged(fastest <= MOST_M_S, evidence, unit="m/s")


    SPEED_RANGE = CheckKind(
        "speed_m_s.range",
        compares="the fastest speed with the top speed of road cars",
        fails="it is above 100 m/s",
        remedy="check the scale of the speed, which should be in {unit}",
        function=_check,
    )
    CHECKS = (SPEED_RANGE,)
"""

from pdhef_logtool.drive.checks.running import check_drive

__all__ = ["check_drive"]
