"""``vehicle.*``: whether wheels, steering and tyres of the car agree with its vehicle file."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.drive.checks.kind import SURE, CheckedDrive, CheckKind
from pdhef_logtool.drive.columns import fit, moving_at
from pdhef_logtool.drive.relations import gentle_at
from pdhef_logtool.records.checks import Check
from pdhef_logtool.records.signals import WHEELS

#: Effective radius over the file's radius: tyres wear by 3 %, sizes of one car differ by 5 %.
RADIUS_RANGE = (0.85, 1.18)


def _radius(drive: CheckedDrive) -> Iterator[Check]:
    columns, speed, vehicle = drive.measured.columns, drive.speed, drive.vehicle
    if not drive.has_file or speed is None or "speed_m_s" not in columns:
        return
    moving = moving_at(speed)
    wheels = [columns[n] for w in WHEELS if (n := f"wheel_speed_{w}_rad_s") in columns]
    turning = [(w, moving & np.isfinite(w) & (w != 0.0)) for w in wheels]
    ratios = [float(np.median(speed[k] / w[k])) for w, k in turning if k.any()]
    if not ratios:
        return
    radius = float(np.median(ratios))
    low, high = (f * vehicle.wheel_radius_m for f in RADIUS_RANGE)
    evidence = f"the speed over the wheels' is {radius:.3f} m, the file's radius {vehicle.wheel_radius_m:g} m"
    yield RADIUS.judged(low <= radius <= high, evidence, radius=radius)


RADIUS = CheckKind(
    "vehicle.wheel_radius",
    compares="the ratio of speed and wheel speed with the wheel radius in the vehicle file",
    fails="it is below 0.85 or above 1.18 of the radius",
    remedy="set wheel_radius_m = {radius:.3f}",
    function=_radius,
)

#: Understeer gradients that have opposite signs and are this far from neutral; rad per m/s^2. Cars have 0.002 to 0.006.
NEUTRAL_RAD_PER_M_S2 = 0.0006
#: Steering angle over the angle that follows from curvature, ratio and wheelbase of the file.
STEERING_RANGE = (0.75, 1.33)
#: Largest share of the steering's spread that curvature and lateral acceleration do not explain.
UNEXPLAINED_STEERING = 0.5
#: Highest over lowest speed from which wheelbase and understeer can be distinguished.
SPEED_SPREAD = 1.4


def _steering(drive: CheckedDrive) -> list[Check]:
    """Check wheelbase with steering ratio, and under- or oversteer, by delta = s L r / v + K v r + offset."""
    columns, speed, vehicle = drive.measured.columns, drive.speed, drive.vehicle
    rate, steer = columns.get("yaw_rate_rad_s"), columns.get("steer_rad")
    if steer is None and "steering_wheel_rad" in columns:
        steer = columns["steering_wheel_rad"] / vehicle.steering_ratio
    is_misread = drive.wrong & {"yaw_rate_rad_s", "steer_rad", "steering_wheel_rad"}
    if not drive.has_file or speed is None or rate is None or steer is None or is_misread:
        return []
    with np.errstate(divide="ignore", invalid="ignore"):
        curved = vehicle.wheelbase_m * rate / speed
    lateral = rate * speed
    gentle = gentle_at(lateral, moving_at(speed))
    result = fit(steer, [curved, lateral, np.ones_like(steer)], gentle)
    speeds = np.abs(speed[gentle & np.isfinite(speed)])
    # At constant speed, curvature and lateral acceleration are proportional.
    if result is None or np.quantile(speeds, 0.9) < SPEED_SPREAD * np.quantile(speeds, 0.1):
        lacks = "needs bends to both sides at low and at high speed"
        return [kind.undecided("too little driving in bends", lacks=lacks) for kind in (STEERING, UNDERSTEER)]
    (share, gradient, _), (share_error, error, _), left = result
    if share <= 0.0 or left > UNEXPLAINED_STEERING * float(np.std(steer[gentle & np.isfinite(steer)])):
        lacks = "needs bends that the car does not slide through"
        evidence = "curvature and lateral acceleration do not explain the steering"
        return [kind.undecided(evidence, lacks=lacks) for kind in (STEERING, UNDERSTEER)]
    file = vehicle.understeer_gradient_rad_per_m_s2(vehicle.assumed_friction)
    evidence = (
        f"slow bends take {share:.2f} +- {share_error:.2f} of the steering that wheelbase and ratio of the file ask for"
    )
    steering = STEERING.of_figure(share, share_error, STEERING_RANGE, evidence, share=share)
    return [steering, _understeer_check(gradient, error, file)]


def _understeer_check(gradient: float, error: float, file: float) -> Check:
    drive_mrad, error_mrad, file_mrad = (1e3 * x for x in (gradient, error, file))
    evidence = (
        f"understeer gradient {drive_mrad:.2f} +- {error_mrad:.2f} mrad per m/s^2 in the drive, {file_mrad:.2f} "
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
    fails="it is less than 0.75 or more than 1.33 of the value from the file",
    remedy="steering_ratio is off by {share:.2f}, or the wheelbase",
    lacks=_LACKS,
    function=_steering,
)
UNDERSTEER = CheckKind(
    "vehicle.understeer",
    compares="the understeer gradient of the drive with the gradient of the vehicle file",
    fails="their signs are opposite, and both are far from neutral",
    remedy="the car {behaves}: check tyre stiffness and position of the CG, or run pdhef learn",
    lacks=_LACKS,
)

#: Driven lateral acceleration over the limit of the file's tyres at friction 1: summer tyres reach 1.15.
MAX_GRIP_USE = 1.25


def _mass(drive: CheckedDrive) -> Iterator[Check]:
    columns, speed, vehicle = drive.measured.columns, drive.speed, drive.vehicle
    rate, ay = columns.get("yaw_rate_rad_s"), columns.get("ay_m_s2")
    if not drive.has_file or speed is None or rate is None or ay is None:
        return
    # Roll increases a_y, and the yaw rate is too high when a car begins to spin.
    lateral = np.minimum(np.abs(ay), np.abs(rate * speed))
    finite = lateral[np.isfinite(lateral)]
    friction = max(1.0, vehicle.assumed_friction)
    carried = [vehicle.magic_formula(front, friction)[2] / vehicle.axle_load_n(front) for front in (True, False)]
    most = GRAVITY_M_S2 * min(carried)
    seen = float(np.quantile(finite, 0.99)) if finite.size else 0.0
    evidence = f"{seen:.1f} m/s^2 were driven, the limit by tyres and mass of the file is {most:.1f} m/s^2"
    yield MASS.judged(seen <= MAX_GRIP_USE * most, evidence)


MASS = CheckKind(
    "vehicle.mass",
    compares="the driven lateral acceleration with the limit by tyres and mass of the vehicle file",
    fails="it is above 1.25 of the limit at friction 1",
    remedy="mass_kg is too large, or friction and the tyres' peak are too small",
    function=_mass,
)
CHECKS = (RADIUS, STEERING, UNDERSTEER, MASS)
