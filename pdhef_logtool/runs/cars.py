"""Which car each log of a run had: one for all, or a car a log by ``cars.toml`` (docs/car.md)."""

import os
from collections.abc import Callable
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from itertools import accumulate
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.names import SHIPPED_CARS
from pdhef_logtool.car.vehicle import Record
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.logs.open_log import log_metadata
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.journal import digest_of
from pdhef_logtool.storage.documents import jsonable, read_toml, validated

_Name = Annotated[str, Field(min_length=1)]


class CarTable(Record):
    """``cars.toml``: cars by log, by folder of logs, or by metadata of the logs.

    Cars and folders are relative to the file; a car may be a shipped one's name.

    Attributes
    ----------
    logs : car by file name of a log, or pattern of names (``run_*.mcap``); they win, the first that matches.
    folders : car by folder, the deepest that a log lies in.
    metadata : by key of the log's metadata, or ``record.key``, the car of each value.
    default : car of the other logs; None: a log without an entry is an error.
    """

    logs: dict[_Name, _Name] = Field(default_factory=dict)
    folders: dict[_Name, _Name] = Field(default_factory=dict)
    metadata: dict[_Name, dict[str, _Name]] = Field(default_factory=dict)
    default: _Name | None = None


@dataclass(frozen=True, slots=True)
class RunCars:
    """The cars of a run; each is read once.

    Attributes
    ----------
    paths : the files and folders of the cars, None for the default one. warn : called with stale parts.
    """

    config: RunConfig
    warn: Callable[[str], None] = lambda _text: None
    table: CarTable | None = None
    _read: dict[Path | None, Car] = field(default_factory=dict)

    @classmethod
    def of(cls, config: RunConfig, warn: Callable[[str], None]) -> "RunCars":
        """Return the cars that a configuration names.

        Raises
        ------
        UsageError
            It names one car and a table, or the table is missing, wrong, or names a car that is not there.
        VehicleError, ModelError
            The one car is wrong.
        """
        if config.cars is None:
            cars = cls(config, warn)
            cars.read(config.car)
            return cars
        if config.car is not None:
            raise UsageError(expected="car or cars", got="both", where="settings")
        raw = read_toml(config.cars, "a TOML table of cars", UsageError)
        table = validated(CarTable, raw, str(config.cars), UsageError, expected="the entries of cars.toml")
        cars = cls(config, warn, table)
        given = [path for path in filter(None, cars.paths) if str(path) not in SHIPPED_CARS]
        if missing := [str(path) for path in given if not path.exists()]:
            raise UsageError(expected="cars that are there", got=f"no {', '.join(missing)}", where=str(config.cars))
        return cars

    @property
    def paths(self) -> list[Path | None]:
        """Every car that may be read."""
        if self.table is None:
            return [self.config.car]
        table = self.table
        named = [car for of in (table.logs, table.folders, *table.metadata.values()) for car in of.values()]
        return list(dict.fromkeys(map(self._place, [*named, *filter(None, [table.default])])))

    def read(self, path: Path | None) -> Car:
        """Return a car, which is read at the first call; raises VehicleError or ModelError."""
        if path not in self._read:
            car = Car.load(path, network=self.config.network, sensors=self.config.sensor_profile)
            for note in car.notes:
                self.warn(note if self.table is None else f"{car.file_name}: {note}")
            self._read[path] = car
        return self._read[path]

    def of_log(self, log: LogInput) -> Car:
        """Return the car of a log.

        Raises
        ------
        UsageError
            The table names none, or its folders and the log's metadata name different ones.
        LogError
            The table asks for the log's metadata, which cannot be read.
        VehicleError, ModelError
            The car is wrong.
        """
        if self.table is None:
            return self.read(self.config.car)
        table = self.table
        by_name = next((car for name, car in table.logs.items() if fnmatchcase(log.path.name, name)), None)
        if by_name is not None:
            return self.read(self._place(by_name))
        by_folder = self._by_folder(log)
        matches = {} if by_folder is None else {f"folder {by_folder[0]}": by_folder[1]}
        if table.metadata:
            has = log_metadata(log.path, self.config.read_options.limits)
            matches |= {f"{k} {has[k]}": cars[has[k]] for k, cars in table.metadata.items() if has.get(k) in cars}
        cars = {self._place(car) for car in matches.values()}
        if len(cars) > 1:
            raise UsageError(
                expected="one car a log",
                got="; ".join(f"{car} by {why}" for why, car in matches.items()),
                where=str(log.path),
                remedy=f"name the log under [logs] of {self.config.cars}",
            )
        if not cars and table.default is None:
            asked = [*table.metadata] or ["none"]
            raise UsageError(
                expected=f"a car for every log in {self.config.cars}",
                got=f"no name, no folder and no metadata (asked for: {', '.join(asked)}) in it",
                where=str(log.path),
                remedy='name it under [logs], or give default = "car"',
            )
        return self.read(cars.pop() if cars else self._place(table.default or ""))

    def _by_folder(self, log: LogInput) -> tuple[str, str] | None:
        assert self.table is not None
        if log.folder is None:
            urls = {name.rstrip("/"): (name, car) for name, car in self.table.folders.items()}
            above = accumulate(log.path.parts, "{}/{}".format)
            return next((urls[url] for url in reversed(list(above)) if url in urls), None)
        place = Path(os.path.realpath(log.folder)) / log.path.name  # a link lies where it was put
        places = {Path(os.path.realpath(self._beside(name))): (name, car) for name, car in self.table.folders.items()}
        return next((places[folder] for folder in (place, *place.parents) if folder in places), None)

    def _place(self, car: str) -> Path:
        return Path(car) if car in SHIPPED_CARS else self._beside(car)

    def _beside(self, name: str) -> Path:
        assert self.config.cars is not None
        return self.config.cars.parent / name


def car_record(car: Car) -> dict[str, Any]:
    """Return the identity of a car for ``--resume``: its name, name and digest of its network, a digest of each part.

    Messages name the part that has changed.
    """
    network = None if car.network is None else [Path(car.network_name).name, car.network.sha256]
    parts = {
        "the car's physics": car.vehicle,
        "the car's fit": [car.fitted_physics, car.noise],
        "the car's model": car.model,
        "the network": network,
        "the residual gain": car.network_gain,
    }
    digests = {what: digest_of(jsonable(part)) for what, part in parts.items()}
    return {"name": car.file_name or "", "network": network, "parts": digests}
