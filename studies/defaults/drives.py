"""Drives with a true sideslip, read into memory."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.drive.reading import WholeDrive, read_drive
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.learning.drives import DriveRecord, DriveSet, no_true_sideslip, record_of
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.records.signals import BoolArray
from pdhef_logtool.records.tracks import StateTrack

#: Seed of the random draws on validation drives.
SEED = 0


def scorable_stamps(truth: StateTrack, low_speed_m_s: float) -> BoolArray:
    """Return a mask [N]: sideslip of the ground truth available, speed above the low-speed limit."""
    finite: BoolArray = np.isfinite(signal_error(truth, truth, "sideslip_rad", low_speed_m_s))
    return finite


def load_drive(
    log: LogInput,
    task: DriveSet,
    *,
    needs: frozenset[str] = frozenset(),
    least_scored: int = 1,
) -> tuple[DriveRecord, WholeDrive | None]:
    """Read a drive with a true sideslip into memory; None with the reason in the record if it cannot be used.

    ``needs`` : required signals. ``least_scored`` : required number of stamps with a true sideslip above the low-speed
    limit of the car.
    """
    with read_drive(log, task.car, task.mapping, task.settings.config.read_options) as drive:
        missing = ", ".join(sorted(needs - drive.available))
        if left_out := no_true_sideslip(drive.plan) or (f"the log has no {missing}" if missing else ""):
            return record_of(drive, left_out=left_out), None
        whole = drive.whole()
        slow = task.car.vehicle.low_speed_blend_m_s
        assert whole.truth is not None
        scored = int(np.count_nonzero(scorable_stamps(whole.truth, slow)))
        if scored < least_scored:
            return record_of(drive, left_out=f"{scored} stamps with a true sideslip above {slow:g} m/s"), None
        return record_of(drive, whole=whole), whole
