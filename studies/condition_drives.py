"""Simulated drives in memory for the studies that choose the shipped settings, with the sideslip errors of estimators.

A log is read once, as ``pdhef run`` reads it. Friction is the only input of an estimator from the ground truth.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive import reading
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import Tell
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.evaluation.metrics import signal_error
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from studies.independent_sim_logs import write_run
from studies.pages import INDEPENDENT
from truthsim.drive import Drive, write_drive

SIDESLIP = "sideslip_rad"
_FRICTION = SignalSource("friction", "/truth/perfect/state", "friction")


@dataclass(frozen=True, slots=True, eq=False)
class ConditionDrive:
    """Signals [N] with the true friction, and the exact ground truth [N] at their stamps.

    Slower than ``low_speed_m_s`` nothing is scored.
    """

    name: str
    signals: Signals
    truth: StateTrack
    low_speed_m_s: float

    def error(self, track: StateTrack) -> FloatArray:
        """Return the sideslip error of a track [N] in rad, NaN where it is not scored."""
        return signal_error(track, self.truth, SIDESLIP, self.low_speed_m_s)


def read_drive(path: Path, car: Car) -> ConditionDrive:
    """Read a simulated log with its true friction.

    The exact ground truth has the clock of the sensors, so that no latency is estimated: a stuck gyro would bend it.
    """

    def with_true_friction(_log: DriveLog, mapping: Mapping, _tell: Tell) -> Mapping:
        return replace(mapping, signals={**mapping.signals, "friction": _FRICTION})

    with reading.read_drive(path, car, options=ReadOptions(friction=None), adjust=with_true_friction) as drive:
        drive.plan = replace(drive.plan, latency=None)
        whole = drive.whole()
    assert whole.truth is not None
    return ConditionDrive(whole.name, whole.signals, whole.truth, car.vehicle.low_speed_blend_m_s)


@contextmanager
def as_read(drive: Drive, car: Car, options: ReadOptions) -> Iterator[reading.Drive]:
    """Open a simulated drive the way of every log: written as MCAP, mapped by recognition, read."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        write_drive(drive, path)
        with reading.read_drive(path, car, options=options) as read:
            yield read


def as_logged(drive: Drive, car: Car) -> reading.WholeDrive:
    """Return the whole of a simulated drive without friction."""
    with as_read(drive, car, ReadOptions(friction=None)) as read:
        return read.whole()


def sideslip_error(estimator: Estimator, drive: ConditionDrive) -> FloatArray:
    """Run an estimator and return its sideslip error [N] in rad, NaN where it is not scored."""
    return drive.error(run_window(estimator, drive.signals, None)[0])


def root_mean_square(error: FloatArray) -> float:
    """Return the root mean square of what is known of an error [N]; NaN for nothing."""
    finite = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(finite**2))) if finite.size else float("nan")


def drives_of(folder: Path, split: str | None = None) -> list[dict[str, Any]]:
    """Return the entries of a set's manifest, of one split or all, whose drives could be made."""
    entries = json.loads((folder / "manifest.json").read_text(encoding="utf-8"))["drives"]
    return [e for e in entries if "sha256" in e and split in (None, e.get("split"))]


def independent_runs(folder: Path) -> Iterable[tuple[Path, Path, float]]:
    """Write the independent simulator's runs as logs into a folder, once; yield run, log and friction of each."""
    for source in sorted(INDEPENDENT.glob("*.parquet")):
        log = folder / f"{source.stem}.mcap"
        if not log.is_file():
            write_run(source, log)
        yield source, log, float(json.loads(source.with_suffix(".json").read_text(encoding="utf-8"))["mu"])
