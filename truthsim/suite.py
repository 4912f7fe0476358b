"""A training set of any size from one seed: manoeuvre, speed, friction, amplitude and vehicle drawn drive by drive.

Each drive has a random stream by its number, so that it depends neither on the size of the set nor on the number of
processes. ``fishhook`` is excluded: it is the unseen manoeuvre of the condition table; the paper's network has a set of
its own with it. Cells of manoeuvre × speed × friction at the edge of the range are marked ``extrapolation`` and never
used for training.
"""

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.records.errors import UsageError
from truthsim.batch import DriveSpec, Job, run_jobs
from truthsim.drive import DEFAULT_VEHICLE
from truthsim.manoeuvres import MANOEUVRES

#: Probability of each manoeuvre.
SHARES: dict[str, float] = {
    "dlc": 0.18,
    "dlc-3888-2": 0.05,
    "sine-sweep": 0.16,
    "sine-sweep-wide": 0.06,
    "sine-with-dwell": 0.12,
    "step-steer": 0.09,
    "ramp-steer": 0.07,
    "brake-in-turn": 0.06,
    "mu-jump": 0.05,
    "banked-road": 0.06,
    "stop-and-go": 0.02,
    "road": 0.08,
}
SPEEDS_KM_H = (40.0, 120.0)
FRICTIONS = (0.3, 1.0)
#: Edges of the cells.
SPEED_EDGES_KM_H = (40.0, 60.0, 80.0, 100.0, 120.0)
FRICTION_EDGES = (0.3, 0.5, 0.7, 0.85, 1.0)
#: Range of the peak |a_y| over μ g of scaled manoeuvres.
PEAK_SHARES = (0.2, 0.97)
#: Factor on the standard's angle, or on the course.
AMPLITUDES: dict[str, tuple[float, float]] = {
    "dlc-3888-2": (0.4, 1.0),
    "sine-with-dwell": (0.25, 1.2),
    "banked-road": (0.5, 1.5),
    "mu-jump": (0.4, 1.2),
    "brake-in-turn": (0.4, 1.3),
    "stop-and-go": (1.0, 1.0),
    "road": (1.0, 1.0),
}
#: Highest speed of manoeuvres with a speed limit.
_TOP_KM_H = {"dlc-3888-2": 70.0, "stop-and-go": 60.0}
#: Held-out edge cells (speed, friction), by manoeuvre in turn: fast and slippery, slow and grippy, and so on.
_EDGES = (((3, 0), (2, 0)), ((0, 3), (0, 2)), ((3, 3), (3, 2)), ((0, 0), (1, 0)))
SPLITS = (("train", 0.70), ("validation", 0.15), ("test", 0.15))
VEHICLE_CHOICES = ("default", "randomised")
#: Maximum number of draws for a drive, as drives with a spin are rejected.
_ATTEMPTS = 6


def cell_of(speed_km_h: float, friction: float) -> tuple[int, int]:
    """Return the numbers of the speed bin and of the friction bin of a drive."""
    speed = int(np.clip(np.searchsorted(SPEED_EDGES_KM_H, speed_km_h, side="right") - 1, 0, 3))
    grip = int(np.clip(np.searchsorted(FRICTION_EDGES, friction, side="right") - 1, 0, 3))
    return speed, grip


def is_held_out(manoeuvre: str, speed_km_h: float, friction: float) -> bool:
    """Return whether a drive is in a cell of the extrapolation test; the cells do not depend on the seed."""
    return cell_of(speed_km_h, friction) in _EDGES[list(SHARES).index(manoeuvre) % len(_EDGES)]


