"""What identification sees of a drive: signals with ground truth at the same stamps, training and validation split."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import VehicleParameters, correct_signals
from pdhef_logtool.drive.correlation import GAP_PERIODS
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.proposals import Proposal, car_proposals, surest
from pdhef_logtool.drive.truth import (
    TruthTrack,
    booked_on_the_late,
    estimate_truth_latency,
    yaw_rate_channel,
)
from pdhef_logtool.learning.drives import DriveRecord, load_drive
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.mapping.frames import Placement
from pdhef_logtool.records.signals import SIGNAL_UNITS, Channel, Signals
from pdhef_logtool.records.tracks import StateTrack

#: Between the training and the validation split: filter states and slow disturbances must have forgotten the former.
GUARD_S = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class FitDrive:
    """One drive, or a part of it: signals [N] and ground truth [N] at the same stamps.

    ``signals`` are as measured: no bias and no offset of a vehicle file is taken off.
    ``independent_yaw_rate`` shows that the yaw rate of ground truth is not the gyro, ``steering_wheel`` that the log
    has the steering wheel's angle in place of the road wheels'. ``gyro_latency_s`` was taken off the gyro's stamps.
    ``placed`` is where recorded frames put the IMU.
    """

    name: str
    signals: Signals
    truth: StateTrack
    independent_yaw_rate: bool
    log_start_ns: int
    steering_wheel: bool = False
    gyro_latency_s: float = 0.0
    placed: Placement | None = None

    @property
    def span_s(self) -> tuple[float, float]:
        """First and last stamp in seconds from the log's start."""
        stamps = self.signals.stamps_ns
        return float(stamps[0] - self.log_start_ns) * 1e-9, float(stamps[-1] - self.log_start_ns) * 1e-9

    @property
    def duration_s(self) -> float:
        """Time from first to last stamp."""
        stamps = self.signals.stamps_ns
        return float(stamps[-1] - stamps[0]) * 1e-9 if stamps.size else 0.0


def load_fit_drive(
    log_input: LogInput, car: Car, mapping: Mapping | None, options: ReadOptions
) -> tuple[DriveRecord, FitDrive | None]:
    """Read a slice of a log; None, and the reason in the record, when it has no true sideslip.

    The car gives geometry only (lever arms, steering ratio, wheel radius).
    """
    vehicle = car.vehicle
    none = {"ax_bias_m_s2": 0.0, "ay_bias_m_s2": 0.0, "yaw_rate_bias_rad_s": 0.0, "yaw_rate_gain": 1.0}
    sensors = vehicle.sensors.model_copy(update=none)
    as_measured = vehicle.model_copy(update={"steer_offset_rad": 0.0, "sensors": sensors})
    record, whole = load_drive(log_input, car.with_vehicle(as_measured), mapping, replace(options, friction=None))
    if whole is None or whole.truth is None:
        return record, None
    independent = "yaw_rate_rad_s" not in whole.plan.dependent
    by_wheel = "steer_rad" not in whole.plan.mapping.signals
    gyro = whole.plan.mapping.signals.get("yaw_rate_rad_s")
    latency_s = 0.0 if gyro is None else gyro.latency_s
    return record, FitDrive(
        record.name,
        whole.signals,
        whole.truth,
        independent,
        whole.log_start_ns,
        by_wheel,
        latency_s,
        whole.plan.placed,
    )


def sensors_of(drives: Sequence[FitDrive], vehicle: VehicleParameters) -> tuple[Proposal, ...]:
    """Return place, gain and delay of the car's sensors by the drives' ground truth, beside what the vehicle has."""
    return surest(p for drive in drives for p in _sensors_of(drive, vehicle))


def _sensors_of(drive: FitDrive, vehicle: VehicleParameters) -> tuple[Proposal, ...]:
    channels = {}
    for name in ("yaw_rate_rad_s", "ay_m_s2"):
        values = getattr(drive.signals, name)
        is_finite = np.isfinite(values)
        stamps = drive.signals.stamps_ns[is_finite]
        channels[name] = Channel(name, SIGNAL_UNITS[name], drive.name, stamps, stamps, values[is_finite])
    truth = TruthTrack(drive.truth, max_gap_s=GAP_PERIODS * period_s(drive))
    latency = None
    rate = yaw_rate_channel(truth)
    if drive.independent_yaw_rate and len(rate) and len(channels["yaw_rate_rad_s"]):
        latency = booked_on_the_late(estimate_truth_latency(channels["yaw_rate_rad_s"], rate), None)
    return car_proposals(channels, truth, latency, drive.gyro_latency_s, vehicle, drive.placed)


def period_s(drive: FitDrive) -> float:
    """Return the usual time from one stamp to the next."""
    stamps = drive.signals.stamps_ns
    return float(np.median(np.diff(stamps))) * 1e-9 if stamps.size > 1 else 0.01


def signals_of(drive: FitDrive, start: VehicleParameters, vehicle: VehicleParameters) -> Signals:
    """Return a drive's signals as a vehicle file reads them; they were loaded with the starting file's ratio."""
    ratio = start.steering_ratio / vehicle.steering_ratio
    return correct_signals(replace(drive.signals, steer_rad=drive.signals.steer_rad * ratio), vehicle)


def split_drive(drive: FitDrive, holdout: float) -> tuple[FitDrive, FitDrive | None]:
    """Split off the last ``holdout`` share of a drive, with ``GUARD_S`` between; None when nothing is held out."""
    if holdout <= 0.0:
        return drive, None
    stamps = drive.signals.stamps_ns
    cut = int(stamps[0]) + round((1.0 - holdout) * (int(stamps[-1]) - int(stamps[0])))
    first = int(np.searchsorted(stamps, cut))
    second = int(np.searchsorted(stamps, cut + round(GUARD_S * 1e9)))
    return part_of(drive, 0, first), part_of(drive, second, len(stamps)) if second < len(stamps) else None


def part_of(drive: FitDrive, a: int, b: int) -> FitDrive:
    """Return the stamps [a, b) of a drive."""
    columns = {}
    for f in fields(StateTrack):
        value = getattr(drive.truth, f.name)
        columns[f.name] = value if f.name == "name" or value.shape[0] != len(drive.truth) else value[a:b]
    return replace(drive, signals=drive.signals.rows(a, b), truth=StateTrack(**columns))
