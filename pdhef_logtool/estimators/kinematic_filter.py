"""Extended Kalman filter of the plane kinematics of a car, without tyre data (docs/method.md#reference).

States in body axes at the CG: v_x, v_y, biases b of the accelerometers, error d of the measured v_y; constants:
compliance of the rear axle and the parameters of the sensors; with GNSS also heading, error of the receiver, antenna.

    v̇_x = a_x + v_y r,   v̇_y = a_y − v_x r                               (kinematics of a plane body)
    ḃ_x = −g q + r b_y,  ḃ_y = g p − r b_x                                (tilt, if roll rate p, pitch rate q exist)

Measurements are the speed, GNSS velocity, standstill, and a lateral velocity of uncertainty S, whose error has a
correlated part d and a white part w: either the rear axle's in the linear range,

    v_y − l_r r = −(κ a_r + k₂ ṙ) |v_x| − k₃ ȧ_y + β₀ v_x + S |v| (d + w),

with the rear axle's lateral acceleration a_r and the lag k₃ of tyre relaxation and body roll, or another filter's v_y.
Each measurement is a function of the state at which it is linearised, and of a row of inputs; it writes its Jacobian
to ``h`` [n] and returns its residual and its variance. Gains multiply low-passed accelerations, so that noise does not
bias them.
"""

import math

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.gaussian import correct, dot, times

#: Entries of the state: up to PITCH_RATE_BIAS always, all with GNSS velocity.
(
    VX, VY, AX_BIAS, AY_BIAS, LAW_ERROR,
    COMPLIANCE, YAW_COMPLIANCE, LAW_ANGLE, REAR_AXLE, ROLL_GAIN, SPEED_SCALE, IMU_X,
    YAW_RATE_BIAS, YAW_RATE_GAIN, RATE_COMPLIANCE, IMU_Y, IMU_YAW, AX_GAIN,
    ROLL_RATE_BIAS, PITCH_RATE_BIAS,
    HEADING, EAST_ERROR, NORTH_ERROR, ANTENNA_X, ANTENNA_Y, GNSS_DELAY, ANTENNA_HEIGHT,
) = range(27)  # fmt: skip
WITHOUT_GNSS, WITH_GNSS = HEADING, ANTENNA_HEIGHT + 1
#: Columns of the inputs at the knots: means over the interval before the knot, values at it, and 1-sigmas.
(
    MEAN_AX, MEAN_AY, MEAN_YAW_RATE, YAW_RATE, AX, AY, YAW_ACCELERATION, AY_RATE,
    SPEED, SPEED_STD, LAW_STD, GNSS_EAST, GNSS_NORTH, GNSS_OFFSET, GNSS_STD,
    GAP, STANDSTILL, MEAN_YAW_ACCELERATION, SLOW_AX, SLOW_AY,
    ROLL_RATE, MEAN_ROLL_RATE, MEAN_PITCH_RATE, TILT, LENGTH, UNSIGNED,
) = range(26)  # fmt: skip
INPUTS = UNSIGNED + 1

#: Time constants of the accelerometer biases (tilt, bank), the law's error and the receiver's error, s.
BIAS_S, LAW_S, RECEIVER_S = 6.0, 2.0, 5.0
#: Their stationary 1-sigmas (the law's is LAW_STD), m/s² and m/s.
BIAS_M_S2, RECEIVER_M_S = 0.35, 0.02
#: Share of a change of a_x, a_y that changes their bias by pitch and roll; the same with known roll and pitch rate.
TILT_SHARE, KNOWN_TILT_SHARE = 0.05, 0.01
#: Time constant of the tilt from roll and pitch rate, and noise by their errors, m/s²/√s.
TILT_S, TILT_NOISE = 30.0, 0.03
#: White noise of a stretch without IMU, m/s²/√Hz.
GAP_NOISE = 3.0
#: White part of the law's error as a share of LAW_STD, and its floor in m/s.
LAW_WHITE, LAW_FLOOR_M_S = 0.7, 0.02
#: Share of the rear axle in the lateral acceleration that acts on it in steady turns.
REAR_SHARE = 0.95
#: 1-sigmas of v_y and of the gyro at standstill, and the scale of the Cauchy weight.
STILL_M_S, STILL_RAD_S, CAUCHY = 0.02, 0.002, 3.0


@njit(cache=True)
def predict(x, p, point, step_s, row, before, noise):  # type: ignore[no-untyped-def]
    """Return the state after a step, its covariance, and Cov(x, new x); linearised about ``point``.

    ``before``: the previous row. ``noise``: white, of a_x, a_y in m/s²/√Hz, of the gyro in rad/s/√Hz.
    """
    f = np.zeros(p.shape)
    new = _transition(point, step_s, row, f)
    for i in range(new.shape[0]):
        new[i] += dot(f[i], x - point)
    cross = times(f, p).T.copy()
    predicted = times(f, cross)
    _add_process_noise(predicted, point, step_s, row, before, noise)
    return new, predicted, cross


