"""``pdhef identify`` from files to files: read drives, identify, write vehicle.toml and the plot of the fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdhef_logtool.car.vehicle import Network, VehicleParameters, default_vehicle, load_vehicle, vehicle_to_toml
from pdhef_logtool.estimators.physics_tuned import NAME as TUNED
from pdhef_logtool.learning.car.fit_data import FitDrive, load_fit_drive, split_drive
from pdhef_logtool.learning.car.identify import Identification, Identified, identify, understeer_deg_per_g
from pdhef_logtool.learning.drives import DriveRecord, drives_document, exit_code, tell_drive
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.mapping import load_mapping
from pdhef_logtool.records.errors import EstimatorError, OutputError, UsageError
from pdhef_logtool.records.files import write_bytes
from pdhef_logtool.run.config import RunConfig

#: Other tyres, another nominal model: what was found with those of the starting file counts no more.
NO_NETWORK_TRIED = "no network was tried on this vehicle"
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


@dataclass(frozen=True, slots=True, eq=False)
class IdentifyResult:
    """What the command found and wrote."""

    identification: Identification
    vehicle_file: Path
    plot_file: Path
    records: tuple[DriveRecord, ...]

    @property
    def exit_code(self) -> int:
        """0 if all drives took part whole, 3 if not."""
        return exit_code(self.records)

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        found = self.identification
        return {
            "vehicle": str(self.vehicle_file),
            "plot": str(self.plot_file),
            "exit_code": self.exit_code,
            **drives_document(self.records),
            "parameters": [
                {
                    "name": p.name,
                    "unit": p.unit,
                    "value": p.value,
                    "low95": p.low,
                    "high95": p.high,
                    "prior": p.prior,
                    "excited": p.excited,
                }
                for p in found.parameters
            ],
            "understeer_deg_per_g": understeer_deg_per_g(found.vehicle),
            "sideslip_rmse_deg": [
                {
                    "part": s.part,
                    "seconds": s.seconds,
                    "zero": s.zero_deg,
                    "phy-ukf, starting file": s.start_file_deg,
                    f"{TUNED}, identified file": s.identified_deg,
                }
                for s in found.scores
            ],
            "notes": list(found.notes),
        }


def run_identification(
    arguments: Sequence[str],
    output: Path,
    config: RunConfig,
    *,
    holdout: float = 0.25,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
    warn: Callable[[str], None] = lambda _text: None,
) -> IdentifyResult:
    """Identify a vehicle on logs with truth; write ``output`` (vehicle.toml) and a plot beside it.

    Parameters
    ----------
    arguments : logs, folders, glob patterns; ``config.start`` and ``config.end`` cut each of them.
    holdout : share at the end of each slice that the fit never sees and that is scored once; 0 uses everything.

    Raises
    ------
    UsageError, VehicleError, MappingError, LogError
        An input is wrong. One unreadable log stops the command, because its absence would change the result unnoticed.
    EstimatorError
        There is too little driving with truth.
    """
    if not 0.0 <= holdout < 0.9:
        raise UsageError(expected="a share from 0 to 0.9", got=f"{holdout:g}", where="--holdout")
    if output.suffix != ".toml":
        raise UsageError(expected="a file name that ends in .toml", got=output.name, where="--output")
    start = default_vehicle() if config.vehicle is None else load_vehicle(config.vehicle)
    if config.vehicle is None:
        warn(f"no --vehicle: mass, geometry and priors are those of the default {start.name}")
    given = None if config.mapping is None else load_mapping(config.mapping)
    fit: list[FitDrive] = []
    held_out: list[FitDrive] = []
    records: list[DriveRecord] = []
    logs = find_logs(arguments)
    for number, log_input in enumerate(logs):
        progress(f"reading {log_input.stem}", 0.2 * number / len(logs))
        record, drive = load_fit_drive(log_input, start, given, config.read_options)
        records.append(record)
        tell_drive(record, warn)
        if drive is None:
            continue
        kept, scored = split_drive(drive, holdout)
        fit.append(kept)
        if scored is not None:
            held_out.append(scored)
    if not fit:
        raise EstimatorError(
            expected="at least one drive with truth velocities",
            got="none",
            where="identify",
            remedy="map v_y, sideslip, or position and heading of an RTK, INS or motion-capture reference",
        )
    found = identify(
        fit,
        held_out,
        start,
        steering_wheel=any(drive.steering_wheel for drive in fit),
        progress=lambda text, share: progress(text, 0.2 + 0.8 * share),
    )
    name = f"{start.name} (identified)" if not start.name.endswith("(identified)") else start.name
    vehicle = found.vehicle.model_copy(
        update={
            "name": name,
            "network": Network(trust_cap=0.0, evidence=NO_NETWORK_TRIED),
            "identification": _provenance(found, fit, holdout, start),
        }
    )
    write_bytes(output, vehicle_to_toml(vehicle, _comments(found)).encode())
    plot = output.with_suffix(".png")
    from pdhef_logtool.learning.car.identify_plot import plot_identification

    try:
        plot_identification(found, plot)
    except OSError as error:
        raise OutputError(expected="a place to write to", got=error.strerror or str(error), where=str(plot)) from None
    return IdentifyResult(found, output, plot, tuple(records))


def _provenance(
    found: Identification, fit: Sequence[FitDrive], holdout: float, start: VehicleParameters
) -> dict[str, str | float | int | list[str]]:
    document: dict[str, str | float | int | list[str]] = {
        "starting_vehicle": start.name,
        "drives": ["{}: {:.2f} to {:.2f} s".format(d.name, *d.span_s) for d in fit],
        "holdout_share": holdout,
        "notes": list(found.notes),
    }
    for score in found.scores:
        key = score.part.replace(" ", "_")
        document[f"{key}_seconds"] = round(score.seconds, 2)
        document[f"{key}_sideslip_rmse_deg"] = round(score.identified_deg, 4)
        document[f"{key}_sideslip_rmse_deg_starting_vehicle"] = round(score.start_file_deg, 4)
        document[f"{key}_sideslip_rmse_deg_zero"] = round(score.zero_deg, 4)
    return document


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
    comments[""] = (
        "Written by pdhef identify. The tyres and the filter noise belong together: use neither with another file's.\n"
        f"Understeer {understeer_deg_per_g(found.vehicle):.2f} deg/g."
    )
    return comments
