"""The on-line estimate of friction: how far it is off where it calls itself observable, and what it does to sideslip.

    python -m studies.friction [--write-docs]

Simulates every manoeuvre of ``PLAN`` on every friction of ``FRICTIONS`` with the shipped car, a seed a drive
from ``FIRST_SEED`` on, which no network, filter noise or table is made of. ``--write-docs`` puts the tables into
docs/friction.md.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators.friction_bank import USUAL_FRICTION, FrictionBank
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.records.errors import SimulationError
from pdhef_logtool.records.signals import BoolArray, FloatArray
from studies.condition_drives import ConditionDrive, read_drive, root_mean_square, sideslip_error
from studies.pages import DOCS, measured, table
from truthsim.drive import simulate_drive, write_drive

FIRST_SEED = 6100
#: 0.3, 0.5 and 1 are those of filters of the bank; the others lie between two.
FRICTIONS = (0.3, 0.36, 0.5, 0.68, 0.85, 1.0)
#: Manoeuvre: km/h and seconds (None: its own).
PLAN: dict[str, tuple[float, float | None]] = {
    "dlc": (80.0, None),
    "sine-sweep": (60.0, None),
    "fishhook": (70.0, None),
    "step-steer": (80.0, None),
    "brake-in-turn": (70.0, None),
    "road": (90.0, 120.0),
}
ORDINARY = "road"
ESTIMATORS = ("phy-ukf", "physics", "pd-hef")
TOLD = ("true", "1", "0.85", "estimated")
DOCUMENT = DOCS / "friction.md"


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """One drive: |error| of the estimate [N] with its flag [N], and the sideslip RMSE in degrees by what was told.

    ``rmse_seen_deg`` counts the stamps where the friction is observable only; NaN without any.
    """

    manoeuvre: str
    friction: float
    error: FloatArray
    observable: BoolArray
    rmse_deg: Mapping[tuple[str, str], float]
    rmse_seen_deg: Mapping[tuple[str, str], float]


def measure(drive: ConditionDrive, manoeuvre: str, friction: float, car: Car) -> Outcome:
    """Estimate the friction of a drive, and run every estimator with every friction that it may be told."""
    found, _ = FrictionBank(car.vehicle).run(drive.signals, None)
    told = {
        "true": drive.signals.friction,
        "1": np.ones(len(drive.signals)),
        "0.85": np.full(len(drive.signals), 0.85),
        "estimated": found.friction,
    }
    rmse, rmse_seen = {}, {}
    for name, how in product(ESTIMATORS, TOLD):
        given = replace(drive.signals, friction=told[how])
        error = np.degrees(sideslip_error(make_estimator(name, car), drive, given))
        rmse[name, how] = root_mean_square(error)
        rmse_seen[name, how] = root_mean_square(error[found.observable])
    return Outcome(
        manoeuvre, friction, np.abs(found.friction - drive.signals.friction), found.observable, rmse, rmse_seen
    )


def measure_all(folder: Path) -> list[Outcome]:
    """Simulate and measure every drive; one that spins is left out, with a line on stderr."""
    car = Car.load("saloon")
    outcomes = []
    for seed, (manoeuvre, friction) in enumerate(product(PLAN, FRICTIONS), start=FIRST_SEED + 1):
        speed, duration = PLAN[manoeuvre]
        path = folder / f"{manoeuvre}-{seed}.mcap"
        print(f"{manoeuvre}, friction {friction:g}", file=sys.stderr)
        try:
            made = simulate_drive(manoeuvre, speed_km_h=speed, friction=friction, seed=seed, duration_s=duration)
        except SimulationError as error:
            print(f"left out: {error}", file=sys.stderr)
            continue
        write_drive(made, path)
        outcomes.append(measure(read_drive(path, car), manoeuvre, friction, car))
        path.unlink()
    return outcomes


def groups(outcomes: Sequence[Outcome]) -> dict[str, list[Outcome]]:
    """Return the drives by friction, ordinary driving apart."""
    limit = [o for o in outcomes if o.manoeuvre != ORDINARY]
    named = {f"manoeuvres, {mu:g}": [o for o in limit if o.friction == mu] for mu in FRICTIONS}
    named["manoeuvres, all"] = limit
    named |= {f"road, {mu:g}": [o for o in outcomes if o not in limit and o.friction == mu] for mu in FRICTIONS}
    return {name: found for name, found in named.items() if found}


def tables(outcomes: Sequence[Outcome]) -> str:
    """Return the tables of the estimate itself, and of the sideslip errors: root mean square and median over drives."""
    body = []
    for name, found in groups(outcomes).items():
        seen = np.concatenate([o.observable for o in found])
        error = np.concatenate([o.error for o in found])[seen]
        prior = np.concatenate([np.full(len(o.error), abs(USUAL_FRICTION - o.friction)) for o in found])[seen]
        figures = ["", "", ""]
        if error.size:
            figures = [f"{v:.3f}" for v in (np.median(error), np.quantile(error, 0.95), np.median(prior))]
        body.append([name, str(len(found)), f"{100 * seen.mean():.0f}", *figures])
    head = ["drives, friction", "drives", "observable, % of the time", "error there: median", "95 %", "if none is seen"]
    estimate = table(head, body, right_from=1)

    cells = list(product(ESTIMATORS, TOLD))
    limit = [o for o in outcomes if o.manoeuvre != ORDINARY]
    rows = {m: [[o.rmse_deg[c] for o in outcomes if o.manoeuvre == m] for c in cells] for m in PLAN}
    rows["manoeuvres"] = [[o.rmse_deg[c] for o in limit] for c in cells]
    seen_at_all = [o for o in limit if np.isfinite(o.rmse_seen_deg[cells[0]])]
    rows["manoeuvres, where observable"] = [[o.rmse_seen_deg[c] for o in seen_at_all] for c in cells]
    body = []
    for name, columns in rows.items():
        pooled = [np.sqrt(np.mean(np.square(c))) for c in columns]
        median = [np.median(c) for c in columns]
        for how, values in ((f"{len(columns[0])}, root mean square", pooled), ("median", median)):
            body.append([name, how, *(f"{v:.3f}" for v in values)])
    sideslip = table(["drives", "over them", *(f"{name}: {how}" for name, how in cells)], body, right_from=2)
    last = FIRST_SEED + len(PLAN) * len(FRICTIONS)
    drives = f"{len(outcomes)} drives of seeds {FIRST_SEED + 1} to {last}: {', '.join(PLAN)}."
    told = "Sideslip RMSE of the drives in degrees, by the friction told:"
    return "\n\n".join([drives, estimate, told, sideslip])


def all_tables() -> str:
    """Return the tables of the page."""
    with tempfile.TemporaryDirectory() as folder:
        return tables(measure_all(Path(folder)))


if __name__ == "__main__":
    measured("friction", __doc__, DOCUMENT, all_tables)
