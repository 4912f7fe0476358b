"""All results of the experiment as one JSON document.

Beside the errors: residuals (Figures 10 and 19), adaptation of R (20), residual gain (21), time of a step (23).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import polars as pl

from pdhef_logtool.car.car import NETWORK_FOLDER, SHIPPED_CARS, Car
from pdhef_logtool.drive.reading import WholeDrive
from pdhef_logtool.estimators.drive_signals import DriveSignals
from pdhef_logtool.estimators.parallel_physics import filter_of
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.learning.network.residuals import residual_rows
from pdhef_logtool.learning.network.train_command import HISTORY_FILE
from pdhef_logtool.residual_model.bundle import PAPER_FOLDER, ModelBundle
from pdhef_logtool.results.run_report import tool_versions
from pdhef_logtool.runs.estimating import estimate_drive
from studies.gates.tool import Tool
from studies.paper import experiment as paper
from studies.paper.experiment import BURST, BURST_S, ESP, PAIRS, A, B, Experiment, improvement, spread

SCENARIOS = (A, B, BURST)
#: Schemes with a variable gain or factor on R.
ADAPTIVE = ("pd-hef-paper", "pd-hef")


def residual_fit(whole: WholeDrive, car: Car) -> dict[str, list[float]]:
    """Compare the residual of a drive with the output of the paper's network, features as in service.

    ``explained``: share of the residual's mean square that the output explains (1 − mean square error / mean square),
    of v_y and of the yaw rate. ``yaw_rate_increment_rad_s``: smallest and largest over one step (Eq 18).
    """
    assert isinstance(car.network, ModelBundle)
    assert car.network.paper_network is not None and whole.truth is not None
    network, period_s = car.network.paper_network, whole.plan.alignment.grid_period_s
    rows = residual_rows(whole.signals, whole.truth, filter_of(car, network.model), period_s=period_s)
    starts = np.concatenate([[True], np.diff(rows.segment) != 0])
    output, _ = network.run(rows.features, starts, None)
    use = rows.weight > 0.0
    target, output, step_s = rows.targets[use] / rows.step_s[use, None], output[use], np.median(rows.step_s[use])
    explained = 1.0 - np.mean((output - target) ** 2, axis=0) / np.mean(target**2, axis=0)
    increments = step_s * output[:, 1]
    return {
        "explained": explained.tolist(),
        "yaw_rate_increment_rad_s": [float(increments.min()), float(increments.max())],
    }


def trust_curve(experiment: Experiment, scenario: str, scheme: str, bins: int = 12) -> dict[str, Any] | None:
    """Return the median of β of a scheme in bins of the true |a_y| of equal width, and its mean.

    None for a constant gain.
    """
    ay = np.abs(experiment.truth(scenario)["ay_m_s2"].to_numpy()) / paper.GRAVITY_M_S2
    trust = paper.valid(experiment.track(scenario, scheme), "network_trust")
    use = np.isfinite(trust) & np.isfinite(ay)
    ay, trust = ay[use], trust[use]
    if not ay.size or np.ptp(trust) < 1e-9:
        return None
    edges = np.linspace(0.0, ay.max(), bins + 1)
    place = np.clip(np.digitize(ay, edges) - 1, 0, bins - 1)
    filled = [i for i in range(bins) if np.count_nonzero(place == i) >= 5]
    return {
        "centre_g": (0.5 * (edges[1:] + edges[:-1])[filled]).tolist(),
        "median": [float(np.median(trust[place == i])) for i in filled],
        "mean": float(trust.mean()),
    }


def inflation(experiment: Experiment, scheme: str, burst_s: tuple[float, float]) -> dict[str, float] | None:
    """Return the factor on R: median before the burst, without its first half second, and largest within.

    None if its R is constant.
    """
    track = experiment.track(BURST.name, scheme)
    scale, at_s = paper.valid(track, "r_scale"), paper.time_s(track)
    before, within = (
        scale[(at_s > low) & (at_s < high) & np.isfinite(scale)] for low, high in ((0.5, burst_s[0]), burst_s)
    )
    if not before.size or not within.size or np.nanmax(scale) - np.nanmin(scale) < 1e-9:
        return None
    return {"before": float(np.median(before)), "within": float(within.max())}


#: Rounds of the step times.
ROUNDS = 15


def step_times(whole: WholeDrive, car: Car, names: Sequence[str], rounds: int = ROUNDS) -> dict[str, dict[str, float]]:
    """Return median, fastest and slowest of several rounds in turns, in microseconds of processor time a step.

    The first round compiles and does not count.
    """
    schemes, corrected = [make_estimator(name, car) for name in names], DriveSignals.of(whole.signals, car)
    seconds: dict[str, list[float]] = {s.name: [] for s in schemes}
    for number in range(rounds + 1):
        for scheme in schemes:
            start = time.process_time()
            estimate_drive(whole, corrected, [scheme])
            if number:
                seconds[scheme.name].append(time.process_time() - start)
    us = 1e6 / len(whole.signals)
    return {
        name: {"median_us": us * float(np.median(taken)), "low_us": us * min(taken), "high_us": us * max(taken)}
        for name, taken in seconds.items()
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


def gather(tool: Tool, car: Car, *, noise_seeds: Sequence[int]) -> tuple[Experiment, dict[str, Any]]:
    """Run the whole experiment; return it and all results for ``results.json``.

    They are the same, but for ``step_time_us``, when they are computed again.
    """
    experiment = paper.run_experiment(tool, scenarios=SCENARIOS, noise_seeds=noise_seeds)
    metrics, scenarios, network = experiment.metrics, [s.name for s in SCENARIOS], car.network
    drives = {s.name: paper.read_log(experiment.logs[s.name], paper.on_the_road(car, s.friction)) for s in (A, B)}
    history = pl.read_parquet(SHIPPED_CARS["saloon"] / NETWORK_FOLDER / PAPER_FOLDER / HISTORY_FILE)
    summary = {
        scenario: {
            scheme: {f: of for f in paper.FIGURES if (of := spread(metrics, scenario, scheme, f)) is not None}
            for scheme in experiment.ran
        }
        for scenario in scenarios
    }
    gains = [
        {"scenario": scenario, "scheme": s, "baseline": b, **improvement(metrics, scenario, s, b)}
        for scenario in scenarios
        for s, b in PAIRS
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
            "step_time_us": step_times(drives[B.name], paper.on_the_road(car, B.friction), timed),
        }
    )
    return experiment, results
