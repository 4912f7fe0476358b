"""Tune the process noise of the frozen baseline ``phy-ukf`` by innovation likelihood, without any truth.

    python benchmarks/tune_physics_q.py

Maximises the mean over manoeuvres of the log-likelihood per scalar innovation, so that minutes of straight road do
not outvote a lane change. R stays at sensor level (vehicle file). Nelder-Mead on the logarithms of the four 1-sigma
values, from several starts and then anew from the best, for as long as that gains. Writes
benchmarks/results/physics_q.json; the result is entered as PHY_UKF_Q_STD.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from scipy.optimize import minimize
from tuning_drives import FIRST_SEED, VEHICLE_FILE, TuningDrive, tuning_drives

from pdhef_logtool.estimators.physics import PhysicsUkf, innovation_log_likelihood

ROOT = Path(__file__).resolve().parents[2]
RESULT = ROOT / "benchmarks" / "results" / "physics_q.json"
NAMES = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ax_bias_m_s2")
STARTS = ((0.05, 0.1, 0.05, 0.05), (0.2, 0.5, 0.3, 0.02), (0.02, 0.03, 0.02, 0.1))
#: Beyond these a value means "not needed" or "the model is of no use": the search is kept inside.
LOWEST, HIGHEST = 1e-4, 10.0
#: A search from the best so far that gains less than this per innovation is the last one.
WORTHWHILE = 2e-4
Q = tuple[float, float, float, float]


def likelihood_by_manoeuvre(drives: list[TuningDrive], q_std: Q) -> dict[str, float]:
    """Return the log-likelihood per scalar innovation of every manoeuvre."""
    total: dict[str, list[float]] = {}
    for drive in drives:
        value, count = innovation_log_likelihood(PhysicsUkf(drive.vehicle, q_std=q_std), drive.signals)
        sums = total.setdefault(drive.manoeuvre, [0.0, 0.0])
        sums[0] += value
        sums[1] += count
    return {manoeuvre: value / count for manoeuvre, (value, count) in total.items()}


def score(drives: list[TuningDrive], q_std: Q) -> float:
    """Return the mean over the manoeuvres."""
    return float(np.mean(list(likelihood_by_manoeuvre(drives, q_std).values())))


def sideslip_rmse_deg(drives: list[TuningDrive], q_std: Q) -> float:
    """Return the median over drives of the sideslip RMSE, for information only: it decides nothing here."""
    errors = []
    for drive in drives:
        track, _ = PhysicsUkf(drive.vehicle, q_std=q_std).run(drive.signals, None)
        error = (track.sideslip_rad - drive.sideslip_rad)[track.valid]
        errors.append(np.sqrt(np.nanmean(error**2)))
    return float(np.rad2deg(np.median(errors)))


def rounded(q_std: np.ndarray) -> Q:
    """Round to two significant digits: the likelihood knows no more."""
    a, b, c, d = (float(f"{v:.2g}") for v in q_std)
    return a, b, c, d


def search(drives: list[TuningDrive], start: Q) -> tuple[float, Q, int]:
    """Run one Nelder-Mead; returns score, values, number of evaluations."""

    def cost(log_q: np.ndarray) -> float:
        a, b, c, d = np.exp(np.clip(log_q, np.log(LOWEST), np.log(HIGHEST)))
        outside = float(np.sum(np.maximum(0.0, np.abs(log_q - np.clip(log_q, np.log(LOWEST), np.log(HIGHEST))))))
        return -score(drives, (a, b, c, d)) + outside

    simplex = np.log(start) + np.vstack([np.zeros(4), 0.7 * np.eye(4)])
    found = minimize(
        cost,
        np.log(start),
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.02, "fatol": 1e-5, "maxfev": 400},
    )
    return -float(found.fun), rounded(np.exp(found.x)), int(found.nfev)


def main() -> int:
    """Search, print the table, write the result."""
    drives = tuning_drives(ROOT)
    samples = sum(len(d.signals) for d in drives)
    print(f"{len(drives)} drives, {samples} steps\n")
    print("start -> " + ", ".join(NAMES) + "   log-likelihood per innovation   evaluations")
    runs: list[tuple[Q, float, Q, int]] = []

    def run(start: Q) -> float:
        value, q_std, evaluations = search(drives, start)
        runs.append((start, value, q_std, evaluations))
        print(f"{start} -> {q_std}   {value:.5f}   {evaluations}", flush=True)
        return value

    for start in STARTS:
        run(start)
    while True:
        _, value, best, _ = max(runs, key=lambda r: r[1])
        if run(best) < value + WORTHWHILE:
            break
    best = max(runs, key=lambda r: r[1])[2]

    print("\nq_std" + " " * 34 + "mean     " + "  ".join(dict.fromkeys(d.manoeuvre for d in drives)))
    table = {"chosen": best}
    for i, name in enumerate(NAMES):
        for factor in (0.5, 2.0):
            varied = list(best)
            varied[i] *= factor
            table[f"{name} x {factor:g}"] = (varied[0], varied[1], varied[2], varied[3])
    rows = {}
    for label, q_std in table.items():
        by = likelihood_by_manoeuvre(drives, q_std)
        rows[label] = {"q_std": list(q_std), "mean": float(np.mean(list(by.values()))), **by}
        print(f"{label:36s} {rows[label]['mean']:8.4f}  " + "  ".join(f"{v:8.4f}" for v in by.values()))
    rmse = sideslip_rmse_deg(drives, best)
    flagged = sum(bool(PhysicsUkf(d.vehicle, q_std=best).run(d.signals, None)[0].diverged.any()) for d in drives)
    print(f"\nmedian sideslip RMSE of the choice (not used): {rmse:.3f} deg; drives flagged as diverged: {flagged}")

    RESULT.parent.mkdir(exist_ok=True)
    document = {
        "made_by": "python benchmarks/tune_physics_q.py",
        "what": "1-sigma per square root of second of " + ", ".join(NAMES),
        "criterion": "mean over manoeuvres of the Gaussian log-likelihood per scalar innovation",
        "vehicle": VEHICLE_FILE + ", friction of the drive",
        "q_std": list(best),
        "searches": [
            {"start": list(start), "q_std": list(q_std), "log_likelihood": value, "evaluations": evaluations}
            for start, value, q_std, evaluations in runs
        ],
        "neighbourhood": rows,
        "median_sideslip_rmse_deg": rmse,
        "first_seed": FIRST_SEED,
        "drives": [d.command for d in drives],
    }
    RESULT.write_text(json.dumps(document, indent=2) + "\n")
    print(f"wrote {RESULT.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
