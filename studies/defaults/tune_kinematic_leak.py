"""Tune the leak of the ``kinematic`` baseline by sideslip RMSE against the perfect truth of simulated drives.

    python benchmarks/tune_kinematic_leak.py

A baseline should be as good as it can be made. Criterion: the mean over manoeuvres of the median sideslip RMSE of
its drives. Writes benchmarks/results/kinematic_leak.json; the result is entered as LEAK_S.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from tuning_drives import FIRST_SEED, TuningDrive, tuning_drives

from pdhef_logtool.estimators.kinematic import Kinematic

ROOT = Path(__file__).resolve().parents[2]
RESULT = ROOT / "benchmarks" / "results" / "kinematic_leak.json"
GRID_S = (0.2, 0.3, 0.4, 0.5, 0.7, 1.0, 1.4, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 14.0, 20.0)


def rmse_deg(drive: TuningDrive, leak_s: float | None) -> float:
    """Return the sideslip RMSE of a drive in degrees; None stands for no sideslip at all."""
    error = drive.sideslip_rad
    if leak_s is not None:
        track, _ = Kinematic(leak_s=leak_s).run(drive.signals, None)
        error = (track.sideslip_rad - drive.sideslip_rad)[track.valid]
    return float(np.rad2deg(np.sqrt(np.nanmean(error**2))))


def by_manoeuvre(drives: list[TuningDrive], leak_s: float | None) -> dict[str, float]:
    """Return the median RMSE of every manoeuvre."""
    values: dict[str, list[float]] = {}
    for drive in drives:
        values.setdefault(drive.manoeuvre, []).append(rmse_deg(drive, leak_s))
    return {manoeuvre: float(np.median(v)) for manoeuvre, v in values.items()}


def main() -> int:
    """Try the grid, print the table, write the result."""
    drives = tuning_drives(ROOT)
    print("leak s    mean     " + "  ".join(dict.fromkeys(d.manoeuvre for d in drives)))
    rows = []
    for leak_s in (*GRID_S, None):
        by = by_manoeuvre(drives, leak_s)
        rows.append({"leak_s": leak_s, "mean_deg": float(np.mean(list(by.values()))), **by})
        label = "beta = 0" if leak_s is None else f"{leak_s:8.1f}"
        print(f"{label}  {rows[-1]['mean_deg']:.4f}   " + "  ".join(f"{v:.4f}" for v in by.values()))
    best = min((r for r in rows if r["leak_s"] is not None), key=lambda r: r["mean_deg"])
    print(f"chosen: {best['leak_s']} s")
    RESULT.parent.mkdir(exist_ok=True)
    document = {
        "made_by": "python benchmarks/tune_kinematic_leak.py",
        "criterion": "mean over manoeuvres of the median sideslip RMSE of the drives, degrees",
        "leak_s": best["leak_s"],
        "grid": rows,
        "first_seed": FIRST_SEED,
        "drives": [d.command for d in drives],
    }
    RESULT.write_text(json.dumps(document, indent=2) + "\n")
    print(f"wrote {RESULT.relative_to(ROOT)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
