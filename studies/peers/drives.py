"""The recorded drives with ground truth: car, mapping and vehicle file of each, all without use of ground truth."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping as Table
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.toml_files import load_vehicle
from pdhef_logtool.car.vehicle import VehicleParameters, vehicle_from_dict
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import WholeDrive, read_drive
from pdhef_logtool.mapping import Mapping, SignalSource, load_mapping
from studies.pages import DRIVES, ROOT

REFERENCE = ROOT / "tests" / "reference"
#: Groups of the page: full-size cars on roads, small or off-road cars, and drives whose ground truth has an offset.
FULL_SIZE, SMALL, OFFSET = "full-size", "small", "offset"
_WHEELS = (("front", "rear"), ("left", "right"))
#: Quantities of the ``.signals.toml`` files beside the drives, by role; road wheel and steering wheel are sensors only.
_SIGNALS = {
    "longitudinal_acceleration": "ax_m_s2", "lateral_acceleration": "ay_m_s2", "yaw_rate": "yaw_rate_rad_s",
    "road_wheel_angle": "steer_rad", "steering_wheel_angle": "steering_wheel_rad", "longitudinal_velocity": "speed_m_s",
    **{f"wheel_speed_{end}_{side}": f"wheel_speed_{end[0]}{side[0]}_m_s" for end, side in product(*_WHEELS)},
}  # fmt: skip
_TRUTH = {"longitudinal_velocity": "vx_m_s", "lateral_velocity": "vy_m_s", "yaw_rate": "yaw_rate_rad_s"}
#: Entries of the ``.vehicle.toml`` files beside the drives with another name here.
_VEHICLE = {"lf_m": "cg_to_front_axle_m", "lr_m": "cg_to_rear_axle_m"}


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


_F1TENTH = ("hoons_run2", "xray_run24", "xray_0", "test_20", "test_63", "hoonsall_22", "tyres_0", "tyres_6")
PEER_DRIVES = (
    PeerDrive("revs_250lm_a.mcap", "250 LM", files="revs_250lm"),
    PeerDrive("niki_gti_1khz.mcap", "GTI", files="niki_gti"),
    PeerDrive("gti_pole_aa.mcap", "GTI"),
    PeerDrive("gti_low_speed.mcap", "GTI"),
    PeerDrive("stanford_wet_1.mcap", "GTI"),
    PeerDrive("tts_kk.mcap", "TT-S", files="tts_kk"),
    PeerDrive("lunda_v40", "V40", files="lunda_v40"),
    PeerDrive("v40_swd_gnss.mcap", "V40", files="lunda_v40", same_as="lunda_v40"),
    PeerDrive("v40_slalom.mcap", "V40", files="lunda_v40"),
    *(PeerDrive(f"f1tenth_{name}.bag", "1:10 F1TENTH", SMALL, "f1tenth", 1.0) for name in _F1TENTH),
    PeerDrive("dart_circles_fast.mcap", "1:10 DART", SMALL, least_speed_m_s=1.0),
    PeerDrive("dart_steer_rate.mcap", "1:10 DART", SMALL, least_speed_m_s=1.0),
    PeerDrive("autorally_7.mcap", "1:5 AutoRally", SMALL),
    PeerDrive("polaris_a.mcap", "Polaris", OFFSET),
    PeerDrive("polaris_b.mcap", "Polaris", OFFSET),
    PeerDrive("comma2k19_segment.mcap", "RAV4", OFFSET, "comma2k19"),
)


def mapping_of(drive: PeerDrive, folder: Path = DRIVES) -> Mapping:
    """Return the mapping of a drive."""
    if drive.log.startswith("v40_"):
        return load_mapping(Path(__file__).with_name("v40_gnss.toml"))
    if drive.files:
        return load_mapping(REFERENCE / "mappings" / f"{drive.files}.toml")
    return beside_mapping(tomllib.loads((folder / f"{drive.log}.signals.toml").read_text(encoding="utf-8")))


def beside_mapping(document: Table[str, Any]) -> Mapping:
    """Return the mapping of a ``.signals.toml`` document."""
    sides: dict[str, dict[str, SignalSource]] = {"sensor": {}, "truth": {}}
    for entry in document["signal"]:
        names = _SIGNALS if entry["role"] == "sensor" else _TRUTH
        if entry["role"] in sides and entry["signal"] in names:
            name = names[entry["signal"]]
            place = entry["topic"], entry["field"], entry["stamp"]
            sides[entry["role"]][name] = SignalSource(name, *place, scale=entry["scale"], offset=entry["offset"])
    return Mapping(sides["sensor"], sides["truth"])


def vehicle_of(drive: PeerDrive, folder: Path = DRIVES) -> VehicleParameters:
    """Return the published vehicle of a drive."""
    if not drive.files:
        return beside_vehicle(tomllib.loads((folder / f"{drive.log}.vehicle.toml").read_text(encoding="utf-8")))
    name = "comma2k19_rav4" if drive.files == "comma2k19" else drive.files
    vehicle = load_vehicle(REFERENCE / "vehicles" / f"{name}.toml")
    # The accelerometer position in the TT-S file was regressed on ground truth.
    return vehicle.model_copy(update={"imu_position_m": (0.0, 0.0, 0.0)}) if name == "tts_kk" else vehicle


def beside_vehicle(document: Table[str, Any]) -> VehicleParameters:
    """Return the vehicle of a ``.vehicle.toml`` document; friction is the mean of the axles."""
    given = document["vehicle"]
    renamed = {_VEHICLE.get(name, name): value for name, value in given.items()}
    raw = {name: value for name, value in renamed.items() if name in VehicleParameters.model_fields}
    raw["tyres"] = {
        axle: {"cornering_stiffness_n_per_rad": given[f"c{axle[0]}_axle_n_per_rad"]} for axle in ("front", "rear")
    }
    if "friction_front" in given:
        raw["friction"] = 0.5 * (given["friction_front"] + given["friction_rear"])
    if "reference_point_x_from_cg_m" in given:
        raw["truth_position_m"] = (given["reference_point_x_from_cg_m"], 0.0, 0.0)
    if given["name"].startswith("Polaris"):
        raw["imu_position_m"] = raw["truth_position_m"]  # one instrument
    if given["mass_kg"] < 3.0:
        raw["low_speed_blend_m_s"] = 0.3  # as in the file of the other 1:10 car
    return vehicle_from_dict(raw, where=given["name"])


def read_peer_drive(log: Path, vehicle: VehicleParameters, mapping: Mapping) -> WholeDrive:
    """Read a drive as ``pdhef run`` does."""
    with read_drive(log, Car.of(vehicle), mapping, ReadOptions()) as drive:
        return drive.whole()
