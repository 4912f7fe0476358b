"""Find the process noise of a filter on physics by innovation likelihood, without ground truth.

    python -m studies.defaults.tune_physics_q {phy-ukf,physics}

Maximises the mean over manoeuvres of the log-likelihood per scalar innovation, so that minutes of straight road do
not outvote a lane change. R stays at sensor level (vehicle file). Nelder-Mead on the logarithms of the 1-sigma values,
from several starts, and of ``phy-ukf`` then anew from the best, for as long as that gains. results/physics_q.json is
entered as PHY_UKF_Q_STD; results/physics_parts_q.json is near PHYSICS_Q_STD, which is frozen: ``physics`` has lag, load
transfer and bias states there, with the values of the vehicle file.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize

from pdhef_logtool.car.vehicle import PhysicsParts, VehicleParameters
from pdhef_logtool.estimators.phy_ukf import PhysicsUkf
from pdhef_logtool.estimators.physics_filter import PhysicsFilter
from pdhef_logtool.records.signals import FloatArray
from studies.defaults.tuning_drives import VEHICLE_FILE, TuningDrive, sideslip_rmse_deg, tuning_drives, write_result
from studies.pages import options

CRITERION = "mean over manoeuvres of the Gaussian log-likelihood per scalar innovation"
#: Beyond these a 1-sigma means "not needed" or "the model is of no use": the search is kept inside.
LOWEST, HIGHEST = 1e-4, 10.0
STATES = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ax_bias_m_s2")
Q = tuple[float, ...]
Build = Callable[[VehicleParameters, Q], PhysicsUkf | PhysicsFilter]


@dataclass(frozen=True)
class Search:
    """How a filter is searched; ``worthwhile``: a search from the best that gains less per innovation is the last."""

    result: str
    names: tuple[str, ...]
    starts: tuple[Q, ...]
    build: Build
    options: dict[str, float]
    worthwhile: float = np.inf


def _phy_ukf(vehicle: VehicleParameters, q_std: Q) -> PhysicsUkf:
    a, b, c, d = q_std
    return PhysicsUkf(vehicle, q_std=(a, b, c, d))


def _physics(vehicle: VehicleParameters, q_std: Q) -> PhysicsFilter:
    """Both axles' forces share one value."""
    parts = PhysicsParts(lag=True, load_transfer=True, biases=True)
    return PhysicsFilter(vehicle.model_copy(update={"physics": parts}), q_std=(*q_std, q_std[-1]))


SEARCHES = {
    "phy-ukf": Search(
        "physics_q",
        STATES,
        ((0.05, 0.1, 0.05, 0.05), (0.2, 0.5, 0.3, 0.02), (0.02, 0.03, 0.02, 0.1)),
        _phy_ukf,
        {"xatol": 0.02, "fatol": 1e-5, "maxfev": 400},
        worthwhile=2e-4,
    ),
    "physics": Search(
        "physics_parts_q",
        (*STATES, "force_over_mass_m_s2"),
        ((0.1, 0.1, 0.05, 0.02, 2.0), (0.1, 0.3, 0.2, 0.02, 0.5)),
        _physics,
        {"xatol": 0.05, "fatol": 1e-4, "maxfev": 200},
    ),
}


def log_likelihood(drives: list[TuningDrive], build: Build, q_std: Q) -> float:
    """Return the criterion: Gaussian log-likelihood per scalar innovation, the mean over manoeuvres."""
    total: dict[str, tuple[float, int]] = {}
    for drive in drives:
        steps, _ = build(drive.vehicle, q_std).run(drive.signals, None)
        value, count = total.get(drive.manoeuvre, (0.0, 0))
        value += float(steps.log_likelihood.sum())
        total[drive.manoeuvre] = value, count + int(np.isfinite(steps.innovation).sum())
    return float(np.mean([value / count for value, count in total.values()]))


def search(score: Callable[[Q], float], start: Q, given: dict[str, float]) -> dict[str, Any]:
    """Run one Nelder-Mead on the logarithms, print and return what it found.

    The values are rounded to two significant digits: the likelihood is no more precise.
    """
    low, high = np.log(LOWEST), np.log(HIGHEST)

    def cost(log_q: FloatArray) -> float:
        inside = np.clip(log_q, low, high)
        return -score(tuple(np.exp(inside).tolist())) + float(np.abs(log_q - inside).sum())

    simplex = np.log(start) + np.vstack([np.zeros(len(start)), 0.7 * np.eye(len(start))])
    result = minimize(cost, np.log(start), method="Nelder-Mead", options={"initial_simplex": simplex, **given})
    q_std = [float(f"{v:.2g}") for v in np.exp(result.x)]
    value, evaluations = -float(result.fun), int(result.nfev)
    print(f"{start} -> {q_std}   {value:.5f}   {evaluations}", flush=True)
    return {"start": list(start), "q_std": q_std, "log_likelihood": value, "evaluations": evaluations}


def main() -> None:
    """Search, print, write the result; the sideslip RMSE is for information and decides nothing."""
    parser = options("defaults.tune_physics_q", __doc__)
    parser.add_argument("filter", choices=SEARCHES)
    name = parser.parse_args().filter
    chosen = SEARCHES[name]
    drives = tuning_drives()
    print(f"{len(drives)} drives, {sum(len(d.signals) for d in drives)} steps")

    def run(start: Q) -> dict[str, Any]:
        return search(lambda q: log_likelihood(drives, chosen.build, q), start, chosen.options)

    def reached(result: dict[str, Any]) -> float:
        return float(result["log_likelihood"])

    runs = [run(start) for start in chosen.starts]
    gained = np.isfinite(chosen.worthwhile)
    while gained:
        before = max(runs, key=reached)
        runs.append(run(tuple(before["q_std"])))
        gained = reached(runs[-1]) >= reached(before) + chosen.worthwhile
    best = max(runs, key=reached)["q_std"]
    rmse = float(np.median([sideslip_rmse_deg(d, chosen.build(d.vehicle, tuple(best))) for d in drives]))
    print(f"median sideslip RMSE of the choice (not used): {rmse:.3f} deg")
    write_result(
        chosen.result,
        drives,
        made_by=f"python -m studies.defaults.tune_physics_q {name}",
        what="1-sigma per square root of second of " + ", ".join(chosen.names),
        criterion=CRITERION,
        vehicle=VEHICLE_FILE + ", friction of the drive",
        q_std=best,
        searches=runs,
        median_sideslip_rmse_deg=rmse,
    )


if __name__ == "__main__":
    main()
