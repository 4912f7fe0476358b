"""The sideslip reference against ground truth: recorded and simulated drives, with and without GNSS.

    python -m studies.reference [--cases TEXT ...] [--work out/reference] [--out docs] [--results DIR]

Each case is a run of ``pdhef run --reference on`` (docs/method.md#reference). Recorded drives are in
``../shared``, which may not be redistributed: without them, their stored figures stay. GNSS of most of them is made
from ground truth and marked so. Only cases with changed inputs are recomputed.
Recorded drives were seen while constants were chosen: their figures are development figures.
"""

import hashlib
import heapq
import json
import math
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from pdhef_logtool import Car
from pdhef_logtool.evaluation.track_errors import NORMAL_95
from pdhef_logtool.records.geometry import DEGREES, wrap_angle
from pdhef_logtool.records.signals import FloatArray, IntArray
from studies import pages
from studies.drawn_cars import FIT_FRICTION, fit_vehicle
from studies.gates.tool import Tool, estimates, metrics, reports, sideslip_rmse_deg
from studies.mcap_logs import Message, messages, write_log
from studies.pages import DRIVES, ROOT, write_toml
from studies.peers.drives import PEER_DRIVES, mapping_table, peer_drive, vehicle_table
from studies.recalibrate import input_digest
from truthsim.batch import DriveSpec
from truthsim.drive import DEFAULT_VEHICLE
from truthsim.vehicle_choice import choose_vehicle

STORED = "cases.json"
#: Checks that a spin fails: its course does not turn as the car does.
SPIN_CHECKS = ("yaw_rate_rad_s.unit", "truth.yaw_rate_rad_s.unit", "truth.sideslip_rad.frame")
#: Sideslip is scored above this speed.
LEAST_SPEED_M_S = 3.0
#: Where the antenna of made GNSS is from the CG, forward and left, and above the roll axis, m.
ANTENNA_M, ANTENNA_HEIGHT_M = (-0.4, 0.1), 1.2
#: From the stamp of made GNSS to its arrival, s.
LATE_S = 0.06
#: Estimates that rankings compare, and a clear difference of two of them.
RANKED, CLEAR_DEG = ("zero", "kinematic", "open-loop", "phy-ukf", "physics"), 0.3


_TABLES = pages.read_toml(Path(__file__).with_suffix(".toml"))
#: GNSS velocity made from ground truth: rate, white and correlated 1-sigma errors, and how late it is.
RECEIVERS: dict[str, dict[str, float]] = _TABLES["receivers"]
NONE, REAL = "none", "recorded"


@dataclass(frozen=True, slots=True)
class Case:
    """One row: a recorded drive (``log``) or a simulated one (``spec``), its GNSS and its fault.

    ``fault``: a name of ``FAULTS``. ``target_deg``: RMSE that the reference must reach, None: only reported.
    """

    title: str
    gnss: str = NONE
    log: str = ""
    spec: DriveSpec | None = None
    fault: str = ""
    target_deg: float | None = None
    least_speed_m_s: float = LEAST_SPEED_M_S

    @property
    def name(self) -> str:
        """Title, GNSS and fault in one text."""
        return ", ".join(text for text in (self.title, f"GNSS {self.gnss}", self.fault) if text)


class Motion(NamedTuple):
    """Ground truth [N] that GNSS is made from; heading up to a constant."""

    stamps_ns: IntArray
    vx_m_s: FloatArray
    vy_m_s: FloatArray
    heading_rad: FloatArray
    roll_rate_rad_s: FloatArray


