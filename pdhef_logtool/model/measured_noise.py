"""Measurement noise of ``physics`` as a drive shows it, without ground truth.

The normalised squared innovations of a consistent filter have the distribution χ² (Bar-Shalom et al. 2001, chapter 5).
If those of a drive are far larger, its sensors are noisier than assumed, or the model is wrong. The noise is then
raised to the robust spread of the innovations, but only as far as the model still explains the measured yaw rate: if
the model is wrong, more noise makes the estimate follow it. See docs/method.md#self-calibration.
"""

import math
from dataclasses import replace

import numpy as np

from pdhef_logtool.car.parts import MEASUREMENTS
from pdhef_logtool.estimators.filter_steps import PosteriorSteps
from pdhef_logtool.estimators.vehicle_model import VY
from pdhef_logtool.estimators.vehicle_ukf import VehicleUkf
from pdhef_logtool.evaluation.metrics.metric import CalibratedSignals, rms
from pdhef_logtool.evaluation.metrics.yaw_consistency import yaw_rate_errors
from pdhef_logtool.records.signals import FloatArray

#: Median of χ² with 3 degrees of freedom over 3; beyond this multiple of it the innovations are inconsistent.
MEDIAN_NIS, INCONSISTENT = 0.789, 1.3
#: More noise may raise the yaw consistency up to this factor of the lowest one.
EXPLAINED = 1.05
#: Noise over the median absolute innovation, 0.9 of a normal distribution's ratio: the spread of innovations includes
#: that of the prediction. Largest number of steps.
OF_MEDIAN, STEPS = 0.9 * 1.4826, 3
#: Longest part of a drive that is used, in its middle: five minutes at 100 Hz.
MOST_STAMPS = 30_000


def measured_noise(calibrated: CalibratedSignals, physics: VehicleUkf) -> dict[str, float]:
    """Return raised 1-sigmas by measurement (``r_std``); empty if the innovations are consistent."""
    first = max(0, (len(calibrated.signals) - MOST_STAMPS) // 2)
    calibrated = calibrated._replace(signals=calibrated.signals.rows(first, first + MOST_STAMPS))
    assumed = r_std = raised = physics.measurement_std
    allowed = math.inf
    for step in range(STEPS + 1):
        steps, _ = replace(physics, r_std=tuple(raised.tolist())).run(calibrated.signals, None)
        used = steps.nis_dof > 0.0
        fits = not used.any() or np.median(steps.nis[used] / steps.nis_dof[used]) <= INCONSISTENT * MEDIAN_NIS
        if fits and step == 0:  # most drives: their sensors are as assumed
            break
        consistency = _yaw_consistency(calibrated, steps)
        if consistency > allowed:
            break
        r_std, allowed = raised, min(allowed, EXPLAINED * consistency)
        if fits:
            break
        seen = np.abs(steps.innovation)
        spread = [OF_MEDIAN * np.median(s) if (s := c[np.isfinite(c)]).size else 0.0 for c in seen.T]
        raised = np.maximum(r_std, spread)
    return {m: float(new) for m, new, old in zip(MEASUREMENTS, r_std, assumed, strict=True) if new > old}


def _yaw_consistency(calibrated: CalibratedSignals, steps: PosteriorSteps) -> float:
    """Return the RMS of the modelled minus the measured yaw rate, rad/s; infinite without any."""
    vy: FloatArray = np.where(steps.valid, steps.x[:, VY], np.nan)
    errors = next(yaw_rate_errors(calibrated, [vy]))
    errors = errors[np.isfinite(errors)]
    return rms(errors) if errors.size else math.inf
