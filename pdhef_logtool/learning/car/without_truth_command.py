"""``pdhef identify --without-truth``: a pool of logs calibrates its car on the sensors alone (METHOD §17).

One log's calibration serves that log, and on another it can be absurd: only pools are written to a car.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pdhef_logtool.car.car import FIT_FILE, NO_INTERVALS, Car
from pdhef_logtool.car.parts import Fit, FittedPhysics, FittedValues, physics_sha256
from pdhef_logtool.car.store import Change, check_output, update_car
from pdhef_logtool.car.toml_files import part_toml
from pdhef_logtool.drive.cached import read_cached
from pdhef_logtool.learning.drives import (
    LearnResult,
    check_file_output,
    config_document,
    open_mapping,
    record_of,
    tell_drive,
)
from pdhef_logtool.logs.discovery import find_logs
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.residual_model.bundle import NO_MODEL
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.self_calibrating import lacking, read_driving
from pdhef_logtool.self_calibration.calibration import LEAST_KNOWN_EXPORTED, SelfCalibration, self_calibrate

#: Logs from which on they are a pool.
LEAST_LOGS = 2
WHERE = "identify --without-truth"


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class WithoutTruthResult(LearnResult):
    """What the command found and wrote."""

    calibration: SelfCalibration

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document."""
        return {**super(WithoutTruthResult, self).to_dict(), "self_calibration": self.calibration.to_dict()}


def identify_without_truth(
    arguments: Sequence[str],
    output: Path,
    config: RunConfig,
    *,
    progress: Callable[[str, float], None] = lambda _text, _share: None,
    warn: Callable[[str], None] = lambda _text: None,
) -> WithoutTruthResult:
    """Calibrate a car on its logs without looking at a truth; write ``output`` (its folder).

    Parameters
    ----------
    arguments : logs, folders, glob patterns, all of one car; ``config.start`` and ``config.end`` cut each of them.

    Raises
    ------
    UsageError, VehicleError, MappingError, LogError
        An input is wrong. One unreadable log stops the command, because its absence would change the result unnoticed.
    EstimatorError
        The logs do not carry a calibration: too few, too little driving, stiffness known too badly, or the car drifts.
    """
    car = Car.load(config.car, network=NO_MODEL, intervals=NO_INTERVALS)
    start = car.own
    check_output(car, output)
    if config.car is None:
        warn(f"no --car: mass, geometry and priors are those of the default {start.name}")
    given = open_mapping(config)
    logs = find_logs(arguments, private_redirects=config.allow_private_redirects)
    check_file_output(logs, config, output)
    driving, records = [], []
    for number, log_input in enumerate(logs):
        progress(f"reading {log_input.stem}", 0.8 * number / len(logs))
        with read_cached(log_input, Car.of(start), given, config.read_options) as drive:
            if missing := lacking(drive):
                records.append(record_of(drive, left_out=f"the log has no {', '.join(missing)}"))
            else:
                found = read_driving(drive)
                usable = len(found.stretches) > 0
                span_s = tuple((at - drive.log.start_ns) * 1e-9 for at in (drive.plan.start_ns, drive.plan.end_ns))
                record = record_of(drive, left_out="" if usable else "no driving that a calibration can use")
                records.append(replace(record, seconds=span_s[1] - span_s[0], span_s=(span_s[0], span_s[1])))
                driving += [found] * usable
        tell_drive(records[-1], warn)
    if len(driving) < LEAST_LOGS:
        raise _refused(f"{len(driving)} of them", "logs of one car, for what one log says need not hold on another")
    calibration = self_calibrate(
        driving,
        start,
        least_known=LEAST_KNOWN_EXPORTED,
        progress=lambda share: progress("fitting what the sensors say", 0.8 + 0.2 * share),
    )
    if calibration.refused:
        raise _refused(calibration.refused, "logs with bends and lane changes that calibrate the car")
    part = fit_part(calibration, [r.learnt_on for r in records if not r.left_out])
    head = f"Written by pdhef identify --without-truth: no truth was looked at.\n{calibration.text}."
    files = {FIT_FILE: part_toml(part, head).encode()}
    settings = {**config_document(config), "without_truth": True}
    change = Change("identify", FIT_FILE, files, settings=settings, drives=part.drives)
    update_car(car, output, change)
    return WithoutTruthResult(car=output, records=tuple(records), calibration=calibration)


def fit_part(calibration: SelfCalibration, drives: Sequence[Any]) -> Fit:
    """Return what a pool found as a car holds it; ``physics`` has the same values, and its own noise."""
    own, vehicle = calibration.own, calibration.vehicle
    return Fit(
        physics_sha256=physics_sha256(own),
        values=FittedValues.between(own, vehicle),
        physics=FittedPhysics(
            values=FittedValues.of(vehicle),
            noise=calibration.noise,
            varied=tuple(FittedValues.between(vehicle, v) for v in calibration.varied),
        ),
        without_truth=True,
        drives=tuple(drives),
        notes=(calibration.text, "no truth was looked at: what a drive with truth finds is worth more"),
    )


def _refused(got: str, expected: str) -> EstimatorError:
    return EstimatorError(
        expected=expected,
        got=got,
        where=WHERE,
        remedy="give more logs of this car, or one with truth without this option",
    )
