"""Kinematic smoother between stretches of linear driving, with or without GNSS velocity (docs/method.md#reference).

States at the knots, in body axes at the CG: v_x, v_y, biases of the accelerometers, error d of the axle law; constants:
compliance of the rear axle and the parameters of the sensors; with GNSS also heading, error of the receiver, antenna.

    v̇_x = a_x + v_y r,   v̇_y = a_y − v_x r                               (kinematics of a plane body)
    v_y − l_r r = −(κ a_r + k₂ ṙ) |v_x| − k₃ ȧ_y + β₀ v_x + S v_x (d + w) (axle law in the linear range)

with the rear axle's lateral acceleration a_r, the lag k₃ of tyre relaxation and body roll, and S, the law's
uncertainty, which grows beyond the linear range. Each
iteration linearises about the last smoothed states (Gauss–Newton): a Kalman filter with scalar updates, then the
modified Bryson–Frazier smoother (Bierman, "Fixed interval smoothing with discrete measurements", 1973), which inverts
no matrix. Measurements with large residuals count less (Cauchy, k = 3).
"""

from __future__ import annotations

import math

import numpy as np

from pdhef_logtool.compiled.cache import njit

#: Entries of the state. Those up to RATE_COMPLIANCE always, the others with GNSS.
VX, VY, AX_BIAS, AY_BIAS, LAW_ERROR = 0, 1, 2, 3, 4
COMPLIANCE, YAW_COMPLIANCE, LAW_ANGLE, REAR_AXLE, ROLL_GAIN, SPEED_SCALE, IMU_X = 5, 6, 7, 8, 9, 10, 11
YAW_RATE_BIAS, YAW_RATE_GAIN, RATE_COMPLIANCE = 12, 13, 14
HEADING, EAST_ERROR, NORTH_ERROR, ANTENNA_X, ANTENNA_Y, GNSS_DELAY, ANTENNA_ROLL = 15, 16, 17, 18, 19, 20, 21
WITHOUT_GNSS, WITH_GNSS = 15, 22
#: Columns of the inputs at the knots: means over the interval before the knot, values at it, and 1-sigmas.
MEAN_AX, MEAN_AY, MEAN_YAW_RATE, YAW_RATE, AX, AY, YAW_ACCELERATION, AY_RATE = 0, 1, 2, 3, 4, 5, 6, 7
SPEED, SPEED_STD, LAW_STD, GNSS_EAST, GNSS_NORTH, GNSS_OFFSET, GNSS_STD = 8, 9, 10, 11, 12, 13, 14
GAP, STANDSTILL = 15, 16
INPUTS = 17

#: Time constants of the accelerometer biases (tilt, bank), the law's error and the receiver's error, s.
BIAS_S, LAW_S, RECEIVER_S = 6.0, 2.0, 5.0
#: Their stationary 1-sigmas (the law's is LAW_STD), m/s² and m/s.
BIAS_M_S2, RECEIVER_M_S = 0.35, 0.02
#: Share of a change of a_x, a_y that changes their bias: pitch and roll.
TILT_SHARE = 0.05
#: White noise of the gyro, rad/s/√Hz, and of a stretch without IMU, m/s²/√Hz.
GYRO_NOISE, GAP_NOISE = 0.0007, 3.0
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
def _update(x, p, h, e, r, store, k, m):  # type: ignore[no-untyped-def]
    """Update with a scalar measurement of residual e; keep what the backward pass needs in slot m of knot k."""
    ph = _times(p, h)
    s = _dot(h, ph) + r
    gain = ph / s
    n = x.shape[0]
    store[k, m, :n] = h
    store[k, m, n : 2 * n] = gain
    store[k, m, 2 * n] = e
    store[k, m, 2 * n + 1] = s
    for i in range(n):
        x[i] += gain[i] * e
        for j in range(n):
            p[i, j] -= ph[i] * ph[j] / s


