"""Kinematic smoother with linear driving as reference, with or without GNSS velocity (docs/method.md#reference).

States at the knots, in body axes at the CG: v_x, v_y, biases b of the accelerometers, error d of the axle law;
constants: compliance of the rear axle and the parameters of the sensors; with GNSS also heading, error of the receiver,
antenna; with positions also position and its error.

    v̇_x = a_x + v_y r,   v̇_y = a_y − v_x r                               (kinematics of a plane body)
    ḃ_x = −g q + r b_y,  ḃ_y = g p − r b_x                                (tilt, if roll rate p, pitch rate q exist)
    v_y − l_r r = −(κ a_r + k₂ ṙ) |v_x| − k₃ ȧ_y + β₀ v_x + S |v| (d + w)  (axle law in the linear range)

with the rear axle's lateral acceleration a_r, the lag k₃ of tyre relaxation and body roll, and S, the law's
uncertainty, which increases beyond the linear range. Gains multiply low-passed accelerations, so that noise does not
bias them. Each iteration linearises about the last smoothed states (Gauss–Newton): a Kalman filter with scalar updates,
then the modified Bryson–Frazier smoother (Bierman, "Fixed interval smoothing with discrete measurements", 1973), which
needs no matrix inversion. Measurements with large residuals have a reduced weight (Cauchy, k = 3).
"""

from __future__ import annotations

import math

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.compiled.cache import njit

#: Entries of the state: up to PITCH_RATE_BIAS always, to ANTENNA_HEIGHT with GNSS velocity, all with positions.
(
    VX, VY, AX_BIAS, AY_BIAS, LAW_ERROR,
    COMPLIANCE, YAW_COMPLIANCE, LAW_ANGLE, REAR_AXLE, ROLL_GAIN, SPEED_SCALE, IMU_X,
    YAW_RATE_BIAS, YAW_RATE_GAIN, RATE_COMPLIANCE, IMU_Y, IMU_YAW, AX_GAIN,
    ROLL_RATE_BIAS, PITCH_RATE_BIAS,
    HEADING, EAST_ERROR, NORTH_ERROR, ANTENNA_X, ANTENNA_Y, GNSS_DELAY, ANTENNA_HEIGHT,
    EAST, NORTH, EAST_OFFSET, NORTH_OFFSET,
) = range(31)  # fmt: skip
WITHOUT_GNSS, WITH_GNSS, WITH_POSITION = HEADING, EAST, NORTH_OFFSET + 1
#: Entries with a full row in the Jacobian; all others only decay.
DENSE = (VX, VY, AX_BIAS, AY_BIAS, HEADING, EAST, NORTH)
#: Columns of the inputs at the knots: means over the interval before the knot, values at it, and 1-sigmas.
(
    MEAN_AX, MEAN_AY, MEAN_YAW_RATE, YAW_RATE, AX, AY, YAW_ACCELERATION, AY_RATE,
    SPEED, SPEED_STD, LAW_STD, GNSS_EAST, GNSS_NORTH, GNSS_OFFSET, GNSS_STD,
    GAP, STANDSTILL, MEAN_YAW_ACCELERATION, SLOW_AX, SLOW_AY,
    ROLL_RATE, MEAN_ROLL_RATE, MEAN_PITCH_RATE, TILT, LENGTH,
    POSITION_EAST, POSITION_NORTH, POSITION_STD, POSITION_OFFSET_STD, UNSIGNED,
) = range(30)  # fmt: skip
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
#: Time constant of the error of a position.
POSITION_S = 60.0
#: White part of the law's error as a share of LAW_STD, and its floor in m/s.
LAW_WHITE, LAW_FLOOR_M_S = 0.7, 0.02
#: Share of the rear axle in the lateral acceleration that acts on it in steady turns.
REAR_SHARE = 0.95
#: 1-sigmas of v_y and of the gyro at standstill, and the scale of the Cauchy weight.
STILL_M_S, STILL_RAD_S, CAUCHY = 0.02, 0.002, 3.0


