"""Everything that the page and the pictures need, gathered once, and as one JSON document."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators.table import spec_of
from pdhef_logtool.residual_model.bundle import ModelBundle
from pdhef_logtool.results.run_report import tool_versions
from studies.paper.comparison import Improvement, Spread, improvement, spread
from studies.paper.experiment import (
    BURST,
    BURST_S,
    FIGURES,
    OVERSHOOTS,
    A,
    B,
    Experiment,
    Scenario,
    on_the_road,
    run_experiment,
)
from studies.paper.probes import (
    Inflation,
    ResidualFit,
    TrustCurve,
    inflation,
    residual_fit,
    trust_curve,
)
from studies.paper.schemes import HYBRID, SCHEMES
from studies.paper.step_time import StepTime, step_times
from studies.paper.withheld import Withheld
from truthsim.suite import is_held_out

SCENARIOS: tuple[Scenario, ...] = (A, B, BURST)
#: Schemes with a variable gain or factor on R.
ADAPTIVE = ("pd-hef-paper", "pd-hef")
#: Default figure of the improvements.
FIGURE = "sideslip_deg"
BASELINES = ("phy-ukf", "phy-ukf:tuned", "physics", "linear-regression", "pure-lstm", "pd-hef-paper")


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """Results of the experiment.

    Attributes
    ----------
    ran : schemes in the order of the tables.
    cars : by training seed. fits : residual fits by scenario, one a car.
    curves : β over |a_y| by scenario and scheme. inflations : of R by scheme.
    without : A and B with the network trained without lane changes and sweeps, or None.
    """

    experiment: Experiment
    cars: Mapping[int, Car]
    fits: Mapping[str, tuple[ResidualFit, ...]]
    curves: Mapping[str, Mapping[str, TrustCurve]]
    inflations: Mapping[str, Inflation]
    times: Mapping[str, StepTime]
    withheld: Withheld | None = None
    without: Experiment | None = None

    @property
    def networks(self) -> dict[int, ModelBundle]:
        """The cars' networks by training seed."""
        return {seed: c.network for seed, c in self.cars.items() if isinstance(c.network, ModelBundle)}

    @property
    def first_seed(self) -> int:
        """Training seed of the network that the pictures show."""
        return next(iter(self.cars))

    @property
    def car(self) -> Car:
        """The car with that network."""
        return self.cars[self.first_seed]

    @property
    def ran(self) -> tuple[str, ...]:
        """Schemes that ran."""
        there = {r.scheme for r in self.experiment.runs}
        return tuple(n for n in SCHEMES if n in there)

    def spread(self, scenario: str, scheme: str, figure: str) -> Spread | None:
        """See :func:`~studies.paper.comparison.spread`."""
        return spread(self.experiment, scenario, scheme, figure)

    def improvement(self, scenario: str, scheme: str, baseline: str, figure: str = FIGURE) -> Improvement | None:
        """See :func:`~studies.paper.comparison.improvement`."""
        return improvement(self.experiment, scenario, scheme, baseline, figure)


def gather(
    cars: Mapping[int, Car],
    *,
    noise_seeds: Sequence[int],
    withheld: Withheld | None = None,
    progress: Callable[[str], None] = lambda _text: None,
) -> Results:
    """Run the whole experiment.

    Parameters
    ----------
    cars : by the training seed of their networks; the first is the one that the pictures show.
    """
    experiment = run_experiment(cars, scenarios=SCENARIOS, noise_seeds=noise_seeds, progress=progress)
    fits = {s.name: tuple(residual_fit(experiment.drives[s.name], c) for c in cars.values()) for s in (A, B)}
    curves = {s.name: {n: c for n in ADAPTIVE if (c := trust_curve(experiment, s.name, n)) is not None} for s in (A, B)}
    inflations = {n: i for n in ADAPTIVE if (i := inflation(experiment, n, BURST_S)) is not None}
    progress("step times")
    names = [n for n in SCHEMES if n not in experiment.missing]
    times = step_times(experiment.drives[B.name], on_the_road(next(iter(cars.values())), B.friction), names)
    without = None
    if withheld is not None:
        progress("the network without lane changes and sweeps")
        seeds = {0: withheld.car}
        without = run_experiment(seeds, scenarios=(A, B), noise_seeds=noise_seeds, names=(HYBRID,))
    return Results(experiment, cars, fits, curves, inflations, times, withheld, without)


