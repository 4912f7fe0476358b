"""Simulate the paper's two manoeuvres, run every scheme on them and score it, as ``pdhef run`` would.

A drive is written as an MCAP file and read back by the tool's own path: recognised mapping, alignment, the estimators
of the registry on aligned signals, the metrics of :mod:`pdhef_logtool.evaluation.metrics`. Friction is known: the
vehicle file is told that of the drive. Noise seeds change the sensors alone; training seeds change the network alone.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pdhef_logtool.car.vehicle import Network, VehicleParameters
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.drive.windows import DriveWindow
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.evaluation.metrics import MetricRow, score_track
from pdhef_logtool.evaluation.segments import segment_masks
from pdhef_logtool.records.signals import Signals, join_signals
from pdhef_logtool.records.tracks import StateTrack, concatenate
from pdhef_logtool.residual_model.bundle import ModelBundle
from studies.paper.schemes import SCHEMES, schemes_for
from truthsim.drive import Drive, simulate_drive, write_drive
from truthsim.faults import parse_fault
from truthsim.manoeuvres import MANOEUVRES

GRAVITY_M_S2 = 9.80665
#: Sensor errors of the reported drives; sample logs have seeds of one digit, tuning drives from 1000 on.
FIRST_NOISE_SEED = 52_001
NOISE_SEEDS = 8


@dataclass(frozen=True, slots=True)
class Scenario:
    """One manoeuvre of the paper at the catalogue's own speed and friction; ``faults`` as the command line has them."""

    name: str
    manoeuvre: str
    title: str
    faults: tuple[str, ...] = ()

    @property
    def speed_km_h(self) -> float:
        """Speed of the manoeuvre."""
        return MANOEUVRES[self.manoeuvre].speed_km_h

    @property
    def friction(self) -> float:
        """Friction of the road."""
        return MANOEUVRES[self.manoeuvre].friction


#: The burst covers both lane changes of A.
BURST_S = (2.5, 5.0)
A = Scenario("A", "dlc", "double lane change")
B = Scenario("B", "sine-sweep", "sine sweep")
BURST = Scenario(
    "A-burst", "dlc", "double lane change with a noise burst", (f"burst20:imu:{BURST_S[0]:g}:{BURST_S[1]:g}",)
)


@dataclass(frozen=True, slots=True, eq=False)
class ReadDrive:
    """A drive as the estimators see it.

    Attributes
    ----------
    windows : of the reading path; signals and truth at the same stamps.
    vehicle : the vehicle file with the friction of the drive.
    facts : of the simulated drive, JSON-able; ``truth_latency_s`` is what the comparison took off.
    """

    scenario: Scenario
    noise_seed: int
    vehicle: VehicleParameters
    windows: tuple[DriveWindow, ...]
    period_s: float
    available: frozenset[str]
    not_independent: dict[str, str]
    facts: dict[str, object]

    @property
    def signals(self) -> Signals:
        """All windows' signals."""
        return join_signals([w.signals for w in self.windows])

    @property
    def truth(self) -> StateTrack:
        """All windows' truth."""
        return concatenate([w.truth for w in self.windows if w.truth is not None])


@dataclass(frozen=True, slots=True)
class Run:
    """Figures of one scheme on one drive; ``training_seed`` is None for a scheme without a network."""

    scenario: str
    noise_seed: int
    scheme: str
    training_seed: int | None
    values: dict[str, float]


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """A trained network, the seed of its training, and how far it may be trusted on which evidence (``pdhef trust``).

    ``trust`` is that of the vehicle file beside it; None leaves what the nominal vehicle file says.
    """

    seed: int
    bundle: ModelBundle
    trust: Network | None = None

    def on(self, vehicle: VehicleParameters) -> VehicleParameters:
        """Return a vehicle file with the evidence about this network."""
        return vehicle if self.trust is None else vehicle.model_copy(update={"network": self.trust})


@dataclass(frozen=True, slots=True, eq=False)
class Experiment:
    """Everything that was run.

    Attributes
    ----------
    missing : by scheme, why it is not in the tables.
    networks : schemes that depend on the network.
    tracks : of the first noise seed and first model, by scenario and scheme.
    drives : of the first noise seed, by scenario.
    """

    runs: tuple[Run, ...]
    missing: dict[str, str]
    networks: frozenset[str]
    drives: dict[str, ReadDrive]
    tracks: dict[tuple[str, str], StateTrack]
    facts: tuple[dict[str, object], ...]


#: Figure by name: signal, segment, metric, factor to the unit of the tables.
FIGURES: dict[str, tuple[str, str, str, float]] = {
    "sideslip_deg": ("sideslip_rad", "all", "rmse", math.degrees(1.0)),
    "sideslip_relative": ("sideslip_rad", "all", "rmse_relative", 1.0),
    "sideslip_nonlinear_deg": ("sideslip_rad", "nonlinear", "rmse", math.degrees(1.0)),
    "vy_m_s": ("vy_m_s", "all", "rmse", 1.0),
    "vy_relative": ("vy_m_s", "all", "rmse_relative", 1.0),
    "yaw_rate_rad_s": ("yaw_rate_rad_s", "all", "rmse", 1.0),
    "yaw_rate_relative": ("yaw_rate_rad_s", "all", "rmse_relative", 1.0),
    "ay_g": ("ay_m_s2", "all", "rmse", 1.0 / GRAVITY_M_S2),
    "ay_relative": ("ay_m_s2", "all", "rmse_relative", 1.0),
    "position_m": ("position_m", "all", "rmse", 1.0),
    "lateral_1s_m": ("lateral_1s_m", "all", "rmse", 1.0),
    "sideslip_lag_ms": ("sideslip_rad", "all", "lag_s", 1e3),
    "yaw_rate_lag_ms": ("yaw_rate_rad_s", "all", "lag_s", 1e3),
    "diverged": ("state", "all", "diverged", 1.0),
}
#: Largest |value| of the estimate over that of the truth, less 1: what the paper calls overshoot.
OVERSHOOTS = {"sideslip_overshoot": "sideslip_rad", "ay_overshoot": "ay_m_s2"}