def made_gnss(motion: Motion, receiver: Mapping[str, float], fault: str) -> tuple[IntArray, FloatArray]:
    """Return the stamps [M] and the velocities [M, 2] to the east and north that a receiver would show."""
    rng = np.random.default_rng(7)
    t = (motion.stamps_ns - motion.stamps_ns[0]) * 1e-9
    sampled = np.arange(0.0, t[-1], 1.0 / receiver["rate_hz"])
    rate = np.gradient(np.unwrap(motion.heading_rad), t)
    forward = motion.vx_m_s - ANTENNA_M[1] * rate
    left = motion.vy_m_s + ANTENNA_M[0] * rate - ANTENNA_HEIGHT_M * motion.roll_rate_rad_s
    cos, sin = np.cos(motion.heading_rad + 0.7), np.sin(motion.heading_rad + 0.7)
    keep = math.exp(-1.0 / (receiver["rate_hz"] * receiver["correlated_s"]))
    columns = []
    for component in (cos * forward - sin * left, sin * forward + cos * left):
        drawn = rng.standard_normal(len(sampled) + 1)[:-1]
        drawn[1:] *= math.sqrt(1.0 - keep**2)
        correlated = lfilter([1.0], [1.0, -keep], drawn)
        good = np.isfinite(component)
        made = np.interp(sampled - receiver.get("delay_s", 0.0), t[good], component[good])
        columns.append(
            made + receiver["correlated_m_s"] * correlated + receiver["white_m_s"] * rng.standard_normal(len(made))
        )
    velocity = np.stack(columns, axis=1)
    stamps = motion.stamps_ns[0] + np.rint(sampled * 1e9).astype(np.int64)
    if fault == OUTAGE:
        there = (sampled < 20.0) | (sampled >= 40.0)
        return stamps[there], velocity[there]
    if fault == MULTIPATH:
        velocity[(sampled >= 20.0) & (sampled < 25.0)] += 0.5 / math.sqrt(2.0)
    return stamps, velocity


def add_gnss(log: Path, output: Path, stamps_ns: IntArray, velocity_m_s: FloatArray) -> Path:
    """Copy an MCAP log and add a topic with GNSS velocity as JSON; it arrives ``LATE_S`` after its stamp."""
    types = {"type": "object", "properties": {name: {"type": "number"} for name in ("east", "north")}}
    schema, late_ns = ("Velocity", "jsonschema", json.dumps(types).encode()), round(1e9 * LATE_S)
    added = (
        Message(stamp + late_ns, stamp, GNSS_TOPIC, json.dumps({"east": e, "north": n}).encode(), "json", schema)
        for stamp, (e, n) in zip(stamps_ns.tolist(), velocity_m_s.tolist(), strict=True)
    )
    return write_log(output, heapq.merge(messages(log), added, key=lambda m: m.log_time_ns))


GNSS_TOPIC = "/made/gnss_velocity"
MADE_SOURCES = {
    f"gnss_velocity_{to}_m_s": {"topic": GNSS_TOPIC, "field": to, "stamp": "publish_time"} for to in ("east", "north")
}
OUTAGE, MULTIPATH = "no GNSS from 20 to 40 s", "multipath of 0.5 m/s from 20 to 25 s"
BIASED = "a_y + 0.5 m/s², yaw rate + 0.005 rad/s and 1 %"
WRONG_AXLE = "l_r wrong by 0.15 m"
FAULTS = (OUTAGE, MULTIPATH, BIASED, WRONG_AXLE)
#: Of simulated drives: the position of the accelerometer is not stated.
MOVED_IMU, REAR_IMU = "accelerometer at the rear axle", (("imu_x_m", -1.71),)
#: Of recorded drives with a receiver: the ground truth is the velocity of the antenna, at the position estimated by the
#: smoother, instead of the velocity of the reference point in the vehicle file.
AT_ANTENNA = "ground truth at the antenna"


def _specs(entries: dict[str, dict[str, Any]]) -> dict[str, DriveSpec]:
    usual = {"friction": 0.85, "seed": 1, "duration_s": 14.0}
    return {title: DriveSpec(**usual | entry) for title, entry in entries.items()}


