"""Agreement of calibrated parameters between drives of one car."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.pages import number, table
from studies.peers.drives import PEER_DRIVES, PeerDrive, vehicle_of

NORMAL_95 = 1.959964
#: Parameters of the car; biases, offsets and delays belong to a drive.
STEERING, PEAK = "steering ratio", "peak force over the file's"
OF_CAR = (
    "rear cornering stiffness", PEAK, "yaw inertia", "relaxation length", STEERING,
    "roll gain", "lever of a_y",
)  # fmt: skip


def pairs_table(documents: Sequence[dict[str, Any]]) -> str:
    """Return how parameters of pairs of drives of one car agree, a line a parameter and one for all of them.

    Two logs of the same drive are no pair.
    """
    fitted = {d["log"]: {p["name"]: p for p in d["parameters"]} for d in documents}
    drives = [drive.log for drive in PEER_DRIVES if drive.log in fitted]
    of = {drive.log: drive for drive in PEER_DRIVES}
    pairs = [(a, b) for a, b in combinations(drives, 2) if of[a].car == of[b].car and of[a].drive != of[b].drive]
    every = {name: np.array([_difference(name, of[a], of[b], fitted) for a, b in pairs]) for name in OF_CAR}
    body = [_row(name, rows) for name, rows in [*every.items(), ("all", np.concatenate(list(every.values())))]]
    return table(["parameter", "pairs", "within 1.96 σ", "RMS of difference / σ"], body, right_from=1)


def _difference(name: str, a: PeerDrive, b: PeerDrive, fitted: Mapping[str, Mapping[str, dict[str, Any]]]) -> float:
    """Return the difference over its 1-sigma; steering ratios are over the file's, for the channels differ."""
    of_a, of_b = fitted[a.log][name], fitted[b.log][name]
    files = [vehicle_of(drive).steering_ratio if name == STEERING else 1.0 for drive in (a, b)]
    values = [of_one["value"] / file for of_one, file in zip((of_a, of_b), files, strict=True)]
    values = [math.log(value) if of_a["log"] else value for value in values]
    return float((values[0] - values[1]) / math.hypot(of_a["sd"], of_b["sd"]))


def _row(name: str, rows: NDArray[np.float64]) -> list[str]:
    """Return the cells of the differences [pairs]."""
    within, rms = np.abs(rows) <= NORMAL_95, number(float(np.sqrt(np.mean(rows**2))), 2)
    return [name, str(len(rows)), f"{np.mean(within):.0%}", rms]
