"""Preparation of a drive: calibration of its car, sideslip reference, choice of estimators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.table import Options, Skipped, runnable
from pdhef_logtool.model.drive_model import DriveModel
from pdhef_logtool.model.intervals import DriveIntervals, drive_intervals
from pdhef_logtool.records.errors import EstimatorError
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.referencing import DriveReference, reference_of
from pdhef_logtool.runs.selection import default_names

_MAP_THEM = "map the missing signals (pdhef inspect LOG --write-mapping mapping.toml)"


@dataclass(frozen=True, slots=True, eq=False)
class PreparedDrive:
    """A drive, its model, and the estimators that run on it; ``failed``: reasons of those without a result, by name."""

    drive: Drive
    config: RunConfig
    model: DriveModel
    reference: DriveReference | None
    estimators: Sequence[Estimator]
    skipped: Sequence[Skipped]
    intervals: DriveIntervals
    failed: Mapping[str, str]

    @property
    def names(self) -> list[str]:
        """Names of the estimators."""
        return [e.name for e in self.estimators]

    @property
    def car(self) -> Car:
        """The car of the model."""
        return self.model.car


def prepare(drive: Drive, config: RunConfig) -> PreparedDrive:
    """Fit the model of the drive, make the reference, choose the estimators.

    Raises EstimatorError if no requested estimator can run.
    """
    model = DriveModel.fit(drive)
    car = model.car
    estimators, skipped = choose(drive, config.estimators, car, gnss=config.gnss == "auto")
    if not estimators:
        raise EstimatorError(
            expected="at least one estimator that can run",
            got="; ".join(f"{s.name}: {s.reason}" for s in skipped),
            where=str(drive.path),
            remedy=next((f"{reason} (or --waive it)" for reason in drive.plan.refused.values()), _MAP_THEM),
        )
    reference = reference_of(drive, model, config)
    if reference is not None and reference.estimator is not None:
        estimators = [*estimators, reference.estimator]
    intervals, failed = drive_intervals(car, estimators), {s.name: s.reason for s in skipped if s.is_error}
    return PreparedDrive(drive, config, model, reference, estimators, skipped, intervals, failed)


def choose(
    drive: Drive, names: Sequence[str] | None = None, car: Car | None = None, *, gnss: bool = True
) -> tuple[list[Estimator], list[Skipped]]:
    """Return the estimators that can run on a drive and a car, and the skipped ones with the reasons.

    Parameters
    ----------
    names : of estimators, ``["all"]`` or ``["peers"]``; None: those that a run chooses. car : by default the drive's.
    gnss : whether filters may use GNSS velocity.
    """
    car = drive.car if car is None else car
    names = default_names(car, drive.available) if names is None else names
    options = Options(drive.options.use_speed, gnss=gnss)
    return runnable(names, car, drive.available, options, drive.plan.refused)
