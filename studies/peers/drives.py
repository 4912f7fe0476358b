"""The recorded drives with ground truth: car, mapping and vehicle file of each, all without use of ground truth."""

from collections.abc import Mapping as Table
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pdhef_logtool.car.toml_files import vehicle_of_entries
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.mapping.mapping_file import mapping_from_dict
from studies.pages import DRIVES, ROOT, read_toml

REFERENCE = ROOT / "tests" / "reference"
#: Groups of the page: full-size cars on roads, small or off-road cars, and drives with an offset in the ground truth.
FULL_SIZE, SMALL, OFFSET = "full-size", "small", "offset"
_HERE = Path(__file__).parent
#: Names of quantities and entries in the files beside the drives (``.signals.toml``, ``.vehicle.toml``), and here.
_NAMES = read_toml(_HERE / "beside.toml")


@dataclass(frozen=True, slots=True)
class PeerDrive:
    """A drive.

    Attributes
    ----------
    log : file or folder. car : has one vote. group : table of the page.
    files : mapping and vehicle in ``tests/reference``; empty: from the files beside the drive.
    least_speed_m_s : sideslip is scored above it.
    same_as : drive of which this log is another recording; both share its weight.
    """

    log: str
    car: str
    group: str = FULL_SIZE
    files: str = ""
    least_speed_m_s: float = 3.0
    same_as: str = ""

    @property
    def drive(self) -> str:
        """Name of the drive that the log recorded."""
        return self.same_as or self.log


PEER_DRIVES = tuple(PeerDrive(log, **entries) for log, entries in read_toml(_HERE / "drives.toml").items())


def peer_drive(log: str) -> PeerDrive:
    """Return the drive of a log."""
    return next(drive for drive in PEER_DRIVES if drive.log == log)


def needed_files(drive: PeerDrive) -> tuple[Path, ...]:
    """Return the files outside the repository that a drive needs: its log, and mapping and vehicle beside it."""
    beside = () if drive.files else (".signals.toml", ".vehicle.toml")
    return tuple(DRIVES / f"{drive.log}{end}" for end in ("", *beside))


def mapping_table(drive: PeerDrive, *, receiver: bool = False) -> dict[str, Any]:
    """Return the mapping file of a drive as a document; ``receiver``: the GNSS velocity of a V40 replaces its speed."""
    if drive.log.startswith("v40_"):
        document = read_toml(_HERE / "v40_gnss.toml")
        if receiver:
            del document["signals"]["speed_m_s"]
            document["signals"] |= read_toml(_HERE / "v40_receiver.toml")
        return document
    if drive.files:
        return read_toml(REFERENCE / "mappings" / f"{drive.files}.toml")
    return beside_mapping(read_toml(DRIVES / f"{drive.log}.signals.toml"))


def beside_mapping(document: Table[str, Any]) -> dict[str, Any]:
    """Return the mapping file of a ``.signals.toml`` document."""
    sides: dict[str, dict[str, Any]] = {"signals": {}, "truth": {}}
    for entry in document["signal"]:
        side = "signals" if entry["role"] == "sensor" else entry["role"]
        if side in sides and entry["signal"] in _NAMES[side]:
            source = {key: entry[key] for key in ("topic", "field", "stamp", "scale", "offset")}
            sides[side][_NAMES[side][entry["signal"]]] = source
    return sides


def vehicle_table(drive: PeerDrive) -> dict[str, Any]:
    """Return the published vehicle file of a drive as a document."""
    if not drive.files:
        return beside_vehicle(read_toml(DRIVES / f"{drive.log}.vehicle.toml"))
    name = "comma2k19_rav4" if drive.files == "comma2k19" else drive.files
    vehicle = read_toml(REFERENCE / "vehicles" / f"{name}.toml")
    # The accelerometer position in the TT-S file was regressed on ground truth.
    return vehicle | {"imu_position_m": [0.0, 0.0, 0.0]} if name == "tts_kk" else vehicle


def beside_vehicle(document: Table[str, Any]) -> dict[str, Any]:
    """Return the vehicle file of a ``.vehicle.toml`` document; friction is the mean of the axles."""
    given = document["vehicle"]
    raw = {_NAMES["vehicle"][name]: value for name, value in given.items() if name in _NAMES["vehicle"]}
    if "friction_front" in given:
        raw["friction"] = 0.5 * (given["friction_front"] + given["friction_rear"])
    if "reference_point_x_from_cg_m" in given:
        raw["truth_position_m"] = [given["reference_point_x_from_cg_m"], 0.0, 0.0]
    if given["name"].startswith("Polaris"):
        raw["imu_position_m"] = raw["truth_position_m"]  # one instrument
    stiffness = {
        axle: {"cornering_stiffness_n_per_rad": given[f"c{axle[0]}_axle_n_per_rad"]} for axle in ("front", "rear")
    }
    return raw | {"tyres": stiffness}


def mapping_of(drive: PeerDrive) -> Mapping:
    """Return the mapping of a drive, as :func:`mapping_table`."""
    return mapping_from_dict(mapping_table(drive), where=drive.log)


def vehicle_of(drive: PeerDrive) -> VehicleParameters:
    """Return the published vehicle of a drive."""
    return vehicle_of_entries(vehicle_table(drive), where=drive.log).vehicle
