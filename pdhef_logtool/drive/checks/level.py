"""``SIGNAL.level``: gravity on an axis of the accelerometer that should be level."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind, is_beyond
from pdhef_logtool.drive.columns import derivative, fit, independent_samples, median_known
from pdhef_logtool.drive.frames import IS_GRAVITY_M_S2
from pdhef_logtool.drive.relations import gentle_at
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import BoolArray, FloatArray

#: Limits of an accelerometer's mean that driving does not explain. Grade and crossfall of a whole drive are 3 % at most
#: (0.3 m/s^2), a production sensor's bias less. 0.8 m/s^2 is a tilt of 4.7 degrees; half of g means another axis.
LEVEL_M_S2 = 0.8
OTHER_AXIS_M_S2 = 5.0
#: Least number of independent samples of gentle driving, so that a mean is not due to a manoeuvre: 10 s.
LEVEL_SAMPLES = 20.0


def _levels(drive: CheckedDrive) -> Iterator[Check]:
    columns, speed, sensors = drive.measured.columns, drive.speed, drive.vehicle.sensors
    driving_is_known = not drive.wrong & {"yaw_rate_rad_s", "ay_m_s2", drive.measured.speed_name}
    yaw = columns.get("yaw_rate_rad_s")
    failed = {c.name for c in drive.related if c.verdict == "failed"}
    for name in ("ax_m_s2", "ay_m_s2"):
        if name not in columns or f"{name}.unit" in failed:
            continue
        driven, at_ease = _driven(name, columns[name], speed, yaw)
        rest = columns[name] - driven
        finite = np.isfinite(rest)
        is_known = speed is not None and yaw is not None and bool((yaw[np.isfinite(yaw)] != 0.0).any())
        if independent_samples(int(np.count_nonzero(finite))) < 6.0:
            rest, finite, is_known = columns[name], np.isfinite(columns[name]), False
        if independent_samples(int(np.count_nonzero(finite))) < 2.0:
            continue
        is_gentle_enough = independent_samples(int(np.count_nonzero(finite & at_ease))) >= LEVEL_SAMPLES
        use = finite & at_ease if is_gentle_enough else finite
        bias = sensors.ax_bias_m_s2 if name == "ax_m_s2" else sensors.ay_bias_m_s2
        left, error = float(np.mean(rest[use])), 0.0
        # Roll and tyres near their limit change the gain; the tilt is the intercept at zero acceleration.
        line = fit(columns[name], [np.ones_like(driven), driven], use)
        if line is not None:
            left, error = min(left, float(line[0][0]), key=abs), float(line[1][0])
        check = _level(name, left - bias, error, float(np.mean(columns[name][use])) - bias)
        # A drive in circles has a mean too: without yaw rate and speed, only a mean of about 1 g is gravity.
        is_known |= name == "ax_m_s2" and speed is not None
        is_gravity = is_known or abs(float(np.mean(rest[use]))) > IS_GRAVITY_M_S2[0]
        if (driving_is_known and is_known and is_gentle_enough) or (check.name == f"{name}.axis" and is_gravity):
            yield check


def _driven(
    name: str, measured: FloatArray, speed: FloatArray | None, yaw_rate: FloatArray | None
) -> tuple[FloatArray, BoolArray]:
    """Return the acceleration [N] from speed and yaw rate, 0 without them, and where the driving is gentle [N]."""
    driven, at_ease = np.zeros_like(measured), np.ones(measured.shape[0], np.bool_)
    if speed is not None and yaw_rate is not None:
        # Speed and yaw rate do not explain the acceleration of a sliding car.
        at_ease = gentle_at(yaw_rate * speed, at_ease) & gentle_at(measured - median_known(measured), at_ease)
    if speed is not None and name == "ax_m_s2":
        driven = derivative(speed)
    elif speed is not None and yaw_rate is not None:
        driven = yaw_rate * speed
    return driven, at_ease


def _level(name: str, rest: float, error: float, mean: float) -> Check:
    # A wrong sign or unit of the speed changes the rest, but not the mean: both must exceed the limit.
    size = min(abs(rest), abs(mean))
    evidence = f"mean {mean:.2f} m/s^2, after removal of the driving {rest:.2f} +- {error:.2f}"
    if size > OTHER_AXIS_M_S2:
        return Check(f"{name}.axis", name, "failed", f"{evidence}: that is gravity", "map a level axis of the sensor")
    if is_beyond(size, error, (0.0, LEVEL_M_S2)):
        return LEVEL.failed(evidence, name, tilt=math.degrees(math.asin(size / GRAVITY_M_S2)))
    return LEVEL.passed(evidence, name) if size <= LEVEL_M_S2 else LEVEL.undecided(evidence, name)


LEVEL = CheckKind(
    "SIGNAL.level",
    compares="the mean of an accelerometer with the mean acceleration of the driving",
    fails="they differ by more than 0.8 m/s²: a tilt of 4.7 degrees, or a bias; beyond 5 m/s² `axis` fails",
    remedy="the sensor is tilted by {tilt:.1f} deg (correct it in the mapping), or has a bias (run pdhef learn)",
    lacks="needs gentle driving: speed and yaw rate do not explain the acceleration of a sliding car",
    function=_levels,
)
CHECKS = (LEVEL,)
