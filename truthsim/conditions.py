"""Drives of the condition table: the same base drives, with one changed condition in each row.

See docs/method.md#evaluation.

A row that changes the car, the sensors or the road changes the ground truth; the nominal vehicle file stays. A row that
changes only inputs of the estimators (friction, sensors) reuses the drives of the row ``in-domain``; its entry in the
manifest contains the change. Recorded drives and independent simulators, the table's last rows, are not made
here.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.records.errors import UsageError
from truthsim.batch import BINS, DriveSpec, Job, run_jobs
from truthsim.manoeuvres import MANOEUVRES
from truthsim.suite import is_held_out

DURATION_S = 12.5
#: Minimum time in a bin of |a_y| over μ g for a drive to count in it.
BIN_LEAST_S = 0.3
#: Manoeuvres through all bins, for rows with one changed condition.
BASE = ("dlc", "sine-sweep", "ramp-steer", "sine-with-dwell")
BASE_SPEEDS_KM_H = (60.0, 110.0)
BASE_FRICTIONS = (0.4, 1.0)
#: Peak |a_y| over μ g of the base drives: above 0.6, so that each has samples in every bin.
BASE_PEAK_SHARES = (0.68, 0.92)
BELOW_TRAINING = (0.15, 0.25)
#: Amplitude factors to try in turn if a drive ends in a spin.
_GENTLER = (1.0, 0.9, 0.8, 0.7, 0.55, 0.4)


@dataclass(frozen=True, slots=True)
class Row:
    """One row of the table.

    Attributes
    ----------
    draw : returns a drive from a random stream, the base drive with the same number, and the number.
    assume : changed inputs of the estimators, for readers of the manifest.
    reuses : name of the row with the drives.
    """

    name: str
    description: str
    draw: Callable[[np.random.Generator, DriveSpec, int], DriveSpec] | None = None
    assume: dict[str, Any] = field(default_factory=dict)
    reuses: str | None = None


def _base(rng: np.random.Generator) -> DriveSpec:
    """Draw a drive inside the training range and outside the held-out cells."""
    while True:
        name = BASE[int(rng.integers(len(BASE)))]
        speed, friction = rng.uniform(*BASE_SPEEDS_KM_H), rng.uniform(*BASE_FRICTIONS)
        share, seed = rng.uniform(*BASE_PEAK_SHARES), int(rng.integers(2**31))
        if not is_held_out(name, speed, friction):
            return _spec(name, speed, friction, share, seed)


def _spec(name: str, speed_km_h: float, friction: float, share: float, seed: int) -> DriveSpec:
    # Four times the angle at 0.3 g reaches about 0.93 μ g.
    amplitude = share / (MANOEUVRES[name].peak_share or 0.93)
    return DriveSpec(name, round(speed_km_h, 2), round(friction, 3), seed, DURATION_S, amplitude=round(amplitude, 4))


def _same(_rng: np.random.Generator, base: DriveSpec, _index: int) -> DriveSpec:
    return base


def _held_out(rng: np.random.Generator, _base_spec: DriveSpec, _index: int) -> DriveSpec:
    while True:
        name = BASE[int(rng.integers(len(BASE)))]
        speed, friction = rng.uniform(40.0, 120.0), rng.uniform(0.3, 1.0)
        share, seed = rng.uniform(*BASE_PEAK_SHARES), int(rng.integers(2**31))
        if is_held_out(name, speed, friction):
            return _spec(name, speed, friction, share, seed)


def _standard(name: str) -> Callable[[np.random.Generator, DriveSpec, int], DriveSpec]:
    """Return the manoeuvre at its default speed and friction, with new sensor errors each time."""

    def draw(rng: np.random.Generator, _base_spec: DriveSpec, _index: int) -> DriveSpec:
        chosen = MANOEUVRES[name]
        return DriveSpec(name, chosen.speed_km_h, chosen.friction, int(rng.integers(2**31)), chosen.duration_s)

    return draw


def _fishhook(rng: np.random.Generator, _base_spec: DriveSpec, _index: int) -> DriveSpec:
    speed, friction = round(float(rng.uniform(56.0, 80.0)), 2), round(float(rng.uniform(0.5, 1.0)), 3)
    amplitude = round(float(rng.uniform(0.35, 1.0)), 4)
    return DriveSpec("fishhook", speed, friction, int(rng.integers(2**31)), DURATION_S, amplitude=amplitude)


def _slippery(rng: np.random.Generator, base: DriveSpec, _index: int) -> DriveSpec:
    friction, speed = round(float(rng.uniform(*BELOW_TRAINING)), 3), round(float(rng.uniform(40.0, 80.0)), 2)
    return replace(base, friction=friction, speed_km_h=speed)


def _banked(rng: np.random.Generator, base: DriveSpec, _index: int) -> DriveSpec:
    return replace(
        base,
        manoeuvre="banked-road",
        friction=round(float(rng.uniform(0.5, 1.0)), 3),
        amplitude=round(float(rng.uniform(1.4, 1.8)), 4),
        duration_s=20.0,
    )


def _vehicle(*texts: str) -> Callable[[np.random.Generator, DriveSpec, int], DriveSpec]:
    """Return the base drive with other cars, in turn."""
    return lambda _rng, base, index: replace(base, vehicle=texts[index % len(texts)])


def _randomised(rng: np.random.Generator, base: DriveSpec, _index: int) -> DriveSpec:
    return replace(base, vehicle=f"{base.vehicle}~{rng.integers(2**31)}")


def _fault(kind: str, *targets: str, length_s: float) -> Callable[[np.random.Generator, DriveSpec, int], DriveSpec]:
    """Return the base drive with a fault that begins somewhere in the middle."""

    def draw(rng: np.random.Generator, base: DriveSpec, _index: int) -> DriveSpec:
        start = round(float(rng.uniform(2.0, 6.0)), 2)
        faults = tuple(f"{kind}:{target}:{start:g}:{round(start + length_s, 2):g}" for target in targets)
        return replace(base, faults=faults)

    return draw


def _always(*faults: str) -> Callable[[np.random.Generator, DriveSpec, int], DriveSpec]:
    return lambda _rng, base, _index: replace(base, faults=faults)


def _biased(rng: np.random.Generator, base: DriveSpec, _index: int) -> DriveSpec:
    """Return the drive with three times the usual 1-sigma bias, of either sign, on every channel with a bias."""
    signs = rng.choice([-1.0, 1.0], size=4)
    values = zip(("ax", "ay", "yaw_rate", "steer"), (0.24, 0.24, 0.0045, 0.0024), signs.tolist(), strict=True)
    return replace(base, faults=tuple(f"bias{sign * size:g}:{name}:0:end" for name, size, sign in values))


_IN_DOMAIN = "in-domain"
#: Every row, in the order of the table.
ROWS: tuple[Row, ...] = (
    Row(_IN_DOMAIN, "inside the training range, outside the held-out cells", _same),
    Row("paper-a", "double lane change, 100 km/h, friction 0.85, with new sensor errors", _standard("dlc")),
    Row("paper-b", "sine sweep, 60 km/h, friction 0.3, with new sensor errors", _standard("sine-sweep")),
    Row("extrapolation", "cells of manoeuvre, speed and friction without training drives", _held_out),
    Row("unseen-manoeuvre", "fishhook, which only `pd-hef-paper` has in its training set", _fishhook),
    Row("low-friction", "friction 0.15 to 0.25, below the training range", _slippery),
    Row("friction-plus-20", "friction given 20 % too high", None, {"friction_factor": 1.2}, _IN_DOMAIN),
    Row("friction-minus-20", "friction given 20 % too low", None, {"friction_factor": 0.8}, _IN_DOMAIN),
    Row("friction-unknown", "friction not given", None, {"friction": "unknown"}, _IN_DOMAIN),
    Row("mass-plus-20", "mass and inertias 20 % higher", _vehicle("sedan,mass=1.2")),
    Row("cg-shift", "CG 10 cm back or forward", _vehicle("sedan,cg=0.1", "sedan,cg=-0.1")),
    Row("stiffness-plus-15", "cornering stiffness of all tyres 15 % higher", _vehicle("sedan,stiffness=1.15")),
    Row("stiffness-minus-15", "cornering stiffness of all tyres 15 % lower", _vehicle("sedan,stiffness=0.85")),
    Row("other-tyres", "tyres of the hatchback", _vehicle("sedan,tyres=hatchback")),
    Row("other-vehicle", "SUV and hatchback alternately", _vehicle("suv", "hatchback")),
    Row("randomised-vehicle", "random variants of the sedan", _randomised),
    Row("burst-5", "2.5 s of five times the noise on the whole IMU", _fault("burst5", "imu", length_s=2.5)),
    Row("burst-20", "2.5 s of twenty times the noise on the whole IMU", _fault("burst20", "imu", length_s=2.5)),
    Row("gyro-stuck", "the yaw rate repeats one value for 4 s", _fault("stuck", "yaw_rate", length_s=4.0)),
    Row("gyro-dead", "the yaw rate reads zero for 4 s", _fault("dead", "yaw_rate", length_s=4.0)),
    Row("gyro-dropped", "no yaw rate for 4 s", _fault("dropout", "yaw_rate", length_s=4.0)),
    Row("bias", "three times the usual 1-sigma bias on accelerations, yaw rate and steering", _biased),
    Row("delay-30", "all sensors arrive 30 ms later", _always("delay30:all:0:end")),
    Row("bank-and-grade", "bends banked inward, level and outward, uphill and downhill", _banked),
    Row("no-wheel-speed", "no wheel speeds", None, {"sensors": "esp"}, _IN_DOMAIN),
)
ROW_NAMES = tuple(row.name for row in ROWS)


def plan_conditions(drives: int, seed: int, rows: Sequence[str] | None = None) -> tuple[list[Job], list[Row]]:
    """Draw the drives of the named rows (all if None); return the jobs and the rows.

    A row that reuses another row's drives includes that row.

    Raises
    ------
    UsageError
        A row is unknown, or a value is out of range.
    """
    if drives < 1 or seed < 0:
        raise UsageError(
            expected="at least one drive and a seed of at least 0", got=f"{drives}, {seed}", where="conditions"
        )
    wanted = list(ROW_NAMES if rows is None else rows)
    unknown = [name for name in wanted if name not in ROW_NAMES]
    if unknown or not wanted:
        raise UsageError(expected=f"rows of {', '.join(ROW_NAMES)}", got=", ".join(unknown) or "none", where="--rows")
    chosen = [row for row in ROWS if row.name in wanted]
    needed = {row.name for row in chosen} | {row.reuses for row in chosen}
    jobs = []
    for number, row in enumerate(ROWS):
        if row.draw is None or row.name not in needed:
            continue
        for index in range(drives):
            base = _base(np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=(400, index))))
            rng = np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=(401, number, index)))
            spec = row.draw(rng, base, index)
            gentler = tuple(replace(spec, amplitude=round(spec.amplitude * share, 4)) for share in _GENTLER)
            jobs.append(Job(f"{row.name}/{index:03d}.mcap", gentler, (("row", row.name), ("index", index))))
    return jobs, chosen


def write_conditions(
    folder: Path,
    *,
    drives: int = 30,
    seed: int = 1,
    rows: Sequence[str] | None = None,
    processes: int = 1,
    progress: Callable[[str, float], None] | None = None,
) -> dict[str, Any]:
    """Write the drives of the condition table and their manifest into a folder.

    Existing files with the right content are kept.

    Raises
    ------
    UsageError : a row is unknown, or a value is out of range.
    OutputError : the folder or a file cannot be written.
    """
    jobs, chosen = plan_conditions(drives, seed, rows)
    command = f"python -m studies.conditions --drives {drives} --seed {seed}"
    head = {
        "command": command if rows is None else f"{command} --rows {','.join(row.name for row in chosen)}",
        "seed": seed,
        "drives_per_row": drives,
    }

    def table(entries: list[dict[str, Any]]) -> dict[str, Any]:
        return {"rows": [_row_entry(row, entries) for row in chosen]}

    return run_jobs(jobs, folder, head, processes=processes, progress=progress, finish=table)


def _row_entry(row: Row, entries: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the manifest entry of a row: files, changed inputs of the estimators, number of drives in each bin."""
    made = [entry for entry in entries if entry["row"] == (row.reuses or row.name) and "sha256" in entry]
    return {
        "name": row.name,
        "description": row.description,
        "assume": row.assume,
        "files": [entry["file"] for entry in made],
        "drives_in_bin": {b: sum(entry["bins_s"][b] >= BIN_LEAST_S for entry in made) for b in BINS},
    }