@njit(cache=True)
def _dot(a, b):  # type: ignore[no-untyped-def]
    total = 0.0  # NumPy's product would load SciPy's BLAS
    for i in range(a.shape[0]):
        total += a[i] * b[i]
    return total


@njit(cache=True)
def _times(p, h):  # type: ignore[no-untyped-def]
    out = np.empty(h.shape[0])
    for i in range(h.shape[0]):
        out[i] = _dot(p[i], h)
    return out


@njit(cache=True)
def correct(x, p, h, e, r):  # type: ignore[no-untyped-def]
    """Update state and covariance with a scalar measurement of residual e and variance r; return gain and variance."""
    ph = _times(p, h)
    s = _dot(h, ph) + r
    gain = ph / s
    for i in range(x.shape[0]):
        x[i] += gain[i] * e
        for j in range(x.shape[0]):
            p[i, j] -= ph[i] * ph[j] / s
    return gain, s


@njit(cache=True)
def _update(x, p, h, e, r, store, k, m):  # type: ignore[no-untyped-def]
    """Update with a scalar measurement of residual e; store the data for the backward pass in slot m of knot k."""
    n = x.shape[0]
    gain, s = correct(x, p, h, e, r)
    store[k, m, :n] = h
    store[k, m, n : 2 * n] = gain
    store[k, m, 2 * n] = e
    store[k, m, 2 * n + 1] = s


@njit(cache=True)
def _propagate(f, x, p, dense, dense_row, decay):  # type: ignore[no-untyped-def]
    """Return F P Fᵀ; F has the rows ``dense`` [7, n] and is diagonal (``decay``) elsewhere."""
    n = x.shape[0]
    a = np.empty((n, n))
    for i in range(n):
        q = dense_row[i]
        for j in range(n):
            if q < 0:
                a[i, j] = decay[i] * p[i, j]
            else:
                total = 0.0
                for m in range(n):
                    total += dense[q, m] * p[m, j]
                a[i, j] = total
    for i in range(n):
        for j in range(n):
            q = dense_row[j]
            if q < 0:
                f[i, j] = a[i, j] * decay[j]
            else:
                total = 0.0
                for m in range(n):
                    total += a[i, m] * dense[q, m]
                f[i, j] = total


@njit(cache=True)
def _pull_back(f, lam, dense, dense_row, decay):  # type: ignore[no-untyped-def]
    """Return Fᵀ Λ F for F as in :func:`_propagate`."""
    n = decay.shape[0]
    a = np.zeros((n, n))
    for i in range(n):  # a = Λ F
        for m in range(n):
            q = dense_row[m]
            value = lam[i, m]
            if q < 0:
                a[i, m] += value * decay[m]
            else:
                for j in range(n):
                    a[i, j] += value * dense[q, j]
    f[:, :] = 0.0
    for m in range(n):  # Fᵀ a
        q = dense_row[m]
        for i in range(n):
            weight = (decay[i] if i == m else 0.0) if q < 0 else dense[q, i]
            if weight != 0.0:
                for j in range(n):
                    f[i, j] += weight * a[m, j]


@njit(cache=True)
def _corrected(point, ax, ay, slow_ax, slow_ay, rate, yaw_acceleration):  # type: ignore[no-untyped-def]
    """Return the accelerations of the CG from accelerometers that read a_x, a_y, at a state."""
    x, y, yaw = point[IMU_X], point[IMU_Y], point[IMU_YAW]
    corrected_ax = ax - point[AX_GAIN] * slow_ax - yaw * slow_ay - point[AX_BIAS] + x * rate**2 + y * yaw_acceleration
    corrected_ay = ay - point[ROLL_GAIN] * slow_ay + yaw * slow_ax - point[AY_BIAS] - x * yaw_acceleration + y * rate**2
    return corrected_ax, corrected_ay


