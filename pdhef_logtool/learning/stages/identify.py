"""Stage ``identify``: tyres, steering, biases, roll gradient and filter noise of a car (``fit.toml``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from pdhef_logtool.car.car import FIT_FILE, Car
from pdhef_logtool.car.parts import PHYSICS, Fit, FittedValues, LearntOn, physics_sha256
from pdhef_logtool.car.store import Change
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.proposals import apply_proposals
from pdhef_logtool.estimators.phy_ukf import TUNED
from pdhef_logtool.learning.car.fit_data import FitDrive, load_fit_drive, sensors_of, split_drive
from pdhef_logtool.learning.car.identify import Identification, Identified, fit_car, understeer_deg_per_g
from pdhef_logtool.learning.drives import IDENTIFY, DriveRecord, no_drive
from pdhef_logtool.learning.split import TRAINING
from pdhef_logtool.learning.stages.task import StageOutput, Task
from pdhef_logtool.learning.stages.without_truth import identify_without_truth
from pdhef_logtool.mapping import Mapping

#: Entry of vehicle.toml that a parameter's interval is written beside.
_ENTRIES = {
    "yaw inertia": "yaw_inertia_kg_m2",
    "steering offset": "steer_offset_rad",
    "steering ratio": "steering_ratio",
    "roll gradient": "roll_gradient_rad_per_m_s2",
    "a_y bias": "sensors.ay_bias_m_s2",
    "yaw rate bias": "sensors.yaw_rate_bias_rad_s",
    "front shape": "tyres.front.C",
    "rear shape": "tyres.rear.C",
}


def identify(task: Task) -> StageOutput:
    """Identify a car on drives with ground truth, or without it by the sensors of several logs.

    Raises
    ------
    EstimatorError
        There is too little driving.
    """
    if task.settings.without_truth:
        return identify_without_truth(task)
    start = task.car.datasheet
    records, fit, held_out = _read(task, start)
    if not fit:
        raise no_drive("ground truth velocities", IDENTIFY)
    # On the training part alone: nothing may be taken from what is held out.
    proposals = sensors_of(fit, start)
    for proposal in proposals:
        task.reporter.warn(
            f"{proposal.subject}: {proposal.evidence}; the fit removes it ({', '.join(proposal.entries)})"
        )
    _, with_sensors = apply_proposals(proposals, Mapping(), start)
    if with_sensors.sensors.yaw_rate_delay_s != start.sensors.yaw_rate_delay_s:
        records, fit, held_out = _read(
            replace(task, reporter=replace(task.reporter, warn=lambda _text: None)), with_sensors
        )
    identification = fit_car(
        fit,
        held_out,
        with_sensors,
        steering_wheel=any(drive.steering_wheel for drive in fit),
        progress=lambda text, share: task.reporter.progress(text, 0.2 + 0.8 * share),
    )
    used = (r for r in records if not r.left_out)
    drives = tuple(
        LearntOn(name=d.name, sha256=r.sha256, start_s=round(d.span_s[0], 2), end_s=round(d.span_s[1], 2))
        for d, r in zip(fit, used, strict=True)
    )
    files = {FIT_FILE: _fit_toml(identification, start, drives).encode()}
    change = Change(f"learn --stages {IDENTIFY}", FIT_FILE, files, settings=task.settings.to_dict(), drives=drives)
    return StageOutput(change, records, "; ".join(identification.notes), _figures(identification))


def _read(task: Task, vehicle: VehicleParameters) -> tuple[tuple[DriveRecord, ...], list[FitDrive], list[FitDrive]]:
    """Return the records of the drives, their part to fit to, and the held-out part of those that have one."""
    car = Car.of(vehicle)
    records, drives = task.read(
        task.split.parts[TRAINING], lambda log: load_fit_drive(log, car, task.mapping, task.options), 0.2
    )
    halves = [split_drive(drive, task.split.holdout) for drive in drives]
    return records, [fit for fit, _ in halves], [scored for _, scored in halves if scored is not None]


def _fit_toml(identification: Identification, start: VehicleParameters, drives: Sequence[LearntOn]) -> str:
    """Return the text of ``fit.toml``, with the intervals of the values as comments."""
    fitted = identification.vehicle
    part = Fit(
        physics_sha256=physics_sha256(start),
        values=FittedValues.between(start, fitted),
        filter={TUNED: identification.noise.model_copy(update={"physics_sha256": physics_sha256(fitted)})},
        physics=identification.physics,
        drives=tuple(drives),
        scores={s.part: s.to_dict() for s in identification.scores},
        notes=identification.notes,
    )
    head = (
        "Written by pdhef learn, stage identify. Values and filter noise belong together: use neither with another "
        f"car's.\nUndersteer {understeer_deg_per_g(fitted):.2f} deg/g."
    )
    return part_toml(part, head, {f"values.{k}": v for k, v in _comments(identification).items()})


def _figures(identification: Identification) -> dict[str, Any]:
    return {
        "parameters": [_parameter(p) for p in identification.parameters],
        "physics_parameters": [_parameter(p) for p in identification.physics_parameters],
        "understeer_deg_per_g": understeer_deg_per_g(identification.vehicle),
        "sideslip_rmse_deg": [
            {
                "part": s.part,
                "seconds": s.seconds,
                "zero": s.zero_deg,
                "phy-ukf, starting file": s.start_file_deg,
                f"{TUNED}, identified file": s.identified_deg,
                PHYSICS: s.physics_deg,
            }
            for s in identification.scores
        ],
        "physics": identification.physics.model_dump(mode="json", exclude_none=True),
        "notes": list(identification.notes),
    }


def _parameter(p: Identified) -> dict[str, Any]:
    figures = {"value": p.value, "low95": p.low, "high95": p.high, "prior": p.prior}
    return {"name": p.name, "unit": p.unit, **figures, "excited": p.excited, "noise": p.tuning}


def describe(parameter: Identified) -> str:
    """Return the interval of a parameter in words, as the file contains it."""
    if parameter.tuning:
        return f"95 %: {parameter.low:.3g} to {parameter.high:.3g}"
    if not parameter.excited:
        tyre = parameter.name.startswith(("front", "rear"))
        return f"kept at {'the fit to the axle forces' if tyre else 'its prior'}: the sideslip shows no more about it"
    return f"95 %: {parameter.low:.4g} to {parameter.high:.4g}, prior {parameter.prior:.4g}"


def _comments(identification: Identification) -> dict[str, str]:
    by_name = {p.name: p for p in identification.parameters}
    comments = {entry: describe(by_name[name]) for name, entry in _ENTRIES.items() if name in by_name}
    for axle in ("front", "rear"):
        stiffness, peak = by_name[f"{axle} cornering stiffness"], by_name[f"{axle} peak force"]
        comments[f"tyres.{axle}.B"] = f"cornering stiffness {stiffness.value:.0f} N/rad, {describe(stiffness)}"
        comments[f"tyres.{axle}.D_n"] = f"peak {peak.value:.0f} N at the friction above, {describe(peak)}"
    return comments
