"""Parameters and identified parts of one vehicle, for estimators and commands.

A car is a folder. The user writes ``vehicle.toml``, and no command changes it; ``learn`` writes ``model.toml`` beside
it, ``train`` the folder ``network``. The shipped car has ``fit.toml`` (:mod:`~.parts`). A single
``vehicle.toml`` is a car without parts. A part of another vehicle file is not used, and the car has a note.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from pdhef_logtool.car.assumed_values import DEFAULT_CG_SPREAD, AssumedValue
from pdhef_logtool.car.model import GROUND_TRUTH, CarModel, TaughtParameter, read_model
from pdhef_logtool.car.names import MODEL_FILE, SHIPPED_CARS as SHIPPED_CARS
from pdhef_logtool.car.parts import PHYSICS, FilterNoise, Fit, FittedPhysics, LearntOn, physics_sha256
from pdhef_logtool.car.posterior import Posterior
from pdhef_logtool.car.toml_files import VehicleFile, read_vehicle_file, with_sensors
from pdhef_logtool.car.vehicle import DEFAULT_VEHICLE_NAME, VehicleParameters, default_vehicle
from pdhef_logtool.records.errors import VehicleError
from pdhef_logtool.residual_model import bundle as bundles
from pdhef_logtool.residual_model.interface import PlugInModel, load_plug_in, plug_in_names
from pdhef_logtool.storage.documents import read_toml, validated

VEHICLE_FILE, FIT_FILE = "vehicle.toml", "fit.toml"
NETWORK_FOLDER = "network"
#: Number of digits of a hash in messages.
SHOWN_DIGITS = 12

#: A file or folder, or the name of a shipped one.
Place = Path | str | None


@dataclass(frozen=True, slots=True, eq=False)
class Car:
    """A vehicle with its identified parts.

    Attributes
    ----------
    vehicle : physics and sensors of the user's file, or as calibrated on the drive.
    noise : of filters, by the name of :data:`~.parts.NOISY_FILTERS`.
    fitted_physics : values and noise identified with the filter ``physics``, None without.
    model : prior of the calibration, and residual, from earlier drives; None without.
    network, network_name : the residual network, None without.
    network_gain : residual gain of ``pd-hef``; None: 1 with a network that was trained with these physics, otherwise 0.
    learnt_on : drives on which ``fitted_physics`` was identified.
    self_calibrated : the posterior of the current drive, for the estimators that use it; None without.
    assumed : missing entries of the file. source : folder or file, None for the default car.
    notes : stale parts, with the reason.
    """

    vehicle: VehicleParameters
    noise: Mapping[str, FilterNoise] = field(default_factory=dict)
    network: bundles.ModelBundle | PlugInModel | None = None
    network_name: str = bundles.NO_MODEL
    network_gain: float | None = None
    learnt_on: tuple[LearntOn, ...] = ()
    fitted_physics: FittedPhysics | None = None
    model: CarModel | None = None
    self_calibrated: Posterior | None = None
    assumed: tuple[AssumedValue, ...] = ()
    source: Path | None = None
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"<Car {self.vehicle.name}: {self.source or 'default'}, network {self.network_name}>"

    @classmethod
    def load(cls, path: Place = None, *, network: Place = None, sensors: Place = None) -> "Car":
        """Read a car.

        Parameters
        ----------
        path : a car's folder, a vehicle.toml, ``saloon`` (the shipped car); None: the default sedan.
        network : instead of the car's own: the name of a shipped network or an installed model, a folder, ``none``.
        sensors : instead of the car's own: a profile's name, or a file with ``[sensors]``.

        Raises
        ------
        VehicleError, ModelError
            A file is missing or wrong; the error lists all wrong entries.

        >>> car = Car.load("saloon")
        >>> car.vehicle.mass_kg, sorted(car.noise), car.residual_gain
        (1440.0, ['phy-ukf:tuned', 'physics'], 0.75)
        """
        source = SHIPPED_CARS.get(str(path), None if path is None else Path(path))
        folder = source if source is not None and source.is_dir() else None
        file = _file_of(source, folder)
        vehicle = file.vehicle if sensors is None else with_sensors(file.vehicle, sensors)
        car = cls(vehicle, network_gain=file.network_gain, assumed=file.assumed, source=source)
        if folder is not None:
            car = _with_parts(car, folder)
        name, used = _network_of(folder, network)
        return replace(car, network=used, network_name=name)

    @property
    def file_name(self) -> str | None:
        """Name of its folder or file or of a shipped car, without the path; None for the default car."""
        shipped = [name for name, folder in SHIPPED_CARS.items() if folder == self.source]
        return shipped[0] if shipped else None if self.source is None else self.source.name or str(self.source)

    @property
    def physics_sha256(self) -> str:
        """Digest of the physics for the estimators."""
        return physics_sha256(self.vehicle)

    @property
    def physics_vehicle(self) -> VehicleParameters:
        """The vehicle for the filter ``physics``: the one identified with it, otherwise as for all filters."""
        return self.vehicle if self.fitted_physics is None else self.fitted_physics.values

    @property
    def residual_network(self) -> bundles.ModelBundle | PlugInModel | None:
        """The network if its residual is of ``physics``; the paper's network predicts the residual of ``phy-ukf``."""
        return self.network if self.network is not None and self.network.model == bundles.PHYSICS_MODEL else None

    @property
    def residual_gain(self) -> float:
        """Residual gain of ``pd-hef`` with the network of this car (docs/method.md#gain)."""
        if self.network_gain is not None:
            return self.network_gain
        return float(self.network is not None and self.network.physics_sha256 == physics_sha256(self.physics_vehicle))

    @property
    def taught_prior(self) -> tuple[TaughtParameter, ...]:
        """Prior of the calibration from earlier drives; empty without."""
        return () if self.model is None else self.model.parameters

    @property
    def has_evidence(self) -> bool:
        """Whether drives confirm this vehicle: it was fitted, or its network was trained with it."""
        return bool(self.learnt_on) or self.fitted_physics is not None or self.residual_gain > 0.0

    @property
    def cg_std_m(self) -> float:
        """1-sigma of the distance from the rear axle to the centre of gravity; 0 if the file gives this distance."""
        share = next((a.spread for a in self.assumed if a.entry == "front_weight_share"), 0.0)
        if self.source is None and self.vehicle.name == DEFAULT_VEHICLE_NAME:
            share = DEFAULT_CG_SPREAD
        return share * self.vehicle.cg_to_rear_axle_m

    @property
    def calibrated_car(self) -> "Car":
        """The car with the vehicle as calibrated on the log; the same car without a calibration."""
        calibrated = self.self_calibrated
        if calibrated is None:
            return self
        physics = FittedPhysics(values=calibrated.vehicle, noise=calibrated.noise)
        return replace(
            self.with_noise(PHYSICS, physics.noise),
            vehicle=calibrated.vehicle,
            network_gain=self.residual_gain,
            fitted_physics=physics,
            self_calibrated=None,
        )

    def with_noise(self, name: str, noise: FilterNoise) -> "Car":
        """Return the car with different noise of one filter."""
        return replace(self, noise={**self.noise, name: noise})


