"""A drive of the condition table in memory, and every estimator on it.

A log is read once, as ``pdhef run`` reads it. Friction is the only input of an estimator from the ground truth, and
only with the factor of the row: 1.2 times it, or nothing at all. The bins are those of the true friction always.
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
from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.drive import reading
from pdhef_logtool.drive.options import ReadOptions
from pdhef_logtool.drive.reading import Tell
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.latency_compensation import run_window
from pdhef_logtool.evaluation.metrics import ALL, NORMAL_95, MetricRow, score_track, signal_error
from pdhef_logtool.evaluation.segments import GRIP_SMOOTHING_HZ, NONLINEAR_SHARE
from pdhef_logtool.evaluation.smoothing import smooth
from pdhef_logtool.logs.drive_log import DriveLog
from pdhef_logtool.mapping import Mapping
from pdhef_logtool.mapping.records import SignalSource
from pdhef_logtool.records.signals import BoolArray, FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from studies.independent_sim_logs import write_run
from studies.pages import INDEPENDENT
from studies.table_maths import interval_score
from truthsim.drive import Drive, write_drive

SIDESLIP = "sideslip_rad"
#: Bins of true |a_y| over μ g (docs/method.md#evaluation), by name: lower and upper limit.
BINS: dict[str, tuple[float, float]] = {"low": (0.0, 0.3), "middle": (0.3, 0.6), "high": (0.6, np.inf)}
NONLINEAR = "nonlinear"
#: A drive counts in a bin from this many seconds on.
BIN_LEAST_S = 0.3
_FRICTION = SignalSource("friction", "/truth/perfect/state", "friction")
#: Recognised types contain no lateral acceleration, and the smoothed derivative in its place lacks the ends of a drive.
_TRUE_A_Y = SignalSource("ay_m_s2", "/truth/perfect/state", "ay_m_s2")
#: What is kept of the metrics: the sideslip in all segments, of the rest these.
_KEPT = {
    "vx_m_s": ("rmse",),
    "vy_m_s": ("rmse", "lag_s"),
    "yaw_rate_rad_s": ("rmse", "lag_s"),
    "ay_m_s2": ("rmse", "lag_s"),
    "position_m": ("rmse",),
    "lateral_1s_m": ("rmse",),
}


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


def read_drive(path: Path, car: Car, *, friction: float | None = None) -> ConditionDrive:
    """Read a simulated log; ``friction`` where the log has none of its own.

    The exact ground truth stands on the sensors' clock, so that no latency is looked for: a stuck gyro would bend it.
    """

    def with_true_friction(_log: DriveLog, mapping: Mapping, _tell: Tell) -> Mapping:
        return replace(
            mapping, signals={**mapping.signals, "friction": _FRICTION}, truth={**mapping.truth, "ay_m_s2": _TRUE_A_Y}
        )

    adjust = with_true_friction if friction is None else None
    with reading.read_drive(path, car, options=ReadOptions(friction=None), adjust=adjust) as drive:
        drive.plan = replace(drive.plan, latency=None)
        whole = drive.whole()
    signals, truth = whole.signals, whole.truth
    assert truth is not None
    if friction is not None:
        constant = np.full(len(signals), friction)
        signals = replace(signals, friction=constant, available=signals.available | {"friction"})
    return ConditionDrive(whole.name, signals, truth, car.vehicle.low_speed_blend_m_s)


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


def told(drive: ConditionDrive, assume: dict[str, Any]) -> Signals:
    """Return the signals with the friction of the row.

    Raises
    ------
    ValueError
        The row asks for something that is not known here.
    """
    unknown = set(assume) - {"friction_factor", "friction", "sensors"}
    if unknown or assume.get("friction", "unknown") != "unknown" or assume.get("sensors", "esp") != "esp":
        raise ValueError(f"expected friction_factor, friction unknown or sensors esp, got {assume}")
    if assume.get("friction") == "unknown":
        nothing = np.full(len(drive.signals), np.nan)
        return replace(drive.signals, friction=nothing, available=drive.signals.available - {"friction"})
    return replace(drive.signals, friction=float(assume.get("friction_factor", 1.0)) * drive.signals.friction)


def bin_masks(drive: ConditionDrive) -> dict[str, BoolArray]:
    """Return the segments: everything, the bins, and the nonlinear range; by true friction and lateral acceleration."""
    share = np.abs(smooth(drive.truth.stamps_ns, drive.truth.ay_m_s2, GRIP_SMOOTHING_HZ))
    share = share / (drive.signals.friction * GRAVITY_M_S2)
    masks = {name: (share >= low) & (share < high) for name, (low, high) in BINS.items()}
    return {ALL: np.ones(len(share), dtype=np.bool_), **masks, NONLINEAR: share > NONLINEAR_SHARE}


def score(track: StateTrack, drive: ConditionDrive) -> list[MetricRow]:
    """Return the metrics that the table needs: of :mod:`pdhef_logtool.evaluation.metrics`, and of the interval."""
    masks = bin_masks(drive)
    rows = [
        row
        for row in score_track(track, drive.truth, masks, log=drive.name, low_speed_m_s=drive.low_speed_m_s)
        if row.signal in (SIDESLIP, "state") or (row.segment == ALL and row.metric in _KEPT.get(row.signal, ()))
    ]
    error = drive.error(track)
    sigma = np.hypot(track.sideslip_std_rad, np.nan_to_num(drive.truth.sideslip_std_rad, nan=0.0))
    return rows + interval_rows(error, sigma, masks, log=drive.name, estimator=track.name)


def interval_rows(
    error: FloatArray, sigma: FloatArray, masks: dict[str, BoolArray], *, log: str, estimator: str
) -> list[MetricRow]:
    """Return ``interval_score95`` and ``width95`` (mean of the whole width) of the sideslip by segment."""
    finite = np.isfinite(error) & np.isfinite(sigma)
    rows = []
    for segment, mask in masks.items():
        use = mask & finite
        n = int(np.count_nonzero(use))
        if n:
            mean = float(np.mean(interval_score(error[use], sigma[use])))
            width = float(np.mean(2.0 * NORMAL_95 * sigma[use]))
            rows.append(MetricRow(log, estimator, SIDESLIP, segment, "interval_score95", mean, "rad", n))
            rows.append(MetricRow(log, estimator, SIDESLIP, segment, "width95", width, "rad", n))
    return rows


def sideslip_error(estimator: Estimator, drive: ConditionDrive, signals: Signals | None = None) -> FloatArray:
    """Run an estimator on signals, None: the drive's; returns its sideslip error [N] in rad, NaN where not scored."""
    return drive.error(run_window(estimator, drive.signals if signals is None else signals, None)[0])


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
