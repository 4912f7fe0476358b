"""Simulated drives on which the fixed baselines are tuned: aligned signals as from a log, and the perfect truth.

None of their seeds is used for a sample log or for an evaluation drive.
"""

from __future__ import annotations

import tempfile
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters, load_vehicle
from pdhef_logtool.drive.alignment import align, plan_alignment
from pdhef_logtool.logs.open_log import open_log
from pdhef_logtool.mapping import auto_map, fit_clocks, read_signals
from pdhef_logtool.records.signals import FloatArray, Signals
from truthsim.drive import Drive, simulate_drive, write_drive

FIRST_SEED = 1000
VEHICLE_FILE = "sample_logs/vehicle.toml"

#: Manoeuvre, then speeds in km/h and frictions that are combined; the seed counts on.
PLAN: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "dlc": ((60.0, 80.0, 100.0), (0.3, 0.5, 0.85)),
    "sine-sweep": ((50.0, 70.0, 90.0), (0.3, 0.5, 0.85)),
    "step-steer": ((60.0, 80.0, 100.0), (0.3, 0.5, 0.85)),
    "ramp-steer": ((60.0, 80.0), (0.4, 0.85)),
    "road": ((60.0, 90.0, 110.0), (0.5, 0.85)),
}
ROAD_DURATION_S = 90.0


@dataclass(frozen=True)
class TuningDrive:
    """One drive: how it was made, what an estimator sees, and the true sideslip at its stamps (rad, NaN if slow)."""

    manoeuvre: str
    command: str
    vehicle: VehicleParameters
    signals: Signals
    sideslip_rad: FloatArray


def signals_of(drive: Drive, vehicle: VehicleParameters, folder: Path) -> Signals:
    """Take a drive the way of every log: written as MCAP, mapped by recognition, aligned."""
    path = folder / f"{drive.manoeuvre}-{drive.seed}.mcap"
    write_drive(drive, path)
    with closing(open_log(path)) as log:
        mapping = auto_map(log).mapping
        clocks = fit_clocks(log, mapping, log.start_ns, log.end_ns)
        channels = read_signals(log, mapping, clocks, log.start_ns, log.end_ns).signals
        plan = plan_alignment(channels, steering_ratio=vehicle.steering_ratio, wheel_radius_m=vehicle.wheel_radius_m)
        signals = align(channels, plan, log.start_ns, log.end_ns)
    path.unlink()
    return signals


def tuning_drives(root: Path) -> list[TuningDrive]:
    """Simulate the drives of ``PLAN``; a drive that spins is left out."""
    nominal = load_vehicle(root / VEHICLE_FILE)
    drives: list[TuningDrive] = []
    seed = FIRST_SEED
    with tempfile.TemporaryDirectory() as folder:
        for manoeuvre, (speeds, frictions) in PLAN.items():
            for speed in speeds:
                for friction in frictions:
                    drive = simulate_drive(
                        manoeuvre,
                        speed_km_h=speed,
                        friction=friction,
                        seed=seed,
                        duration_s=ROAD_DURATION_S if manoeuvre == "road" else None,
                    )
                    seed += 1
                    if drive.spun:
                        print(f"left out, it spun: {drive.command}")
                        continue
                    vehicle = nominal.model_copy(update={"friction": friction})
                    signals = signals_of(drive, vehicle, Path(folder))
                    at = (signals.stamps_ns - drive.start_ns) * 1e-9
                    truth = {
                        k: np.interp(at, drive.times_s, drive.truth[k], left=np.nan, right=np.nan)
                        for k in ("vx_m_s", "vy_m_s")
                    }
                    moving = np.hypot(truth["vx_m_s"], truth["vy_m_s"]) > vehicle.low_speed_blend_m_s
                    sideslip = np.where(moving, np.arctan2(truth["vy_m_s"], truth["vx_m_s"]), np.nan)
                    drives.append(TuningDrive(manoeuvre, drive.command, vehicle, signals, sideslip))
    return drives
