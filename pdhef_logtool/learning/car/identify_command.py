"""``pdhef identify`` from files to files: read drives, identify, write vehicle.toml and the plot of the fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdhef_logtool.car.car import FIT_FILE, NO_INTERVALS, Car
from pdhef_logtool.car.parts import PHYSICS, Fit, FittedValues, LearntOn, physics_sha256
from pdhef_logtool.car.store import Change, check_output, update_car
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.car.vehicle import PhysicsParts, VehicleParameters
from pdhef_logtool.drive.proposals import apply_proposals
from pdhef_logtool.estimators.phy_ukf import TUNED
from pdhef_logtool.learning.car.fit_data import FitDrive, load_fit_drive, sensors_of, split_drive
from pdhef_logtool.learning.car.identify import Identification, Identified, fit_car, understeer_deg_per_g
from pdhef_logtool.learning.car.identify_plot import plot_identification
from pdhef_logtool.learning.drives import (
    DriveRecord,
    LearnResult,
    check_file_output,
    config_document,
    no_drive,
    open_mapping,
    tell_drive,
)
from pdhef_logtool.logs.discovery import Logs, find_logs
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.outputs import local_path
from pdhef_logtool.residual_model.bundle import NO_MODEL
from pdhef_logtool.runs.config import RunConfig

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


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class IdentifyResult(LearnResult):
    """What the command found and wrote."""

    identification: Identification

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        found = self.identification
        return {
            **super(IdentifyResult, self).to_dict(),
            "parameters": [_parameter(p) for p in found.parameters],
            "physics_parameters": [_parameter(p) for p in found.physics_parameters],
            "understeer_deg_per_g": understeer_deg_per_g(found.vehicle),
            "sideslip_rmse_deg": [
                {
                    "part": s.part,
                    "seconds": s.seconds,
                    "zero": s.zero_deg,
                    "phy-ukf, starting file": s.start_file_deg,
                    f"{TUNED}, identified file": s.identified_deg,
                    PHYSICS: s.physics_deg,
                }
                for s in found.scores
            ],
            "physics": found.physics.model_dump(mode="json", exclude_none=True),
            "notes": list(found.notes),
        }


def _parameter(p: Identified) -> dict[str, Any]:
    figures = {"value": p.value, "low95": p.low, "high95": p.high, "prior": p.prior}
    return {"name": p.name, "unit": p.unit, **figures, "excited": p.excited}


def identify(
    arguments: Logs,
    output: Path | str,
    config: RunConfig,
    *,
    holdout: float = 0.25,
    parts: PhysicsParts | None = None,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
    warn: Callable[[str], None] = lambda _text: None,
) -> IdentifyResult:
    """Identify a car on logs with truth; write ``output`` (its folder) with a plot of the fit.

    Parameters
    ----------
    arguments : logs, folders, glob patterns; ``config.start`` and ``config.end`` cut each of them.
    holdout : share at the end of each slice that the fit never sees and that is scored once; 0 uses everything.
    parts : of the model of ``physics``; None: chosen by what part of the drives says of the other.

    Raises
    ------
    UsageError, VehicleError, MappingError, LogError
        An input is wrong. One unreadable log stops the command, because its absence would change the result unnoticed.
    EstimatorError
        There is too little driving with truth.
    """
    output = local_path(output)
    if not 0.0 <= holdout < 0.9:
        raise UsageError(expected="a share from 0 to 0.9", got=f"{holdout:g}", where="--holdout")
    car = Car.load(config.car, network=NO_MODEL, intervals=NO_INTERVALS)
    start = car.own
    check_output(car, output)
    if config.car is None:
        warn(f"no --car: mass, geometry and priors are those of the default {start.name}")
    given = open_mapping(config)
    logs = find_logs(arguments, private_redirects=config.allow_private_redirects)
    check_file_output(logs, config, output)

    def read(vehicle: VehicleParameters) -> tuple[list[DriveRecord], list[FitDrive], list[FitDrive]]:
        records, fit, held_out = [], [], []
        for number, log_input in enumerate(logs):
            progress(f"reading {log_input.stem}", 0.2 * number / len(logs))
            record, drive = load_fit_drive(log_input, Car.of(vehicle), given, config.read_options)
            records.append(record)
            if drive is None:
                continue
            kept, scored = split_drive(drive, holdout)
            fit.append(kept)
            held_out += [] if scored is None else [scored]
        return records, fit, held_out

    records, fit, held_out = read(start)
    for record in records:
        tell_drive(record, warn)
    if not fit:
        raise no_drive("truth velocities", "identify")
    # Of the parts that are fitted to alone: what is held out must not be seen.
    proposals = sensors_of(fit, start)
    for proposal in proposals:
        warn(f"{proposal.subject}: {proposal.evidence}; the fit takes it off ({', '.join(proposal.entries)})")
    _, with_sensors = apply_proposals(proposals, Mapping(), start)
    if with_sensors.sensors.yaw_rate_delay_s != start.sensors.yaw_rate_delay_s:
        records, fit, held_out = read(with_sensors)
    found = fit_car(
        fit,
        held_out,
        with_sensors,
        steering_wheel=any(drive.steering_wheel for drive in fit),
        parts=parts,
        progress=lambda text, share: progress(text, 0.2 + 0.8 * share),
    )
    fitted = found.vehicle
    drives = tuple(
        LearntOn(name=d.name, sha256=r.sha256, start_s=round(d.span_s[0], 2), end_s=round(d.span_s[1], 2))
        for d, r in zip(fit, (r for r in records if not r.left_out), strict=True)
    )
    part = Fit(
        physics_sha256=physics_sha256(start),
        values=FittedValues.between(start, fitted),
        filter={TUNED: found.noise.model_copy(update={"physics_sha256": physics_sha256(fitted)})},
        physics=found.physics,
        drives=drives,
        scores={s.part: s.to_dict() for s in found.scores},
        notes=found.notes,
    )
    head = (
        "Written by pdhef identify. Values and filter noise belong together: use neither with another car's.\n"
        f"Understeer {understeer_deg_per_g(fitted):.2f} deg/g."
    )
    text = part_toml(part, head, {f"values.{k}": v for k, v in _comments(found).items()})
    files = {FIT_FILE: text.encode(), "fit.png": plot_identification(found)}
    settings = {**config_document(config), "holdout": holdout, "parts": "auto" if parts is None else parts.names}
    change = Change("identify", FIT_FILE, files, settings=settings, drives=drives)
    update_car(car, output, change)
    return IdentifyResult(car=output, records=tuple(records), identification=found)


def describe(parameter: Identified) -> str:
    """Return the interval of a parameter in words, as it stands in the file."""
    if parameter.tuning:
        return f"95 %: {parameter.low:.3g} to {parameter.high:.3g}"
    if not parameter.excited:
        tyre = parameter.name.startswith(("front", "rear"))
        return f"kept at {'the fit to the axle forces' if tyre else 'its prior'}: the sideslip says no more about it"
    return f"95 %: {parameter.low:.4g} to {parameter.high:.4g}, prior {parameter.prior:.4g}"


def _comments(found: Identification) -> dict[str, str]:
    by_name = {p.name: p for p in found.parameters}
    comments = {entry: describe(by_name[name]) for name, entry in _ENTRIES.items() if name in by_name}
    for axle in ("front", "rear"):
        stiffness, peak = by_name[f"{axle} cornering stiffness"], by_name[f"{axle} peak force"]
        comments[f"tyres.{axle}.B"] = f"cornering stiffness {stiffness.value:.0f} N/rad, {describe(stiffness)}"
        comments[f"tyres.{axle}.D_n"] = f"peak {peak.value:.0f} N at the friction above, {describe(peak)}"
    return comments
