"""What more driving would be worth: parameters that are not observable, stages that lack driving, learning curve."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import NO_INTERVALS, Car
from pdhef_logtool.car.vehicle import PhysicsParts
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.learning.car.fit_data import FitDrive, load_fit_drive
from pdhef_logtool.learning.car.physics_fit import GUARD_S, LEAST_FOLD_S, drive_errors, fit_physics
from pdhef_logtool.learning.drives import GAIN, IDENTIFY, INTERVALS, NETWORK
from pdhef_logtool.learning.evidence.calibrate import MIN_DRIVES
from pdhef_logtool.learning.evidence.trust import BLOCK_S, MIN_BLOCKS
from pdhef_logtool.learning.split import TRAINING, VALIDATION, Split, divided, usable_in
from pdhef_logtool.learning.stages.intervals import PIECE_S
from pdhef_logtool.learning.stages.network import LEAST_TRAINING_S
from pdhef_logtool.learning.stages.task import Progress
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.residual_model.bundle import NO_MODEL

#: Driving that excites a parameter, by words of its name.
EXCITED_BY = {
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


def learning_curve(
    split: Split, folder: Path, mapping: SignalMapping | None, options: ReadOptions, progress: Progress
) -> dict[str, float] | None:
    """Return the validation RMSE of ``physics`` after half of the training part and after all; None without a fit."""
    car = Car.load(folder, network=NO_MODEL, intervals=NO_INTERVALS)
    if car.fitted_physics is None:
        return None
    start = car.datasheet

    def load(slices: Sequence[LogInput]) -> list[FitDrive]:
        drives = (load_fit_drive(s, Car.of(start), mapping, options)[1] for s in slices)
        return [drive for drive in drives if drive is not None]

    half_slices, _ = divided(split.usable(TRAINING), 0.5)
    half, validation = load(half_slices), load(split.parts[VALIDATION])
    progress("fitting physics to half of the driving", 0.2)
    parts = car.physics_vehicle.physics or PhysicsParts()
    fit = fit_physics(half, start, parts, steering_wheel=any(d.steering_wheel for d in half))

    def rms_deg(vehicle: Any, noise: Any) -> float:
        errors = drive_errors(validation, start, vehicle, noise)
        squares = sum(float(np.sum(e.error**2)) for e in errors)
        return math.degrees(math.sqrt(squares / max(1, sum(e.counted for e in errors))))

    return {
        "half_s": sum(d.seconds for d in usable_in(split.times, half_slices)),
        "half_deg": rms_deg(fit.vehicle, fit.noise),
        "whole_s": split.seconds(TRAINING),
        "whole_deg": rms_deg(car.physics_vehicle, car.fitted_physics.noise),
    }


def what_more_would_pay(
    split: Split,
    stages: Sequence[str],
    figures: Mapping[str, Mapping[str, Any]],
    curve: Mapping[str, float] | None,
) -> list[str]:
    """Return sentences on what these drives do not show and which driving would; ``figures``: of the kept stages."""
    lines = []
    identified = figures.get(IDENTIFY, {})
    for p in identified.get("physics_parameters", ()):
        if not p["excited"]:
            how = next((text for words, text in EXCITED_BY.items() if words in p["name"]), "driving of other kinds")
            lines.append(f"{p['name']}: not observable in these drives; needs {how}")
    training_s, validation_s = split.seconds(TRAINING), split.seconds(VALIDATION)
    if identified and not identified["physics"].get("tried"):
        needed = 2.0 * (LEAST_FOLD_S + GUARD_S)
        lines.append(
            f"parts of the model of physics: none was tried on {training_s:.0f} s; about {needed:.0f} s of usable "
            "training driving are needed to choose them by cross-validation"
        )
    if NETWORK in stages and max(training_s, split.seconds(split.network_part())) < LEAST_TRAINING_S:
        lines.append(f"the network was not trained on: needs {LEAST_TRAINING_S:g} s of usable driving in its part")
    if {GAIN, NETWORK} & set(stages) and validation_s < MIN_BLOCKS * BLOCK_S:
        lines.append(
            f"a residual gain above one half needs {MIN_BLOCKS} blocks of {BLOCK_S:g} s in the validation part, which "
            f"has {validation_s:.0f} s"
        )
    if INTERVALS in stages and len(split.pieces(VALIDATION, PIECE_S)) < MIN_DRIVES:
        lines.append(
            f"the 95 % intervals are not calibrated: needs {MIN_DRIVES} drives, or pieces of {PIECE_S:g} s, in the "
            f"validation part, which has {validation_s:.0f} s"
        )
    if curve is not None:
        gain = 1.0 - curve["whole_deg"] / curve["half_deg"]
        lines.append(
            f"RMSE of physics on the validation part: {curve['half_deg']:.3f}° after half of the training part "
            f"({curve['half_s']:.0f} s), {curve['whole_deg']:.3f}° after all of it ({curve['whole_s']:.0f} s): "
            + (f"{gain:.0%} lower with twice the driving" if gain > 0.0 else "not lower with twice the driving")
        )
    return lines
