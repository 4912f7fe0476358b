"""The steps of ``pdhef learn``: each makes a new car of the one before, with the commands' own functions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import NO_INTERVALS, Car
from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.car.vehicle import PhysicsParts
from pdhef_logtool.estimators.table import spec_of
from pdhef_logtool.learning.car.fit_data import FitDrive, load_fit_drive
from pdhef_logtool.learning.car.identify_command import identify
from pdhef_logtool.learning.car.physics_fit import GUARD_S as FOLD_GUARD_S
from pdhef_logtool.learning.car.physics_fit import LEAST_FOLD_S, drive_errors, fit_physics
from pdhef_logtool.learning.drives import LearnSettings
from pdhef_logtool.learning.evidence.calibrate import MIN_DRIVES
from pdhef_logtool.learning.evidence.calibrate_command import CalibrateSettings, calibrate
from pdhef_logtool.learning.evidence.trust import BLOCK_S, MIN_BLOCKS
from pdhef_logtool.learning.evidence.trust_command import trust
from pdhef_logtool.learning.learn.parts import (
    CHECK,
    FIT,
    NETWORK,
    DriveTimes,
    divided,
    pieces_of,
    usable_in,
)
from pdhef_logtool.learning.network.fine_tune import train_on_parts
from pdhef_logtool.learning.noise.tune_command import TuneSettings, tune
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.records.errors import EstimatorError, ModelError
from pdhef_logtool.residual_model.bundle import MANY_CARS, NO_MODEL, ModelBundle, open_model
from pdhef_logtool.runs.config import RunConfig

#: The filter that follows the network, whose intervals and trust are learnt; and that smoothed.
HYBRID, SMOOTHED = "pd-hef", "pd-hef-smoothed"
#: The baseline that runs on every vehicle file.
BASELINE = "phy-ukf"
#: Estimators whose intervals are calibrated.
CALIBRATED = (PHYSICS, HYBRID, SMOOTHED)
#: Driving without which a network is not trained on: fine-tuning on 125 s reduced the error of simulated cars. The
#: share of it that it learns from; the rest stops it.
LEAST_TRAINING_S, TRAIN_SHARE = 100.0, 0.8
#: A piece of the check part that counts as a drive of its own for intervals.
INTERVAL_PIECE_S = 20.0
#: What would teach a parameter that the drives did not excite, by words of its name.
TEACHING = {
    "stiffness": "bends and lane changes at 2 to 5 m/s², to both sides",
    "peak": "driving near the limit of grip, such as a slalom or a slowly growing steering angle",
    "shape": "driving near the limit of grip, such as a slalom or a slowly growing steering angle",
    "inertia": "quick steering: steps, or a sine that grows from 0.5 to 2 Hz",
    "steering offset": "long straight stretches at speed",
    "steering ratio": "tight bends at low speed, to both sides",
    "roll gradient": "steady bends to both sides at several lateral accelerations",
    "a_y bias": "long straight stretches on a level road, in both directions",
    "yaw rate bias": "long straight stretches, or standing still with the engine running",
}


@dataclass(frozen=True, slots=True, eq=False)
class Lesson:
    """What every step is given: the configuration, slices of drives by part, and how long a search may be."""

    config: RunConfig
    mapping: SignalMapping | None
    parts: Mapping[str, tuple[LogInput, ...]]
    times: tuple[DriveTimes, ...]
    seed: int = 0
    trials: int = 64

    def usable(self, part: str) -> list[DriveTimes]:
        """Return when the slices of a part can be learnt from."""
        return usable_in(self.times, self.parts[part])

    def seconds(self, part: str) -> float:
        """Return how much of a part can be learnt from."""
        return sum(d.seconds for d in self.usable(part))

    def config_for(self, car: Path, network: Path | None = None) -> RunConfig:
        """Return the configuration of a command that learns of ``car``; slices bring their own start and end."""
        return replace(self.config, car=car, network=network, intervals=None, estimators=None, start=None, end=None)

    @property
    def network(self) -> Path:
        """The network to begin with: the one that is asked for, else that of many cars."""
        return Path(MANY_CARS) if self.config.network is None else self.config.network

    def bundle(self) -> ModelBundle | None:
        """Return that network, None without; raises ModelError where one that is asked for cannot be read."""
        if str(self.network) == NO_MODEL:
            return None
        try:
            return open_model(self.network)
        except ModelError:
            if self.config.network is None:
                return None  # a source tree without shipped networks still learns what needs none
            raise


@dataclass(frozen=True, slots=True)
class Taught:
    """What a step found: in words, and its figures as JSON-able values."""

    text: str
    figures: dict[str, Any]


Progress = Callable[[str, float], None]
#: Makes the car ``output`` of the car ``before``; an EstimatorError says what of the driving is missing for it.
Teach = Callable[[Lesson, Path, Path, Progress], Taught]


def learn_physics(lesson: Lesson, before: Path, output: Path, progress: Progress) -> Taught:
    """Find sensors, parameters, parts of the model and their noise on the fit part."""
    result = identify(lesson.parts[FIT], output, lesson.config_for(before), holdout=0.0, progress=progress)
    figures = {k: v for k, v in result.to_dict().items() if k not in ("car", "exit_code", "drives", "left_out")}
    return Taught("; ".join(result.identification.notes), figures)


def learn_noise(lesson: Lesson, before: Path, output: Path, progress: Progress) -> Taught:
    """Search the noise of ``physics`` on the fit part, as every filter's is searched."""
    if not spec_of(PHYSICS).tunable:
        raise EstimatorError(expected=f"a search for the noise of {PHYSICS}", got="none", where="noise")
    settings = TuneSettings(
        config=lesson.config_for(before), names=(PHYSICS,), trials=lesson.trials, seed=lesson.seed, any_split=True
    )
    (found,) = tune(lesson.parts[FIT], output, settings, progress=progress).tuned
    score = found.best.score.objective_deg
    text = f"best of {len(found.trials)} trials: {score:.4f}° on the fit part"
    if found.before is not None:
        text += f", {found.before.objective_deg:.4f}° with the noise that identification found"
    return Taught(text, {"fit_deg": score, "trial": found.best.number})