@njit(cache=True)
def _propagate(f, x, p, dense, dense_row, decay):  # type: ignore[no-untyped-def]
    """Return F P Fᵀ; F has the rows ``dense`` [3, n] and is diagonal (``decay``) elsewhere."""
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
def _transition(x, point, step_s, row, dense):  # type: ignore[no-untyped-def]
    """Put f(x), linearised about ``point``, into x, and the Jacobian's rows of v_x, v_y and heading into ``dense``."""
    h = step_s
    n = x.shape[0]
    rate = row[MEAN_YAW_RATE] * (1.0 - point[YAW_RATE_GAIN]) - point[YAW_RATE_BIAS]
    c, s = math.cos(rate * h), math.sin(rate * h)
    ax = row[MEAN_AX] - point[AX_BIAS] + point[IMU_X] * rate * rate
    ay = row[MEAN_AY] * (1.0 - point[ROLL_GAIN]) - point[AY_BIAS] - point[IMU_X] * row[YAW_ACCELERATION]
    dense[:, :] = 0.0
    dense[0, VX], dense[0, VY] = c, s
    dense[1, VX], dense[1, VY] = -s, c
    dvx, dvy = -s * point[VX] + c * point[VY], -c * point[VX] - s * point[VY]  # by the turned angle
    dense[0, AX_BIAS], dense[1, AY_BIAS] = -h, -h
    dense[1, ROLL_GAIN] = -h * row[MEAN_AY]
    dense[0, IMU_X], dense[1, IMU_X] = h * rate * rate, -h * row[YAW_ACCELERATION]
    dense[0, YAW_RATE_BIAS], dense[1, YAW_RATE_BIAS] = -h * dvx, -h * dvy
    dense[0, YAW_RATE_GAIN], dense[1, YAW_RATE_GAIN] = -h * row[MEAN_YAW_RATE] * dvx, -h * row[MEAN_YAW_RATE] * dvy
    new0 = c * point[VX] + s * point[VY] + h * ax
    new1 = -s * point[VX] + c * point[VY] + h * ay
    new2 = 0.0
    if n == WITH_GNSS:
        dense[2, HEADING], dense[2, YAW_RATE_BIAS], dense[2, YAW_RATE_GAIN] = 1.0, -h, -h * row[MEAN_YAW_RATE]
        new2 = point[HEADING] + rate * h
    for j in range(n):
        away = x[j] - point[j]
        new0 += dense[0, j] * away
        new1 += dense[1, j] * away
        new2 += dense[2, j] * away
    x[VX], x[VY] = new0, new1
    bias, law = math.exp(-h / BIAS_S), math.exp(-h / LAW_S)
    x[AX_BIAS] *= bias
    x[AY_BIAS] *= bias
    x[LAW_ERROR] *= law
    if n == WITH_GNSS:
        x[HEADING] = new2
        receiver = math.exp(-h / RECEIVER_S)
        x[EAST_ERROR] *= receiver
        x[NORTH_ERROR] *= receiver


@njit(cache=True)
def _add_process_noise(p, point, step_s, row, before, accelerometer_noise):  # type: ignore[no-untyped-def]
    h = step_s
    white = accelerometer_noise * accelerometer_noise * h
    if row[GAP] > 0.0:
        white += GAP_NOISE * GAP_NOISE * h
    gyro = GYRO_NOISE * GYRO_NOISE * h
    p[VX, VX] += white + gyro * point[VY] * point[VY]
    p[VY, VY] += white + gyro * point[VX] * point[VX]
    bias, law = math.exp(-2.0 * h / BIAS_S), math.exp(-2.0 * h / LAW_S)
    stationary = BIAS_M_S2 * BIAS_M_S2 * (1.0 - bias)
    p[AX_BIAS, AX_BIAS] += stationary + (TILT_SHARE * (row[AX] - before[AX])) ** 2
    p[AY_BIAS, AY_BIAS] += stationary + (TILT_SHARE * (row[AY] - before[AY])) ** 2
    p[LAW_ERROR, LAW_ERROR] += 1.0 - law
    if p.shape[0] == WITH_GNSS:
        p[HEADING, HEADING] += gyro
        receiver = RECEIVER_M_S * RECEIVER_M_S * (1.0 - math.exp(-2.0 * h / RECEIVER_S))
        p[EAST_ERROR, EAST_ERROR] += receiver
        p[NORTH_ERROR, NORTH_ERROR] += receiver


