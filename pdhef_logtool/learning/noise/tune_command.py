"""``pdhef tune`` from logs to a vehicle file with tuned filter noise, the record of every trial, and a plot."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters, load_vehicle, vehicle_sha256, vehicle_to_toml
from pdhef_logtool.learning.drives import (
    DriveRecord,
    Refusal,
    choose_drives,
    drives_document,
    exit_code,
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
    tuned_vehicle,
)
from pdhef_logtool.learning.noise.tune_drives import Benches, TuneSetup, choose_names
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.mapping import load_mapping
from pdhef_logtool.records.errors import EstimatorError, UsageError
from pdhef_logtool.records.files import PendingFile, write_bytes
from pdhef_logtool.residual_model.bundle import open_model
from pdhef_logtool.run.config import RunConfig
from pdhef_logtool.sinks.report import tool_versions, write_json

FORMAT = "pdhef-tuning"
FORMAT_VERSION = 1
#: Splits of a set that figures are reported on: noise that was tuned there would make them worthless.
HELD_OUT = ("test", "extrapolation")
DEFAULT_TRIALS = 128
#: Share of the progress that reading takes.
READING = 0.2
_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")

Warn = Callable[[str], None]
#: Drives that this command refuses.
REFUSED = Refusal(
    HELD_OUT,
    "drives that no figure is reported on",
    "tune",
    "noise tuned on drives of the test makes the test's figures too good: take --split validation, or say --any-split",
)


@dataclass(frozen=True, slots=True)
class TuneSettings:
    """What decides the result, beside the logs.

    Attributes
    ----------
    config : vehicle, mapping, model, slice, sensors, which truth; the other entries are not used.
    names : estimators; None = all that can be tuned.
    trials : of each estimator. seed : of the search.
    split : only drives that their set's manifest puts into this split. any_split : do not refuse held-out drives.
    """

    config: RunConfig
    names: tuple[str, ...] | None = None
    trials: int = DEFAULT_TRIALS
    seed: int = 0
    split: str | None = None
    any_split: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Tuned:
    """What came out for one estimator.

    ``before`` is the score of the noise that the vehicle file had, None if it had none; ``errors`` are the best
    trial's by drive.
    """

    name: str
    before: Score | None
    trials: tuple[Trial, ...]
    errors: tuple[DriveError, ...]

    @property
    def best(self) -> Trial:
        """The trial that is written to the vehicle file."""
        return best_trial(self.trials)


@dataclass(frozen=True, slots=True, eq=False)
class TuneResult:
    """What the command found and wrote; ``drives`` are those that were scored."""

    vehicle_file: Path
    tuning_file: Path
    plot_file: Path
    tuned: tuple[Tuned, ...]
    drives: tuple[DriveRecord, ...]
    left_out: tuple[DriveRecord, ...]
    notes: tuple[str, ...]

    @property
    def exit_code(self) -> int:
        """0 if all drives took part whole, 3 if not."""
        return exit_code((*self.drives, *self.left_out))

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        return {
            "vehicle": str(self.vehicle_file),
            "tuning": str(self.tuning_file),
            "plot": str(self.plot_file),
            "exit_code": self.exit_code,
            **drives_document((*self.drives, *self.left_out)),
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


def run_tuning(
    arguments: Sequence[str],
    output: Path,
    settings: TuneSettings,
    *,
    jobs: int = 1,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
    warn: Warn = lambda _text: None,
) -> TuneResult:
    """Tune the noise of estimators alike; write ``output`` (vehicle.toml), ``<stem>.tuning.json`` and its plot.

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
    config = settings.config
    _check(output, settings, jobs)
    assert config.vehicle is not None
    vehicle = load_vehicle(config.vehicle)
    model = None if config.model is None else open_model(config.model)
    names = choose_names(settings.names, model)
    inputs, splits = choose_drives(find_logs(arguments), settings, REFUSED)
    if model is not None and "train" in splits.values():
        warn(
            "drives of split train: a network is better there than in service, and its filter's noise is tuned to that"
        )
    mapping = None if config.mapping is None else load_mapping(config.mapping)
    setup = TuneSetup(config, vehicle, mapping, model, names)
    with Benches(setup, min(jobs, len(inputs))) as benches:
        done = 0

        def told(record: DriveRecord) -> None:
            nonlocal done
            done += 1
            progress(f"reading {record.name}", READING * done / len(inputs))
            tell_drive(record, warn)

        loaded = benches.load(inputs, splits, told)
        drives = tuple(d for d in loaded if not d.left_out)
        if not drives:
            raise EstimatorError(
                expected="at least one drive with a true sideslip and the signals of the estimators",
                got="none",
                where="tune",
                remedy="map v_y, sideslip, or position and heading of an RTK, INS or motion-capture reference",
            )
        before = benches.score({n: vehicle.filter[n] for n in names if n in vehicle.filter})

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
    result = TuneResult(
        vehicle_file=output,
        tuning_file=output.with_suffix(".tuning.json"),
        plot_file=output.with_suffix(".tuning.png"),
        tuned=tuned,
        drives=drives,
        left_out=tuple(d for d in loaded if d.left_out),
        notes=notes,
    )
    record = _record(result, settings, vehicle, None if model is None else model.sha256)
    write_bytes(output, tuned_toml(config.vehicle, vehicle, tuned, record).encode())
    write_json(result.tuning_file, record)
    _plot(result)
    return result