def draw_spec(rng: np.random.Generator, *, duration_s: float, vehicle: str = DEFAULT_VEHICLE) -> DriveSpec:
    """Draw one drive."""
    names = list(SHARES)
    manoeuvre = names[int(rng.choice(len(names), p=np.array(list(SHARES.values())) / sum(SHARES.values())))]
    speed = rng.uniform(SPEEDS_KM_H[0], min(SPEEDS_KM_H[1], _TOP_KM_H.get(manoeuvre, np.inf)))
    friction = rng.uniform(*FRICTIONS)
    chosen = MANOEUVRES[manoeuvre]
    if manoeuvre in AMPLITUDES or chosen.peak_share is None:
        amplitude = rng.uniform(*AMPLITUDES[manoeuvre])
    else:
        amplitude = rng.uniform(*PEAK_SHARES) / chosen.peak_share
    return DriveSpec(
        manoeuvre=manoeuvre,
        speed_km_h=round(float(speed), 2),
        friction=round(float(friction), 3),
        seed=int(rng.integers(2**31)),
        duration_s=duration_s,
        amplitude=round(float(amplitude), 4),
        vehicle=vehicle,
    )


def plan_suite(count: int, seed: int, *, vehicles: str = "default", duration_s: float = 12.5) -> list[Job]:
    """Draw the drives of a suite.

    Raises
    ------
    UsageError
        A value is out of range.
    """
    if count < 1 or seed < 0 or not 3.0 <= duration_s <= 3600.0:
        raise UsageError(
            expected="a count of at least 1, a seed of at least 0, and drives of 3 to 3600 s",
            got=f"count {count}, seed {seed}, {duration_s:g} s",
            where="suite",
        )
    if vehicles not in VEHICLE_CHOICES:
        raise UsageError(expected=" or ".join(VEHICLE_CHOICES), got=repr(vehicles), where="--vehicles")
    jobs = []
    for index in range(count):
        rng = np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=(300, index)))
        vehicle = DEFAULT_VEHICLE if vehicles == "default" else f"{DEFAULT_VEHICLE}~{rng.integers(2**31)}"
        place = float(rng.uniform())
        candidates = [draw_spec(rng, duration_s=duration_s, vehicle=vehicle)]
        held_out = _held_out(candidates[0])
        # A replacement for a drive with a spin must be on the same side of the held-out border.
        while len(candidates) < _ATTEMPTS:
            spec = draw_spec(rng, duration_s=duration_s, vehicle=vehicle)
            if _held_out(spec) == held_out:
                candidates.append(spec)
        split = "extrapolation" if held_out else _split(place)
        jobs.append(Job(f"drive_{index:05d}.mcap", tuple(candidates), (("index", index), ("split", split))))
    return jobs


def _held_out(spec: DriveSpec) -> bool:
    return is_held_out(spec.manoeuvre, spec.speed_km_h, spec.friction)


def _split(place: float) -> str:
    limit = 0.0
    for name, share in SPLITS:
        limit += share
        if place < limit:
            return name
    return SPLITS[-1][0]


def write_suite(
    folder: Path,
    *,
    count: int,
    seed: int,
    vehicles: str = "default",
    duration_s: float = 12.5,
    processes: int = 1,
    progress: Callable[[str, float], None] | None = None,
) -> dict[str, Any]:
    """Write a suite and its manifest to a folder; existing files with the right content are kept.

    Raises
    ------
    UsageError : a value is out of range.
    OutputError : the folder or a file cannot be written.
    """
    jobs = plan_suite(count, seed, vehicles=vehicles, duration_s=duration_s)
    command = f"pdhef simulate suite --count {count} --seed {seed} --duration {duration_s:g}"
    head = {
        "command": command if vehicles == "default" else f"{command} --vehicles {vehicles}",
        "seed": seed,
        "count": count,
        "vehicles": vehicles,
        "duration_s": duration_s,
        "held_out_cells": {
            name: [
                {"speed_km_h": SPEED_EDGES_KM_H[s : s + 2], "friction": FRICTION_EDGES[f : f + 2]}
                for s, f in _EDGES[i % len(_EDGES)]
            ]
            for i, name in enumerate(SHARES)
        },
    }
    return run_jobs(jobs, folder, head, processes=processes, progress=progress, finish=_totals)


def _totals(entries: list[dict[str, Any]]) -> dict[str, Any]:
    made = [entry for entry in entries if "sha256" in entry]
    return {
        "splits": dict(sorted(Counter(entry["split"] for entry in made).items())),
        "written": len(made),
        "dropped_draws": sum(len(entry["dropped"]) for entry in entries),
    }