@njit(cache=True)
def _transition(x, point, step_s, row, dense):  # type: ignore[no-untyped-def]
    """Write f(x), linearised about ``point``, to x, and the rows of ``DENSE`` of the Jacobian to ``dense``."""
    h = step_s
    n = x.shape[0]
    rate = row[MEAN_YAW_RATE] * (1.0 - point[YAW_RATE_GAIN]) - point[YAW_RATE_BIAS]
    turning = row[MEAN_YAW_ACCELERATION]
    c, s = math.cos(rate * h), math.sin(rate * h)
    ax, ay = _corrected(point, row[MEAN_AX], row[MEAN_AY], row[SLOW_AX], row[SLOW_AY], rate, turning)
    dense[:, :] = 0.0
    dense[0, VX], dense[0, VY] = c, s
    dense[1, VX], dense[1, VY] = -s, c
    dvx, dvy = -s * point[VX] + c * point[VY], -c * point[VX] - s * point[VY]  # by the turned angle
    dense[0, AX_BIAS], dense[1, AY_BIAS] = -h, -h
    dense[1, ROLL_GAIN], dense[0, AX_GAIN] = -h * row[SLOW_AY], -h * row[SLOW_AX]
    dense[0, IMU_X], dense[1, IMU_X] = h * rate * rate, -h * turning
    dense[0, IMU_Y], dense[1, IMU_Y] = h * turning, h * rate * rate
    dense[0, IMU_YAW], dense[1, IMU_YAW] = -h * row[SLOW_AY], h * row[SLOW_AX]
    dense[0, YAW_RATE_BIAS], dense[1, YAW_RATE_BIAS] = -h * dvx, -h * dvy
    dense[0, YAW_RATE_GAIN], dense[1, YAW_RATE_GAIN] = -h * row[MEAN_YAW_RATE] * dvx, -h * row[MEAN_YAW_RATE] * dvy
    new = np.zeros(dense.shape[0])
    new[0] = c * point[VX] + s * point[VY] + h * ax
    new[1] = -s * point[VX] + c * point[VY] + h * ay
    tilts = row[TILT] > 0.0
    kept = math.exp(-h / (TILT_S if tilts else BIAS_S))
    dense[2, AX_BIAS], dense[3, AY_BIAS] = kept, kept
    new[2], new[3] = kept * point[AX_BIAS], kept * point[AY_BIAS]
    if tilts:
        dense[2, AY_BIAS], dense[3, AX_BIAS] = h * rate, -h * rate
        dense[2, PITCH_RATE_BIAS], dense[3, ROLL_RATE_BIAS] = h * GRAVITY_M_S2, -h * GRAVITY_M_S2
        pitch_rate = row[MEAN_PITCH_RATE] - point[PITCH_RATE_BIAS]
        roll_rate = row[MEAN_ROLL_RATE] - point[ROLL_RATE_BIAS]
        new[2] += h * (rate * point[AY_BIAS] - GRAVITY_M_S2 * pitch_rate)
        new[3] += h * (GRAVITY_M_S2 * roll_rate - rate * point[AX_BIAS])
    if n >= WITH_GNSS:
        dense[4, HEADING], dense[4, YAW_RATE_BIAS], dense[4, YAW_RATE_GAIN] = 1.0, -h, -h * row[MEAN_YAW_RATE]
        new[4] = point[HEADING] + rate * h
    if n == WITH_POSITION:
        _move(point, h, ax, ay, dense, new)
    for j in range(n):
        away = x[j] - point[j]
        for q in range(dense.shape[0]):
            new[q] += dense[q, j] * away
    for q in range(dense.shape[0]):
        if DENSE[q] < n:
            x[DENSE[q]] = new[q]
    x[LAW_ERROR] *= math.exp(-h / LAW_S)
    if n >= WITH_GNSS:
        receiver = math.exp(-h / RECEIVER_S)
        x[EAST_ERROR] *= receiver
        x[NORTH_ERROR] *= receiver
    if n == WITH_POSITION:
        offset = math.exp(-h / POSITION_S)
        x[EAST_OFFSET] *= offset
        x[NORTH_OFFSET] *= offset


