"""Processor time a step of every scheme, all in one run on one core, each the median of several rounds in turns."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.drive.reading import WholeDrive
from pdhef_logtool.estimators.drive_signals import DriveSignals
from pdhef_logtool.estimators.table import make_estimator
from pdhef_logtool.runs.estimating import estimate_drive

ROUNDS = 15


def step_times(whole: WholeDrive, car: Car, names: Sequence[str], rounds: int = ROUNDS) -> dict[str, dict[str, float]]:
    """Return median, fastest and slowest round in microseconds a step; the first one compiles and does not count."""
    schemes, corrected = [make_estimator(name, car) for name in names], DriveSignals.of(whole.signals, car)
    seconds: dict[str, list[float]] = {s.name: [] for s in schemes}
    for number in range(rounds + 1):
        for scheme in schemes:
            start = time.process_time()
            estimate_drive(whole, corrected, [scheme])
            if number:
                seconds[scheme.name].append(time.process_time() - start)
    us = 1e6 / len(whole.signals)
    return {
        name: {"median_us": us * float(np.median(taken)), "low_us": us * min(taken), "high_us": us * max(taken)}
        for name, taken in seconds.items()
    }