def _file_of(source: Path | None, folder: Path | None) -> VehicleFile:
    """Return the vehicle file of a car, or of the default sedan without a source; raises VehicleError."""
    if folder is None:
        return VehicleFile(default_vehicle(), None, ()) if source is None else read_vehicle_file(source)
    if not (folder / VEHICLE_FILE).is_file():
        what = "a network's" if (folder / bundles.DOCUMENT_FILE).is_file() else "another"
        expected = f"a car: a folder with {VEHICLE_FILE}, or such a file"
        raise VehicleError(expected=expected, got=f"{what} folder", where=str(folder))
    return read_vehicle_file(folder / VEHICLE_FILE)


def _with_parts(car: Car, folder: Path) -> Car:
    """Return the car with the valid parts of its folder: ``model.toml``, or a fit."""
    notes: list[str] = []
    if (folder / MODEL_FILE).exists():
        model = read_model(folder / MODEL_FILE)
        if model.belongs_to(car.vehicle):
            if (folder / FIT_FILE).exists():
                notes.append(f"{FIT_FILE}: not used, {MODEL_FILE} takes its place")
            if model.truth not in ("", GROUND_TRUTH):
                notes.append(f"{MODEL_FILE}: taught by {model.truth}")
            return replace(car, model=model, notes=tuple(notes))
        notes.append(f"{MODEL_FILE} is not used: {VEHICLE_FILE} has changed since; pdhef learn creates it again")
    if (folder / FIT_FILE).exists():
        fit = read_fit(folder / FIT_FILE)
        if fit.physics_sha256 == physics_sha256(car.vehicle):
            noise = fit.filter if fit.physics is None else fit.filter | {PHYSICS: fit.physics.noise}
            car = replace(car, noise=noise, fitted_physics=fit.physics, learnt_on=fit.drives)
        else:
            notes.append(f"{FIT_FILE} is not used: {VEHICLE_FILE} has changed since")
    return replace(car, notes=tuple(notes))


def read_fit(path: Path) -> Fit:
    """Read a fit.toml; raises VehicleError."""
    what = "a car's fit.toml"
    raw = read_toml(path, what, VehicleError)
    return validated(Fit, raw, str(path), VehicleError, expected=f"the entries of {what}")


def _network_of(folder: Path | None, chosen: Place) -> tuple[str, bundles.ModelBundle | PlugInModel | None]:
    """Return name and network in force; raises ModelError."""
    name = bundles.SHIPPED if chosen is None else str(chosen)
    if name == bundles.NO_MODEL:
        return bundles.NO_MODEL, None
    inside = None if folder is None or folder in SHIPPED_CARS.values() else folder / NETWORK_FOLDER
    if chosen is None and inside is not None and (inside / bundles.DOCUMENT_FILE).is_file():
        return NETWORK_FOLDER, bundles.load_bundle(inside)
    if name in bundles.SHIPPED_FOLDERS:
        home = bundles.SHIPPED_FOLDERS[name]
        # A source tree without shipped networks still runs the estimators that need none.
        is_absent = chosen is None and not (home / bundles.DOCUMENT_FILE).is_file()
        return (bundles.NO_MODEL, None) if is_absent else (name, bundles.load_bundle(home))
    if name in plug_in_names():
        return name, load_plug_in(name)
    # The path may be a car's folder that contains the network.
    home = Path(name)
    return name, bundles.load_bundle(
        home / NETWORK_FOLDER if (home / NETWORK_FOLDER / bundles.DOCUMENT_FILE).is_file() else home
    )
