"""The sideslip reference against ground truth: recorded and simulated drives, with and without GNSS.

    python -m studies.reference [--cases NAME,...] [--out docs] [--results DIR]

Each case reads a drive as ``pdhef run`` does and smooths it (docs/method.md#reference). Recorded drives are those of
``../shared``, which may not be redistributed: without them, their stored figures stay. GNSS of most of them is made
from ground truth and marked so. A case whose inputs have not changed since the last run is not computed again.
Recorded drives were seen while constants were chosen: their figures are development figures.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.calibration.joint import IMU_X_REACH
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.estimators.presets import Options
from pdhef_logtool.estimators.reference.drive import ReferencePrior, SideslipReference, refer, sideslip_std
from pdhef_logtool.estimators.reference.estimator import ReferenceEstimator, steps_at
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.evaluation.metrics import EvaluatedDrive, evaluate_drive
from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import REFERENCE, StateTrack
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.referencing import prior_of
from pdhef_logtool.runs.self_calibrating import calibrate_drive
from pdhef_logtool.storage.documents import digest
from pdhef_logtool.storage.files import write_bytes
from studies.drawn_cars import FIT_FRICTION, fit_vehicle
from studies.pages import DOCS, DRIVES, RESULTS, ROOT, number, options, table, write
from studies.peers.drives import PEER_DRIVES, PeerDrive, mapping_of, vehicle_of
from studies.recalibrate import input_digest
from truthsim.batch import DriveSpec
from truthsim.drive import DEFAULT_VEHICLE, write_drive
from truthsim.vehicle_choice import choose_vehicle

STORED = "cases.json"
#: Checks that a spin fails: its course does not turn as the car does.
SPIN_CHECKS = ("yaw_rate_rad_s.unit", "truth.yaw_rate_rad_s.unit", "truth.sideslip_rad.frame")
#: Sideslip is scored above this speed; 95 % interval of a normal distribution.
LEAST_SPEED_M_S, NORMAL_95 = 3.0, 1.96
#: Where the antenna of made GNSS is from the CG, forward and left, and above the roll axis, m.
ANTENNA_M, ANTENNA_HEIGHT_M = (-0.4, 0.1), 1.2
#: From the stamp of made GNSS to its arrival, s.
LATE_S = 0.06
#: Estimates that rankings compare, and a clear difference of two of them.
RANKED, CLEAR_DEG = ("zero", "kinematic", "open-loop", "phy-ukf", "physics"), 0.3


@dataclass(frozen=True, slots=True)
class Receiver:
    """GNSS velocity made from ground truth: rate, white and correlated 1-sigma errors, and how late it is."""

    rate_hz: float
    white_m_s: float
    correlated_m_s: float
    correlated_s: float
    delay_s: float = 0.0


RECEIVERS = {
    "RTK 10 Hz": Receiver(10.0, 0.02, 0.01, 5.0),
    "Doppler 10 Hz": Receiver(10.0, 0.05, 0.02, 5.0, 0.02),
    "single point 1 Hz": Receiver(1.0, 0.10, 0.05, 20.0, 0.05),
}
NONE, REAL = "none", "recorded"


@dataclass(frozen=True, slots=True)
class Case:
    """One row: a recorded drive (``log``) or a simulated one (``spec``), its GNSS, and what is wrong with it.

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


@dataclass(frozen=True, slots=True, eq=False)
class ScoredDrive:
    """What the reference gets of a drive, and ground truth [N] at the same stamps; ``heading_rad`` up to a constant.

    ``estimates``: those of the vehicle file as it is, without GNSS, that rankings compare.
    """

    signals: Signals
    prior: ReferencePrior
    vx_m_s: FloatArray
    vy_m_s: FloatArray
    heading_rad: FloatArray
    roll_rate_rad_s: FloatArray
    car: Car | None = None
    estimates: tuple[StateTrack, ...] = ()

    def error_rad(self, track: StateTrack, least_speed_m_s: float) -> FloatArray:
        """Return the sideslip error of an estimate where it is scored."""
        scored = track.valid & (self.vx_m_s > least_speed_m_s)
        error = wrap_angle(track.sideslip_rad - np.arctan2(self.vy_m_s, self.vx_m_s))[scored]
        return np.asarray(error[np.isfinite(error)])


