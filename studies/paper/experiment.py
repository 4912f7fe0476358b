"""Simulate the paper's two manoeuvres, run every scheme on them by ``pdhef run``, and read its tables.

The runs get the friction of the drive. Noise seeds change the sensors alone.
"""

import math
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import WholeDrive, read_drive
from pdhef_logtool.records.geometry import GRAVITY_M_S2
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.residual_model.bundle import ModelBundle
from studies.gates.tool import Tool, estimates, metrics
from studies.paper.schemes import ESP, SCHEMES
from truthsim.drive import Drive, simulate_drive, write_drive
from truthsim.faults import parse_fault
from truthsim.manoeuvres import MANOEUVRES, Manoeuvre

#: Sensor errors of the reported drives. No training or tuning set has these seeds: sample logs have seeds of one digit,
#: the sets of the shipped car are drawn from seeds 1000 to 4000.
FIRST_NOISE_SEED = 61_001
NOISE_SEEDS = 5


@dataclass(frozen=True, slots=True)
class Scenario:
    """One manoeuvre of the paper; ``faults`` as the command line has them."""

    name: str
    manoeuvre: str
    title: str
    faults: tuple[str, ...] = ()

    @property
    def driven(self) -> Manoeuvre:
        """Manoeuvre of the simulator, with its speed and the friction of the road."""
        return MANOEUVRES[self.manoeuvre]


#: The burst covers both lane changes of A.
BURST_S = (2.5, 5.0)
A = Scenario("A", "dlc", "double lane change")
B = Scenario("B", "sine-sweep", "sine sweep")
BURST = Scenario(
    "A-burst", "dlc", "double lane change with a noise burst", (f"burst20:imu:{BURST_S[0]:g}:{BURST_S[1]:g}",)
)
SCENARIO_PAIR = (A, B)


#: Figure by name: signal, metric, factor to the unit of the tables.
FIGURES: dict[str, tuple[str, str, float]] = {
    "sideslip_deg": ("sideslip_rad", "rmse", math.degrees(1.0)),
    "sideslip_relative": ("sideslip_rad", "rmse_relative", 1.0),
    "yaw_rate_rad_s": ("yaw_rate_rad_s", "rmse", 1.0),
    "ay_g": ("ay_m_s2", "rmse", 1.0 / GRAVITY_M_S2),
    "position_m": ("position_m", "rmse", 1.0),
    "lateral_1s_m": ("lateral_1s_m", "rmse", 1.0),
}


@dataclass(slots=True)
class Experiment:
    """Everything that was run.

    Attributes
    ----------
    metrics : scenario, noise seed, scheme, figure and its value.
    logs, tracks : log and ``estimates.parquet`` of the first noise seed, by scenario.
    facts : of the simulated drives, JSON-able.
    """

    metrics: pl.DataFrame
    logs: dict[str, Path] = field(default_factory=dict)
    tracks: dict[str, pl.DataFrame] = field(default_factory=dict)
    facts: list[dict[str, Any]] = field(default_factory=list)

    def truth(self, scenario: str) -> pl.DataFrame:
        """Return the ground truth of the first noise seed."""
        return self.tracks[scenario].filter(estimator="truth").sort("stamp_ns")

    def track(self, scenario: str, scheme: str) -> pl.DataFrame:
        """Return the estimate of a scheme at the stamps of the ground truth."""
        own = self.tracks[scenario].filter(estimator=scheme)
        return self.truth(scenario).select("stamp_ns").join(own, on="stamp_ns", how="left", maintain_order="left")


def valid(track: pl.DataFrame, column: str) -> FloatArray:
    """Return a column of a track [N], NaN where it must not be used."""
    return np.where(track["valid"].fill_null(False).to_numpy(), track[column].to_numpy(), np.nan)


def time_s(track: pl.DataFrame) -> FloatArray:
    """Return the time of a track [N] from its first stamp."""
    stamps = track["stamp_ns"].to_numpy()
    return np.asarray((stamps - stamps[0]) * 1e-9)


def on_the_road(car: Car, friction: float) -> Car:
    """Return a car with the friction of a drive; all else, including the residual gain, is unchanged."""
    changed = {"friction": friction}
    vehicle, physics = car.vehicle.model_copy(update=changed), car.fitted_physics
    if physics is not None:
        values = physics.values.model_copy(update=changed)
        physics = physics.model_copy(update={"values": values})
    gain = car.residual_gain
    return replace(car, vehicle=vehicle, network_gain=gain, fitted_physics=physics)


def paper_network(car: Car) -> ModelBundle:
    """Return the network of the paper's filter of a shipped car."""
    assert isinstance(car.network, ModelBundle) and car.network.paper_network is not None
    return car.network.paper_network