@njit(cache=True)
def _move(point, h, ax, ay, dense, new):  # type: ignore[no-untyped-def]
    """Write the new position of the CG and its Jacobian to rows 5 and 6."""
    c, s = math.cos(point[HEADING]), math.sin(point[HEADING])
    forward, left = point[VX], point[VY]
    new[5] = point[EAST] + h * (c * forward - s * left) + 0.5 * h * h * (c * ax - s * ay)
    new[6] = point[NORTH] + h * (s * forward + c * left) + 0.5 * h * h * (s * ax + c * ay)
    dense[5, EAST], dense[6, NORTH] = 1.0, 1.0
    dense[5, VX], dense[5, VY], dense[5, HEADING] = h * c, -h * s, -h * (s * forward + c * left)
    dense[6, VX], dense[6, VY], dense[6, HEADING] = h * s, h * c, h * (c * forward - s * left)


@njit(cache=True)
def _add_process_noise(p, point, step_s, row, before, noise):  # type: ignore[no-untyped-def]
    """Add the process noise of an interval; ``noise``: white, a_x, a_y in m/s²/√Hz, gyro in rad/s/√Hz."""
    h = step_s
    gap = GAP_NOISE * GAP_NOISE * h if row[GAP] > 0.0 else 0.0
    gyro = noise[2] * noise[2] * h
    p[VX, VX] += noise[0] * noise[0] * h + gap + gyro * point[VY] * point[VY]
    p[VY, VY] += noise[1] * noise[1] * h + gap + gyro * point[VX] * point[VX]
    p[VX, VY] -= gyro * point[VX] * point[VY]
    p[VY, VX] -= gyro * point[VX] * point[VY]
    if row[TILT] > 0.0:
        added, share = TILT_NOISE * TILT_NOISE * h, KNOWN_TILT_SHARE
    else:
        added, share = BIAS_M_S2 * BIAS_M_S2 * (1.0 - math.exp(-2.0 * h / BIAS_S)), TILT_SHARE
    p[AX_BIAS, AX_BIAS] += added + (share * (row[AX] - before[AX])) ** 2
    p[AY_BIAS, AY_BIAS] += added + (share * (row[AY] - before[AY])) ** 2
    p[LAW_ERROR, LAW_ERROR] += 1.0 - math.exp(-2.0 * h / LAW_S)
    if p.shape[0] >= WITH_GNSS:
        p[HEADING, HEADING] += gyro
        p[HEADING, VX] += gyro * point[VY]
        p[VX, HEADING] += gyro * point[VY]
        p[HEADING, VY] -= gyro * point[VX]
        p[VY, HEADING] -= gyro * point[VX]
        receiver = RECEIVER_M_S * RECEIVER_M_S * (1.0 - math.exp(-2.0 * h / RECEIVER_S))
        p[EAST_ERROR, EAST_ERROR] += receiver
        p[NORTH_ERROR, NORTH_ERROR] += receiver
    if p.shape[0] == WITH_POSITION:
        offset = row[POSITION_OFFSET_STD] ** 2 * (1.0 - math.exp(-2.0 * h / POSITION_S))
        p[EAST_OFFSET, EAST_OFFSET] += offset
        p[NORTH_OFFSET, NORTH_OFFSET] += offset


@njit(cache=True)
def _axle_law(point, row, rear_m, h):  # type: ignore[no-untyped-def]
    """Return the residual of the axle law (left minus right side) at a state, and its Jacobian in h."""
    length = rear_m + point[REAR_AXLE]
    rate = row[YAW_RATE] * (1.0 - point[YAW_RATE_GAIN]) - point[YAW_RATE_BIAS]
    acceleration = REAR_SHARE * row[AY] - length * row[YAW_ACCELERATION]
    vx = point[VX]
    speed, sign = abs(vx), 1.0 if vx >= 0.0 else -1.0
    slip = point[COMPLIANCE] * acceleration + point[YAW_COMPLIANCE] * row[YAW_ACCELERATION]
    error_m_s = row[LAW_STD] * math.hypot(vx, point[VY])
    h[:] = 0.0
    h[VX] = slip * sign - point[LAW_ANGLE]
    h[VY] = 1.0
    h[LAW_ERROR] = -error_m_s
    h[COMPLIANCE] = acceleration * speed
    h[YAW_COMPLIANCE] = row[YAW_ACCELERATION] * speed
    h[RATE_COMPLIANCE] = row[AY_RATE]
    h[LAW_ANGLE] = -vx
    h[REAR_AXLE] = -rate - point[COMPLIANCE] * row[YAW_ACCELERATION] * speed
    h[YAW_RATE_BIAS] = length
    h[YAW_RATE_GAIN] = length * row[YAW_RATE]
    lag = point[RATE_COMPLIANCE] * row[AY_RATE]
    return point[VY] - length * rate + slip * speed + lag - point[LAW_ANGLE] * vx - error_m_s * point[LAW_ERROR]


