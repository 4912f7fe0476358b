"""The recorded drives with ground truth: car, mapping and vehicle file of each, all without use of ground truth."""

from __future__ import annotations

import tempfile
import tomllib
from collections.abc import Mapping as Table
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.mapping import Mapping, load_mapping
from studies.pages import DRIVES, ROOT, write_toml

REFERENCE = ROOT / "tests" / "reference"
#: Groups of the page: full-size cars on roads, small or off-road cars, and drives with an offset in the ground truth.
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
_ENTRIES = ("name", "mass_kg", "yaw_inertia_kg_m2", "cg_to_front_axle_m", "cg_to_rear_axle_m", "track_m", "cg_height_m",
            "wheel_radius_m", "steering_ratio")  # fmt: skip
#: Velocity of the V40's GNSS receiver, and roll and pitch rate, which correct it for the height of the antenna.
RECEIVER = {
    f"gnss_velocity_{to}_m_s": {"topic": "/gnss/velocity", "field": f"twist.linear.{axis}", "stamp": "header.stamp"}
    for to, axis in (("east", "x"), ("north", "y"))
} | {
    f"{to}_rate_rad_s": {"topic": "/imu/data", "field": f"angular_velocity.{axis}", "stamp": "header.stamp"}
    for to, axis in (("roll", "x"), ("pitch", "y"))
}


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


def mapping_table(drive: PeerDrive, folder: Path = DRIVES, *, receiver: bool = False) -> dict[str, Any]:
    """Return the mapping file of a drive as a document; ``receiver``: the GNSS velocity of a V40 replaces its speed."""
    if drive.log.startswith("v40_"):
        document = _document(Path(__file__).with_name("v40_gnss.toml"))
        if receiver:
            del document["signals"]["speed_m_s"]
            document["signals"] |= RECEIVER
        return document
    if drive.files:
        return _document(REFERENCE / "mappings" / f"{drive.files}.toml")
    return beside_mapping(_document(folder / f"{drive.log}.signals.toml"))


def beside_mapping(document: Table[str, Any]) -> dict[str, Any]:
    """Return the mapping file of a ``.signals.toml`` document."""
    sides: dict[str, dict[str, Any]] = {"signals": {}, "truth": {}}
    for entry in document["signal"]:
        side, names = ("signals", _SIGNALS) if entry["role"] == "sensor" else ("truth", _TRUTH)
        if entry["role"] in ("sensor", "truth") and entry["signal"] in names:
            source = {key: entry[key] for key in ("topic", "field", "stamp", "scale", "offset")}
            sides[side][names[entry["signal"]]] = source
    return sides


def vehicle_table(drive: PeerDrive, folder: Path = DRIVES) -> dict[str, Any]:
    """Return the published vehicle file of a drive as a document."""
    if not drive.files:
        return beside_vehicle(_document(folder / f"{drive.log}.vehicle.toml"))
    name = "comma2k19_rav4" if drive.files == "comma2k19" else drive.files
    vehicle = _document(REFERENCE / "vehicles" / f"{name}.toml")
    # The accelerometer position in the TT-S file was regressed on ground truth.
    return vehicle | {"imu_position_m": [0.0, 0.0, 0.0]} if name == "tts_kk" else vehicle


def beside_vehicle(document: Table[str, Any]) -> dict[str, Any]:
    """Return the vehicle file of a ``.vehicle.toml`` document; friction is the mean of the axles."""
    given = document["vehicle"]
    raw = {_VEHICLE.get(name, name): value for name, value in given.items() if _VEHICLE.get(name, name) in _ENTRIES}
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


def _document(path: Path) -> dict[str, Any]:
    return tomllib.loads(path.read_text(encoding="utf-8"))


def mapping_of(drive: PeerDrive, folder: Path = DRIVES, *, receiver: bool = False) -> Mapping:
    """Return the mapping of a drive, as :func:`mapping_table`."""
    with tempfile.TemporaryDirectory() as work:
        return load_mapping(write_toml(Path(work) / "mapping.toml", mapping_table(drive, folder, receiver=receiver)))


def vehicle_of(drive: PeerDrive, folder: Path = DRIVES) -> VehicleParameters:
    """Return the published vehicle of a drive."""
    with tempfile.TemporaryDirectory() as work:
        return Car.load(write_toml(Path(work) / "vehicle.toml", vehicle_table(drive, folder))).vehicle