@njit(cache=True)
def use(x, p, point, h, measured, robust):  # type: ignore[no-untyped-def]
    """Update with a measurement (residual, variance) that was linearised about ``point``.

    ``robust``: the weight of a large residual is reduced (Cauchy).
    """
    residual, variance = measured
    if robust:
        variance *= 1.0 + residual * residual / (variance * CAUCHY * CAUCHY)
    correct(x, p, h, residual - dot(h, x - point), variance)


@njit(cache=True)
def yaw_rate(point, measured):  # type: ignore[no-untyped-def]
    """Return the yaw rate at a state."""
    return measured * (1.0 - point[YAW_RATE_GAIN]) - point[YAW_RATE_BIAS]


@njit(cache=True)
def accelerations(point, ax, ay, slow_ax, slow_ay, rate, yaw_acceleration):  # type: ignore[no-untyped-def]
    """Return the accelerations of the CG from accelerometers that read a_x, a_y, at a state."""
    x, y, yaw = point[IMU_X], point[IMU_Y], point[IMU_YAW]
    corrected_ax = ax - point[AX_GAIN] * slow_ax - yaw * slow_ay - point[AX_BIAS] + x * rate**2 + y * yaw_acceleration
    corrected_ay = ay - point[ROLL_GAIN] * slow_ay + yaw * slow_ax - point[AY_BIAS] - x * yaw_acceleration + y * rate**2
    return corrected_ax, corrected_ay


@njit(cache=True)
def _transition(point, h, row, f):  # type: ignore[no-untyped-def]
    """Return the state ``h`` seconds after ``point``; write the Jacobian to ``f`` [n, n], which is zero."""
    rate, turning = yaw_rate(point, row[MEAN_YAW_RATE]), row[MEAN_YAW_ACCELERATION]
    slow_ax, slow_ay = row[SLOW_AX], row[SLOW_AY]
    ax, ay = accelerations(point, row[MEAN_AX], row[MEAN_AY], slow_ax, slow_ay, rate, turning)
    c, s = math.cos(rate * h), math.sin(rate * h)
    tilts = row[TILT] > 0.0
    for i in range(point.shape[0]):
        f[i, i] = 1.0
    f[AX_BIAS, AX_BIAS] = f[AY_BIAS, AY_BIAS] = math.exp(-h / (TILT_S if tilts else BIAS_S))
    f[LAW_ERROR, LAW_ERROR] = math.exp(-h / LAW_S)
    if point.shape[0] == WITH_GNSS:
        f[EAST_ERROR, EAST_ERROR] = f[NORTH_ERROR, NORTH_ERROR] = math.exp(-h / RECEIVER_S)
    new = point.copy()
    for i in (AX_BIAS, AY_BIAS, LAW_ERROR, EAST_ERROR, NORTH_ERROR):
        if i < point.shape[0]:
            new[i] *= f[i, i]
    new[VX] = c * point[VX] + s * point[VY] + h * ax
    new[VY] = -s * point[VX] + c * point[VY] + h * ay
    f[VX, VX], f[VX, VY], f[VX, AX_BIAS], f[VX, AX_GAIN] = c, s, -h, -h * slow_ax
    f[VY, VX], f[VY, VY], f[VY, AY_BIAS], f[VY, ROLL_GAIN] = -s, c, -h, -h * slow_ay
    f[VX, IMU_X], f[VX, IMU_Y], f[VX, IMU_YAW] = h * rate * rate, h * turning, -h * slow_ay
    f[VY, IMU_X], f[VY, IMU_Y], f[VY, IMU_YAW] = -h * turning, h * rate * rate, h * slow_ax
    by_angle = (-s * point[VX] + c * point[VY], -c * point[VX] - s * point[VY])
    f[VX, YAW_RATE_BIAS], f[VX, YAW_RATE_GAIN] = -h * by_angle[0], -h * row[MEAN_YAW_RATE] * by_angle[0]
    f[VY, YAW_RATE_BIAS], f[VY, YAW_RATE_GAIN] = -h * by_angle[1], -h * row[MEAN_YAW_RATE] * by_angle[1]
    if tilts:
        new[AX_BIAS] += h * (rate * point[AY_BIAS] - GRAVITY_M_S2 * (row[MEAN_PITCH_RATE] - point[PITCH_RATE_BIAS]))
        new[AY_BIAS] += h * (GRAVITY_M_S2 * (row[MEAN_ROLL_RATE] - point[ROLL_RATE_BIAS]) - rate * point[AX_BIAS])
        f[AX_BIAS, AY_BIAS], f[AX_BIAS, PITCH_RATE_BIAS] = h * rate, h * GRAVITY_M_S2
        f[AY_BIAS, AX_BIAS], f[AY_BIAS, ROLL_RATE_BIAS] = -h * rate, -h * GRAVITY_M_S2
    if point.shape[0] == WITH_GNSS:
        new[HEADING] += rate * h
        f[HEADING, YAW_RATE_BIAS], f[HEADING, YAW_RATE_GAIN] = -h, -h * row[MEAN_YAW_RATE]
    return new


