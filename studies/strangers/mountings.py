"""Logs with an IMU rotated in steps of 90 degrees."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product

import numpy as np

from pdhef_logtool.records.signals import FloatArray
from studies.strangers.cars import drive
from studies.strangers.layouts import CAUSES
from studies.strangers.recordings import Recording, answers, imu, road_car


def right_angles() -> list[FloatArray]:
    """Return the 24 rotations in steps of 90 degrees, the identity first."""
    turns = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        turn = np.zeros((3, 3))
        turn[range(3), order] = signs
        if np.linalg.det(turn) > 0.0:
            turns.append(turn)
    return turns


def mountings() -> Iterator[Recording]:
    """Yield the 24 logs; the first IMU has the axes of the car."""
    car = drive("short")
    for i, turn in enumerate(right_angles()):
        yield Recording(
            name=f"mounting-{i:02}",
            kind="mounting-90",
            group="fault",
            what="IMU turned in steps of 90 degrees, all 24 ways",
            container="mcap",
            topics=road_car(car, imu=imu(car.force.times(turn), car.rate.times(turn))),
            right=answers(car, "imu", "steer", "speed", "truth", "truth rate"),
            cause=CAUSES["MOUNTING"] if i else "",
            at_fault=frozenset({"ax_m_s2", "ay_m_s2", "yaw_rate_rad_s"} if i else ()),
        )
