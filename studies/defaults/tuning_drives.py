"""Simulated drives on which the fixed baselines are tuned, and what the searches on them share.

A drive is aligned signals as from a log, and the perfect truth. None of their seeds is used for a sample log or for an
evaluation drive. Results are written to ``studies/defaults/results``.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.flat import load_vehicle
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.physics import PhysicsUkf
from pdhef_logtool.estimators.physics_plus import PhysicsPlusUkf
from pdhef_logtool.records.signals import FloatArray, Signals
from studies.pages import ROOT
from truthsim.drive import Drive, simulate_drive, write_drive

FIRST_SEED = 1000
VEHICLE_FILE = "sample_logs/vehicle.toml"
RESULTS = Path(__file__).parent / "results"
CRITERION = "mean over manoeuvres of the Gaussian log-likelihood per scalar innovation"
#: Beyond these a 1-sigma means "not needed" or "the model is of no use": the search is kept inside.
LOWEST, HIGHEST = 1e-4, 10.0

#: Manoeuvre, then speeds in km/h and frictions that are combined; the seed counts on.
PLAN: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "dlc": ((60.0, 80.0, 100.0), (0.3, 0.5, 0.85)),
    "sine-sweep": ((50.0, 70.0, 90.0), (0.3, 0.5, 0.85)),
    "step-steer": ((60.0, 80.0, 100.0), (0.3, 0.5, 0.85)),
    "ramp-steer": ((60.0, 80.0), (0.4, 0.85)),
    "road": ((60.0, 90.0, 110.0), (0.5, 0.85)),
}
ROAD_DURATION_S = 90.0
Q = tuple[float, ...]


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
    with read_drive(path, Car.of(vehicle), options=ReadOptions(friction=None)) as log:
        signals = log.whole().signals
    path.unlink()
    return signals


def tuning_drives() -> list[TuningDrive]:
    """Simulate the drives of ``PLAN``; a drive that spins is left out."""
    nominal = load_vehicle(ROOT / VEHICLE_FILE)
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


def by_manoeuvre(
    drives: list[TuningDrive], build: Callable[[TuningDrive], PhysicsUkf | PhysicsPlusUkf]
) -> dict[str, float]:
    """Return the Gaussian log-likelihood per scalar innovation of every manoeuvre."""
    total: dict[str, tuple[float, int]] = {}
    for drive in drives:
        steps, _ = build(drive).filter_steps(drive.signals, None)
        value, count = total.get(drive.manoeuvre, (0.0, 0))
        value += float(steps.log_likelihood.sum())
        total[drive.manoeuvre] = value, count + int(np.isfinite(steps.innovation).sum())
    return {manoeuvre: value / count for manoeuvre, (value, count) in total.items()}


def search(score: Callable[[Q], float], start: Q, **options: float) -> dict[str, Any]:
    """Run one Nelder-Mead on the logarithms, print and return what it found.

    The values are rounded to two significant digits: the likelihood knows no more.
    """
    low, high = np.log(LOWEST), np.log(HIGHEST)

    def cost(log_q: FloatArray) -> float:
        inside = np.clip(log_q, low, high)
        return -score(tuple(np.exp(inside).tolist())) + float(np.abs(log_q - inside).sum())

    simplex = np.log(start) + np.vstack([np.zeros(len(start)), 0.7 * np.eye(len(start))])
    found = minimize(cost, np.log(start), method="Nelder-Mead", options={"initial_simplex": simplex, **options})
    q_std = [float(f"{v:.2g}") for v in np.exp(found.x)]
    value, evaluations = -float(found.fun), int(found.nfev)
    print(f"{start} -> {q_std}   {value:.5f}   {evaluations}", flush=True)
    return {"start": list(start), "q_std": q_std, "log_likelihood": value, "evaluations": evaluations}


def sideslip_rmse_deg(drive: TuningDrive, estimator: Estimator | None) -> float:
    """Return the sideslip RMSE of a drive in degrees; None stands for no sideslip at all."""
    error = drive.sideslip_rad
    if estimator is not None:
        track, _ = estimator.run(drive.signals, None)
        error = (track.sideslip_rad - drive.sideslip_rad)[track.valid]
    return float(np.rad2deg(np.sqrt(np.nanmean(error**2))))


def write_result(name: str, drives: list[TuningDrive], **found: Any) -> None:
    """Write ``results/NAME.json`` with the drives that it comes from."""
    made = {"made_by": f"python -m studies.defaults.tune_{name}", **found}
    document = {**made, "first_seed": FIRST_SEED, "drives": [d.command for d in drives]}
    path = RESULTS / f"{name}.json"
    path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")
    print(f"wrote {path.relative_to(ROOT)}")