SIMULATED = _specs(_TABLES["simulated"])
OTHER_CARS = _specs({
    f"{manoeuvre} {fastest - slower} km/h, {car}": {
        "manoeuvre": manoeuvre, "speed_km_h": fastest - slower, "seed": 900 + fastest - slower,
        "vehicle": f"{car}~{900 + fastest - slower}", "duration_s": 60.0 if manoeuvre == "road" else 14.0,
    }
    for car, slower in _TABLES["other_cars"]["slower_km_h"].items()
    for manoeuvre, fastest in _TABLES["other_cars"]["fastest_km_h"].items()
})  # fmt: skip
MADE = "Doppler 10 Hz"


def cases() -> Iterator[Case]:
    """Yield all rows of the page."""
    for drive in PEER_DRIVES:
        if drive.log == "lunda_v40":  # the drive of v40_swd_gnss without its receiver
            continue
        entry = _TABLES["recorded"].get(drive.log, {})
        title = entry.get("title", f"{drive.car}, {drive.log.partition('.')[0]}")
        received = REAL if drive.log.startswith("v40_") else MADE
        for gnss in (NONE, received) if entry else (NONE,):
            target = entry.get("targets_deg", {}).get(gnss)
            yield Case(title, gnss, log=drive.log, target_deg=target, least_speed_m_s=drive.least_speed_m_s)
            if gnss == REAL:
                yield Case(title, gnss, log=drive.log, fault=AT_ANTENNA, target_deg=target)
    for title, spec in SIMULATED.items():
        for gnss in (NONE, *RECEIVERS):
            targets = _TABLES["simulated_targets_deg"].get(title, {})
            yield Case(title, gnss, spec=spec, target_deg=targets.get(NONE if gnss == NONE else "made"))
    for title, spec in OTHER_CARS.items():
        for gnss in (NONE, MADE):
            yield Case(title, gnss, spec=spec)
    ((title, spec),) = _specs(_TABLES["road"]).items()
    for fault in FAULTS:
        for gnss in (MADE,) if fault in (OUTAGE, MULTIPATH) else (NONE, MADE):
            yield Case(title, gnss, spec=spec, fault=fault)
    for title in ("sine with dwell, 80 km/h", "fishhook, 70 km/h", "double lane change, 100 km/h"):
        yield Case(title, MADE, spec=replace(SIMULATED[title], sensors=REAR_IMU), fault=MOVED_IMU)


#: Figures of a case; angles in degrees. ``truth``: RMS of the ground truth. ``physics``, ``aided``: RMSE of ``physics``
#: without and with GNSS. ``pairs`` of estimates: that the reference ranks, of these as by ground truth; that differ by
#: more than ``CLEAR_DEG``, of these that the reference ranks.
Figures = dict[str, Any]


def figures(case: Case, tool: Tool) -> Figures:
    """Run a case and compare its reference with the ground truth at all stamps above the least speed.

    With GNSS, the estimators that the reference ranks also run, with and without it.
    """
    name = "".join(c if c.isalnum() else "-" for c in case.name)
    log, mapping, vehicle, motion = drive_of(case, tool, name)
    if case.gnss in RECEIVERS:
        if motion is None:
            motion = motion_of(run(case, tool, f"{name}-without", log, mapping, vehicle))
        log = add_gnss(log, tool.work / "logs" / f"{name}.mcap", *made_gnss(motion, RECEIVERS[case.gnss], case.fault))
        mapping["signals"] |= MADE_SOURCES
    if case.fault == WRONG_AXLE:
        vehicle["cg_to_rear_axle_m"] += 0.15
    elif case.fault == MOVED_IMU:
        vehicle.pop("imu_position_m", None)
    elif case.fault == BIASED:
        yaw_rate = mapping["signals"]["yaw_rate_rad_s"]
        mapping["signals"]["ay_m_s2"]["offset"] = 0.5
        mapping["signals"]["yaw_rate_rad_s"] = yaw_rate | {"scale": 1.01 * yaw_rate.get("scale", 1.0), "offset": 0.005}
    scored = scored_run(run(case, tool, name, log, mapping, vehicle), case, vehicle)
    if case.gnss == NONE or not scored["used_gnss"]:
        return scored
    bare = ("--estimators", ",".join(RANKED))
    without, aided = (
        run(case, tool, f"{name}-{gnss}", log, mapping, vehicle, *bare, "--gnss", gnss) for gnss in ("off", "auto")
    )
    errors = sideslip_rmse_deg(without)
    scored |= {"physics": errors["physics"], "aided": sideslip_rmse_deg(aided)["physics"]}
    return scored if scored["refused"] else scored | {"pairs": rankings(aided, errors)}