@njit(cache=True)
def _axle_law(point, row, rear_m, h):  # type: ignore[no-untyped-def]
    """Return the law's left side minus its right side at a state, and its Jacobian in h."""
    length = rear_m + point[REAR_AXLE]
    rate = row[YAW_RATE] * (1.0 - point[YAW_RATE_GAIN]) - point[YAW_RATE_BIAS]
    acceleration = REAR_SHARE * row[AY] - length * row[YAW_ACCELERATION]
    vx = point[VX]
    speed, sign = abs(vx), 1.0 if vx >= 0.0 else -1.0
    slip = point[COMPLIANCE] * acceleration + point[YAW_COMPLIANCE] * row[YAW_ACCELERATION]
    h[:] = 0.0
    h[VX] = slip * sign - point[LAW_ANGLE] - row[LAW_STD] * point[LAW_ERROR]
    h[VY] = 1.0
    h[LAW_ERROR] = -row[LAW_STD] * vx
    h[COMPLIANCE] = acceleration * speed
    h[YAW_COMPLIANCE] = row[YAW_ACCELERATION] * speed
    h[RATE_COMPLIANCE] = row[AY_RATE]
    h[LAW_ANGLE] = -vx
    h[REAR_AXLE] = -rate - point[COMPLIANCE] * row[YAW_ACCELERATION] * speed
    h[YAW_RATE_BIAS] = length
    h[YAW_RATE_GAIN] = length * row[YAW_RATE]
    lag = point[RATE_COMPLIANCE] * row[AY_RATE]
    return point[VY] - length * rate + slip * speed + lag - (point[LAW_ANGLE] + row[LAW_STD] * point[LAW_ERROR]) * vx


@njit(cache=True)
def _gnss(point, row, east, h):  # type: ignore[no-untyped-def]
    """Return the velocity of the antenna to the east or north that a receiver shows at a state; Jacobian in h."""
    rate = row[YAW_RATE] * (1.0 - point[YAW_RATE_GAIN]) - point[YAW_RATE_BIAS]
    forward = point[VX] - point[ANTENNA_Y] * rate
    left = point[VY] + point[ANTENNA_X] * rate - point[ANTENNA_ROLL] * row[AY_RATE]
    ax = row[AX] - point[AX_BIAS] + point[IMU_X] * rate * rate
    ay = row[AY] * (1.0 - point[ROLL_GAIN]) - point[AY_BIAS] - point[IMU_X] * row[YAW_ACCELERATION]
    later = row[GNSS_OFFSET] + point[GNSS_DELAY]
    c, s = math.cos(point[HEADING]), math.sin(point[HEADING])
    if not east:  # the north component is the east component of a frame turned by −90°
        c, s = s, -c
    h[:] = 0.0
    h[VX], h[VY] = c, -s
    h[HEADING] = -s * (forward + later * ax) - c * (left + later * ay)
    h[ANTENNA_X], h[ANTENNA_Y], h[ANTENNA_ROLL] = -s * rate, -c * rate, s * row[AY_RATE]
    h[YAW_RATE_BIAS] = s * point[ANTENNA_X] + c * point[ANTENNA_Y]
    h[GNSS_DELAY] = c * ax - s * ay
    h[EAST_ERROR if east else NORTH_ERROR] = 1.0
    error = point[EAST_ERROR] if east else point[NORTH_ERROR]
    return c * (forward + later * ax) - s * (left + later * ay) + error


@njit(cache=True)
def _cauchy(variance, residual, trusted):  # type: ignore[no-untyped-def]
    """Return the variance, enlarged for a large residual unless the linearisation is not yet ``trusted``."""
    return variance * (1.0 + residual * residual / (variance * CAUCHY * CAUCHY)) if trusted else variance