@njit(cache=True)
def _gnss(point, row, east, h):  # type: ignore[no-untyped-def]
    """Return the predicted GNSS velocity of the antenna to the east or north at a state; Jacobian in h."""
    rate = row[YAW_RATE] * (1.0 - point[YAW_RATE_GAIN]) - point[YAW_RATE_BIAS]
    forward = point[VX] - point[ANTENNA_Y] * rate
    left = point[VY] + point[ANTENNA_X] * rate - point[ANTENNA_HEIGHT] * row[ROLL_RATE]
    ax, ay = _corrected(point, row[AX], row[AY], row[SLOW_AX], row[SLOW_AY], rate, row[YAW_ACCELERATION])
    later = row[GNSS_OFFSET] + point[GNSS_DELAY]
    c, s = math.cos(point[HEADING]), math.sin(point[HEADING])
    if not east:  # the north component is the east component of a frame turned by −90°
        c, s = s, -c
    h[:] = 0.0
    h[VX], h[VY] = c, -s
    h[HEADING] = -s * (forward + later * ax) - c * (left + later * ay)
    h[ANTENNA_X], h[ANTENNA_Y], h[ANTENNA_HEIGHT] = -s * rate, -c * rate, s * row[ROLL_RATE]
    h[YAW_RATE_BIAS] = s * point[ANTENNA_X] + c * point[ANTENNA_Y]
    h[GNSS_DELAY] = c * ax - s * ay
    h[EAST_ERROR if east else NORTH_ERROR] = 1.0
    error = point[EAST_ERROR] if east else point[NORTH_ERROR]
    return c * (forward + later * ax) - s * (left + later * ay) + error


@njit(cache=True)
def _position(point, row, east, h):  # type: ignore[no-untyped-def]
    """Return the predicted GNSS position of the antenna to the east or north at a state; Jacobian in h."""
    later = row[GNSS_OFFSET] + point[GNSS_DELAY]
    forward, left = point[ANTENNA_X] + later * point[VX], point[ANTENNA_Y] + later * point[VY]
    c, s = math.cos(point[HEADING]), math.sin(point[HEADING])
    if not east:
        c, s = s, -c
    h[:] = 0.0
    h[EAST if east else NORTH], h[EAST_OFFSET if east else NORTH_OFFSET] = 1.0, 1.0
    h[VX], h[VY] = c * later, -s * later
    h[ANTENNA_X], h[ANTENNA_Y] = c, -s
    h[HEADING] = -s * forward - c * left
    h[GNSS_DELAY] = c * point[VX] - s * point[VY]
    place = point[EAST] + point[EAST_OFFSET] if east else point[NORTH] + point[NORTH_OFFSET]
    return place + c * forward - s * left


@njit(cache=True)
def _cauchy(variance, residual, trusted):  # type: ignore[no-untyped-def]
    """Return the variance, enlarged for a large residual if the linearisation is ``trusted``."""
    return variance * (1.0 + residual * residual / (variance * CAUCHY * CAUCHY)) if trusted else variance


