"""Find the default process noise of ``physics-plus`` by innovation likelihood, without any truth.

    python -m studies.defaults.tune_physics_plus_q

The same drives, criterion and search as for ``phy-ukf`` (``tune_physics_q``); both axles' forces share one value.
Writes results/physics_plus_q.json; the result is entered as PHYSICS_PLUS_Q_STD.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.physics import PhysicsUkf
from pdhef_logtool.estimators.physics_plus import PhysicsPlusUkf
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

NAMES = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ax_bias_m_s2", "force_over_mass_m_s2")
STARTS = ((0.1, 0.1, 0.05, 0.02, 2.0), (0.1, 0.3, 0.2, 0.02, 0.5))


def with_noise(q_std: Q, drive: TuningDrive, *, bias_states: bool = True) -> PhysicsPlusUkf:
    """Build the filter of one drive."""
    return PhysicsPlusUkf(drive.vehicle, q_std=(*q_std, q_std[-1]), bias_states=bias_states)


def main() -> None:
    """Search, print, write the result."""
    options("defaults.tune_physics_plus_q", __doc__).parse_args()
    drives = tuning_drives()
    print(f"{len(drives)} drives, {sum(len(d.signals) for d in drives)} steps")

    def score(q_std: Q, *, bias_states: bool = True) -> float:
        build = partial(with_noise, q_std, bias_states=bias_states)
        return float(np.mean(list(by_manoeuvre(drives, build).values())))

    runs = [search(score, start, xatol=0.05, fatol=1e-4, maxfev=200) for start in STARTS]
    best = max(runs, key=lambda r: float(r["log_likelihood"]))["q_std"]
    without = score(tuple(best), bias_states=False)
    filters: dict[str, Callable[[TuningDrive], Estimator]] = {
        "phy-ukf": lambda drive: PhysicsUkf(drive.vehicle),
        "physics-plus": partial(with_noise, best),
        "physics-plus without bias states": partial(with_noise, best, bias_states=False),
    }
    rmse = {name: float(np.median([sideslip_rmse_deg(d, build(d)) for d in drives])) for name, build in filters.items()}
    print(f"without bias states: {without:.5f}; median sideslip RMSE (not used): {rmse}")
    write_result(
        "physics_plus_q",
        drives,
        what="1-sigma per square root of second of " + ", ".join(NAMES),
        criterion=CRITERION,
        vehicle=VEHICLE_FILE + ", friction of the drive",
        q_std=best,
        searches=runs,
        log_likelihood_without_bias_states=without,
        median_sideslip_rmse_deg=rmse,
    )


if __name__ == "__main__":
    main()