def tuned_toml(source: Path, vehicle: VehicleParameters, tuned: Sequence[Tuned], record: Mapping[str, Any]) -> str:
    """Return the vehicle file with the best noise of each estimator and where it is from; comments are kept."""
    provenance: dict[str, str | float | int | list[str]] = {
        k: v for k, v in vehicle.identification.items() if not k.startswith("tuning_")
    }
    provenance |= {
        "tuning_drives_sha256": record["drives_sha256"],
        "tuning_drives": len(record["drives"]),
        "tuning_trials": record["search"]["trials"],
        "tuning_seed": record["search"]["seed"],
        "tuning_space": [f"{f.name} {f.low:g} to {f.high:g} {f.unit}" for f in FACTORS],
        "tuning_objective": record["search"]["objective"],
        "tuning_scores": [f"{t.name}: {t.best.score.objective_deg:.4f} deg at trial {t.best.number}" for t in tuned],
    }
    comments = {
        entry: note
        for entry, note in read_comments(source.read_text(encoding="utf-8")).items()
        if not any(entry.startswith(f"filter.{t.name}.") for t in tuned)
    }
    for t in tuned:
        vehicle = tuned_vehicle(vehicle, t.name, filter_tuning(t.best.values))
        comments[f"filter.{t.name}.q_std"] = "pdhef tune; v_x, v_y, yaw rate"
    return vehicle_to_toml(vehicle.model_copy(update={"identification": provenance}), comments)


def read_comments(text: str) -> dict[str, str]:
    """Return the comments of a vehicle file as :func:`~pdhef_logtool.car.vehicle.vehicle_to_toml` takes them.

    Those at the head stand under ``""``, those behind a value under its dotted entry; others are not kept.
    """
    found: dict[str, str] = {}
    head: list[str] | None = []
    table = ""
    for line in (raw.strip() for raw in text.splitlines()):
        if line.startswith("#"):
            if head is not None:
                head.append(line.lstrip("# "))
            continue
        if head is not None:
            found |= {"": "\n".join(head)} if head else {}
            head = None
        at = line.find("#")
        while at >= 0:
            entry = _entry(line[:at])
            if entry is not None:
                if "=" in entry:
                    found[table + entry.split("=")[0]] = line[at:].lstrip("# ")
                break
            at = line.find("#", at + 1)
        name = _entry(line if at < 0 else line[:at]) or ""
        if name and "=" not in name:
            table = name + "."
    return found


def _entry(text: str) -> str | None:
    """Return ``a.b`` of a table's line, ``key=`` of an entry's, None if the text is no whole line of TOML."""
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        return None
    if not text.lstrip().startswith("["):
        return f"{next(iter(document))}=" if document else None
    keys = []
    while isinstance(document, dict) and document:
        key, document = next(iter(document.items()))
        keys.append(key)
    return ".".join(keys)


# ---- the record ----


def _check(output: Path, settings: TuneSettings, jobs: int) -> None:
    if settings.config.vehicle is None:
        raise UsageError(
            expected="a vehicle file", got="none", where="--vehicle", remedy="pdhef identify writes one of your car"
        )
    if output.suffix != ".toml":
        raise UsageError(expected="a file name that ends in .toml", got=output.name, where="--output")
    if settings.trials < MIN_TRIALS:
        raise UsageError(expected=f"at least {MIN_TRIALS} trials", got=str(settings.trials), where="--trials")
    if settings.seed < 0:
        raise UsageError(expected="a seed of at least 0", got=str(settings.seed), where="--seed")
    if jobs < 1:
        raise UsageError(expected="at least one process", got=str(jobs), where="--jobs")


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
                f"{t.name}: the noise that the vehicle file had is better on these drives "
                f"({t.before.objective_deg:.4f} deg) than all trials: give more --trials"
            )
    return tuple(notes)


def _record(
    result: TuneResult,
    settings: TuneSettings,
    vehicle: VehicleParameters,
    model_sha256: str | None,
) -> dict[str, Any]:
    """Return the document of ``<stem>.tuning.json``."""
    config = settings.config.to_dict()
    together = hashlib.sha256("".join(sorted(d.sha256 for d in result.drives)).encode()).hexdigest()
    return {
        "format": FORMAT,
        "version": FORMAT_VERSION,
        "versions": tool_versions(),
        "settings": {
            **{
                k: config[k]
                for k in ("vehicle", "mapping", "model", "start", "end", "sensors", "friction", "prefer_truth")
            },
            "split": settings.split,
            "any_split": settings.any_split,
        },
        "vehicle": {"name": vehicle.name, "sha256": vehicle_sha256(vehicle)},
        "model_sha256": model_sha256,
        "search": {
            "trials": settings.trials,
            "seed": settings.seed,
            "space": [asdict(f) for f in FACTORS],
            "exploring_share": EXPLORING_SHARE,
            "step_shares": [STEP_FIRST, STEP_LAST],
            "objective": "geometric mean over drives of the sideslip RMSE, each with the floor added as squares",
            "floor_deg": float(f"{np.degrees(FLOOR_RAD):.6g}"),
            "min_availability": MIN_AVAILABILITY,
            "low_speed_m_s": vehicle.low_speed_blend_m_s,
        },
        "drives_sha256": together,
        **drives_document((*result.drives, *result.left_out)),
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


def _plot(result: TuneResult) -> None:
    """Draw the best objective so far over the trials, and every trial as a dot."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.5), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
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
        xlabel="trial (left of the line: Sobol points, right: refinement; dotted: the file's own noise)",
        ylabel="objective (°): geometric mean of drives' sideslip RMSE",
        title=f"{len(result.drives)} drives",
    )
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False)
    with PendingFile(result.plot_file) as pending:
        figure.savefig(pending.path, format="png", metadata={"Software": None})
