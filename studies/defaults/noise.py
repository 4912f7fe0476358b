"""Noise of the tuned filter of the shipped car (docs/method.md#noise).

A trial is a point of the space. The first half of the trials is a scrambled Sobol sequence. The rest are Gaussian steps
from the best point so far, in the logarithms of the factors, with a width that shrinks.

The objective is the mean over drives of ln √(RMSE² + floor²) of the sideslip, reported as its exponential, a geometric
mean in degrees: every drive counts by its relative error. The floor limits the effect of drives that hardly turn.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
from scipy.stats import qmc

from pdhef_logtool.car.car import Car
from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.drive.reading import read_drive
from pdhef_logtool.estimators.drive_signals import DriveSignals
from pdhef_logtool.estimators.latency_compensation import run_estimator
from pdhef_logtool.estimators.table import Options, spec_of
from pdhef_logtool.estimators.vehicle_ukf import PHY_UKF_Q_STD
from pdhef_logtool.evaluation.track_errors import signal_error
from pdhef_logtool.logs.discovery import LogInput
from pdhef_logtool.mapping import mapping_of
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.runs.config import RunConfig

#: Seed of the random draws on validation drives.
SEED = 0
#: The filter with a searched noise; the noise of ``physics`` is identified together with its values.
TUNED = "phy-ukf:tuned"
#: Added to each drive's RMSE as squares.
FLOOR_RAD = math.radians(0.05)
#: If an estimate is missing at more of the scored stamps, its error is at least the error of sideslip 0.
MIN_AVAILABILITY = 0.9
#: Share of the trials that explore the whole space.
EXPLORING_SHARE = 0.5
#: 1-sigma of the local steps, from first to last, as a share of each factor's logarithmic range.
STEP_FIRST, STEP_LAST = 0.15, 0.02
#: Ranges of the factors, log-uniform: q of v_y (m/s/√s), q of the yaw rate (rad/s/√s), r of a_y (m/s²), r of the yaw
#: rate (rad/s). The other noises remain unchanged.
LOW = np.array([0.002, 0.001, 0.02, 0.0002])
HIGH = np.array([2.0, 1.0, 5.0, 0.05])

#: A point of the space, four significant digits each.
Point = tuple[float, ...]


#: Objective in degrees, number of the trial, and point; the least one is the best.
Trial = tuple[float, int, Point]


def tune(logs: Iterable[LogInput], config: RunConfig, trials: int) -> dict[str, FilterNoise]:
    """Return the noise of the tuned filter on drives: the best of ``trials``."""
    options, mapping, identified = config.read_options, mapping_of(config.mapping), Car.load(config.car)
    slow, drives = identified.vehicle.low_speed_blend_m_s, []
    for log in logs:
        with read_drive(log, identified, mapping, options) as drive:
            drives.append(drive.whole())

    def objective(values: Point) -> float:
        car = identified.with_noise(TUNED, filter_noise(values))
        estimator = spec_of(TUNED).make(car, Options(options.use_speed))
        given = ((DriveSignals.of(d.signals, car).of_estimator(TUNED), d.truth) for d in drives)
        return objective_deg(
            [error_rad(run_estimator(estimator, s), truth, slow) for s, truth in given if truth is not None]
        )

    error_deg, number, best = min(search(objective, trials, SEED))
    print(f"{TUNED}: trial {number} of {trials}, {error_deg:.4f}°", flush=True)
    return {TUNED: filter_noise(best)}


def filter_noise(values: Point) -> FilterNoise:
    """Return the noise of a point."""
    q_vy, q_yaw_rate, r_ay, r_yaw_rate = values
    return FilterNoise(
        q_std=(PHY_UKF_Q_STD[0], q_vy, q_yaw_rate), r_std={"ay_m_s2": r_ay, "yaw_rate_rad_s": r_yaw_rate}
    )


def error_rad(estimate: StateTrack, truth: StateTrack, low_speed_m_s: float) -> float:
    """Return the sideslip RMSE of a drive as ``pdhef run`` scores it.

    It is at least the RMSE of sideslip 0 if too much of the estimate is missing.
    """
    error = signal_error(estimate, truth, "sideslip_rad", low_speed_m_s)
    error = error[np.isfinite(error)]
    scorable = truth.sideslip_rad[np.isfinite(signal_error(truth, truth, "sideslip_rad", low_speed_m_s))]
    rms, zero = (float(np.sqrt(np.mean(x**2))) if x.size else math.nan for x in (error, scorable))
    if error.size == 0:
        return zero
    return rms if error.size >= MIN_AVAILABILITY * scorable.size else max(rms, zero)


def objective_deg(errors_rad: Sequence[float]) -> float:
    """Return the objective over drives."""
    return math.degrees(math.exp(float(np.mean(np.log(np.hypot(errors_rad, FLOOR_RAD))))))


def point(shares: FloatArray) -> Point:
    """Return the point at shares [4] in [0, 1] of the logarithmic ranges."""
    return tuple(float(f"{value:.4g}") for value in LOW * (HIGH / LOW) ** shares)


def search(objective: Callable[[Point], float], trials: int, seed: int) -> list[Trial]:
    """Return all trials; ``seed`` determines the Sobol scrambling and the local steps."""
    exploring = max(1, round(EXPLORING_SHARE * trials))
    sobol = qmc.Sobol(len(LOW), scramble=True, seed=seed).random_base2(max(0, (exploring - 1).bit_length()))
    width = np.geomspace(STEP_FIRST, STEP_LAST, trials - exploring) if trials > exploring else np.empty(0)
    steps = width[:, None] * np.random.default_rng([seed, len(LOW)]).standard_normal((trials - exploring, len(LOW)))
    done: list[Trial] = []
    for number in range(trials):
        if number < exploring:
            shares = sobol[number]
        else:
            centre = np.log(np.array(min(done)[2]) / LOW) / np.log(HIGH / LOW)
            shares = np.clip(centre + steps[number - exploring], 0.0, 1.0)
        values = point(shares)
        done.append((objective(values), number, values))
    return done