def read_log(log: Path, car: Car) -> WholeDrive:
    """Read a simulated log without its friction, mapped by recognition."""
    with read_drive(log, car, options=ReadOptions(friction=None)) as read:
        return read.whole()


def as_logged(drive: Drive, car: Car) -> WholeDrive:
    """Return a simulated drive as the estimators see it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        write_drive(drive, path)
        return read_log(path, car)


def run_experiment(
    tool: Tool,
    *,
    scenarios: Iterable[Scenario] = (A, B, BURST),
    noise_seeds: Sequence[int] = tuple(range(FIRST_NOISE_SEED, FIRST_NOISE_SEED + NOISE_SEEDS)),
    names: Sequence[str] = SCHEMES,
) -> Experiment:
    """Run the schemes on all scenarios with all noise seeds; names may end in ``ESP``."""
    done, rows = Experiment(pl.DataFrame()), list[dict[str, Any]]()
    for scenario, seed in product(scenarios, noise_seeds):
        drive = simulate_drive(scenario.manoeuvre, seed=seed, faults=[parse_fault(f) for f in scenario.faults])
        log = tool.log(f"{scenario.name}-{seed}", drive)
        about = {"scenario": scenario.name, "noise_seed": seed}
        peak_deg = math.degrees(drive.peak_sideslip_rad)
        facts = {"peak_ay_g": drive.peak_ay_m_s2 / GRAVITY_M_S2, "peak_sideslip_deg": peak_deg}
        done.facts.append(about | {"duration_s": drive.duration_s} | facts)
        tracks = []
        for end, sensors in (("", "full"), (ESP, "esp")):
            chosen = [n.removesuffix(ESP) for n in names if n.endswith(ESP) == bool(end)]
            given = ["--car", "saloon", "--friction", str(drive.friction), "--set", f"sensors={sensors}"]
            given += ["--keep", "estimates", "--estimators", ",".join(chosen)]
            folder = tool.run(f"{log.stem}-{sensors}", log, *given)
            wanted = pl.col("estimator").is_in(chosen if end else [*chosen, "truth"])
            tracks.append(estimates(folder).filter(wanted).with_columns(pl.col("estimator").cast(pl.String) + end))
            scores = metrics(folder).filter(wanted, pl.col("value").is_finite())
            for name, (signal, metric, factor) in FIGURES.items():
                found = scores.filter(signal=signal, metric=metric).select("estimator", "value")
                for scheme, value in found.iter_rows():
                    rows.append(about | {"scheme": f"{scheme}{end}", "figure": name, "value": factor * value})
        if scenario.name not in done.logs:
            done.logs[scenario.name], done.tracks[scenario.name] = log, pl.concat(tracks)
    done.metrics = pl.DataFrame(rows)
    return done


# ------------------------------------------------------------------------------------------------ comparison

BOOTSTRAP_DRAWS = 10_000
BOOTSTRAP_SEED = 0
LEVEL = 0.95


def spread(metrics: pl.DataFrame, scenario: str, scheme: str, figure: str) -> dict[str, Any] | None:
    """Return median, lowest and highest of a figure over the seeds; None where the scheme has no such figure."""
    values = metrics.filter(scenario=scenario, scheme=scheme, figure=figure)["value"].to_numpy()
    if not len(values):
        return None
    return {"median": float(np.median(values)), "low": min(values), "high": max(values), "n": len(values)}


def improvement(metrics: pl.DataFrame, scenario: str, scheme: str, baseline: str) -> dict[str, Any]:
    """Return the relative reduction of the sideslip RMSE, pooled over the seeds.

    Its bounds are those of a bootstrap in which seeds are drawn in pairs; NaN with fewer than two.
    """
    of = metrics.filter(scenario=scenario, figure="sideslip_deg")
    ours, theirs = (of.filter(scheme=name).select("noise_seed", "value") for name in (scheme, baseline))
    both = ours.join(theirs, on="noise_seed", suffix="_baseline").sort("noise_seed")
    squares = both.select("value", "value_baseline").to_numpy() ** 2

    def share(sums: np.ndarray) -> np.ndarray:
        return np.asarray(1.0 - np.sqrt(sums[..., 0] / sums[..., 1]))

    low = high = float("nan")
    if len(squares) > 1:
        draws = np.random.default_rng(BOOTSTRAP_SEED).integers(len(squares), size=(BOOTSTRAP_DRAWS, len(squares)))
        bounds = np.percentile(share(squares[draws].sum(axis=1)), [50.0 * (1.0 - LEVEL), 50.0 * (1.0 + LEVEL)])
        low, high = map(float, bounds)
    return {"value": float(share(squares.sum(axis=0))), "low": low, "high": high, "n": len(squares)}
