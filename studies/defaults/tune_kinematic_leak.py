"""Tune the leak of the ``kinematic`` baseline by sideslip RMSE against the exact ground truth of simulated drives.

    python -m studies.defaults.tune_kinematic_leak

A baseline should be as good as it can be made. Criterion: the mean over manoeuvres of the median sideslip RMSE of
its drives. Writes results/kinematic_leak.json; the result is entered as LEAK_S.
"""

from __future__ import annotations

import numpy as np

from pdhef_logtool.estimators.kinematic import Kinematic
from studies.defaults.tuning_drives import TuningDrive, sideslip_rmse_deg, tuning_drives, write_result
from studies.pages import options

GRID_S = (0.2, 0.3, 0.4, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 14.0, 20.0)


def rmse_by_manoeuvre(drives: list[TuningDrive], leak_s: float | None) -> dict[str, float]:
    """Return the median RMSE of every manoeuvre in degrees; None: no sideslip."""
    estimator = None if leak_s is None else Kinematic(leak_s=leak_s)
    values: dict[str, list[float]] = {}
    for drive in drives:
        values.setdefault(drive.manoeuvre, []).append(sideslip_rmse_deg(drive, estimator))
    return {manoeuvre: float(np.median(v)) for manoeuvre, v in values.items()}


def main() -> None:
    """Try the grid and no sideslip at all, print what comes of each, write the result."""
    options("defaults.tune_kinematic_leak", __doc__).parse_args()
    drives = tuning_drives()
    rows: list[dict[str, float | None]] = []
    means: dict[float, float] = {}
    for leak_s in (*GRID_S, None):
        by = rmse_by_manoeuvre(drives, leak_s)
        mean = float(np.mean(list(by.values())))
        rows.append({"leak_s": leak_s, "mean_deg": mean, **by})
        if leak_s is not None:
            means[leak_s] = mean
        print(rows[-1])
    best = min(means, key=means.__getitem__)
    print(f"chosen: {best} s")
    criterion = "mean over manoeuvres of the median sideslip RMSE of the drives, degrees"
    made_by = "python -m studies.defaults.tune_kinematic_leak"
    write_result("kinematic_leak", drives, made_by=made_by, criterion=criterion, leak_s=best, grid=rows)


if __name__ == "__main__":
    main()
