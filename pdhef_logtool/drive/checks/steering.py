"""``vehicle.steering``, ``vehicle.understeer``: whether the car steers as its file has it; one fit serves both."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.drive.checks.fitting import SURE, fit
from pdhef_logtool.drive.checks.kind import CheckedDrive, CheckKind
from pdhef_logtool.drive.columns import moving_at
from pdhef_logtool.drive.relations import gentle_at
from pdhef_logtool.records.checks import Check

#: Understeer gradients that have opposite signs and are this far from neutral; rad per m/s^2. Cars have 0.002 to 0.006.
NEUTRAL_RAD_PER_M_S2 = 0.0006
#: Steering angle over what the file's ratio and wheelbase make of the curvature.
STEERING_RANGE = (0.75, 1.33)
#: Share of the steering's spread that curvature and lateral acceleration may leave.
UNEXPLAINED_STEERING = 0.5
#: Highest over lowest speed from which wheelbase and understeer can be distinguished.
SPEED_SPREAD = 1.4


def _checks(drive: CheckedDrive) -> list[Check]:
    """Judge wheelbase with steering ratio, and under- or oversteer, by delta = s L r / v + K v r + offset."""
    columns, speed, vehicle = drive.measured.columns, drive.speed, drive.vehicle
    rate, steer = columns.get("yaw_rate_rad_s"), columns.get("steer_rad")
    if steer is None and "steering_wheel_rad" in columns:
        steer = columns["steering_wheel_rad"] / vehicle.steering_ratio
    if not drive.has_file or speed is None or rate is None or steer is None:
        return []
    with np.errstate(divide="ignore", invalid="ignore"):
        curved = vehicle.wheelbase_m * rate / speed
    lateral = rate * speed
    gentle = gentle_at(lateral, moving_at(speed))
    result = fit(steer, [curved, lateral, np.ones_like(steer)], gentle)
    speeds = np.abs(speed[gentle & np.isfinite(speed)])
    # At one speed curvature and lateral acceleration are one regressor.
    if result is None or np.quantile(speeds, 0.9) < SPEED_SPREAD * np.quantile(speeds, 0.1):
        lacks = "needs bends to both sides at low and at high speed"
        return [kind.undecided("too little driving in bends", lacks=lacks) for kind in CHECKS]
    (share, gradient, _), (share_error, error, _), left = result
    if share <= 0.0 or left > UNEXPLAINED_STEERING * float(np.std(steer[gentle & np.isfinite(steer)])):
        lacks = "needs bends that the car does not slide through"
        evidence = "curvature and lateral acceleration do not explain the steering"
        return [kind.undecided(evidence, lacks=lacks) for kind in CHECKS]
    file = vehicle.understeer_gradient_rad_per_m_s2(vehicle.assumed_friction)
    return [_steering_check(share, share_error), _understeer_check(gradient, error, file)]


def _steering_check(share: float, error: float) -> Check:
    low, high = STEERING_RANGE
    evidence = (
        f"slow bends take {share:.2f} +- {error:.2f} of the steering that wheelbase and ratio of the file ask for"
    )
    if share + SURE * error < low or share - SURE * error > high:
        return STEERING.failed(evidence, share=share)
    if share - 2.0 * error < low or share + 2.0 * error > high:
        return STEERING.undecided(evidence)
    return STEERING.passed(evidence)


def _understeer_check(gradient: float, error: float, file: float) -> Check:
    evidence = (
        f"understeer gradient {gradient * 1e3:.2f} +- {error * 1e3:.2f} mrad per m/s^2 in the drive, {file * 1e3:.2f} "
        "in the file"
    )
    opposite = gradient * file < 0.0 and min(abs(gradient), abs(file)) > NEUTRAL_RAD_PER_M_S2
    if opposite and abs(gradient) > SURE * error:
        behaves = "understeers where the file oversteers" if gradient > 0.0 else "oversteers where the file understeers"
        return UNDERSTEER.failed(evidence, behaves=behaves)
    if error > max(abs(gradient), abs(file), NEUTRAL_RAD_PER_M_S2):
        return UNDERSTEER.undecided(evidence)
    return UNDERSTEER.passed(evidence)


_LACKS = "needs bends at low and at high speed"
STEERING = CheckKind(
    "vehicle.steering",
    compares="the steering in slow bends with the steering ratio and the wheelbase of the vehicle file",
    fails="less than 0.75 or more than 1.33 of what the file gives is used",
    remedy="steering_ratio is off by {share:.2f}, or the wheelbase",
    lacks=_LACKS,
    function=_checks,
)
UNDERSTEER = CheckKind(
    "vehicle.understeer",
    compares="the understeer gradient of the drive with that of the vehicle file",
    fails="their signs are opposite, and both are far from neutral",
    remedy="the car {behaves}: check tyre stiffness and place of the CG, or run pdhef learn",
    lacks=_LACKS,
)
CHECKS = (STEERING, UNDERSTEER)
