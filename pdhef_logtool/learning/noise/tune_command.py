"""``pdhef tune`` from logs to a car with tuned filter noise, the record of every trial, and a plot."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import NOISE_FILE, Car
from pdhef_logtool.car.parts import FilterNoise, Noise
from pdhef_logtool.car.store import Change, update_car
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.drive.reading import Tell
from pdhef_logtool.learning.drives import (
    DriveRecord,
    LearnResult,
    LearnSettings,
    Refusal,
    check_file_output,
    choose_drives,
    drives_document,
    no_drive,
    open_car,
    open_mapping,
    record_head,
    tell_drive,
)
from pdhef_logtool.learning.noise.search import (
    EXPLORING_SHARE,
    FACTORS,
    FLOOR_RAD,
    MIN_AVAILABILITY,
    MIN_TRIALS,
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
from pdhef_logtool.learning.noise.tune_drives import Benches, TuneSetup, choose_names
from pdhef_logtool.learning.plots import new_figure, png_bytes
from pdhef_logtool.logs.discovery import Logs
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.outputs import local_path
from pdhef_logtool.sinks.report import json_bytes

FORMAT = "pdhef-tuning"
FORMAT_VERSION = 2
#: Splits of a set that figures are reported on: noise that was tuned there would make them worthless.
HELD_OUT = ("test", "extrapolation")
DEFAULT_TRIALS = 128
#: Share of the progress that reading takes.
READING = 0.2
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")

#: Drives that this command refuses.
REFUSED = Refusal(
    HELD_OUT,
    "drives that no figure is reported on",
    "tune",
    "noise tuned on drives of the test makes the test's figures too good: take --split validation, or say --any-split",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class TuneSettings(LearnSettings):
    """With ``names`` of the estimators (None = all that are usually tuned), and ``trials`` of each."""

    names: tuple[str, ...] | None = None
    trials: int = DEFAULT_TRIALS


@dataclass(frozen=True, slots=True, eq=False)
class Tuned:
    """What came out for one estimator.

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


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class TuneResult(LearnResult):
    """What the command found and wrote."""

    tuned: tuple[Tuned, ...]
    notes: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        return {
            **super(TuneResult, self).to_dict(),
            "estimators": {
                t.name: {
                    "trials": len(t.trials),
                    "best_trial": t.best.number,
                    "values": _named(t.best.values),
                    "score": asdict(t.best.score),
                    "before": None if t.before is None else asdict(t.before),
                }
                for t in self.tuned
            },
            "notes": list(self.notes),
        }


def tune(
    arguments: Logs,
    output: Path | str,
    settings: TuneSettings,
    *,
    jobs: int = 1,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
    warn: Tell = lambda _text: None,
) -> TuneResult:
    """Tune the noise of estimators alike; write them to the car ``output`` with a record of all trials and its plot.

    Parameters
    ----------
    arguments : logs, folders, glob patterns. jobs : processes; they change no number.

    Raises
    ------
    UsageError
        An option is wrong, or drives are held out by their set.
    PdhefError
        A file or log cannot be read: an absent drive would change the result unnoticed.
    EstimatorError
        No drive can be scored.
    """
    output = local_path(output)
    config = settings.config
    if settings.trials < MIN_TRIALS:
        raise UsageError(expected=f"at least {MIN_TRIALS} trials", got=str(settings.trials), where="--trials")
    if jobs < 1:
        raise UsageError(expected="at least one process", got=str(jobs), where="--jobs")
    car = open_car(config, output, warn)
    names = choose_names(settings.names, car)
    inputs, splits = choose_drives(arguments, settings, REFUSED)
    check_file_output(inputs, config, output)
    setup = TuneSetup(config, car, open_mapping(config), names)
    with Benches(setup, min(jobs, len(inputs))) as benches:
        done = 0

        def told(record: DriveRecord) -> None:
            nonlocal done
            done += 1
            progress(f"reading {record.name}", READING * done / len(inputs))
            tell_drive(record, warn)

        loaded = benches.load(inputs, splits, told)
        if all(d.left_out for d in loaded):
            raise no_drive("a true sideslip and the signals of the estimators", "tune")
        before = benches.score({n: car.noise[n] for n in names if n in car.noise})

        def tell(trial: int) -> None:
            progress(f"trial {trial} of {settings.trials}", READING + (1.0 - READING) * trial / settings.trials)

        def evaluate(points: Mapping[str, tuple[float, ...]]) -> dict[str, Score]:
            errors = benches.score({n: filter_tuning(values) for n, values in points.items()})
            return {n: score_drives(e) for n, e in errors.items()}

        found = search(evaluate, names, trials=settings.trials, seed=settings.seed, progress=tell)
        errors = benches.score({n: filter_tuning(best_trial(found[n]).values) for n in names})
    tuned = tuple(Tuned(n, score_drives(before[n]) if n in before else None, found[n], tuple(errors[n])) for n in names)
    notes = _notes(tuned)
    for note in notes:
        warn(note)
    result = TuneResult(car=output, records=tuple(loaded), tuned=tuned, notes=notes)
    record = _record(result, settings, car)
    noise = {**_kept(car), **{t.name: _noise(t, car) for t in tuned}}
    part = Noise(
        filter=noise,
        search={**_summary(settings), "drives_sha256": record["drives_sha256"]},
        drives=tuple(d.learnt_on for d in result.drives),
    )
    comments = {f"filter.{n}.q_std": "v_x, v_y, yaw rate" for n in noise}
    head = "Written by pdhef tune. It belongs to the physics of this car: use it with no other."
    files = {
        NOISE_FILE: part_toml(part, head, comments).encode(),
        "noise.record.json": json_bytes(record),
        "noise.png": _plot(result),
    }
    change = Change("tune", NOISE_FILE, files, settings=settings.to_dict(), drives=part.drives)
    update_car(car, output, change)
    return result


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
    """Return what an earlier search found for filters; its scores are not those of the same drives and count no more.

    Noise without a trial is the fit's or a person's: it stays where it is.
    """
    found = {n: one for n, one in car.noise.items() if one.trial is not None}
    return {n: one.model_copy(update={"score_deg": None}) for n, one in found.items()}