def try_network(lesson: Lesson, before: Path, output: Path, progress: Progress) -> Taught:
    """Find how far the network to begin with may be followed, on the check part."""
    if lesson.bundle() is None:
        raise EstimatorError(expected="a network", got="none", where="network")
    return _trusted(lesson, before, output, lesson.network, progress)


def train_network(lesson: Lesson, before: Path, output: Path, progress: Progress) -> Taught:
    """Go on training that network, stopped by driving that it has not seen, and find how far it may be followed."""
    network, part = lesson.bundle(), NETWORK if lesson.parts[NETWORK] else FIT
    if network is None:
        raise EstimatorError(expected="a network", got="none", where="training of the network")
    seconds = lesson.seconds(part)
    if seconds < LEAST_TRAINING_S:
        raise EstimatorError(
            expected=f"at least {LEAST_TRAINING_S:g} s of usable driving to train on",
            got=f"{seconds:.0f} s",
            where="training of the network",
        )
    config, work = lesson.config_for(before), output.parent / "training"
    learns, stops = divided(lesson.usable(part), TRAIN_SHARE)
    if not stops:
        raise EstimatorError(expected="driving to stop it", got="none", where="training of the network")
    parts = {"train": (learns, config), "validation": (stops, config)}
    train_on_parts(parts, work, network, progress=progress)
    return _trusted(lesson, before, output, work / "model", progress)


def _trusted(lesson: Lesson, before: Path, output: Path, network: Path, progress: Progress) -> Taught:
    settings = LearnSettings(config=lesson.config_for(before, network), seed=lesson.seed, any_split=True)
    result = trust(lesson.parts[CHECK], output, settings, progress=progress)
    figures = {"trust_cap": result.decision.cap, "blocks": result.decision.blocks}
    return Taught(f"trust {result.decision.cap:g}: {result.trust.evidence}", figures)


def learn_intervals(lesson: Lesson, before: Path, output: Path, progress: Progress) -> Taught:
    """Calibrate the 95 % intervals on pieces of the check part, each judged by a fit without it."""
    pieces = pieces_of(lesson.usable(CHECK), INTERVAL_PIECE_S)
    if len(pieces) < MIN_DRIVES:
        raise EstimatorError(
            expected=f"{MIN_DRIVES} drives, or pieces of {INTERVAL_PIECE_S:g} s, in the check part",
            got=str(len(pieces)),
            where="intervals",
        )
    config = replace(lesson.config_for(before), estimators=CALIBRATED)
    result = calibrate(
        pieces, output, CalibrateSettings(config=config, seed=lesson.seed, any_split=True), progress=progress
    )
    names = ", ".join(e.estimator for e in result.intervals.entries)
    coverage = {e.estimator: list(e.coverage) for e in result.intervals.entries}
    return Taught(f"{names}, on {len(pieces)} pieces of the check part", {"coverage": coverage})