@njit(cache=True)
def _add_process_noise(p, point, h, row, before, noise):  # type: ignore[no-untyped-def]
    """Add the process noise of ``h`` seconds."""
    gap = GAP_NOISE**2 if row[GAP] > 0.0 else 0.0
    p[VX, VX] += (noise[0] ** 2 + gap) * h
    p[VY, VY] += (noise[1] ** 2 + gap) * h
    if row[TILT] > 0.0:
        added, share = TILT_NOISE**2 * h, KNOWN_TILT_SHARE
    else:
        added, share = BIAS_M_S2**2 * (1.0 - math.exp(-2.0 * h / BIAS_S)), TILT_SHARE
    p[AX_BIAS, AX_BIAS] += added + (share * (row[AX] - before[AX])) ** 2
    p[AY_BIAS, AY_BIAS] += added + (share * (row[AY] - before[AY])) ** 2
    p[LAW_ERROR, LAW_ERROR] += 1.0 - math.exp(-2.0 * h / LAW_S)
    turned = np.zeros(point.shape[0])  # change of the state per rad of error of the gyro
    turned[VX], turned[VY] = point[VY], -point[VX]
    if point.shape[0] == WITH_GNSS:
        turned[HEADING] = 1.0
        receiver = RECEIVER_M_S**2 * (1.0 - math.exp(-2.0 * h / RECEIVER_S))
        p[EAST_ERROR, EAST_ERROR] += receiver
        p[NORTH_ERROR, NORTH_ERROR] += receiver
    for i in (VX, VY, HEADING):
        for j in (VX, VY, HEADING):
            if i < p.shape[0] and j < p.shape[0]:
                p[i, j] += noise[2] ** 2 * h * turned[i] * turned[j]


@njit(cache=True)
def rear_axle(point, row, rear_m, h):  # type: ignore[no-untyped-def]
    """Measure the lateral velocity of the rear axle, ``rear_m`` behind the CG, by its law in the linear range."""
    h[:] = 0.0
    vx, length = point[VX], rear_m + point[REAR_AXLE]
    sign = 1.0 if vx >= 0.0 else -1.0
    rate, turning, ay_rate = yaw_rate(point, row[YAW_RATE]), row[YAW_ACCELERATION], row[AY_RATE]
    acceleration = REAR_SHARE * row[AY] - length * turning
    slip = point[COMPLIANCE] * acceleration + point[YAW_COMPLIANCE] * turning
    error_m_s = row[LAW_STD] * math.hypot(vx, point[VY])
    h[VX], h[VY], h[LAW_ERROR] = sign * slip - point[LAW_ANGLE], 1.0, -error_m_s
    h[COMPLIANCE], h[YAW_COMPLIANCE] = acceleration * abs(vx), turning * abs(vx)
    h[RATE_COMPLIANCE], h[LAW_ANGLE] = ay_rate, -vx
    h[REAR_AXLE] = -rate - point[COMPLIANCE] * turning * abs(vx)
    h[YAW_RATE_BIAS], h[YAW_RATE_GAIN] = length, length * row[YAW_RATE]
    law = -slip * abs(vx) - point[RATE_COMPLIANCE] * ay_rate + point[LAW_ANGLE] * vx + error_m_s * point[LAW_ERROR]
    return law - (point[VY] - length * rate), (LAW_WHITE * error_m_s) ** 2 + LAW_FLOOR_M_S**2


@njit(cache=True)
def speed(point, row, h):  # type: ignore[no-untyped-def]
    """Measure the speed by the wheels, which may be unsigned, or as the length of a velocity over ground."""
    h[:] = 0.0
    if row[LENGTH] > 0.0:
        length = math.hypot(point[VX], point[VY])
        h[VX], h[VY] = point[VX] / max(length, 0.1), point[VY] / max(length, 0.1)
        return row[SPEED] - length, row[SPEED_STD] ** 2
    sign = -1.0 if point[VX] < 0.0 and row[UNSIGNED] > 0.0 else 1.0
    h[VX], h[SPEED_SCALE] = sign * (1.0 + point[SPEED_SCALE]), sign * point[VX]
    return row[SPEED] - h[VX] * point[VX], row[SPEED_STD] ** 2