# ---- the record ----


def _named(values: Sequence[float]) -> dict[str, float]:
    return {f.name: v for f, v in zip(FACTORS, values, strict=True)}


def _notes(tuned: Sequence[Tuned]) -> tuple[str, ...]:
    notes = []
    for t in tuned:
        ends = at_an_end(t.best)
        if ends:
            notes.append(f"{t.name}: the best {', '.join(ends)} stands at an end of the search space")
        if t.before is not None and t.before.objective_deg < t.best.score.objective_deg:
            notes.append(
                f"{t.name}: the noise that the car had is better on these drives "
                f"({t.before.objective_deg:.4f} deg) than all trials: give more --trials"
            )
    return tuple(notes)


def _summary(settings: TuneSettings) -> dict[str, Any]:
    objective = "geometric mean over drives of the sideslip RMSE, each with the floor added as squares"
    return {"trials": settings.trials, "seed": settings.seed, "objective": objective}


def _record(result: TuneResult, settings: TuneSettings, car: Car) -> dict[str, Any]:
    """Return the document of ``noise.record.json``."""
    together = hashlib.sha256("".join(sorted(d.sha256 for d in result.drives)).encode()).hexdigest()
    return {
        **record_head(FORMAT, FORMAT_VERSION, settings, car),
        "search": {
            **_summary(settings),
            "space": [asdict(f) for f in FACTORS],
            "exploring_share": EXPLORING_SHARE,
            "step_shares": [STEP_FIRST, STEP_LAST],
            "floor_deg": float(f"{np.degrees(FLOOR_RAD):.6g}"),
            "min_availability": MIN_AVAILABILITY,
            "low_speed_m_s": car.vehicle.low_speed_blend_m_s,
        },
        "drives_sha256": together,
        **drives_document(result.records),
        "estimators": {
            t.name: {
                "best_trial": t.best.number,
                "before": None if t.before is None else asdict(t.before),
                "rmse_deg": {
                    d.name: None if e.scored == 0 else float(np.degrees(e.rmse_rad))
                    for d, e in zip(result.drives, t.errors, strict=True)
                },
                "trials": [
                    {"trial": x.number, "stage": x.stage, "values": _named(x.values), **asdict(x.score)}
                    for x in t.trials
                ],
            }
            for t in result.tuned
        },
        "notes": list(result.notes),
    }


def _plot(result: TuneResult) -> bytes:
    """Draw the best objective so far over the trials, and every trial as a dot."""
    figure = new_figure(8.0, 4.5)
    axes = figure.subplots()
    for i, t in enumerate(result.tuned):
        colour = _COLOURS[i % len(_COLOURS)]
        values = np.array([x.score.objective_deg for x in t.trials])
        at = np.arange(1, len(values) + 1)
        axes.semilogy(at, values, ".", ms=3, color=colour, alpha=0.35)
        axes.step(at, np.minimum.accumulate(values), where="post", color=colour, label=t.name)
        if t.before is not None:
            axes.axhline(t.before.objective_deg, color=colour, lw=0.8, ls=":")
    exploring = sum(x.stage == "sobol" for x in result.tuned[0].trials)
    axes.axvline(exploring + 0.5, color="0.5", lw=0.8)
    axes.set(
        xlabel="trial (left of the line: Sobol points, right: refinement; dotted: the noise that the car had)",
        ylabel="objective (°): geometric mean of drives' sideslip RMSE",
        title=f"{len(result.drives)} drives",
    )
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False)
    return png_bytes(figure)