@njit(cache=True)
def structure(n, step_s):  # type: ignore[no-untyped-def]
    """Return the row in ``DENSE`` of each state, −1 for states that only decay, and the decay over a step, [n] each."""
    dense_row, decay = np.full(n, -1), np.ones(n)
    for q in range(len(DENSE)):
        if DENSE[q] < n:
            dense_row[DENSE[q]] = q
    decay[LAW_ERROR] = math.exp(-step_s / LAW_S)
    if n >= WITH_GNSS:
        decay[EAST_ERROR] = decay[NORTH_ERROR] = math.exp(-step_s / RECEIVER_S)
    if n == WITH_POSITION:
        decay[EAST_OFFSET] = decay[NORTH_OFFSET] = math.exp(-step_s / POSITION_S)
    return dense_row, decay


# positional: keyword arguments of compiled code have a cost.
@njit(cache=True)
def _measure(x, p, point, row, rear_m, store, k, used, trusted):  # type: ignore[no-untyped-def]
    """Update with all measurements of a knot, linearised about ``point``; if ``trusted``, outliers are downweighted."""
    n = x.shape[0]
    h = np.zeros(n)
    m = 0
    if row[LAW_STD] > 0.0:
        value = _axle_law(point, row, rear_m, h)
        r = (LAW_WHITE * row[LAW_STD] * math.hypot(point[VX], point[VY])) ** 2 + LAW_FLOOR_M_S**2
        r = _cauchy(r, value, trusted)
        _update(x, p, h, -value - _dot(h, x - point), r, store, k, m)
        m += 1
    if row[SPEED] == row[SPEED]:
        h[:] = 0.0
        if row[LENGTH] > 0.0:  # the length of a velocity over ground
            value = math.hypot(point[VX], point[VY])
            length = max(value, 0.1)
            h[VX], h[VY] = point[VX] / length, point[VY] / length
        else:
            sign = -1.0 if point[VX] < 0.0 and row[UNSIGNED] > 0.0 else 1.0
            value = sign * (1.0 + point[SPEED_SCALE]) * point[VX]
            h[VX], h[SPEED_SCALE] = sign * (1.0 + point[SPEED_SCALE]), sign * point[VX]
        r = _cauchy(row[SPEED_STD] ** 2, row[SPEED] - value, trusted)
        _update(x, p, h, row[SPEED] - value - _dot(h, x - point), r, store, k, m)
        m += 1
    if row[STANDSTILL] > 0.0:
        h[:] = 0.0
        h[VY] = 1.0
        _update(x, p, h, -_dot(h, x), STILL_M_S**2, store, k, m)
        m += 1
        h[:] = 0.0
        h[YAW_RATE_BIAS], h[YAW_RATE_GAIN] = 1.0, row[YAW_RATE]
        _update(x, p, h, row[YAW_RATE] - _dot(h, x), STILL_RAD_S**2, store, k, m)
        m += 1
    if n >= WITH_GNSS and row[GNSS_EAST] == row[GNSS_EAST]:
        for east in (True, False):
            value = _gnss(point, row, east, h)
            measured = row[GNSS_EAST] if east else row[GNSS_NORTH]
            r = _cauchy(row[GNSS_STD] ** 2, measured - value, trusted)
            _update(x, p, h, measured - value - _dot(h, x - point), r, store, k, m)
            m += 1
    if n == WITH_POSITION and row[POSITION_EAST] == row[POSITION_EAST]:
        for east in (True, False):
            value = _position(point, row, east, h)
            measured = row[POSITION_EAST] if east else row[POSITION_NORTH]
            r = _cauchy(row[POSITION_STD] ** 2, measured - value, trusted)
            _update(x, p, h, measured - value - _dot(h, x - point), r, store, k, m)
            m += 1
    used[k] = m