def drive_of(case: Case, tool: Tool, name: str) -> tuple[Path, dict[str, Any], dict[str, Any], Motion | None]:
    """Return the log of a case, its mapping and vehicle file, and the motion of a simulated drive."""
    if case.spec is None:
        peer = peer_drive(case.log)
        mapping = mapping_table(peer, receiver=case.gnss == REAL)
        return DRIVES / case.log, mapping, vehicle_table(peer), None
    drive = case.spec.simulate()
    log = tool.log(f"{name}-simulated", drive)
    vehicle = pages.read_toml(pages.SAMPLE_VEHICLE)
    if case.spec.vehicle != DEFAULT_VEHICLE:
        fitted = fit_vehicle(choose_vehicle(case.spec.vehicle), FIT_FRICTION, Car.load(pages.SAMPLE_VEHICLE).vehicle)
        vehicle = fitted.model_dump(mode="json", exclude_none=True)
    stamps = drive.start_ns + np.rint(drive.times_s * 1e9).astype(np.int64)
    columns = (drive.truth[n] for n in ("vx_m_s", "vy_m_s", "yaw_rad", "roll_rate_rad_s"))
    return log, tool.mapping(log), vehicle, Motion(stamps, *columns)


def run(
    case: Case, tool: Tool, name: str, log: Path, mapping: dict[str, Any], vehicle: dict[str, Any], *more: str
) -> Path:
    """Run the reference on a drive; return the output folder."""
    file = write_toml(tool.work / "mappings" / f"{name}.toml", mapping)
    place = tool.work / "cars" / name
    car = pages.write_validated_car(place, vehicle) if more else write_toml(place.parent / f"{name}.toml", vehicle)
    files = ("--mapping", file, "--car", car)
    waived = [word for check in SPIN_CHECKS for word in ("--waive", check)] if "spin" in case.title else []
    given = more or ("--estimators", "zero,physics")
    return tool.run(name, log, *files, "--keep", "estimates", "--reference", "on", *waived, *given)


def motion_of(folder: Path) -> Motion:
    """Return the motion of a recorded drive from the ground truth of a run."""
    truth = estimates(folder).filter(estimator="truth").sort("stamp_ns")
    stamps = truth["stamp_ns"].to_numpy()
    vx, vy, rate = (truth[n].to_numpy() for n in ("vx_m_s", "vy_m_s", "yaw_rate_rad_s"))
    return Motion(stamps, vx, vy, np.cumsum(np.nan_to_num(rate) * np.gradient(stamps * 1e-9)), np.zeros(len(stamps)))


def scored_run(folder: Path, case: Case, vehicle: dict[str, Any]) -> Figures:
    """Return the figures of the reference of a run at the stamps that it shares with the ground truth."""
    (report,) = (r["reference"] for r in reports(folder).values())
    sides = [estimates(folder).filter(estimator=name).sort("stamp_ns") for name in ("truth", "reference")]
    truth, reference = (a.join(b, on="stamp_ns", how="semi") for a, b in (sides, sides[::-1]))
    vx, vy = (truth[n].to_numpy() for n in ("vx_m_s", "vy_m_s"))
    if case.fault == AT_ANTENNA:
        (antenna,) = (p["value"] for p in report["parameters"] if p["name"] == "antenna x")
        vy = vy + (vehicle.get("truth_position_m", (0.0,))[0] - antenna) * truth["yaw_rate_rad_s"].to_numpy()
    beta = np.arctan2(vy, vx)
    error, std = wrap_angle(reference["sideslip_rad"].to_numpy() - beta), reference["sideslip_std_rad"].to_numpy()
    used = (vx > case.least_speed_m_s) & np.isfinite(error)
    valid = used & reference["valid"].to_numpy()

    def rms_deg(values: FloatArray) -> float:
        return DEGREES * float(np.sqrt(np.mean(values**2))) if values.size else math.nan

    return {
        "truth": rms_deg(beta[used]),
        "rmse": rms_deg(error[used]),
        "std": rms_deg(std[used]),
        "coverage": float(np.mean(np.abs(error[used]) < NORMAL_95 * std[used])),
        "valid_share": float(valid.sum() / max(used.sum(), 1)),
        "valid_rmse": rms_deg(error[valid]),
        "used_gnss": report["gnss"],
        "refused": str(report["refused"] or ""),
        "physics": math.nan,
        "aided": math.nan,
        "pairs": (0, 0, 0, 0),
    }


