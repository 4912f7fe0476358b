"""Agreement of calibrated parameters between drives of one car."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.evaluation.metrics import NORMAL_95
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.self_calibrating import calibrate_drive
from studies.pages import DRIVES, number, table
from studies.peers.drives import PEER_DRIVES, PeerDrive, mapping_of, vehicle_of

#: Parameters of the car; biases, offsets and delays belong to a drive.
STEERING = "steering ratio"
OF_CAR = (
    "front cornering stiffness", "rear cornering stiffness", "peak force over the file's", "yaw inertia",
    "relaxation length", STEERING, "roll gain", "lever of a_y",
)  # fmt: skip


def parameters_of_drive(drive: PeerDrive) -> dict[str, Any] | None:
    """Return the calibration of a drive, as ``pdhef run`` makes it; None where it is refused."""
    with read_drive(DRIVES / drive.log, Car.of(vehicle_of(drive)), mapping_of(drive)) as opened:
        calibration = calibrate_drive(opened, RunConfig())
    if calibration is None or calibration.refused:
        return None
    return {"log": drive.log, "parameters": calibration.to_dict()["parameters"]}


def pairs_table(documents: Sequence[dict[str, Any]]) -> str:
    """Return how parameters of pairs of drives of one car agree, a line a parameter and one for all of them.

    Two logs of the same drive are no pair.
    """
    fitted = {d["log"]: {p["name"]: p for p in d["parameters"]} for d in documents}
    drives = [drive for drive in PEER_DRIVES if drive.log in fitted]
    pairs = [(a, b) for a, b in combinations(drives, 2) if a.car == b.car and a.drive != b.drive]
    body, within, excited = [], [], []
    for name in OF_CAR:
        of_name = [_difference(fitted[a.log][name], fitted[b.log][name]) for a, b in pairs]
        agree = [abs(z) <= NORMAL_95 for z, _ in of_name]
        shown = [is_excited for _, is_excited in of_name]
        within += agree
        excited += shown
        body.append(_row(name, agree, shown, [z for z, _ in of_name]))
    every = [_difference(fitted[a.log][n], fitted[b.log][n])[0] for n in OF_CAR for a, b in pairs]
    body.append(_row("all", within, excited, every))
    head = ["parameter", "pairs", "within 1.96 σ", "RMS of difference / σ", "excited in both", "within, of those"]
    return table(head, body, right_from=1)


def _difference(a: dict[str, Any], b: dict[str, Any]) -> tuple[float, bool]:
    """Return the difference over its standard deviation, and whether both drives excite the parameter."""
    channel = a["name"] == STEERING  # over the file's, for drives of a car have different steering channels
    values = [p["value"] / p["prior"] if channel else p["value"] for p in (a, b)]
    values = [np.log(value) if a["log"] else value for value in values]
    return float((values[0] - values[1]) / np.hypot(a["sd"], b["sd"])), a["excited"] and b["excited"]


def _row(name: str, agree: Sequence[bool], excited: Sequence[bool], scaled: Sequence[float]) -> list[str]:
    both = [is_within for is_within, is_excited in zip(agree, excited, strict=True) if is_excited]
    rms = number(float(np.sqrt(np.mean(np.square(scaled)))), 2)
    return [
        name,
        str(len(agree)),
        f"{np.mean(agree):.0%}",
        rms,
        str(len(both)),
        f"{np.mean(both):.0%}" if both else "–",
    ]