def _withheld(r: Results) -> dict[str, Any] | None:
    """Return the training drives, and gain limit and errors of the network that lacked some manoeuvres."""
    if r.withheld is None or r.without is None:
        return None
    errors = {s.name: spread(r.without, s.name, HYBRID, FIGURE) for s in (A, B)}
    return {
        "drives": dict(r.withheld.drives),
        "gain_limit": r.withheld.car.allowed_trust.cap,
        "sideslip_deg": {name: None if s is None else asdict(s) for name, s in errors.items()},
    }


def _plain(value: Any) -> Any:
    """Return JSON-able values: floats to six digits, null for non-finite ones."""
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return value


def document(results: Results) -> dict[str, Any]:
    """Return all results for ``results.json``; the same but for ``step_time_us`` when made again."""
    r, car = results, results.car
    scenarios = [s.name for s in SCENARIOS]
    names = (*FIGURES, *OVERSHOOTS)
    summary = {
        scenario: {
            scheme: {f: asdict(s) for f in names if (s := r.spread(scenario, scheme, f)) is not None}
            for scheme in r.ran
        }
        for scenario in scenarios
    }
    gains = [
        {"scenario": scenario, "scheme": HYBRID, "baseline": b, "figure": f, **asdict(gain), "proven": gain.proven}
        for scenario in scenarios
        for b in BASELINES
        if b in r.ran and b != HYBRID
        for f in FIGURES
        if not f.endswith(("_relative", "_ms")) and f != "diverged"
        if (gain := r.improvement(scenario, HYBRID, b, f)) is not None
    ]
    residuals = {
        scenario: [
            {
                "training_seed": seed,
                "explained": [fit.explained(0), fit.explained(1)],
                "lag_ms": [fit.lag_ms(0), fit.lag_ms(1)],
                "yaw_rate_increment_rad_s": list(fit.increments(1)),
                "noise_of_target_and_output": [fit.noise(0), fit.noise(1)],
            }
            for seed, fit in zip(r.cars, fits, strict=True)
        ]
        for scenario, fits in r.fits.items()
    }
    trust = {
        scenario: {
            scheme: {
                "centre_g": c.centre_g.tolist(),
                "median": c.median.tolist(),
                "p10": c.low.tolist(),
                "p90": c.high.tolist(),
                "mean": float(c.trust.mean()),
            }
            for scheme, c in curves.items()
        }
        for scenario, curves in r.curves.items()
    }
    plain: dict[str, Any] = _plain(
        {
            "made_by": "python -m studies.paper",
            "scenarios": [
                {
                    **asdict(s),
                    "speed_km_h": s.speed_km_h,
                    "friction": s.friction,
                    "held_out_of_training_suites": is_held_out(s.manoeuvre, s.speed_km_h, s.friction),
                }
                for s in SCENARIOS
            ],
            "friction": "given: the vehicle file contains the friction of each drive",
            "vehicle": {"name": car.vehicle.name, "sha256": car.physics_sha256},
            "models": [
                {"training_seed": seed, "sha256": n.sha256, "provenance": n.provenance}
                for seed, n in r.networks.items()
            ],
            "versions": tool_versions(),
            "missing": r.experiment.missing,
            "network_schemes": sorted(n for n in r.ran if spec_of(n).network),
            "summary": summary,
            "improvements": gains,
            "withheld": _withheld(r),
            "residuals": residuals,
            "trust": trust,
            "r_factor": {name: asdict(i) for name, i in r.inflations.items()},
            "drives": list(r.experiment.facts),
            "runs": [asdict(run) for run in r.experiment.runs],
            "step_time_us": {name: asdict(t) for name, t in r.times.items()},
        }
    )
    return plain