# positional: compiled code takes no keywords at no cost.
@njit(cache=True)
def _measure(x, p, point, row, rear_m, store, k, used, iteration):  # type: ignore[no-untyped-def]
    """Update with all measurements of a knot; ``point`` is where they are linearised."""
    n = x.shape[0]
    h = np.zeros(n)
    m = 0
    trusted = iteration > 1
    if row[LAW_STD] > 0.0:
        value = _axle_law(point, row, rear_m, h)
        r = (LAW_WHITE * row[LAW_STD] * point[VX]) ** 2 + LAW_FLOOR_M_S**2
        _update(x, p, h, -value - _dot(h, x - point), r, store, k, m)
        m += 1
    if row[SPEED] == row[SPEED]:
        h[:] = 0.0
        h[VX], h[SPEED_SCALE] = 1.0 + point[SPEED_SCALE], point[VX]
        value = (1.0 + point[SPEED_SCALE]) * point[VX]
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
    if n == WITH_GNSS and row[GNSS_EAST] == row[GNSS_EAST]:
        for east in (True, False):
            value = _gnss(point, row, east, h)
            measured = row[GNSS_EAST] if east else row[GNSS_NORTH]
            r = _cauchy(row[GNSS_STD] ** 2, measured - value, trusted)
            _update(x, p, h, measured - value - _dot(h, x - point), r, store, k, m)
            m += 1
    used[k] = m


@njit(cache=True)
def smooth(step_s, rows, rear_m, start, start_variance, accelerometer_noise, iterations, tolerance_m_s):  # type: ignore[no-untyped-def]
    """Smooth a drive over its knots.

    Parameters
    ----------
    step_s : between knots. rows : inputs [K, INPUTS]. rear_m : distance of the rear axle from the CG.
    start, start_variance : first state and its variances [n]; n is ``WITHOUT_GNSS`` or ``WITH_GNSS``.
    accelerometer_noise : white, m/s²/√Hz. iterations : at most. tolerance_m_s : of v_y between iterations, rms.

    Returns
    -------
    Smoothed states [K, n], covariance of v_x, v_y [K, 3] (xx, xy, yy), variances of the last state [n], and the rms
    change of v_y in the last iteration.
    """
    knots, n = rows.shape[0], start.shape[0]
    filtered = np.empty((knots, n))
    variance = np.empty((knots, n, n))
    dense = np.zeros((knots, 3, n))
    store = np.zeros((knots, 6, 2 * n + 2))
    used = np.zeros(knots, np.int64)
    smoothed = np.empty((knots, n))
    moved = np.inf
    dense_row = np.full(n, -1)
    decay = np.ones(n)
    dense_row[VX], dense_row[VY] = 0, 1
    decay[AX_BIAS] = decay[AY_BIAS] = math.exp(-step_s / BIAS_S)
    decay[LAW_ERROR] = math.exp(-step_s / LAW_S)
    if n == WITH_GNSS:
        dense_row[HEADING] = 2
        decay[EAST_ERROR] = decay[NORTH_ERROR] = math.exp(-step_s / RECEIVER_S)
    done = 0
    for iteration in range(iterations):
        x = start.copy()
        p = np.diag(start_variance)
        scratch = np.empty((n, n))
        for k in range(knots):
            if k:
                point = smoothed[k - 1] if iteration else x.copy()
                _transition(x, point, step_s, rows[k], dense[k])
                _propagate(scratch, x, p, dense[k], dense_row, decay)
                p, scratch = scratch, p
                _add_process_noise(p, point, step_s, rows[k], rows[k - 1], accelerometer_noise)
            point = smoothed[k] if iteration else x.copy()
            _measure(x, p, point, rows[k], rear_m, store, k, used, iteration)
            filtered[k] = x
            variance[k] = p
        pull = np.zeros(n)
        information = np.zeros((n, n))
        total = 0.0
        for k in range(knots - 1, -1, -1):
            before = smoothed[k, VY] if iteration else filtered[k, VY]
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
        moved = math.sqrt(total / knots)
        done = iteration
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
    return smoothed, covariance, last, moved, done


@njit(cache=True)
def _pull_vector(pull, dense, dense_row, decay):  # type: ignore[no-untyped-def]
    """Put Fᵀ λ into λ."""
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