def simulate(scenario: Scenario, noise_seed: int) -> Drive:
    """Drive a scenario with the sensor errors of a seed."""
    return simulate_drive(scenario.manoeuvre, seed=noise_seed, faults=[parse_fault(f) for f in scenario.faults])


def read_simulated(scenario: Scenario, noise_seed: int, nominal: VehicleParameters) -> ReadDrive:
    """Simulate a drive, write it as a log and read it as ``pdhef run`` does."""
    drive = simulate(scenario, noise_seed)
    vehicle = nominal.model_copy(update={"friction": drive.friction})
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        write_drive(drive, path)
        with read_drive(path, vehicle, options=ReadOptions(friction=None)) as read:
            plan = read.plan
            windows = tuple(w for w in read.windows() if len(w.signals))
    facts = {
        "scenario": scenario.name,
        "noise_seed": noise_seed,
        "command": drive.command,
        "duration_s": drive.duration_s,
        "peak_ay_g": drive.peak_ay_m_s2 / GRAVITY_M_S2,
        "peak_sideslip_deg": math.degrees(drive.peak_sideslip_rad),
        "truth_latency_ms": 1e3 * plan.truth_latency_s,
        "friction": drive.friction,
        "notes": list(drive.notes),
    }
    return ReadDrive(
        scenario,
        noise_seed,
        vehicle,
        windows,
        plan.alignment.grid_period_s,
        plan.alignment.available,
        plan.dependent,
        facts,
    )


def estimate(estimator: Estimator, drive: ReadDrive) -> StateTrack:
    """Run an estimator over a drive, window by window."""
    tracks, carry = [], None
    for window in drive.windows:
        track, carry = estimator.run(window.signals, carry)
        tracks.append(track)
    return concatenate(tracks)


def figures_of(track: StateTrack, drive: ReadDrive) -> dict[str, float]:
    """Score a track; the figures of ``FIGURES`` and ``OVERSHOOTS`` that it has."""
    truth = drive.truth
    rows = score_track(
        track,
        truth,
        segment_masks(drive.signals, truth, drive.vehicle),
        log=drive.scenario.name,
        low_speed_m_s=drive.vehicle.low_speed_blend_m_s,
        not_independent=drive.not_independent,
    )
    by_key: dict[tuple[str, str, str], MetricRow] = {(r.signal, r.segment, r.metric): r for r in rows}
    values = {
        name: factor * by_key[signal, segment, metric].value
        for name, (signal, segment, metric, factor) in FIGURES.items()
        if (signal, segment, metric) in by_key
    }
    for name, signal in OVERSHOOTS.items():
        theirs, real = np.abs(getattr(track, signal)[track.valid]), np.abs(getattr(truth, signal))
        if np.isfinite(theirs).any():
            values[name] = float(np.nanmax(theirs) / np.nanmax(real) - 1.0)
    return {name: value for name, value in values.items() if math.isfinite(value)}


def run_experiment(
    nominal: VehicleParameters,
    models: Sequence[Model],
    *,
    scenarios: Iterable[Scenario] = (A, B, BURST),
    noise_seeds: Sequence[int] = tuple(range(FIRST_NOISE_SEED, FIRST_NOISE_SEED + NOISE_SEEDS)),
    names: Sequence[str] = tuple(SCHEMES),
    progress: Callable[[str], None] = lambda _text: None,
) -> Experiment:
    """Run the schemes on all scenarios with all sensor noise seeds and all networks.

    Parameters
    ----------
    nominal : vehicle file; its friction is replaced by that of each drive.
    models : without any, the drives alone are made.
    """
    runs: list[Run] = []
    drives: dict[str, ReadDrive] = {}
    tracks: dict[tuple[str, str], StateTrack] = {}
    facts: list[dict[str, object]] = []
    missing: dict[str, str] = {}
    networks: set[str] = set()
    for scenario in scenarios:
        for noise_seed in noise_seeds:
            drive = read_simulated(scenario, noise_seed, nominal)
            facts.append(drive.facts)
            first_drive = scenario.name not in drives
            drives.setdefault(scenario.name, drive)
            for model in models:
                schemes, skipped = schemes_for(names, model.on(drive.vehicle), drive.available, model.bundle)
                missing.update(skipped)
                networks.update(s.name for s in schemes if s.uses_network)
                for scheme in schemes:
                    if model is not models[0] and not scheme.uses_network:
                        continue
                    track = estimate(scheme.estimator, drive)
                    seed = model.seed if scheme.uses_network else None
                    runs.append(Run(scenario.name, noise_seed, scheme.name, seed, figures_of(track, drive)))
                    if first_drive and model is models[0]:
                        tracks[scenario.name, scheme.name] = track
            progress(f"scenario {scenario.name}, noise seed {noise_seed}")
    return Experiment(tuple(runs), missing, frozenset(networks), drives, tracks, tuple(facts))
