"""Everything that the page and the pictures need, gathered once, and as one JSON document."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import product
from typing import Any

import polars as pl

from pdhef_logtool.car.car import NETWORK_FOLDER, SHIPPED_CARS, Car
from pdhef_logtool.learning.network.train_command import HISTORY_FILE
from pdhef_logtool.residual_model.bundle import PAPER_FOLDER
from pdhef_logtool.results.run_report import tool_versions
from studies.gates.tool import Tool
from studies.paper import experiment as paper
from studies.paper.probes import ResidualFit, TrustCurve, inflation, residual_fit, step_times, trust_curve
from studies.paper.schemes import ESP, HYBRID, PAIRS, PAPER, SCHEMES

SCENARIOS = (paper.A, paper.B, paper.BURST)
#: Schemes with a variable factor on R; that of the paper also has a variable gain.
ADAPTIVE = (PAPER, HYBRID)


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """Results of the experiment.

    Attributes
    ----------
    fits : of the paper's network by scenario. curves : its β over |a_y| by scenario.
    inflations, times : of R, and processor times, by scheme.
    """

    experiment: paper.Experiment
    car: Car
    fits: Mapping[str, ResidualFit]
    curves: Mapping[str, TrustCurve]
    inflations: Mapping[str, dict[str, float]]
    times: Mapping[str, dict[str, float]]

    @property
    def losses(self) -> dict[str, list[float]]:
        """Losses of the shipped paper's network by epoch."""
        history = pl.read_parquet(SHIPPED_CARS["saloon"] / NETWORK_FOLDER / PAPER_FOLDER / HISTORY_FILE)
        return {name: history[name].to_list() for name in ("train_loss", "validation_loss")}


def gather(tool: Tool, car: Car, *, noise_seeds: Sequence[int]) -> Results:
    """Run the whole experiment."""
    experiment = paper.run_experiment(tool, scenarios=SCENARIOS, noise_seeds=noise_seeds)
    pair = paper.SCENARIO_PAIR
    drives = {s.name: paper.read_log(experiment.logs[s.name], paper.on_the_road(car, s.driven.friction)) for s in pair}
    fits = {name: residual_fit(whole, car) for name, whole in drives.items()}
    curves = {s.name: trust_curve(experiment, s.name, PAPER) for s in pair}
    inflations = {name: inflation(experiment, name, paper.BURST_S) for name in ADAPTIVE}
    names = [n for n in SCHEMES if not n.endswith(ESP)]
    times = step_times(drives[paper.B.name], paper.on_the_road(car, paper.B.driven.friction), names)
    return Results(experiment, car, fits, curves, inflations, times)


def _plain(document: Mapping[str, Any]) -> dict[str, Any]:
    """Return a document with floats of six digits, null for non-finite ones."""
    text = json.dumps(document)
    return dict(json.loads(text, parse_float=lambda x: float(f"{float(x):.6g}"), parse_constant=lambda _: None))


def document(r: Results) -> dict[str, Any]:
    """Return all results for ``results.json``; the same but for ``step_time_us`` when made again."""
    metrics, scenarios, network = r.experiment.metrics, [s.name for s in SCENARIOS], r.car.network
    summary = {
        scenario: {
            scheme: {f: of for f in paper.FIGURES if (of := paper.spread(metrics, scenario, scheme, f)) is not None}
            for scheme in SCHEMES
        }
        for scenario in scenarios
    }
    gains = [
        {"scenario": scenario, "scheme": s, "baseline": b, **paper.improvement(metrics, scenario, s, b)}
        for scenario, (s, b) in product(scenarios, PAIRS)
    ]
    residuals = {
        scenario: {
            "explained": [fit.explained(0), fit.explained(1)],
            "yaw_rate_increment_rad_s": list(fit.increments(1)),
        }
        for scenario, fit in r.fits.items()
    }
    trust = {
        scenario: {PAPER: {"centre_g": c.centre_g.tolist(), "median": c.median.tolist(), "mean": float(c.trust.mean())}}
        for scenario, c in r.curves.items()
    }
    return _plain(
        {
            "made_by": "python -m studies.paper",
            "scenarios": [asdict(s) | {n: getattr(s.driven, n) for n in ("speed_km_h", "friction")} for s in SCENARIOS],
            "vehicle": {"name": r.car.vehicle.name, "sha256": r.car.physics_sha256},
            "networks": [n.sha256 for n in (network, network and network.paper_network) if n is not None],
            "losses": r.losses,
            "versions": tool_versions(),
            "summary": summary,
            "improvements": gains,
            "residuals": residuals,
            "trust": trust,
            "r_factor": r.inflations,
            "drives": r.experiment.facts,
            "runs": metrics.to_dicts(),
            "step_time_us": r.times,
        }
    )
