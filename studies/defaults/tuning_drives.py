"""Simulated drives on which the fixed baselines are tuned, and what those who tune on them share.

A drive consists of aligned signals, as from a log, and the exact ground truth. No sample log or evaluation drive has
one of their seeds. Results are written to ``studies/defaults/results``.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.toml_files import load_vehicle
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.records.signals import FloatArray, Signals
from studies.condition_drives import as_logged
from studies.pages import ROOT
from truthsim.drive import simulate_drive

FIRST_SEED = 1000
VEHICLE_FILE = "sample_logs/vehicle.toml"
RESULTS = Path(__file__).parent / "results"

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


def tuning_drives() -> list[TuningDrive]:
    """Simulate the drives of ``PLAN``; a drive that spins is left out."""
    nominal = load_vehicle(ROOT / VEHICLE_FILE)
    plan = [(name, *point) for name, (speeds, frictions) in PLAN.items() for point in product(speeds, frictions)]
    drives: list[TuningDrive] = []
    for seed, (manoeuvre, speed, friction) in enumerate(plan, start=FIRST_SEED):
        duration_s = ROAD_DURATION_S if manoeuvre == "road" else None
        drive = simulate_drive(manoeuvre, speed_km_h=speed, friction=friction, seed=seed, duration_s=duration_s)
        if drive.spun:
            print(f"left out, it spun: {drive.command}")
            continue
        vehicle = nominal.model_copy(update={"friction": friction})
        signals = as_logged(drive, Car.of(vehicle)).signals
        time_s = (signals.stamps_ns - drive.start_ns) * 1e-9
        vx, vy = (
            np.interp(time_s, drive.times_s, drive.truth[k], left=np.nan, right=np.nan) for k in ("vx_m_s", "vy_m_s")
        )
        moving = np.hypot(vx, vy) > vehicle.low_speed_blend_m_s
        sideslip = np.where(moving, np.arctan2(vy, vx), np.nan)
        drives.append(TuningDrive(manoeuvre, drive.command, vehicle, signals, sideslip))
    return drives


def sideslip_rmse_deg(drive: TuningDrive, estimator: Estimator | None) -> float:
    """Return the sideslip RMSE of a drive in degrees; None: no sideslip."""
    error = drive.sideslip_rad
    if estimator is not None:
        track, _ = run_window(estimator, drive.signals)
        error = (track.sideslip_rad - drive.sideslip_rad)[track.valid]
    return float(np.rad2deg(np.sqrt(np.nanmean(error**2))))


def write_result(name: str, drives: list[TuningDrive], **figures: Any) -> None:
    """Write ``results/NAME.json`` with the drives that it comes from."""
    document = {**figures, "first_seed": FIRST_SEED, "drives": [d.command for d in drives]}
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    print(f"wrote {path.relative_to(ROOT)}")