@njit(cache=True)
def no_lateral_velocity(point, h):  # type: ignore[no-untyped-def]
    """Measure v_y = 0 at standstill."""
    h[:] = 0.0
    h[VY] = 1.0
    return -point[VY], STILL_M_S**2


@njit(cache=True)
def no_yaw_rate(point, row, h):  # type: ignore[no-untyped-def]
    """Measure yaw rate 0 at standstill."""
    h[:] = 0.0
    h[YAW_RATE_BIAS], h[YAW_RATE_GAIN] = 1.0, row[YAW_RATE]
    return yaw_rate(point, row[YAW_RATE]), STILL_RAD_S**2


@njit(cache=True)
def gnss_velocity(point, row, east, h):  # type: ignore[no-untyped-def]
    """Measure a component of the antenna's velocity, to the east or to the north."""
    h[:] = 0.0
    rate = yaw_rate(point, row[YAW_RATE])
    forward = point[VX] - point[ANTENNA_Y] * rate
    left = point[VY] + point[ANTENNA_X] * rate - point[ANTENNA_HEIGHT] * row[ROLL_RATE]
    turning = row[YAW_ACCELERATION]
    ax, ay = accelerations(point, row[AX], row[AY], row[SLOW_AX], row[SLOW_AY], rate, turning)
    later = row[GNSS_OFFSET] + point[GNSS_DELAY]
    c, s = math.cos(point[HEADING]), math.sin(point[HEADING])
    error, measured = EAST_ERROR, row[GNSS_EAST]
    if not east:  # the north component is the east component of a frame turned by −90°
        c, s, error, measured = s, -c, NORTH_ERROR, row[GNSS_NORTH]
    h[VX], h[VY], h[error] = c, -s, 1.0
    h[HEADING] = -s * (forward + later * ax) - c * (left + later * ay)
    h[ANTENNA_X], h[ANTENNA_Y], h[ANTENNA_HEIGHT] = -s * rate, -c * rate, s * row[ROLL_RATE]
    h[YAW_RATE_BIAS] = s * point[ANTENNA_X] + c * point[ANTENNA_Y]
    h[GNSS_DELAY] = c * ax - s * ay
    expected = c * (forward + later * ax) - s * (left + later * ay) + point[error]
    return measured - expected, row[GNSS_STD] ** 2


@njit(cache=True)
def measure(x, p, point, row, rear_m, robust):  # type: ignore[no-untyped-def]
    """Update with all measurements of a row, linearised about ``point``."""
    h = np.zeros(x.shape[0])
    if row[LAW_STD] > 0.0:
        use(x, p, point, h, rear_axle(point, row, rear_m, h), robust)
    if row[SPEED] == row[SPEED]:
        use(x, p, point, h, speed(point, row, h), robust)
    if row[STANDSTILL] > 0.0:
        use(x, p, point, h, no_lateral_velocity(point, h), False)
        use(x, p, point, h, no_yaw_rate(point, row, h), False)
    if x.shape[0] == WITH_GNSS and row[GNSS_EAST] == row[GNSS_EAST]:
        use(x, p, point, h, gnss_velocity(point, row, True, h), robust)
        use(x, p, point, h, gnss_velocity(point, row, False, h), robust)


# positional: numbers and arrays of a compiled function.
@njit(cache=True)
def forward_pass(step_s, rows, rear_m, start, start_variance, noise, points, robust):  # type: ignore[no-untyped-def]
    """Filter a drive over its knots.

    Parameters
    ----------
    step_s : between knots. rows : inputs [K, INPUTS]. rear_m : distance of the rear axle from the CG.
    start, start_variance : first state and its variances [n], n = ``WITHOUT_GNSS`` or ``WITH_GNSS``.
    noise : see :func:`predict`. points : states [K, n] to linearise about; [0, n]: the predictions.
    robust : see :func:`use`.

    Returns
    -------
    States [K, n] and covariances [K, n, n] after the measurements, the same before, and cross covariances: the
    arguments of :mod:`~.rts`.
    """
    knots, n = rows.shape[0], start.shape[0]
    x, predicted_x = np.empty((knots, n)), np.empty((knots, n))
    p, predicted_p, cross = np.empty((knots, n, n)), np.empty((knots, n, n)), np.zeros((knots, n, n))
    predicted_x[0], predicted_p[0] = start, np.diag(start_variance)
    given = points.shape[0] > 0
    for k in range(knots):
        if k:
            point = points[k - 1] if given else x[k - 1]
            state, covariance, common = predict(x[k - 1], p[k - 1], point, step_s, rows[k], rows[k - 1], noise)
            predicted_x[k], predicted_p[k], cross[k] = state, covariance, common
        x[k], p[k] = predicted_x[k], predicted_p[k]
        measure(x[k], p[k], points[k] if given else predicted_x[k], rows[k], rear_m, robust)
    return x, p, predicted_x, predicted_p, cross
