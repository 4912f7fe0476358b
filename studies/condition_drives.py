"""Simulated drives for the studies that choose the shipped settings, read as ``pdhef run`` reads them.

Friction is the only input of an estimator from the ground truth.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive import reading
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import Tell
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.mapping.records import SignalSource
from truthsim.drive import Drive, write_drive

_FRICTION = SignalSource("friction", "/truth/perfect/state", "friction")


def read_drive(path: Path, car: Car) -> reading.WholeDrive:
    """Read a simulated log with its true friction.

    The exact ground truth has the clock of the sensors, so that no latency is estimated: a stuck gyro would bend it.
    """

    def with_true_friction(_log: DriveLog, mapping: Mapping, _tell: Tell) -> Mapping:
        return replace(mapping, signals={**mapping.signals, "friction": _FRICTION})

    with reading.read_drive(path, car, options=ReadOptions(friction=None), adjust=with_true_friction) as drive:
        drive.plan = replace(drive.plan, latency=None)
        return drive.whole()


def as_logged(drive: Drive, car: Car) -> reading.WholeDrive:
    """Return a simulated drive without friction, written as MCAP, mapped by recognition and read."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        write_drive(drive, path)
        with reading.read_drive(path, car, options=ReadOptions(friction=None)) as read:
            return read.whole()