#: In the order in which they are done; each begins with the car that the ones before have left.
STEPS: dict[str, Teach] = {
    "physics": learn_physics,
    "noise": learn_noise,
    "network": try_network,
    "training": train_network,
    "intervals": learn_intervals,
}


def judged_by(car: Car) -> str:
    """Return the estimator that stands for a car: the best that it has evidence for."""
    if car.network is not None and car.trust is not None and car.trust.has_evidence:
        return HYBRID
    return BASELINE if spec_of(PHYSICS).missing(car) else PHYSICS


# ---- what more driving would pay ----


def learning_curve(lesson: Lesson, folder: Path, progress: Progress) -> dict[str, float] | None:
    """Return the RMSE of ``physics`` on the check part after half of the fit part and after all; None without a fit."""
    car = Car.load(folder, network=NO_MODEL, intervals=NO_INTERVALS)
    if car.fitted_physics is None:
        return None
    start = car.own
    half_slices, _ = divided(lesson.usable(FIT), 0.5)
    half, check = (_loaded(lesson, Car.of(start), slices) for slices in (half_slices, lesson.parts[CHECK]))
    progress("fitting physics to half of the driving", 0.2)
    parts = car.physics_vehicle.physics or PhysicsParts()
    found = fit_physics(half, start, parts, steering_wheel=any(d.steering_wheel for d in half))

    def rms_deg(vehicle: Any, noise: Any) -> float:
        errors = drive_errors(check, start, vehicle, noise)
        squares = sum(float(np.sum(e.error**2)) for e in errors)
        return math.degrees(math.sqrt(squares / max(1, sum(e.counted for e in errors))))

    return {
        "half_s": sum(d.seconds for d in usable_in(lesson.times, half_slices)),
        "half_deg": rms_deg(found.vehicle, found.noise),
        "whole_s": lesson.seconds(FIT),
        "whole_deg": rms_deg(car.physics_vehicle, car.fitted_physics.noise),
    }


def _loaded(lesson: Lesson, car: Car, slices: Sequence[LogInput]) -> list[FitDrive]:
    found = (load_fit_drive(s, car, lesson.mapping, lesson.config_for(Path()).read_options)[1] for s in slices)
    return [drive for drive in found if drive is not None]


def what_more_would_pay(
    lesson: Lesson, taught: Mapping[str, Mapping[str, Any]], curve: Mapping[str, float] | None
) -> list[str]:
    """Return in sentences what these drives could not teach, and what driving would; ``taught``: figures by step."""
    told = []
    physics = taught.get("physics", {})
    for p in physics.get("physics_parameters", ()):
        if not p["excited"]:
            how = next((text for words, text in TEACHING.items() if words in p["name"]), "driving of other kinds")
            told.append(f"{p['name']}: the drives say hardly more than the prior; {how} would teach it")
    fit_s, check_s = lesson.seconds(FIT), lesson.seconds(CHECK)
    if physics and not physics["physics"].get("tried"):
        needed = 2.0 * (LEAST_FOLD_S + FOLD_GUARD_S)
        told.append(
            f"parts of the model of physics: none was tried on {fit_s:.0f} s; from about {needed:.0f} s of usable "
            "driving in the fit part on they are chosen by what one half says of the other"
        )
    if max(fit_s, lesson.seconds(NETWORK)) < LEAST_TRAINING_S:
        told.append(f"the network was not trained on: it takes {LEAST_TRAINING_S:g} s of usable driving in its part")
    if check_s < MIN_BLOCKS * BLOCK_S:
        told.append(
            f"trust above one half takes {MIN_BLOCKS} blocks of {BLOCK_S:g} s in the check part, which has "
            f"{check_s:.0f} s"
        )
    if len(pieces_of(lesson.usable(CHECK), INTERVAL_PIECE_S)) < MIN_DRIVES:
        told.append(
            f"the 95 % intervals are the filters' own: calibrating takes {MIN_DRIVES} drives, or pieces of "
            f"{INTERVAL_PIECE_S:g} s, in the check part, which has {check_s:.0f} s"
        )
    if curve is not None:
        gain = 1.0 - curve["whole_deg"] / curve["half_deg"]
        told.append(
            f"physics has {curve['half_deg']:.3f}° on the check part after half of the fit part "
            f"({curve['half_s']:.0f} s) and {curve['whole_deg']:.3f}° after all of it ({curve['whole_s']:.0f} s): "
            + (f"twice the driving was worth {gain:.0%}" if gain > 0.0 else "twice the driving was worth nothing")
        )
    return told
