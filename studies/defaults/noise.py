"""Noise of the tuned filter of the shipped car (docs/method.md#noise).

Differential evolution of SciPy chooses the trials, points of the space of the logarithms of the factors; its first
generation is a scrambled Sobol sequence.

The objective is the mean over drives of ln √(RMSE² + floor²) of the sideslip, reported as its exponential, a geometric
mean in degrees: every drive counts by its relative error. The floor limits the effect of drives that hardly turn.
"""

import math
from collections.abc import Iterable

import numpy as np
from scipy.optimize import differential_evolution

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
#: Trials of a generation, a multiple of the number of factors.
GENERATION = 16
#: Ranges of the factors, log-uniform: q of v_y (m/s/√s), q of the yaw rate (rad/s/√s), r of a_y (m/s²), r of the yaw
#: rate (rad/s). The other noises remain unchanged.
LOW = np.array([0.002, 0.001, 0.02, 0.0002])
HIGH = np.array([2.0, 1.0, 5.0, 0.05])

#: A point of the space, four significant digits each.
Point = tuple[float, ...]


def tune(logs: Iterable[LogInput], config: RunConfig, trials: int) -> dict[str, FilterNoise]:
    """Return the noise of the tuned filter on drives: the best of ``trials``."""
    options, mapping, identified = config.read_options, mapping_of(config.mapping), Car.load(config.car)
    slow, drives = identified.vehicle.low_speed_blend_m_s, []
    for log in logs:
        with read_drive(log, identified, mapping, options) as drive:
            drives.append(drive.whole())

    def objective(shares: FloatArray) -> float:
        car = identified.with_noise(TUNED, filter_noise(point(shares)))
        estimator = spec_of(TUNED).make(car, Options(options.use_speed))
        given = ((DriveSignals.of(d.signals, car).of_estimator(TUNED), d.truth) for d in drives)
        errors_rad = [error_rad(run_estimator(estimator, s), truth, slow) for s, truth in given if truth is not None]
        return math.degrees(math.exp(float(np.mean(np.log(np.hypot(errors_rad, FLOOR_RAD))))))

    effort = {"popsize": GENERATION // len(LOW), "maxiter": max(1, trials // GENERATION) - 1}
    way = {"init": "sobol", "tol": 0.0, "polish": False, "seed": SEED}
    best = differential_evolution(objective, [(0.0, 1.0)] * len(LOW), **effort, **way)
    print(f"{TUNED}: {best.nfev} trials, {best.fun:.4f}°", flush=True)
    return {TUNED: filter_noise(point(best.x))}


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


def point(shares: FloatArray) -> Point:
    """Return the point at shares [4] in [0, 1] of the logarithmic ranges."""
    return tuple(float(f"{value:.4g}") for value in LOW * (HIGH / LOW) ** shares)