# positional: numbers and arrays of a compiled function.
@njit(cache=True)
def smooth(step_s, rows, rear_m, start, start_variance, noise, guess, iterations, tolerance_m_s):  # type: ignore[no-untyped-def]
    """Smooth a drive over its knots.

    Parameters
    ----------
    step_s : between knots. rows : inputs [K, INPUTS]. rear_m : distance of the rear axle from the CG.
    start, start_variance : first state and its variances [n], of ``WITHOUT_GNSS``, ``WITH_GNSS`` or ``WITH_POSITION``.
    noise : white, of a_x, a_y in m/s²/√Hz, of the gyro in rad/s/√Hz.
    guess : states [K, n] for the first linearisation; [0, n]: the predicted states.
    iterations : maximum number. tolerance_m_s : rms change of v_y between iterations.

    Returns
    -------
    Smoothed states [K, n], covariance of v_x, v_y [K, 3] (xx, xy, yy), variances of the last state [n], and the rms
    change of v_y in the last iteration.
    """
    knots, n = rows.shape[0], start.shape[0]
    filtered = np.empty((knots, n))
    variance = np.empty((knots, n, n))
    dense = np.zeros((knots, len(DENSE), n))
    store = np.zeros((knots, 8, 2 * n + 2))
    used = np.zeros(knots, np.int64)
    guessed = guess.shape[0] > 0
    smoothed = guess.copy() if guessed else np.empty((knots, n))
    moved = np.inf
    dense_row, decay = structure(n, step_s)
    for iteration in range(iterations):
        x = start.copy()
        trusted = iteration > 1 or guess.shape[0] > 0
        p = np.diag(start_variance)
        scratch = np.empty((n, n))
        for k in range(knots):
            if k:
                point = smoothed[k - 1] if guessed else x.copy()
                _transition(x, point, step_s, rows[k], dense[k])
                _propagate(scratch, x, p, dense[k], dense_row, decay)
                p, scratch = scratch, p
                _add_process_noise(p, point, step_s, rows[k], rows[k - 1], noise)
            point = smoothed[k] if guessed else x.copy()
            _measure(x, p, point, rows[k], rear_m, store, k, used, trusted)
            filtered[k] = x
            variance[k] = p
        pull = np.zeros(n)
        total = 0.0
        for k in range(knots - 1, -1, -1):
            before = smoothed[k, VY] if guessed else filtered[k, VY]
            change = _times(variance[k], pull)
            for i in range(n):
                smoothed[k, i] = filtered[k, i] - change[i]
            total += (smoothed[k, VY] - before) ** 2
            for m in range(used[k] - 1, -1, -1):
                h, gain = store[k, m, :n], store[k, m, n : 2 * n]
                e, s = store[k, m, 2 * n], store[k, m, 2 * n + 1]
                weighted = _dot(gain, pull)
                pull -= h * (weighted + e / s)
            if k:
                _pull_vector(pull, dense[k], dense_row, decay)
        guessed = True
        moved = math.sqrt(total / knots)
        if iteration > 2 and moved < tolerance_m_s:
            break
    covariance = np.empty((knots, 3))
    information = np.zeros((n, n))
    last = np.empty(n)
    for i in range(n):
        last[i] = variance[knots - 1, i, i]
    scratch = np.empty((n, n))
    for k in range(knots - 1, -1, -1):
        p = variance[k]
        wx, wy = _times(information, p[VX]), _times(information, p[VY])
        covariance[k, 0] = p[VX, VX] - _dot(p[VX], wx)
        covariance[k, 1] = p[VX, VY] - _dot(p[VX], wy)
        covariance[k, 2] = p[VY, VY] - _dot(p[VY], wy)
        for m in range(used[k] - 1, -1, -1):
            h, gain, s = store[k, m, :n], store[k, m, n : 2 * n], store[k, m, 2 * n + 1]
            w = _times(information, gain)
            inner = _dot(gain, w) + 1.0 / s
            for i in range(n):
                for j in range(n):
                    information[i, j] += inner * h[i] * h[j] - h[i] * w[j] - w[i] * h[j]
        if k:
            _pull_back(scratch, information, dense[k], dense_row, decay)
            information, scratch = scratch, information
    return smoothed, covariance, last, moved


@njit(cache=True)
def _pull_vector(pull, dense, dense_row, decay):  # type: ignore[no-untyped-def]
    """Replace λ by Fᵀ λ."""
    n = pull.shape[0]
    out = np.zeros(n)
    for m in range(n):
        q = dense_row[m]
        if q < 0:
            out[m] += decay[m] * pull[m]
        else:
            for j in range(n):
                out[j] += dense[q, j] * pull[m]
    pull[:] = out
