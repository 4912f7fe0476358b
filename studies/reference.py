"""The sideslip reference against ground truth: recorded and simulated drives, with and without GNSS.

    python -m studies.reference [--cases NAME,...] [--out docs] [--results DIR]

Each case reads a drive as ``pdhef run`` does and smooths it (docs/method.md#reference). Recorded drives are those of
``../shared``, which may not be redistributed: without them, their stored figures stay. GNSS of most of them is made
from ground truth and marked so. A case whose inputs have not changed since the last run is not computed again.
Constants of the reference are chosen on simulated drives; recorded ones only report.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.reference.drive import ReferencePrior, SideslipReference, refer, sideslip_std
from pdhef_logtool.estimators.reference.estimator import steps_at
from pdhef_logtool.mapping import Mapping, SignalSource, load_mapping
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.referencing import prior_of
from pdhef_logtool.runs.self_calibrating import calibrate_drive
from pdhef_logtool.storage.documents import digest
from pdhef_logtool.storage.files import write_bytes
from studies.condition_runs import source_digest
from studies.pages import DOCS, DRIVES, RESULTS, ROOT, number, options, table, write
from studies.peers.drives import PEER_DRIVES, PeerDrive, mapping_of, vehicle_of
from truthsim.batch import DriveSpec
from truthsim.drive import write_drive

STORED = "cases.json"
#: Sideslip is scored above this speed; 95 % interval of a normal distribution.
LEAST_SPEED_M_S, NORMAL_95 = 3.0, 1.96
#: Where the antenna of made GNSS is from the CG, forward and left, and above the roll axis, m.
ANTENNA_M, ANTENNA_HEIGHT_M = (-0.4, 0.1), 1.2


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
    ``edge_m_s``: scored above this speed.
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
    """What the reference gets of a drive, and ground truth [N] at the same stamps; ``heading_rad`` up to a constant."""

    signals: Signals
    prior: ReferencePrior
    vx_m_s: FloatArray
    vy_m_s: FloatArray
    heading_rad: FloatArray
    roll_rate_rad_s: FloatArray


def recorded_drive(drive: PeerDrive) -> ScoredDrive:
    """Read a recorded drive as ``pdhef run`` does; a receiver's velocity is mapped where the log has one."""
    mapping = mapping_of(drive)
    if drive.log.startswith("v40_"):
        mapping = _with_receiver(mapping)
    car = Car.of(vehicle_of(drive))
    with read_drive(DRIVES / drive.log, car, mapping, ReadOptions()) as opened:
        prior = prior_of(car.vehicle, calibrate_drive(opened, RunConfig()))
        whole = opened.whole()
    assert whole.truth is not None
    truth = whole.truth
    heading = np.cumsum(np.nan_to_num(truth.yaw_rate_rad_s) * np.gradient(truth.stamps_ns * 1e-9))
    return ScoredDrive(whole.signals, prior, truth.vx_m_s, truth.vy_m_s, heading, np.zeros(len(truth)))


def _with_receiver(mapping: Mapping) -> Mapping:
    rates = {
        name: SignalSource(name, "/imu/data", f"angular_velocity.{axis}", "header.stamp")
        for name, axis in (("roll_rate_rad_s", "x"), ("pitch_rate_rad_s", "y"))
    }
    gnss = {
        f"gnss_velocity_{to}_m_s": SignalSource(
            f"gnss_velocity_{to}_m_s", "/gnss/velocity", f"twist.linear.{axis}", "header.stamp"
        )
        for to, axis in (("east", "x"), ("north", "y"))
    }
    others = {name: source for name, source in mapping.signals.items() if name != "speed_m_s"}
    return replace(mapping, signals={**others, **gnss, **rates})


def simulated_drive(spec: DriveSpec, vehicle: VehicleParameters | None = None) -> ScoredDrive:
    """Simulate a drive and read its log, with the vehicle file of the saloon and without tyre identification."""
    drive = spec.simulate()
    car = Car.load(ROOT / "sample_logs" / "vehicle.toml") if vehicle is None else Car.of(vehicle)
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "drive.mcap"
        write_drive(drive, log)
        with read_drive(log, car, None, ReadOptions()) as opened:
            prior = prior_of(car.vehicle, calibrate_drive(opened, RunConfig()))
            signals = opened.whole().signals
    t = (signals.stamps_ns - drive.start_ns) * 1e-9
    columns = (
        np.interp(t, drive.times_s, drive.truth[name])
        for name in ("vx_m_s", "vy_m_s", "yaw_rad", "roll_rate_rad_s")
    )
    return ScoredDrive(signals, prior, *columns)


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
    return replace(signals, gnss_velocity_m_s=velocity)
