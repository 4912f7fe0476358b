"""Find the default process noise of ``physics-plus`` by innovation likelihood, without any truth.

    python benchmarks/tune_physics_plus_q.py

The same drives, criterion and search as for ``phy-ukf`` (``tune_physics_q.py``); both axles' forces share one value.
Writes benchmarks/results/physics_plus_q.json; the result is entered as PHYSICS_PLUS_Q_STD.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from tune_physics_q import HIGHEST, LOWEST
from tuning_drives import FIRST_SEED, VEHICLE_FILE, TuningDrive, tuning_drives

from pdhef_logtool.estimators.physics import PhysicsUkf
from pdhef_logtool.estimators.physics_plus import PhysicsPlusUkf

ROOT = Path(__file__).resolve().parents[2]
RESULT = ROOT / "benchmarks" / "results" / "physics_plus_q.json"
NAMES = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ax_bias_m_s2", "force_over_mass_m_s2")
STARTS = ((0.1, 0.1, 0.05, 0.02, 2.0), (0.1, 0.3, 0.2, 0.02, 0.5))
MAX_EVALUATIONS = 200


def with_noise(drive: TuningDrive, q: np.ndarray, **options: bool) -> PhysicsPlusUkf:
    """Build the filter of one drive."""
    q_std = (*(float(v) for v in q), float(q[-1]))
    return PhysicsPlusUkf(drive.vehicle, q_std=q_std, **options)


def score(drives: list[TuningDrive], q: np.ndarray, **options: bool) -> float:
    """Return the log-likelihood per scalar innovation, its mean over the manoeuvres."""
    total: dict[str, list[float]] = {}
    for drive in drives:
        steps, _ = with_noise(drive, q, **options).filter_steps(drive.signals, None)
        sums = total.setdefault(drive.manoeuvre, [0.0, 0.0])
        sums[0] += float(steps.log_likelihood.sum())
        sums[1] += float(np.isfinite(steps.innovation).sum())
    return float(np.mean([value / count for value, count in total.values()]))


def search(drives: list[TuningDrive], start: tuple[float, ...]) -> tuple[float, np.ndarray, int]:
    """Run one Nelder-Mead on the logarithms; returns score, values to two digits, number of evaluations."""
    low, high = np.log(LOWEST), np.log(HIGHEST)

    def cost(log_q: np.ndarray) -> float:
        inside = np.clip(log_q, low, high)
        return -score(drives, np.exp(inside)) + float(np.abs(log_q - inside).sum())

    simplex = np.log(start) + np.vstack([np.zeros(len(start)), 0.7 * np.eye(len(start))])
    options = {"initial_simplex": simplex, "xatol": 0.05, "fatol": 1e-4, "maxfev": MAX_EVALUATIONS}
    found = minimize(cost, np.log(start), method="Nelder-Mead", options=options)
    return -float(found.fun), np.array([float(f"{v:.2g}") for v in np.exp(found.x)]), int(found.nfev)


def sideslip_rmse_deg(drives: list[TuningDrive], q: np.ndarray | None, **options: bool) -> float:
    """Return the median over drives of the sideslip RMSE, for information; ``q`` None is ``phy-ukf``."""
    errors = []
    for drive in drives:
        estimator = PhysicsUkf(drive.vehicle) if q is None else with_noise(drive, q, **options)
        track, _ = estimator.run(drive.signals, None)
        error = (track.sideslip_rad - drive.sideslip_rad)[track.valid]
        errors.append(np.sqrt(np.nanmean(error**2)))
    return float(np.rad2deg(np.median(errors)))


def main() -> int:
    """Search, print, write the result."""
    drives = tuning_drives(ROOT)
    print(f"{len(drives)} drives, {sum(len(d.signals) for d in drives)} steps")
    runs = []
    for start in STARTS:
        value, q, evaluations = search(drives, start)
        runs.append({"start": list(start), "q_std": q.tolist(), "log_likelihood": value, "evaluations": evaluations})
        print(f"{start} -> {q.tolist()}   {value:.5f}   {evaluations}", flush=True)
    best = np.array(max(runs, key=lambda r: r["log_likelihood"])["q_std"])
    without = score(drives, best, bias_states=False)
    rmse = {
        "phy-ukf": sideslip_rmse_deg(drives, None),
        "physics-plus": sideslip_rmse_deg(drives, best),
        "physics-plus without bias states": sideslip_rmse_deg(drives, best, bias_states=False),
    }
    print(f"without bias states: {without:.5f}; median sideslip RMSE (not used): {rmse}")
    document = {
        "made_by": "python benchmarks/tune_physics_plus_q.py",
        "what": "1-sigma per square root of second of " + ", ".join(NAMES),
        "criterion": "mean over manoeuvres of the Gaussian log-likelihood per scalar innovation",
        "vehicle": VEHICLE_FILE + ", friction of the drive",
        "q_std": best.tolist(),
        "searches": runs,
        "log_likelihood_without_bias_states": without,
        "median_sideslip_rmse_deg": rmse,
        "first_seed": FIRST_SEED,
        "drives": [d.command for d in drives],
    }
    RESULT.write_text(json.dumps(document, indent=2) + "\n")
    print(f"wrote {RESULT.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
