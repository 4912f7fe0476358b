"""Drives with a true sideslip, read into memory."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import MAX_BYTES, Drive, WholeDrive, read_drive
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.learning.drives import DriveRecord, no_true_sideslip, record_of
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.records.signals import BoolArray
from pdhef_logtool.records.tracks import StateTrack


def scorable_stamps(truth: StateTrack, low_speed_m_s: float) -> BoolArray:
    """Return a mask [N]: sideslip of the ground truth available, speed above the low-speed limit."""
    finite: BoolArray = np.isfinite(signal_error(truth, truth, "sideslip_rad", low_speed_m_s))
    return finite


def load_drive(
    log_input: LogInput,
    car: Car,
    mapping: SignalMapping | None,
    options: ReadOptions,
    *,
    refuse: Callable[[Drive], str] = lambda _drive: "",
    fill_friction: bool = True,
    least_scored: int = 0,
) -> tuple[DriveRecord, WholeDrive | None]:
    """Read a drive with a true sideslip into memory; None with the reason in the record if it cannot be used.

    Parameters
    ----------
    refuse : returns why a command cannot use the drive, empty if it can; called before all of the log is read.
    least_scored : required number of stamps with a true sideslip above the car's low-speed limit.

    Raises
    ------
    PdhefError
        The log cannot be read, or is too large for the memory.
    """
    with read_drive(log_input, car, mapping, options) as drive:
        left_out = no_true_sideslip(drive.plan) or refuse(drive)
        if left_out:
            return record_of(drive, left_out=left_out), None
        whole = drive.whole(fill_friction=fill_friction, max_bytes=MAX_BYTES)
        assert whole.truth is not None
        slow = car.vehicle.low_speed_blend_m_s
        scored = int(np.count_nonzero(scorable_stamps(whole.truth, slow)))
        if scored < least_scored or not np.isfinite(whole.truth.sideslip_rad).any():
            left_out = f"{scored} stamps with a true sideslip above {slow:g} m/s"
            return record_of(drive, left_out=left_out), None
        return record_of(drive, whole=whole), whole
