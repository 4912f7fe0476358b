"""Agreement of calibrated parameters between drives of one car."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from studies.pages import number, table
from studies.peers.drives import PEER_DRIVES

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
    every = {name: np.array([_difference(fitted[a][name], fitted[b][name]) for a, b in pairs]) for name in OF_CAR}
    body = [_row(name, rows) for name, rows in [*every.items(), ("all", np.concatenate(list(every.values())))]]
    head = ["parameter", "pairs", "within 1.96 σ", "RMS of difference / σ", "excited in both", "within, of those"]
    return table(head, body, right_from=1)


def _difference(a: dict[str, Any], b: dict[str, Any]) -> tuple[float, bool]:
    """Return the difference over its 1-sigma, and whether both drives excite the parameter."""
    channel = a["name"] == STEERING  # over the file's, for drives of a car have different steering channels
    values = [p["value"] / p["prior"] if channel else p["value"] for p in (a, b)]
    values = [math.log(value) if a["log"] else value for value in values]
    return (values[0] - values[1]) / math.hypot(a["sd"], b["sd"]), a["excited"] and b["excited"]


def _row(name: str, rows: NDArray[np.float64]) -> list[str]:
    """Return the cells of the differences [pairs, 2]."""
    within, both = np.abs(rows[:, 0]) <= NORMAL_95, rows[:, 1] > 0.0
    share = f"{np.mean(within[both]):.0%}" if both.any() else "–"
    rms = number(float(np.sqrt(np.mean(rows[:, 0] ** 2))), 2)
    return [name, str(len(rows)), f"{np.mean(within):.0%}", rms, str(int(both.sum())), share]
