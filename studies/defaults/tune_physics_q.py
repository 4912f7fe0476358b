"""Tune the process noise of the frozen baseline ``phy-ukf`` by innovation likelihood, without any truth.

    python -m studies.defaults.tune_physics_q

Maximises the mean over manoeuvres of the log-likelihood per scalar innovation, so that minutes of straight road do
not outvote a lane change. R stays at sensor level (vehicle file). Nelder-Mead on the logarithms of the four 1-sigma
values, from several starts and then anew from the best, for as long as that gains. Writes results/physics_q.json; the
result is entered as PHY_UKF_Q_STD.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pdhef_logtool.estimators.physics import PhysicsUkf
from studies.defaults.tuning_drives import (
    CRITERION,
    VEHICLE_FILE,
    Q,
    TuningDrive,
    by_manoeuvre,
    search,
    sideslip_rmse_deg,
    tuning_drives,
    write_result,
)
from studies.pages import options

NAMES = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ax_bias_m_s2")
STARTS = ((0.05, 0.1, 0.05, 0.05), (0.2, 0.5, 0.3, 0.02), (0.02, 0.03, 0.02, 0.1))
#: A search from the best so far that gains less than this per innovation is the last one.
WORTHWHILE = 2e-4


def with_noise(drive: TuningDrive, q_std: Q) -> PhysicsUkf:
    """Build the filter of one drive."""
    a, b, c, d = q_std
    return PhysicsUkf(drive.vehicle, q_std=(a, b, c, d))


def main() -> None:
    """Search, print the table, write the result; the sideslip RMSE is for information and decides nothing."""
    options("defaults.tune_physics_q", __doc__).parse_args()
    drives = tuning_drives()
    print(f"{len(drives)} drives, {sum(len(d.signals) for d in drives)} steps\n")
    print("start -> " + ", ".join(NAMES) + "   log-likelihood per innovation   evaluations")

    def likelihoods(q_std: Q) -> dict[str, float]:
        return by_manoeuvre(drives, lambda drive: with_noise(drive, q_std))

    def run(start: Q) -> dict[str, Any]:
        return search(
            lambda q: float(np.mean(list(likelihoods(q).values()))), start, xatol=0.02, fatol=1e-5, maxfev=400
        )

    def reached(found: dict[str, Any]) -> float:
        return float(found["log_likelihood"])

    runs = [run(start) for start in STARTS]
    gained = True
    while gained:
        before = max(runs, key=reached)
        runs.append(run(tuple(before["q_std"])))
        gained = reached(runs[-1]) >= reached(before) + WORTHWHILE
    best = max(runs, key=reached)["q_std"]

    print("\nq_std" + " " * 34 + "mean     " + "  ".join(dict.fromkeys(d.manoeuvre for d in drives)))
    table = {"chosen": best}
    for i, name in enumerate(NAMES):
        for factor in (0.5, 2.0):
            table[f"{name} x {factor:g}"] = [factor * v if k == i else v for k, v in enumerate(best)]
    rows = {}
    for label, q_std in table.items():
        by = likelihoods(tuple(q_std))
        mean = float(np.mean(list(by.values())))
        rows[label] = {"q_std": q_std, "mean": mean, **by}
        print(f"{label:36s} {mean:8.4f}  " + "  ".join(f"{v:8.4f}" for v in by.values()))
    filters = [(d, with_noise(d, tuple(best))) for d in drives]
    rmse = float(np.median([sideslip_rmse_deg(d, f) for d, f in filters]))
    flagged = sum(bool(f.run(d.signals, None)[0].diverged.any()) for d, f in filters)
    print(f"\nmedian sideslip RMSE of the choice (not used): {rmse:.3f} deg; drives flagged as diverged: {flagged}")
    write_result(
        "physics_q",
        drives,
        what="1-sigma per square root of second of " + ", ".join(NAMES),
        criterion=CRITERION,
        vehicle=VEHICLE_FILE + ", friction of the drive",
        q_std=best,
        searches=runs,
        neighbourhood=rows,
        median_sideslip_rmse_deg=rmse,
    )


if __name__ == "__main__":
    main()