def recorded_drive(drive: PeerDrive) -> ScoredDrive:
    """Read a recorded drive as ``pdhef run`` does; a receiver's velocity is mapped where the log has one."""
    mapping = mapping_of(drive, receiver=drive.log.startswith("v40_"))
    car = Car.of(vehicle_of(drive))
    with read_drive(DRIVES / drive.log, car, mapping, ReadOptions()) as opened:
        prior = prior_of(car, calibrate_drive(opened, RunConfig()))
        whole = opened.whole()
    assert whole.truth is not None
    truth = whole.truth
    heading = np.cumsum(np.nan_to_num(truth.yaw_rate_rad_s) * np.gradient(truth.stamps_ns * 1e-9))
    columns = (truth.vx_m_s, truth.vy_m_s, heading, np.zeros(len(truth)))
    return ScoredDrive(whole.signals, prior, *columns, car=car, estimates=_estimates(car, whole.signals))


def _estimates(car: Car, signals: Signals) -> tuple[StateTrack, ...]:
    return tuple(run_window(make_estimator(name, car), signals)[0] for name in RANKED)


def simulated_drive(spec: DriveSpec, vehicle: VehicleParameters | None = None) -> ScoredDrive:
    """Simulate a drive and read its log, with the vehicle file of the car and without tyre identification."""
    drive = spec.simulate()
    car = Car.load(ROOT / "sample_logs" / "vehicle.toml") if vehicle is None else Car.of(vehicle)
    if spec.vehicle != DEFAULT_VEHICLE:
        car = Car.of(fit_vehicle(choose_vehicle(spec.vehicle), FIT_FRICTION, car.vehicle))
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "drive.mcap"
        write_drive(drive, log)
        with read_drive(log, car, None, ReadOptions(waived=SPIN_CHECKS)) as opened:
            prior = prior_of(car, calibrate_drive(opened, RunConfig()))
            signals = opened.whole().signals
    t = (signals.stamps_ns - drive.start_ns) * 1e-9
    names = ("vx_m_s", "vy_m_s", "yaw_rad", "roll_rate_rad_s")
    vx, vy, heading, roll_rate = (np.interp(t, drive.times_s, drive.truth[name]) for name in names)
    bare = Car.of(car.vehicle)
    return ScoredDrive(signals, prior, vx, vy, heading, roll_rate, bare, _estimates(bare, signals))


