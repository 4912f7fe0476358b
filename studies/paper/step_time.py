"""Processor time a step of every scheme, all in one run on one core, each the median of several rounds in turns."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.car.car import Car
from pdhef_logtool.estimators.table import make_estimator
from studies.paper.experiment import ReadDrive, track_of

ROUNDS = 15


@dataclass(frozen=True, slots=True)
class StepTime:
    """Microseconds a step: median, fastest and slowest round."""

    median_us: float
    low_us: float
    high_us: float


def step_times(drive: ReadDrive, car: Car, names: Sequence[str], rounds: int = ROUNDS) -> dict[str, StepTime]:
    """Time the schemes on a drive; the first round, which compiles and loads, does not count."""
    schemes = [make_estimator(name, car) for name in names]
    steps = len(drive.signals)
    seconds: dict[str, list[float]] = {s.name: [] for s in schemes}
    for number in range(rounds + 1):
        for scheme in schemes:
            start = time.process_time()
            track_of(scheme, car, drive)
            if number:
                seconds[scheme.name].append(time.process_time() - start)
    return {
        name: StepTime(*(1e6 * float(f(taken)) / steps for f in (np.median, np.min, np.max)))
        for name, taken in seconds.items()
    }
