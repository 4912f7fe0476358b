"""Training drives of the paper's network as in its section 3.1.3: 200 drives of 12.5 s, 250,000 samples.

Manoeuvres: double lane change, sine sweeps within 0.5 to 2 Hz, fishhook and step steer, in equal shares; 40 to 120 km/h
and friction 0.3 to 1.0, both uniform; 70 % training, 15 % validation and 15 % test drives. The cells of manoeuvre,
speed and friction that the condition table holds out are excluded. Only ``pd-hef-paper`` is trained on a fishhook.
"""

from pathlib import Path

import numpy as np

from truthsim.batch import DriveSpec, Job, run_jobs
from truthsim.manoeuvres import MANOEUVRES
from truthsim.suite import FRICTIONS, PEAK_SHARES, SHARES, SPEEDS_KM_H, SPLITS, is_held_out

SEED = 4000
COUNT, DURATION_S = 200, 12.5
#: The two sweeps share one quarter of the drives: one grows to the limit at 0.6 to 1 Hz, one covers 0.5 to 2 Hz.
MANOEUVRE_CYCLE = ("dlc", "sine-sweep", "fishhook", "step-steer", "dlc", "sine-sweep-wide", "fishhook", "step-steer")
#: Factor on the angle of NHTSA's fishhook.
FISHHOOK_AMPLITUDES = (0.35, 1.0)
#: Number of draws for a drive, as drives with a spin are rejected.
ATTEMPTS = 6


def _draw(rng: np.random.Generator, manoeuvre: str) -> DriveSpec:
    while True:
        speed, friction = float(rng.uniform(*SPEEDS_KM_H)), float(rng.uniform(*FRICTIONS))
        if manoeuvre not in SHARES or not is_held_out(manoeuvre, speed, friction):
            break
    goal = MANOEUVRES[manoeuvre].peak_share
    amplitude = float(rng.uniform(*FISHHOOK_AMPLITUDES) if goal is None else rng.uniform(*PEAK_SHARES) / goal)
    drawn = round(speed, 2), round(friction, 3), int(rng.integers(2**31))
    return DriveSpec(manoeuvre, *drawn, DURATION_S, amplitude=round(amplitude, 4))


def plan_drives() -> list[Job]:
    """Return the drives."""
    jobs = []
    limits = np.cumsum([share for _, share in SPLITS])
    for index in range(COUNT):
        rng = np.random.default_rng(np.random.SeedSequence(entropy=SEED, spawn_key=(index,)))
        split = SPLITS[int(np.searchsorted(limits[:-1], rng.uniform(), side="right"))][0]
        manoeuvre = MANOEUVRE_CYCLE[index % len(MANOEUVRE_CYCLE)]
        candidates = tuple(_draw(rng, manoeuvre) for _ in range(ATTEMPTS))
        jobs.append(Job(f"drive_{index:05d}.mcap", candidates, (("index", index), ("split", split))))
    return jobs


def write_drives(folder: Path, *, processes: int) -> None:
    """Write the drives and their manifest; drives that exist are kept."""
    head = {"command": "python -m studies.defaults.train_default --steps simulate", "seed": SEED, "count": COUNT}
    run_jobs(plan_drives(), folder, head, processes=processes)