def with_gnss(drive: ScoredDrive, receiver: Receiver, seed: int = 7) -> Signals:
    """Return the signals with the velocity to the east and north that a receiver would show."""
    rng = np.random.default_rng(seed)
    signals = drive.signals
    t = (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9
    sampled = np.arange(0.0, t[-1], 1.0 / receiver.rate_hz)
    rate = np.gradient(np.unwrap(drive.heading_rad), t)
    forward = drive.vx_m_s - ANTENNA_M[1] * rate
    left = drive.vy_m_s + ANTENNA_M[0] * rate - ANTENNA_HEIGHT_M * drive.roll_rate_rad_s
    cos, sin = np.cos(drive.heading_rad + 0.7), np.sin(drive.heading_rad + 0.7)
    keep = math.exp(-1.0 / (receiver.rate_hz * receiver.correlated_s))
    velocity = np.full((len(t), 2), np.nan)
    at = np.minimum(np.searchsorted(t, sampled), len(t) - 1)
    for column, component in enumerate((cos * forward - sin * left, sin * forward + cos * left)):
        correlated = np.empty(len(sampled))
        value = rng.standard_normal()
        for i in range(len(sampled)):
            correlated[i] = value
            value = keep * value + math.sqrt(1.0 - keep**2) * rng.standard_normal()
        good = np.isfinite(component)
        made = np.interp(sampled - receiver.delay_s, t[good], component[good])
        made += receiver.correlated_m_s * correlated + receiver.white_m_s * rng.standard_normal(len(sampled))
        velocity[at, column] = made
    late_s = np.where(np.isfinite(velocity[:, 0]), LATE_S, np.nan)
    return replace(signals, gnss_velocity_m_s=velocity, gnss_late_s=late_s)


def _outage(signals: Signals) -> Signals:
    return replace(signals, gnss_velocity_m_s=_within(signals, 20.0, 40.0, np.nan))


def _multipath(signals: Signals) -> Signals:
    return replace(signals, gnss_velocity_m_s=_within(signals, 20.0, 25.0, 0.5))


def _within(signals: Signals, start_s: float, end_s: float, added: float) -> FloatArray:
    """Return GNSS velocity with something added between two times, to the east and north."""
    t = (signals.stamps_ns - signals.stamps_ns[0]) * 1e-9
    velocity = signals.gnss_velocity_m_s.copy()
    velocity[(t >= start_s) & (t < end_s)] += added / math.sqrt(2.0)
    return velocity


def _biased(signals: Signals) -> Signals:
    return replace(signals, ay_m_s2=signals.ay_m_s2 + 0.5, yaw_rate_rad_s=signals.yaw_rate_rad_s * 1.01 + 0.005)


def _tilted(signals: Signals) -> Signals:
    """Turn the IMU by 2 degrees about its vertical axis, and tilt it by 2 degrees to the side."""
    angle = math.radians(2.0)
    ax, ay = signals.ax_m_s2, signals.ay_m_s2
    return replace(
        signals,
        ax_m_s2=math.cos(angle) * ax + math.sin(angle) * ay,
        ay_m_s2=math.cos(angle) * ay - math.sin(angle) * ax + 9.81 * math.sin(angle),
    )


#: What is done to the signals of a simulated drive.
FAULTS: dict[str, Callable[[Signals], Signals]] = {
    "no GNSS from 20 to 40 s": _outage,
    "multipath of 0.5 m/s from 20 to 25 s": _multipath,
    "a_y + 0.5 m/s², yaw rate + 0.005 rad/s and 1 %": _biased,
    "IMU turned and tilted by 2°": _tilted,
}
WRONG_AXLE = "l_r wrong by 0.15 m"
#: Of simulated drives: nothing states where the accelerometer is.
MOVED_IMU, REAR_IMU = "accelerometer at the rear axle", (("imu_x_m", -1.71),)
#: Of recorded drives with a receiver: ground truth is taken to be the velocity of the antenna, whose position the
#: smoother estimates, in place of that of the point that the vehicle file states.
AT_ANTENNA = "ground truth at the antenna"


def _simulated(manoeuvre: str, speed_km_h: float, friction: float, **options: Any) -> DriveSpec:
    duration_s = options.pop("duration_s", 14.0)
    return DriveSpec(manoeuvre, speed_km_h, friction, options.pop("seed", 1), duration_s, **options)


_ROAD = _simulated("road", 80.0, 0.85, seed=3, duration_s=60.0)
SIMULATED = {
    "step steer, 100 km/h": _simulated("step-steer", 100.0, 0.85),
    "sine with dwell, 80 km/h": _simulated("sine-with-dwell", 80.0, 0.85, seed=2),
    "sine sweep, 100 km/h": _simulated("sine-sweep", 100.0, 0.85),
    "fishhook, 70 km/h": _simulated("fishhook", 70.0, 0.85),
    "double lane change, 100 km/h": _simulated("dlc", 100.0, 0.85),
    "spin, fishhook at 110 km/h": _simulated("fishhook", 110.0, 0.85, amplitude=1.6, keep_spins=True),
    "banked road": _simulated("banked-road", 80.0, 0.85, duration_s=40.0),
    "stop and go": _simulated("stop-and-go", 50.0, 0.85, duration_s=40.0),
    "road, 10 s": _simulated("road", 90.0, 0.9, seed=5, duration_s=10.0),
    "road, 20 s": _simulated("road", 90.0, 0.9, seed=5, duration_s=20.0),
    "road, 300 s": _simulated("road", 80.0, 0.85, seed=3, duration_s=300.0),
    "road, 1200 s": _simulated("road", 80.0, 0.85, seed=4, duration_s=1200.0),
}
#: Cars that nothing was chosen with, each with a vehicle file fitted to its ramp steer.
OTHER_CARS = {
    f"{manoeuvre} {speed} km/h, {car}": _simulated(
        manoeuvre, speed, 0.85, seed=900 + speed, vehicle=f"{car}~{900 + speed}", duration_s=duration_s
    )
    for car, slower in (("hatchback", 0), ("suv", 12), ("sedan", 3))
    for manoeuvre, fastest, duration_s in (("fishhook", 72, 14.0), ("dlc", 98, 14.0), ("sine-sweep", 92, 14.0),
                                           ("sine-with-dwell", 84, 14.0), ("road", 82, 60.0))
    for speed in (fastest - slower,)
}  # fmt: skip
_RECORDED_TITLES = {
    "revs_250lm_a.mcap": "Ferrari 250 LM, race track", "niki_gti_1khz.mcap": "VW GTI, handling course",
    "gti_pole_aa.mcap": "VW GTI, slow and tight", "gti_low_speed.mcap": "VW GTI, slow laps",
    "stanford_wet_1.mcap": "VW GTI, wet laps", "tts_kk.mcap": "Audi TT-S",
    "v40_swd_gnss.mcap": "Volvo V40, sine with dwell", "v40_slalom.mcap": "Volvo V40, slalom",
}  # fmt: skip
MADE = "Doppler 10 Hz"
#: RMSE that the reference must reach on recorded drives, by log and GNSS.
TARGETS_DEG = {
    ("v40_swd_gnss.mcap", REAL): 0.25, ("v40_slalom.mcap", REAL): 0.30, ("revs_250lm_a.mcap", MADE): 0.15,
    ("niki_gti_1khz.mcap", MADE): 0.40, ("v40_swd_gnss.mcap", NONE): 0.35, ("v40_slalom.mcap", NONE): 0.35,
    ("revs_250lm_a.mcap", NONE): 0.60, ("stanford_wet_1.mcap", NONE): 0.90,
}  # fmt: skip
_SINGLE = ("step steer, 100 km/h", "sine with dwell, 80 km/h", "sine sweep, 100 km/h")


def cases() -> Iterator[Case]:
    """Yield all rows of the page."""
    for drive in PEER_DRIVES:
        if drive.log == "lunda_v40":  # the drive of v40_swd_gnss without its receiver
            continue
        title = _RECORDED_TITLES.get(drive.log, f"{drive.car}, {drive.log.partition('.')[0]}")
        kinds = (NONE, REAL) if drive.log.startswith("v40_") else (NONE, MADE) if drive.log in _RECORDED_TITLES else ()
        for gnss in kinds or (NONE,):
            target = TARGETS_DEG.get((drive.log, gnss))
            yield Case(title, gnss, log=drive.log, target_deg=target, least_speed_m_s=drive.least_speed_m_s)
            if gnss == REAL:
                yield Case(title, gnss, log=drive.log, fault=AT_ANTENNA, target_deg=target)
    for title, spec in SIMULATED.items():
        for gnss in (NONE, *RECEIVERS):
            target = 0.5 if "spin" in title else 0.35 if gnss == NONE else 0.25
            wanted = title in _SINGLE or ("spin" in title and gnss != NONE)
            yield Case(title, gnss, spec=spec, target_deg=target if wanted else None)
    for title, spec in OTHER_CARS.items():
        for gnss in (NONE, MADE):
            yield Case(title, gnss, spec=spec)
    for fault in (*FAULTS, WRONG_AXLE):
        for gnss in (NONE, MADE):
            if gnss == NONE and fault.startswith(("no GNSS", "multipath")):
                continue
            yield Case("road, 60 s", gnss, spec=_ROAD, fault=fault)
    yield Case("fishhook, 70 km/h", MADE, spec=SIMULATED["fishhook, 70 km/h"], fault="IMU turned and tilted by 2°")
    for title in ("sine with dwell, 80 km/h", "fishhook, 70 km/h", "double lane change, 100 km/h"):
        yield Case(title, MADE, spec=replace(SIMULATED[title], sensors=REAR_IMU), fault=MOVED_IMU)


@dataclass(frozen=True, slots=True)
class Figures:
    """Figures of a case; angles in degrees. ``truth``: RMS of the ground truth.

    ``physics``, ``aided``: RMSE of ``physics`` without and with GNSS. ``pairs`` of estimates: that the reference ranks,
    of these as by ground truth; that differ by more than ``CLEAR_DEG``, of these that the reference ranks.
    """

    truth: float
    rmse: float
    std: float
    coverage: float
    valid_share: float
    valid_rmse: float
    used_gnss: bool
    refused: str
    seconds: float
    physics: float = math.nan
    aided: float = math.nan
    pairs: tuple[int, int, int, int] = (0, 0, 0, 0)


def figures(case: Case, drive: ScoredDrive) -> Figures:
    """Smooth a drive and compare it with its ground truth at all stamps above the least speed."""
    made = case.gnss in RECEIVERS
    signals = with_gnss(drive, RECEIVERS[case.gnss]) if made else drive.signals
    prior = drive.prior
    if case.fault == WRONG_AXLE:
        prior = replace(prior, rear_m=prior.rear_m + 0.15)
    elif case.fault == MOVED_IMU:
        prior = replace(prior, unknown_imu_x_m=IMU_X_REACH * prior.wheelbase_m)
    elif case.fault in FAULTS:
        signals = FAULTS[case.fault](signals)
    start = time.process_time()
    found = refer(signals, prior, use_gnss=case.gnss != NONE)
    seconds = time.process_time() - start
    if case.fault == AT_ANTENNA:
        drive = _at_antenna(drive, found)
    scored = _scored(found, drive, case.least_speed_m_s, seconds)
    if drive.car is None or not np.isfinite(signals.gnss_velocity_m_s).any() or case.gnss == NONE:
        return scored

    car = drive.car

    def rmse(*, gnss: bool) -> float:
        track, _ = run_window(make_estimator("physics", car, Options(gnss=gnss)), signals)
        return _rms_deg(drive.error_rad(track, case.least_speed_m_s))

    pairs = (0, 0, 0, 0) if found.refused else _pairs(found, drive, case.least_speed_m_s)
    return replace(scored, physics=rmse(gnss=False), aided=rmse(gnss=True), pairs=pairs)


def _at_antenna(drive: ScoredDrive, found: SideslipReference) -> ScoredDrive:
    """Return a drive whose ground truth was not measured where its file states, but at the antenna."""
    assert drive.car is not None
    (antenna,) = (p.value for p in found.parameters if p.name == "antenna x")
    moved = drive.car.vehicle.truth_position_m[0] - antenna
    return replace(drive, vy_m_s=drive.vy_m_s + moved * drive.signals.yaw_rate_rad_s)


def _rms_deg(values_rad: FloatArray) -> float:
    return float(np.degrees(np.sqrt(np.mean(values_rad**2)))) if values_rad.size else math.nan


def _pairs(found: SideslipReference, drive: ScoredDrive, least_speed_m_s: float) -> tuple[int, int, int, int]:
    """Return ``pairs`` of :class:`Figures`."""
    reference = ReferenceEstimator((found,)).at(drive.signals.stamps_ns)
    tracks = {t.name: t for t in drive.estimates} | {REFERENCE: reference}
    rows = evaluate_drive(EvaluatedDrive("", tracks, None, None, {}, least_speed_m_s), ("reference_further",))
    claims = {row.estimator: row.value for row in rows}
    errors = {t.name: _rms_deg(drive.error_rad(t, least_speed_m_s)) for t in drive.estimates}
    further = {f"{a}~{b}": errors[a] - errors[b] for a, b in combinations(errors, 2)}
    agreed = sum(claim * further[pair] > 0.0 for pair, claim in claims.items())
    clear = [pair for pair, value in further.items() if abs(value) > CLEAR_DEG]
    return len(claims), agreed, len(clear), sum(pair in claims for pair in clear)


def _scored(found: SideslipReference, drive: ScoredDrive, least_speed_m_s: float, seconds: float) -> Figures:
    steps = steps_at([found], drive.signals.stamps_ns)
    vx, vy = steps.values[:, 0], steps.values[:, 1]
    beta = np.arctan2(drive.vy_m_s, drive.vx_m_s)
    error = np.degrees(np.angle(np.exp(1j * (np.arctan2(vy, vx) - beta))))
    std = np.degrees(sideslip_std(vx, vy, steps.covariance))
    used = (drive.vx_m_s > least_speed_m_s) & np.isfinite(error)
    valid = used & steps.valid

    def rms(values: FloatArray) -> float:
        return float(np.sqrt(np.mean(values**2))) if values.size else math.nan

    return Figures(
        truth=rms(np.degrees(beta[used])),
        rmse=rms(error[used]),
        std=rms(std[used]),
        coverage=float(np.mean(np.abs(error[used]) < NORMAL_95 * std[used])),
        valid_share=float(valid.sum() / used.sum()),
        valid_rmse=rms(error[valid]),
        used_gnss=found.with_gnss,
        refused=found.refused,
        seconds=seconds,
    )


PAGE = """# Sideslip reference against ground truth

How well the [sideslip reference](estimators.md#reference) agrees with ground truth, at all stamps above 3 m/s (1 m/s
for 1:10 cars). Command: `python -m studies.reference`.

RMSE and ± (RMS of the reference's own standard deviation) in degrees; coverage of its 95 % interval;
share of the stamps where it is valid, and the RMSE there. *refused*: why no stamp is valid. GNSS
*{made}* of recorded drives is made from their ground truth. Constants were chosen on simulated drives, and recorded
drives seen meanwhile: development figures. The ground truth of the RAV4 is turned by about 0.8°, that of the Polaris
by 0.5 to 2.3°.

## Recorded drives
{recorded}

The V40's ground truth is documented as 0.32 m behind the CG. With it at the antenna, where the smoother puts that:

{antenna}

## Simulated drives
{simulated}

## Faults, simulated
{faults}

## GNSS in the causal filter
`physics` without calibration, and with the GNSS velocity, which arrives {late:.0f} ms late. In {worse} of {all} rows it
is worse with GNSS by more than 5 % and 0.003°.

{causal}

## Rankings
Pairs of {ranked} on the drives above with GNSS, ranked by the reference where it
[claims](metrics.md) a difference, and by the RMSE against ground truth. *Other cars*: not seen before.

{rankings}

## Targets
{targets}

An hour of driving takes {hour} s of processor time with GNSS, {hour_alone} s without ({basis} s per simulated 300 s).
`studies/results/reference/cases.json` contains all figures.
"""
_HEAD = ("drive", "GNSS", "true RMS", "RMSE", "±", "coverage", "valid", "RMSE there", "refused")


def _row(case: Case, got: Figures) -> list[str]:
    gnss = case.gnss if got.used_gnss or case.gnss == NONE else f"{case.gnss}, not used"
    cells = (number(got.truth, 2), number(got.rmse, 2), number(got.std, 2), f"{100 * got.coverage:.0f} %")
    valid = f"{100 * got.valid_share:.0f} %"
    return [case.title, gnss, *cells, valid, number(got.valid_rmse, 2), got.refused.partition(" (")[0] or "–"]


def _rankings(done: Sequence[tuple[Case, Figures]]) -> list[list[str]]:
    rows = []
    for name, titles in (
        ("recorded", _RECORDED_TITLES.values()),
        ("simulated", (*SIMULATED, "road, 60 s")),
        ("simulated, other cars", OTHER_CARS),
    ):
        pairs = [f.pairs for c, f in done if c.title in titles and c.fault != AT_ANTENNA]
        claimed, agreed, clear, found = map(sum, zip(*pairs, strict=True))
        agree = "–" if not claimed else f"{100.0 * agreed / claimed:.0f} %"
        share = "–" if not clear else f"{100.0 * found / clear:.0f} %"
        rows.append([name, str(claimed), agree, str(clear), share])
    return rows


def page(results: dict[str, Figures]) -> str:
    """Return the page of the stored figures."""
    done = [(case, results[case.name]) for case in cases() if case.name in results]
    aided = [(c, f) for c, f in done if math.isfinite(f.aided) and c.fault != AT_ANTENNA]
    worse = sum(f.aided > f.physics + max(0.05 * f.physics, 0.003) for _, f in aided)
    recorded = [_row(c, f) for c, f in done if c.log and not c.fault]
    antenna = [_row(c, f) for c, f in done if c.fault == AT_ANTENNA]
    simulated = [_row(c, f) for c, f in done if c.spec is not None and not c.fault]
    faults = [[c.fault, *_row(c, f)] for c, f in done if c.fault and c.spec is not None]
    targets = [
        [c.name, f"{c.target_deg:.2f}", number(f.rmse), "yes" if f.rmse <= c.target_deg and not f.refused else "**no**"]
        for c, f in done
        if c.target_deg is not None
    ]
    hour = {c.gnss: 12.0 * f.seconds for c, f in done if c.title == "road, 300 s"}
    with_doppler, alone = hour.get(MADE, math.nan), hour.get(NONE, math.nan)
    return PAGE.format(
        made=MADE,
        late=1e3 * LATE_S,
        worse=worse,
        all=len(aided),
        causal=table(
            ("drive", "physics", "with GNSS"), [[c.name, number(f.physics, 3), number(f.aided, 3)] for c, f in aided]
        ),
        ranked=", ".join(f"`{name}`" for name in RANKED),
        rankings=table(
            (
                "drives",
                "ranked",
                "as by ground truth",
                f"pairs that differ by more than {CLEAR_DEG}°",
                "of these ranked",
            ),
            _rankings(done),
        ),
        recorded=table(_HEAD, recorded),
        antenna=table(_HEAD, antenna),
        simulated=table(_HEAD, simulated),
        faults=table(("fault", *_HEAD), faults),
        targets=table(("drive", "target", "RMSE", "reached"), targets),
        hour=number(with_doppler, 0),
        hour_alone=number(alone, 0),
        basis=number(with_doppler / 12.0, 1),
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute the cases that are not stored yet, and write the page."""
    parser = options("reference", __doc__)
    parser.add_argument("--cases", default="", help="only those whose name contains one of these, comma-separated")
    parser.add_argument("--out", type=Path, default=DOCS)
    parser.add_argument("--results", type=Path, default=RESULTS / "reference")
    given = parser.parse_args(arguments)
    file = given.results / STORED
    stored: dict[str, Any] = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    wanted = given.cases.split(",")
    source = input_digest(ROOT, [f"{folder}/**/*.py" for folder in ("pdhef_logtool", "truthsim", "studies")])
    drives: dict[str, ScoredDrive] = {}
    for case in cases():
        key = digest([repr(case), source, Path(__file__).read_text(encoding="utf-8")])
        if not any(w in case.name for w in wanted) or stored.get(case.name, {}).get("key") == key:
            continue
        if case.log and not (DRIVES / case.log).exists():
            continue
        if (drive := drives.get(case.log or repr(case.spec))) is None:
            drive = recorded_drive(_peer(case.log)) if case.spec is None else simulated_drive(case.spec)
            drives = {case.log or repr(case.spec): drive}
        print(case.name, file=sys.stderr)
        stored[case.name] = {"key": key, **asdict(figures(case, drive))}
        file.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(file, (json.dumps(stored, indent=1) + "\n").encode())
    names = {case.name for case in cases()}
    results = {n: Figures(**{k: v for k, v in s.items() if k != "key"}) for n, s in stored.items() if n in names}
    write(given.out / "reference.md", page(results))
    return 0


def _peer(log: str) -> PeerDrive:
    return next(drive for drive in PEER_DRIVES if drive.log == log)


if __name__ == "__main__":
    sys.exit(main())
