"""Choose the constants that the paper leaves open by one rule on training drives, and show their sensitivity.

    python -m studies.paper.constants

Rule: cyclic search over :data:`GRID`, one constant after the other, until a whole cycle changes nothing; the goal is
the lowest geometric mean of the sideslip RMSE over :data:`COUNT` training drives of the paper's network, each with and
without the wheel speed (``sensors=esp``, the paper's sensor set). The sensitivity varies one constant at a time around
the chosen point, on these drives and on scenarios A and B, which have no part in the choice.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators.filter_steps import PosteriorSteps
from pdhef_logtool.estimators.hybrid_paper import Constants, PaperHybridUkf
from pdhef_logtool.estimators.parallel_physics import run_features
from pdhef_logtool.estimators.vehicle_ukf import nominal_filter
from pdhef_logtool.records.errors import SimulationError
from pdhef_logtool.records.signals import FloatArray, Signals
from studies.defaults.paper_drives import plan_drives
from studies.pages import RESULTS, options, read_toml, write_json
from studies.paper.experiment import FIRST_NOISE_SEED, SCENARIO_PAIR, as_logged, on_the_road, paper_network
from truthsim.drive import Drive, simulate_drive

FILE = RESULTS / "paper" / "constants.json"
#: Number of training drives, and of noise seeds of A and B.
COUNT, NOISE_SEEDS = 12, 5
SENSOR_SETS = {"wheel speed": True, "esp": False}


#: Values of each constant.
GRID: Mapping[str, Sequence[Any]] = {
    name: [tuple(value) if isinstance(value, list) else value for value in values]
    for name, values in read_toml(Path(__file__).with_suffix(".toml")).items()
}
#: First point of the search.
START = Constants(0.95, 3.0, (0.3, 1.0, 2.5), (0.3, 0.6, 0.85), 0.1)


@dataclass(frozen=True)
class Case:
    """A drive with one sensor set; the parallel filter and the network run once, as no constant changes them."""

    drive: Drive
    car: Car
    use_speed: bool

    @cached_property
    def _inputs(self) -> tuple[Signals, FloatArray, PosteriorSteps, FloatArray]:
        whole = as_logged(self.drive, self.car)
        physics = nominal_filter(self.car.vehicle, use_speed=self.use_speed)
        features, dt_s, steps, _ = run_features(physics, whole.signals, None)
        rate, _ = paper_network(self.car).run(features, np.isnan(dt_s), None)
        assert whole.truth is not None
        return whole.signals, whole.truth.sideslip_rad, steps, rate

    def rmse_deg(self, constants: Constants) -> float:
        """Return the RMSE of the sideslip after each update."""
        signals, truth, physics, rate = self._inputs
        ukf = PaperHybridUkf(self.car.vehicle, paper_network(self.car), use_speed=self.use_speed, constants=constants)
        steps, *_ = ukf.filter_steps(signals, physics, rate)
        error = np.arctan2(steps.x[:, 1], steps.x[:, 0]) - truth
        return float(np.degrees(np.sqrt(np.mean(error[steps.valid & np.isfinite(error)] ** 2))))


def training_drives() -> Iterator[Drive]:
    """Simulate the first training drives of the paper's network."""
    for job in itertools.islice((j for j in plan_drives() if dict(j.facts)["split"] == "train"), COUNT):
        for spec in job.candidates:
            try:
                yield spec.simulate()
            except SimulationError:  # a spin: the next draw, as in the training set
                continue
            break


def cases_of(drives: Iterable[Drive], car: Car) -> list[Case]:
    """Return all drives with both sensor sets."""
    return [Case(d, on_the_road(car, d.friction), use) for d in drives for use in SENSOR_SETS.values()]


#: Geometric mean of the sideslip RMSE in degrees over some cases.
Goal = Callable[[Constants], float]


def goal_of(cases: Sequence[Case]) -> Goal:
    """Return the goal of cases, which computes each point once."""
    return cache(lambda point: float(np.exp(np.mean([np.log(case.rmse_deg(point)) for case in cases]))))


def choose(goal: Goal, start: Constants = START) -> Constants:
    """Return the result of the cyclic search."""
    while True:
        point = start
        for name, values in GRID.items():
            point = min((point._replace(**{name: value}) for value in values), key=goal)
        if point == start:
            return point
        start = point


def sensitivity(chosen: Constants, goals: Mapping[str, Goal]) -> list[dict[str, Any]]:
    """Return one row for each value of each constant around the chosen point, with the goals by name."""
    rows = []
    for name, values in GRID.items():
        for value in values:
            point = chosen._replace(**{name: value})
            errors = {title: goal(point) for title, goal in goals.items()}
            rows.append({"constant": name, "value": value, "chosen": point == chosen, "errors_deg": errors})
    return rows


def main() -> None:
    """Run the command line."""
    options("paper.constants", __doc__).parse_args()
    car = Car.load("saloon")
    training = goal_of(cases_of(training_drives(), car))
    chosen = choose(training)
    seeds = range(FIRST_NOISE_SEED, FIRST_NOISE_SEED + NOISE_SEEDS)
    goals = {"training drives": training}
    for scenario in SCENARIO_PAIR:
        cases = cases_of((simulate_drive(scenario.manoeuvre, seed=seed) for seed in seeds), car)
        for title, use_speed in SENSOR_SETS.items():
            goals[f"{scenario.name}, {title}"] = goal_of([c for c in cases if c.use_speed == use_speed])
    document = {
        "made_by": "python -m studies.paper.constants",
        "training_drives": COUNT,
        "noise_seeds": list(seeds),
        "start": START._asdict(),
        "chosen": chosen._asdict(),
        "rows": [{"constant": "start", "value": "", "chosen": False,
                  "errors_deg": {title: goal(START) for title, goal in goals.items()}},
                 *sensitivity(chosen, goals)],
    }  # fmt: skip
    write_json(FILE, document)


if __name__ == "__main__":
    main()
