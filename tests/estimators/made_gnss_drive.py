"""A simulated drive with the GNSS velocity that a receiver would show."""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.records.signals import FloatArray, Signals
from studies import reference as study
from truthsim.batch import DriveSpec
from truthsim.drive import write_drive

CAR = study.ROOT / "sample_logs" / "vehicle.toml"
#: A receiver's velocity arrives so late.
LATE_S = 0.06


@dataclass(frozen=True)
class GnssDrive:
    """Signals without and with GNSS velocity, and the true velocity [N] at their stamps."""

    signals: Signals
    aided: Signals
    vx_m_s: FloatArray
    vy_m_s: FloatArray


def gnss_drive(spec: DriveSpec) -> GnssDrive:
    """Simulate a drive, read its log with the vehicle file of the car, and add the velocity of a receiver."""
    drive = spec.simulate()
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "drive.mcap"
        write_drive(drive, log)
        with read_drive(log, Car.load(CAR), None, ReadOptions(waived=study.SPIN_CHECKS)) as opened:
            signals = opened.whole().signals
    t = (signals.stamps_ns - drive.start_ns) * 1e-9
    names = ("vx_m_s", "vy_m_s", "yaw_rad", "roll_rate_rad_s")
    motion = study.Motion(signals.stamps_ns, *(np.interp(t, drive.times_s, drive.truth[name]) for name in names))
    stamps_ns, made = study.made_gnss(motion, study.RECEIVERS[study.MADE])
    velocity = np.full((len(t), 2), np.nan)
    velocity[np.minimum(np.searchsorted(signals.stamps_ns, stamps_ns), len(t) - 1)] = made
    late_s = np.where(np.isfinite(velocity[:, 0]), LATE_S, np.nan)
    return GnssDrive(
        signals, replace(signals, gnss_velocity_m_s=velocity, gnss_late_s=late_s), motion.vx_m_s, motion.vy_m_s
    )
