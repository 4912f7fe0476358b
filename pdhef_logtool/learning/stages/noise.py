"""Stage ``noise``: filter noise by one search for all estimators (``noise.toml``), and the record of every trial."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from pdhef_logtool.car.car import NOISE_FILE, Car
from pdhef_logtool.car.parts import FilterNoise, Noise
from pdhef_logtool.car.store import Change
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.learning.drives import NOISE, DriveRecord, drives_document, no_drive, record_head
from pdhef_logtool.learning.noise.bench import Bench, choose_names
from pdhef_logtool.learning.noise.search import (
    EXPLORING_SHARE,
    FACTORS,
    FLOOR_RAD,
    MIN_AVAILABILITY,
    STEP_FIRST,
    STEP_LAST,
    DriveError,
    Score,
    Trial,
    at_an_end,
    best_trial,
    filter_tuning,
    score_drives,
    search,
)
from pdhef_logtool.learning.split import TRAINING
from pdhef_logtool.learning.stages.task import StageOutput, Task
from pdhef_logtool.results.run_report import json_bytes

FORMAT = "pdhef-tuning"
FORMAT_VERSION = 2
#: Share of the progress that reading takes.
READING = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Tuned:
    """Result of one estimator.

    ``before`` is the score of the noise that the car had, None if it had none; ``errors`` are the best
    trial's by drive.
    """

    name: str
    before: Score | None
    trials: tuple[Trial, ...]
    errors: tuple[DriveError, ...]

    @property
    def best(self) -> Trial:
        """The trial that the car gets."""
        return best_trial(self.trials)


def tune(task: Task) -> StageOutput:
    """Search the noise of the task's estimators alike, on the training drives.

    Raises
    ------
    UsageError
        An estimator cannot be tuned.
    EstimatorError
        No drive can be scored.
    """
    car, settings = task.car, task.settings
    names = choose_names(task.estimators, car)
    bench = Bench(car, task.mapping, task.options, names)
    records, drives = task.read(task.split.parts[TRAINING], bench.load, READING)
    if not drives:
        raise no_drive("a true sideslip and the signals of the estimators", NOISE)
    before = bench.score({n: car.noise[n] for n in names if n in car.noise})

    def after_trial(trial: int) -> None:
        task.reporter.progress(
            f"trial {trial} of {settings.trials}", READING + (1.0 - READING) * trial / settings.trials
        )

    def evaluate(points: Mapping[str, tuple[float, ...]]) -> dict[str, Score]:
        errors = bench.score({n: filter_tuning(values) for n, values in points.items()})
        return {n: score_drives(e) for n, e in errors.items()}

    trials = search(evaluate, names, trials=settings.trials, seed=settings.seed, progress=after_trial)
    errors = bench.score({n: filter_tuning(best_trial(trials[n]).values) for n in names})
    tuned = [Tuned(n, score_drives(before[n]) if n in before else None, trials[n], tuple(errors[n])) for n in names]
    notes = _notes(tuned)
    for note in notes:
        task.reporter.warn(note)
    figures = {"estimators": _figures(tuned), "notes": notes}
    return StageOutput(_change(task, tuned, records), records, _text(tuned), figures)


def _change(task: Task, tuned: Sequence[Tuned], records: Sequence[DriveRecord]) -> Change:
    """Return the part of the car with the record of all trials."""
    drives = [d for d in records if not d.left_out]
    noise = {**_kept(task.car), **{t.name: _noise(t, task.car) for t in tuned}}
    together = hashlib.sha256("".join(sorted(d.sha256 for d in drives)).encode()).hexdigest()
    objective = "geometric mean over drives of the sideslip RMSE, each with the floor added as squares"
    summary = {"trials": task.settings.trials, "seed": task.settings.seed, "objective": objective}
    part = Noise(filter=noise, search={**summary, "drives_sha256": together}, drives=tuple(d.learnt_on for d in drives))
    record = {
        **record_head(FORMAT, FORMAT_VERSION, task.settings, task.car),
        "search": {
            **summary,
            "space": [asdict(f) for f in FACTORS],
            "exploring_share": EXPLORING_SHARE,
            "step_shares": [STEP_FIRST, STEP_LAST],
            "floor_deg": float(f"{np.degrees(FLOOR_RAD):.6g}"),
            "min_availability": MIN_AVAILABILITY,
            "low_speed_m_s": task.car.vehicle.low_speed_blend_m_s,
        },
        "drives_sha256": together,
        **drives_document(records),
        "estimators": {t.name: _trials(t, drives) for t in tuned},
        "notes": _notes(tuned),
    }
    comments = {f"filter.{n}.q_std": "v_x, v_y, yaw rate" for n in noise}
    head = "Written by pdhef learn, stage noise. It belongs to the physics of this car: use it with no other."
    files = {
        NOISE_FILE: part_toml(part, head, comments).encode(),
        "noise.record.json": json_bytes(record),
    }
    return Change(f"learn --stages {NOISE}", NOISE_FILE, files, settings=task.settings.to_dict(), drives=part.drives)


def _text(tuned: Sequence[Tuned]) -> str:
    lines = []
    for t in tuned:
        before = "" if t.before is None else f", {t.before.objective_deg:.4f}° with the noise that the car had"
        score = f"{t.best.score.objective_deg:.4f}° on the training drives"
        lines.append(f"{t.name}: best of {len(t.trials)} trials {score}{before}")
    return "; ".join(lines)


def _noise(tuned: Tuned, car: Car) -> FilterNoise:
    """Return the noise of the best trial with what it belongs to."""
    return filter_tuning(tuned.best.values).model_copy(
        update={
            "physics_sha256": car.physics_of(tuned.name),
            "score_deg": round(tuned.best.score.objective_deg, 4),
            "trial": tuned.best.number,
        }
    )


def _kept(car: Car) -> dict[str, FilterNoise]:
    """Return the noise of an earlier search; its scores are not those of the same drives and are dropped.

    Noise without a trial is the fit's or a person's: it stays where it is.
    """
    searched = {name: noise for name, noise in car.noise.items() if noise.trial is not None}
    return {name: noise.model_copy(update={"score_deg": None}) for name, noise in searched.items()}


def _named(values: Sequence[float]) -> dict[str, float]:
    return {f.name: v for f, v in zip(FACTORS, values, strict=True)}


def _notes(tuned: Sequence[Tuned]) -> list[str]:
    notes = []
    for t in tuned:
        if ends := at_an_end(t.best):
            notes.append(f"{t.name}: the best {', '.join(ends)} is at an end of the search space")
        if t.before is not None and t.before.objective_deg < t.best.score.objective_deg:
            notes.append(
                f"{t.name}: the noise that the car had is better on these drives "
                f"({t.before.objective_deg:.4f} deg) than all trials: give more --trials"
            )
    return notes


def _figures(tuned: Sequence[Tuned]) -> dict[str, Any]:
    return {
        t.name: {
            "trials": len(t.trials),
            "best_trial": t.best.number,
            "values": _named(t.best.values),
            "score": asdict(t.best.score),
            "before": None if t.before is None else asdict(t.before),
        }
        for t in tuned
    }


def _trials(tuned: Tuned, drives: Sequence[DriveRecord]) -> dict[str, Any]:
    return {
        "best_trial": tuned.best.number,
        "before": None if tuned.before is None else asdict(tuned.before),
        "rmse_deg": {
            d.name: None if e.scored == 0 else float(np.degrees(e.rmse_rad))
            for d, e in zip(drives, tuned.errors, strict=True)
        },
        "trials": [
            {"trial": x.number, "stage": x.stage, "values": _named(x.values), **asdict(x.score)} for x in tuned.trials
        ],
    }
