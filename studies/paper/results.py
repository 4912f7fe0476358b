"""Everything that the page and the pictures need, as one JSON document."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import polars as pl

from pdhef_logtool.car.car import NETWORK_FOLDER, SHIPPED_CARS, Car
from pdhef_logtool.learning.network.train_command import HISTORY_FILE
from pdhef_logtool.residual_model.bundle import PAPER_FOLDER
from pdhef_logtool.results.run_report import tool_versions
from studies.gates.tool import Tool
from studies.paper.experiment import (
    BURST,
    BURST_S,
    FIGURES,
    A,
    B,
    Experiment,
    improvement,
    on_the_road,
    read_log,
    run_experiment,
    spread,
)  # fmt: skip
from studies.paper.probes import inflation, residual_fit, step_times, trust_curve
from studies.paper.schemes import ESP, PAIRS

SCENARIOS = (A, B, BURST)
#: Schemes with a variable gain or factor on R.
ADAPTIVE = ("pd-hef-paper", "pd-hef")


def _plain(value: Any) -> Any:
    """Return JSON-able values: floats to six digits, null for non-finite ones."""
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    return value


def gather(tool: Tool, car: Car, *, noise_seeds: Sequence[int]) -> tuple[Experiment, dict[str, Any]]:
    """Run the whole experiment; return it and all results for ``results.json``.

    They are the same, but for ``step_time_us``, when they are computed again.
    """
    experiment = run_experiment(tool, scenarios=SCENARIOS, noise_seeds=noise_seeds)
    metrics, scenarios, network = experiment.metrics, [s.name for s in SCENARIOS], car.network
    drives = {s.name: read_log(experiment.logs[s.name], on_the_road(car, s.friction)) for s in (A, B)}
    history = pl.read_parquet(SHIPPED_CARS["saloon"] / NETWORK_FOLDER / PAPER_FOLDER / HISTORY_FILE)
    summary = {
        scenario: {
            scheme: {f: of for f in FIGURES if (of := spread(metrics, scenario, scheme, f)) is not None}
            for scheme in experiment.ran
        }
        for scenario in scenarios
    }
    gains = [
        {"scenario": scenario, "scheme": s, "baseline": b, **gain}
        for scenario in scenarios
        for s, b in PAIRS
        if (gain := improvement(metrics, scenario, s, b)) is not None
    ]
    timed = [n for n in experiment.ran if not n.endswith(ESP)]
    results: dict[str, Any] = _plain(
        {
            "made_by": "python -m studies.paper",
            "scenarios": [{**asdict(s), "speed_km_h": s.speed_km_h, "friction": s.friction} for s in SCENARIOS],
            "vehicle": {"name": car.vehicle.name, "sha256": car.physics_sha256},
            "networks": [n.sha256 for n in (network, network and network.paper_network) if n is not None],
            "losses": {name: history[name].to_list() for name in ("train_loss", "validation_loss")},
            "versions": tool_versions(),
            "summary": summary,
            "improvements": gains,
            "residuals": {name: residual_fit(whole, car) for name, whole in drives.items()},
            "trust": {s: {n: c for n in ADAPTIVE if (c := trust_curve(experiment, s, n)) is not None} for s in drives},
            "r_factor": {n: i for n in ADAPTIVE if (i := inflation(experiment, n, BURST_S)) is not None},
            "drives": experiment.facts,
            "runs": metrics.to_dicts(),
            "step_time_us": step_times(drives[B.name], on_the_road(car, B.friction), timed),
        }
    )
    return experiment, results
