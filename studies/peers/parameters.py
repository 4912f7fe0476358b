"""Agreement of calibrated parameters between drives of one car, and what ground truth alone shows of two of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from scipy.signal import butter, sosfiltfilt

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.calibration.driving import STEP_S, Driving
from pdhef_logtool.estimators.calibration.single_track import STEER, YAW_RATE
from pdhef_logtool.evaluation.metrics import NORMAL_95
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.self_calibrating import calibrate_drive, read_driving
from studies.pages import DRIVES, number, table
from studies.peers.drives import PEER_DRIVES, PeerDrive, mapping_of, vehicle_of

#: Parameters of the car; biases, offsets and delays belong to a drive.
STEERING, PEAK = "steering ratio", "peak force over the file's"
OF_CAR = (
    "front cornering stiffness", "rear cornering stiffness", PEAK, "yaw inertia", "relaxation length", STEERING,
    "roll gain", "lever of a_y",
)  # fmt: skip
#: Ground truth is compared below this frequency; the steering up to this share of the friction.
CUTOFF_HZ, GENTLE = 4.0, 0.5
#: Parts of a drive that are left out in turn.
PARTS = 10


def parameters_of_drive(drive: PeerDrive) -> dict[str, Any] | None:
    """Return the calibration of a drive, as ``pdhef run`` makes it, and what ground truth shows; None if refused."""
    with read_drive(DRIVES / drive.log, Car.of(vehicle_of(drive)), mapping_of(drive)) as opened:
        calibration = calibrate_drive(opened, RunConfig())
        if calibration is None or calibration.refused:
            return None
        truth = opened.whole().truth
        assert truth is not None
        shown = shown_by_truth(read_driving(opened), truth, opened.car.vehicle)
    return {"log": drive.log, "parameters": calibration.to_dict()["parameters"], "truth": shown}


def shown_by_truth(driving: Driving, truth: StateTrack, vehicle: VehicleParameters) -> dict[str, tuple[float, float]]:
    """Return what ground truth shows of steering and grip without a calibration: logarithm and 1-sigma (jackknife).

    The steering ratio over the file's is the coefficient of the direction of the front axle in a regression of the
    steering signal on it and on the lateral acceleration; grip is the 99 % quantile of that acceleration.
    """
    known = np.isfinite(truth.vx_m_s + truth.vy_m_s)
    parts = []
    for first, last in driving.stretches:
        at = driving.stamps_ns[first:last] - round(0.5 * STEP_S * 1e9)  # a cell has the mean of its samples
        v = (np.interp(at, truth.stamps_ns[known], x[known]) for x in (truth.vx_m_s, truth.vy_m_s))
        signals = np.stack([*driving.columns[[STEER, YAW_RATE], first:last], *v])
        steer, rate, vx, vy = sosfiltfilt(butter(2, CUTOFF_HZ, fs=1.0 / STEP_S, output="sos"), signals)
        front = np.arctan2(vy + vehicle.cg_to_front_axle_m * rate, vx)
        parts.append(np.stack([steer, front, np.gradient(vy, STEP_S) + vx * rate]))
    rows = np.concatenate(parts, axis=1)
    gentle = rows[:, np.abs(rows[2]) < GENTLE * GRAVITY_M_S2 * vehicle.assumed_friction]
    grip = _jackknife(lambda r: math.log(np.quantile(np.abs(r[2]), 0.99)), rows)
    return {STEERING: _jackknife(_log_steering, gentle), PEAK: grip}


def _log_steering(rows: FloatArray) -> float:
    known = np.stack([rows[1], rows[2], np.ones(rows.shape[1])], axis=1)
    return math.log(max(float(np.linalg.lstsq(known, rows[0], rcond=None)[0][0]), 1e-3))


def _jackknife(figure: Callable[[FloatArray], float], rows: FloatArray) -> tuple[float, float]:
    """Return a figure of rows [m, N] and its 1-sigma from the figures without a part of them (Tukey 1958)."""
    parts = np.array_split(np.arange(rows.shape[1]), PARTS)
    without = [figure(np.delete(rows, part, axis=1)) for part in parts]
    return figure(rows), math.sqrt((PARTS - 1) * float(np.var(without)))


def pairs_table(documents: Sequence[dict[str, Any]]) -> str:
    """Return how parameters of pairs of drives of one car agree, a line a parameter and one for all of them.

    Two logs of the same drive are no pair.
    """
    fitted = {d["log"]: {p["name"]: p for p in d["parameters"]} for d in documents}
    shown = {d["log"]: d["truth"] for d in documents}
    drives = [drive.log for drive in PEER_DRIVES if drive.log in fitted]
    of = {drive.log: drive for drive in PEER_DRIVES}
    pairs = [(a, b) for a, b in combinations(drives, 2) if of[a].car == of[b].car and of[a].drive != of[b].drive]
    every = {
        name: np.array([_difference(fitted[a][name], fitted[b][name], shown[a], shown[b]) for a, b in pairs])
        for name in OF_CAR
    }
    body = [_row(name, rows) for name, rows in [*every.items(), ("all", np.concatenate(list(every.values())))]]
    head = ["parameter", "pairs", "within 1.96 σ", "RMS of difference / σ", "excited in both", "within, of those"]
    return table([*head, "less the change that ground truth shows"], body, right_from=1)


def _difference(
    a: dict[str, Any], b: dict[str, Any], in_a: dict[str, Any], in_b: dict[str, Any]
) -> tuple[float, float, bool]:
    """Return the difference over its 1-sigma, as it is and less what ground truth shows, and whether both excite it."""
    name = a["name"]
    channel = name == STEERING  # over the file's, for drives of a car have different steering channels
    values = [p["value"] / p["prior"] if channel else p["value"] for p in (a, b)]
    values = [math.log(value) if a["log"] else value for value in values]
    apart, sd = values[0] - values[1], math.hypot(a["sd"], b["sd"])
    (true_a, sd_a), (true_b, sd_b) = (d.get(name, (0.0, 0.0)) for d in (in_a, in_b))
    left = (apart - (true_a - true_b)) / math.hypot(sd, sd_a, sd_b)
    return apart / sd, left, a["excited"] and b["excited"]


def _row(name: str, rows: FloatArray) -> list[str]:
    """Return the cells of the differences [pairs, 3]."""
    within, both = np.abs(rows[:, :2]) <= NORMAL_95, rows[:, 2] > 0.0
    shares = [f"{np.mean(within[both, i]):.0%}" if both.any() else "–" for i in (0, 1)]
    rms = number(float(np.sqrt(np.mean(rows[:, 0] ** 2))), 2)
    return [name, str(len(rows)), f"{np.mean(within[:, 0]):.0%}", rms, str(int(both.sum())), *shares]