def rankings(folder: Path, errors: dict[str, float]) -> tuple[int, int, int, int]:
    """Return ``pairs`` of :class:`Figures`; ``errors``: RMSE against ground truth by estimator."""
    ranked = {f"{a}~{b}": errors[a] - errors[b] for a, b in combinations([n for n in RANKED if n in errors], 2)}
    rows = metrics(folder, metric="reference_further").select("estimator", "value").iter_rows()
    claims = {pair: value for pair, value in rows if pair in ranked}
    agreed = sum(claim * ranked[pair] > 0.0 for pair, claim in claims.items())
    clear = [pair for pair, value in ranked.items() if abs(value) > CLEAR_DEG]
    return len(claims), agreed, len(clear), sum(pair in claims for pair in clear)


def blocks(results: dict[str, Figures]) -> dict[str, str]:
    """Return the tables of the stored figures by name."""
    done = [(case, results[case.name]) for case in cases() if case.name in results]
    ranked = [(case, got) for case, got in done if case.fault != AT_ANTENNA]
    aided = [got for _, got in ranked if math.isfinite(got["aided"])]
    titles = {
        "recorded": [entry["title"] for entry in _TABLES["recorded"].values()],
        "simulated": [*SIMULATED, *_TABLES["road"]],
        "simulated, other cars": OTHER_CARS,
    }
    pairs = {name: [got["pairs"] for case, got in ranked if case.title in of] for name, of in titles.items()}
    return pages.blocks(
        __file__,
        recorded=[(case, got) for case, got in done if case.log],
        simulated=[(case, got) for case, got in done if case.spec is not None],
        worse=sum(got["aided"] > got["physics"] + max(0.05 * got["physics"], 0.003) for got in aided),
        aided=len(aided),
        clear_deg=CLEAR_DEG,
        rankings={name: np.sum(np.reshape(of, (-1, 4)), axis=0, dtype=int).tolist() for name, of in pairs.items()},
    )


def main() -> None:
    """Compute the cases that are not stored yet, and write the page."""
    parser = pages.options("reference", __doc__, pages.OF_PAGES)
    parser.add_argument("--cases", nargs="+", default=[""], metavar="TEXT", help="parts of the names of cases")
    given = parser.parse_args()
    file = given.results / STORED
    stored: dict[str, Figures] = pages.read_json(file) if file.is_file() else {}
    source = input_digest(ROOT, [f"{folder}/**/*.py" for folder in ("pdhef_logtool", "truthsim", "studies")])
    tool = Tool(ROOT, given.work.resolve())
    for case in () if given.stored else cases():
        key = hashlib.sha256(f"{case!r} {source}".encode()).hexdigest()
        if not any(text in case.name for text in given.cases) or stored.get(case.name, {}).get("key") == key:
            continue
        if case.log and not (DRIVES / case.log).exists():
            continue
        print(case.name, file=sys.stderr)
        stored[case.name] = {"key": key, **figures(case, tool)}
        pages.write_json(file, stored)
    pages.update(given.out, "reference.md", blocks(stored))


if __name__ == "__main__":
    main()
