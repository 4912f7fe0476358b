"""Driver model: path preview, speed control, planned stops, human lag."""

import math
from typing import NamedTuple

from numba.extending import register_jitable

from pdhef_logtool.records.signals import FloatArray
from truthsim.road import interpolated


class Driver(NamedTuple):
    """Preview and response of the driver."""

    preview_s: float = 0.55
    preview_min_m: float = 4.0
    steering_lag_s: float = 0.06
    steer_rate_limit_rad_s: float = 0.9
    steer_limit_rad: float = 0.6
    #: Understeer that the driver compensates: road-wheel angle beyond L/R per lateral acceleration.
    understeer_rad_per_m_s2: float = 0.0034
    wheelbase_m: float = 2.87
    speed_gain_per_s: float = 0.9
    speed_integral_per_s2: float = 0.15
    pedal_lag_s: float = 0.12
    acceleration_limit_m_s2: float = 3.0
    braking_limit_m_s2: float = 8.0
    #: Standing on a slope of 6 %, the car gives way by about 3 cm/s.
    hold_brake_n_m: float = 1000.0
    max_power_w: float = 110_000.0
    max_drive_n_m: float = 2400.0
    mass_kg: float = 1440.0
    wheel_radius_m: float = 0.30


#: Slots of the driver's memory.
PROGRESS, STEER, PEDAL, INTEGRAL, STOP, DWELL = range(6)
MEMORY_SIZE = 6
#: Columns of a path table, one row every ``step_m`` of arc length.
PATH_X, PATH_Y, PATH_YAW, PATH_SPEED = range(4)


@register_jitable
def track_progress_m(
    path: FloatArray, step_m: float, progress_m: float, x_m: float, y_m: float, ahead_m: float
) -> float:
    """Return the arc length of the path's point beside the car, searched forward from the previous one."""
    progress = progress_m
    for _ in range(3):
        yaw = interpolated(path, progress / step_m, PATH_YAW)
        along = (x_m - interpolated(path, progress / step_m, PATH_X)) * math.cos(yaw) + (
            y_m - interpolated(path, progress / step_m, PATH_Y)
        ) * math.sin(yaw)
        progress = max(progress_m, progress + min(along, ahead_m))
    return progress


@register_jitable
def preview_steer_rad(
    driver: Driver,
    path: FloatArray,
    step_m: float,
    progress_m: float,
    x_m: float,
    y_m: float,
    course_rad: float,
    speed_m_s: float,
) -> float:
    """Return the road-wheel angle of the circle from the present course to the path's point at the preview distance.

    A point straight ahead needs no steering; a point at lateral offset e and distance d needs the curvature 2 e / d².
    """
    distance = max(driver.preview_min_m, driver.preview_s * speed_m_s)
    last_m = step_m * (path.shape[0] - 1)
    at_m = progress_m + distance
    dx = interpolated(path, at_m / step_m, PATH_X) - x_m
    dy = interpolated(path, at_m / step_m, PATH_Y) - y_m
    if at_m > last_m:
        yaw = path[path.shape[0] - 1, PATH_YAW]
        dx += (at_m - last_m) * math.cos(yaw)
        dy += (at_m - last_m) * math.sin(yaw)
    aside = -dx * math.sin(course_rad) + dy * math.cos(course_rad)
    curvature = 2.0 * aside / (dx * dx + dy * dy)
    steer = math.atan(curvature * driver.wheelbase_m) + (
        driver.understeer_rad_per_m_s2 * curvature * speed_m_s * speed_m_s
    )
    return float(min(max(steer, -driver.steer_limit_rad), driver.steer_limit_rad))


@register_jitable
def move_steering(driver: Driver, memory: FloatArray, demand_rad: float, dt_s: float) -> float:
    """Move the steering towards the demand (first-order lag, limited rate); return the mean road-wheel angle in rad."""
    rate = (demand_rad - memory[STEER]) / driver.steering_lag_s
    rate = min(max(rate, -driver.steer_rate_limit_rad_s), driver.steer_rate_limit_rad_s)
    memory[STEER] += rate * dt_s
    return float(memory[STEER])


@register_jitable
def pedal_torques_n_m(
    driver: Driver, memory: FloatArray, target_m_s: float, target_rate_m_s2: float, speed_m_s: float, dt_s: float
) -> tuple[float, float]:
    """Drive and brake torque (N m, all wheels) for a target speed (m/s) and its rate (m/s²)."""
    error = target_m_s - speed_m_s
    demand = target_rate_m_s2 + driver.speed_gain_per_s * error + memory[INTEGRAL]
    limited = min(max(demand, -driver.braking_limit_m_s2), driver.acceleration_limit_m_s2)
    if limited == demand and speed_m_s > 1.0:
        memory[INTEGRAL] += driver.speed_integral_per_s2 * error * dt_s
        memory[INTEGRAL] = min(max(memory[INTEGRAL], -0.6), 0.6)
    memory[PEDAL] += (limited - memory[PEDAL]) / driver.pedal_lag_s * dt_s
    torque = memory[PEDAL] * driver.mass_kg * driver.wheel_radius_m
    if torque < 0.0:
        return 0.0, -torque
    most = min(driver.max_drive_n_m, driver.max_power_w * driver.wheel_radius_m / max(speed_m_s, 1.0))
    return min(torque, most), 0.0


@register_jitable
def target_speed_m_s(path: FloatArray, step_m: float, stops: FloatArray, memory: FloatArray) -> tuple[float, float]:
    """Return the target speed of the path beside the car (m/s), and its rate along the path (m/s²).

    ``stops`` is [K, 2]: arc length in m, dwell in s. The driver does not pass a stop before its dwell, and starts from
    it towards the speed a little further ahead.
    """
    k = int(memory[STOP])
    at_m = memory[PROGRESS]
    if k < stops.shape[0]:
        at_m = min(at_m, stops[k, 0])
    if k > 0:
        at_m = max(at_m, stops[k - 1, 0] + 2.0)
    speed = interpolated(path, at_m / step_m, PATH_SPEED)
    ahead = interpolated(path, (at_m + 0.5) / step_m, PATH_SPEED)
    behind = interpolated(path, (at_m - 0.5) / step_m, PATH_SPEED)
    return speed, 0.5 * (ahead * ahead - behind * behind)


@register_jitable
def standing(stops: FloatArray, memory: FloatArray, speed_m_s: float, dt_s: float) -> bool:
    """Return whether the driver keeps the brake on at a stop, and count its dwell (``stops`` as above)."""
    k = int(memory[STOP])
    if k >= stops.shape[0]:
        return False
    close = memory[PROGRESS] > stops[k, 0] - 0.6
    if memory[DWELL] <= 0.0 and not (close and speed_m_s < 0.35):
        return False
    memory[DWELL] += dt_s
    memory[INTEGRAL] = 0.0
    if memory[DWELL] >= stops[k, 1]:
        memory[STOP] += 1.0
        memory[DWELL] = 0.0
        memory[PEDAL] = 0.0
        return False
    return True
