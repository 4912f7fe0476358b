"""Everything that the page and the pictures need, gathered once, and as one JSON document."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from pdhef_logtool.car.car import NETWORK_FOLDER, SHIPPED_CARS, Car
from pdhef_logtool.learning.network.train_command import HISTORY_FILE
from pdhef_logtool.residual_model.bundle import PAPER_FOLDER
from pdhef_logtool.results.run_report import tool_versions
from studies.paper.comparison import improvement, spread
from studies.paper.experiment import BURST, BURST_S, FIGURES, A, B, Experiment, on_the_road, run_experiment
from studies.paper.probes import Inflation, ResidualFit, TrustCurve, inflation, residual_fit, trust_curve
from studies.paper.schemes import ESP, PAIRS, SCHEMES
from studies.paper.step_time import StepTime, step_times

SCENARIOS = (A, B, BURST)
#: Schemes with a variable gain or factor on R.
ADAPTIVE = ("pd-hef-paper", "pd-hef")


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """Results of the experiment.

    Attributes
    ----------
    fits : of the paper's network by scenario. curves : β over |a_y| by scenario and scheme.
    inflations, times : of R, and processor times, by scheme.
    """

    experiment: Experiment
    car: Car
    fits: Mapping[str, ResidualFit]
    curves: Mapping[str, Mapping[str, TrustCurve]]
    inflations: Mapping[str, Inflation]
    times: Mapping[str, StepTime]

    @property
    def losses(self) -> dict[str, list[float]]:
        """Losses of the shipped paper's network by epoch."""
        import polars as pl

        history = pl.read_parquet(SHIPPED_CARS["saloon"] / NETWORK_FOLDER / PAPER_FOLDER / HISTORY_FILE)
        return {name: history[name].to_list() for name in ("train_loss", "validation_loss")}

    @property
    def ran(self) -> tuple[str, ...]:
        """Schemes that ran."""
        there = {r.scheme for r in self.experiment.runs}
        return tuple(n for n in SCHEMES if n in there)


def gather(
    car: Car,
    *,
    noise_seeds: Sequence[int],
    progress: Callable[[str], None] = lambda _text: None,
) -> Results:
    """Run the whole experiment."""
    experiment = run_experiment(car, scenarios=SCENARIOS, noise_seeds=noise_seeds, progress=progress)
    fits = {s.name: residual_fit(experiment.drives[s.name], car) for s in (A, B)}
    curves = {s.name: {n: c for n in ADAPTIVE if (c := trust_curve(experiment, s.name, n)) is not None} for s in (A, B)}
    inflations = {n: i for n in ADAPTIVE if (i := inflation(experiment, n, BURST_S)) is not None}
    progress("step times")
    names = [n for n in SCHEMES if n not in experiment.missing and not n.endswith(ESP)]
    times = step_times(experiment.drives[B.name], on_the_road(car, B.friction), names)
    return Results(experiment, car, fits, curves, inflations, times)


def _plain(value: Any) -> Any:
    """Return JSON-able values: floats to six digits, null for non-finite ones."""
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return value


def document(r: Results) -> dict[str, Any]:
    """Return all results for ``results.json``; the same but for ``step_time_us`` when made again."""
    scenarios = [s.name for s in SCENARIOS]
    summary = {
        scenario: {
            scheme: {f: asdict(s) for f in FIGURES if (s := spread(r.experiment, scenario, scheme, f)) is not None}
            for scheme in r.ran
        }
        for scenario in scenarios
    }
    gains = [
        {"scenario": scenario, "scheme": s, "baseline": b, **asdict(gain)}
        for scenario in scenarios
        for s, b in PAIRS
        if (gain := improvement(r.experiment, scenario, s, b)) is not None
    ]
    residuals = {
        scenario: {
            "explained": [fit.explained(0), fit.explained(1)],
            "yaw_rate_increment_rad_s": list(fit.increments(1)),
        }
        for scenario, fit in r.fits.items()
    }
    trust = {
        scenario: {
            scheme: {"centre_g": c.centre_g.tolist(), "median": c.median.tolist(), "mean": float(c.trust.mean())}
            for scheme, c in curves.items()
        }
        for scenario, curves in r.curves.items()
    }
    network = r.car.network
    plain: dict[str, Any] = _plain(
        {
            "made_by": "python -m studies.paper",
            "scenarios": [{**asdict(s), "speed_km_h": s.speed_km_h, "friction": s.friction} for s in SCENARIOS],
            "vehicle": {"name": r.car.vehicle.name, "sha256": r.car.physics_sha256},
            "networks": [n.sha256 for n in (network, network and network.paper_network) if n is not None],
            "losses": r.losses,
            "versions": tool_versions(),
            "missing": r.experiment.missing,
            "summary": summary,
            "improvements": gains,
            "residuals": residuals,
            "trust": trust,
            "r_factor": {name: asdict(i) for name, i in r.inflations.items()},
            "drives": list(r.experiment.facts),
            "runs": [asdict(run) for run in r.experiment.runs],
            "step_time_us": {name: asdict(t) for name, t in r.times.items()},
        }
    )
    return plain
