"""Sensors of an earlier drive, for later drives of the same car and recorder (:mod:`pdhef_logtool.car.model`).

In a car, mounting, delays, clocks and parameters are known from earlier drives. Offline they come from the log itself,
so that estimates depend on later samples. With a model file they do not.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pydantic import ConfigDict
from pydantic.dataclasses import dataclass

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.model import read_model
from pdhef_logtool.drive.alignment import AlignmentPlan
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping import ClockModel, Mapping, check_mapping, fit_clocks
from pdhef_logtool.mapping.records import CanSettings, SignalSource
from pdhef_logtool.records.errors import VehicleError
from pdhef_logtool.storage.documents import validated

#: The offset of a device clock changes between logs: it is estimated from the messages of this duration.
CLOCK_START_S = 1.0
_REMEDY = "give the model.toml of a run of the same car and recorder"


@dataclass(frozen=True, slots=True, config=ConfigDict(extra="forbid", defer_build=True))
class Sensors:
    """How the sensors of a recorder are read.

    Attributes
    ----------
    signals, can : the mapping of the sensors, with mounting and units applied.
    clocks : relation of stamps to log time, by topic and stamp of the sensors.
    alignment : source, delay and gaps of every channel.
    decided_s : duration of the log that decided them.
    """

    signals: dict[str, SignalSource]
    clocks: dict[str, ClockModel]
    alignment: AlignmentPlan
    decided_s: float
    can: CanSettings | None = None

    def applied_to(self, mapping: Mapping) -> Mapping:
        """Return the mapping with these sensors; its ground truth is unchanged."""
        return replace(mapping, signals=self.signals, can=self.can, origin="file")


def with_earlier_drive(car: Car, path: Path) -> tuple[Car, Sensors]:
    """Return a car with the model of an earlier drive, and the sensors of that drive.

    Raises
    ------
    VehicleError : The file is missing, wrong, of another vehicle file, or without sensors.
    """
    model = read_model(path, "auto, off or a model.toml", _REMEDY)
    if not model.belongs_to(car.datasheet):
        raise VehicleError(
            expected=f"a model of the car {car.datasheet.name}",
            got=f"one of the vehicle file of {model.vehicle}, which differs",
            where=str(path),
            remedy="give the --car of that run, or a model of this car",
        )
    what = "the entries of a model.toml"
    sensors = validated(Sensors, model.sensors, f"{path}: sensors", VehicleError, expected=what, remedy=_REMEDY)
    return replace(car, model=model.over(car.model)), sensors


def clocks_of(sensors: Sensors, log: DriveLog, mapping: Mapping, start_ns: int) -> dict[str, ClockModel]:
    """Return the clocks of the sensors. A device clock keeps its drift; its offset is from this log's first messages.

    Parameters
    ----------
    mapping : with the sensors applied.

    Raises
    ------
    MappingError : The log lacks a topic of the sensors.
    """
    read = replace(mapping, truth={}, quality=None)
    check_mapping(read, log)
    first = fit_clocks(log, read, start_ns, start_ns + round(CLOCK_START_S * 1e9))
    return {
        key: replace(clock, reference_stamp_ns=new.reference_stamp_ns, reference_log_ns=new.reference_log_ns)
        if is_device_clock(clock) and is_device_clock(new := first[key])
        else clock
        for key, clock in sensors.clocks.items()
    }


def is_device_clock(clock: ClockModel) -> bool:
    """Return whether stamps of the clock are shifted to log time."""
    return (clock.reference_stamp_ns, clock.reference_log_ns, clock.drift) != (0, 0, 0.0)
