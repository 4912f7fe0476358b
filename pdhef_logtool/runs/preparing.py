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
from pdhef_logtool.records.tracks import REFERENCE
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.referencing import DriveReference, reference_of
from pdhef_logtool.runs.selection import default_names

_MAP_THEM = "map the missing signals (pdhef inspect LOG --write-mapping mapping.toml)"


@dataclass(frozen=True, slots=True, eq=False)
class PreparedDrive:
    """A drive, its model, and the estimators that run on it.

    Estimators that are not ``requested`` are candidates for the selected estimate: of these only the selected one is in
    the outputs. ``failed``: reasons of estimators without a result, by name.
    """

    drive: Drive
    config: RunConfig
    model: DriveModel
    reference: DriveReference | None
    estimators: Sequence[Estimator]
    skipped: Sequence[Skipped]
    requested: frozenset[str]
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
    estimators, skipped, requested = _choose_estimators(drive, config, car)
    reference = reference_of(drive, model, config)
    if reference is not None and reference.estimator is not None:
        estimators, requested = [*estimators, reference.estimator], requested | {REFERENCE}
    intervals, failed = drive_intervals(car, estimators), {s.name: s.reason for s in skipped if s.is_error}
    return PreparedDrive(drive, config, model, reference, estimators, skipped, requested, intervals, failed)


def _choose_estimators(
    drive: Drive, config: RunConfig, car: Car
) -> tuple[list[Estimator], list[Skipped], frozenset[str]]:
    """Return the estimators that run, those that cannot, and the names of the requested ones that run.

    Candidates for the selected estimate always run. Raises EstimatorError if no requested estimator can run.
    """
    names = config.estimators or default_names(car, drive.available)
    options, refused = Options(drive.options.use_speed, gnss=config.gnss == "auto"), drive.plan.refused
    estimators, skipped = runnable(names, car, drive.available, options, refused)
    requested = frozenset(e.name for e in estimators)
    more = [name for name in default_names(car, drive.available) if name not in requested]
    estimators += runnable(more, car, drive.available, options, refused)[0] if more else []
    if not requested:
        raise EstimatorError(
            expected="at least one estimator that can run",
            got="; ".join(f"{s.name}: {s.reason}" for s in skipped),
            where=str(drive.path),
            remedy=next((f"{reason} (or --waive it)" for reason in refused.values()), _MAP_THEM),
        )
    return estimators, skipped, requested
