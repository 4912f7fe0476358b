"""The open-loop single track that a log calibrates: relaxing axle forces from steering and speed alone.

See docs/method.md#self-calibration.

State [v_y, r, f_f, f_r] with f = F_y / m of an axle; (σ / v_x) ḟ + f = f_ss(α). No sensor corrects it, so that low
frequencies count. What it says of yaw rate and a_y is compared with the sensors, both through the same low-pass.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pdhef_logtool.car.nominal_points import arctangent, sine
from pdhef_logtool.compiled.cache import njit

#: Columns of a drive on its grid.
STEER, SPEED, YAW_RATE, AY, FRICTION, SLOW_TURN = range(6)
#: What the sensors correct: how v_y and yaw rate wander, m/s and rad/s per √s, and their 1-sigma at the start of a
#: stretch. The model wanders little, for parameters show at low frequencies; as
#: much as keeps it from spinning where the car does not (docs/method.md#self-calibration).
WANDER_STD, START_STD = (0.05, 0.002), (0.3, 0.05)
#: Largest phase of the model's oscillation in a step of its integration.
LARGEST_STEP_RAD = 0.7
#: From about this sum of normalised squared innovations on the model is taken to be lost, and the sensors lead it back.
CONTRADICTED = 18.0
#: Rows of the errors.
OF_RATE, OF_AY = range(2)


class TrackParameters(NamedTuple):
    """What the model needs, flat; the steering signal as the file reads it becomes (δ + offset) · gain − offset'."""

    front_m: float
    rear_m: float
    mass_over_inertia: float  # m / I_z, 1/m²
    front_B: float
    rear_B: float
    front_peak: float  # over the mass, at ``friction``, m/s²
    rear_peak: float
    shape: float
    friction: float
    relaxation_m: float
    ay_gain: float
    imu_x_m: float
    ay_bias: float
    rate_bias: float
    steer_gain: float
    steer_added: float
    superelevation: float  # share of a bend's slow v_x r that the road's bank carries
    steer_delay: float  # in grid steps
    ay_delay: float
    rate_std: float  # of the innovations
    ay_std: float


class LowPass(NamedTuple):
    """A second-order Butterworth filter on the grid, direct form II transposed."""

    b0: float
    b1: float
    b2: float
    a1: float
    a2: float


def low_pass(cutoff_hz: float, step_s: float) -> LowPass:
    """Return the filter of a cutoff frequency; bilinear, warped to be exact at the cutoff."""
    k = math.tan(math.pi * cutoff_hz * step_s)
    norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    b0 = k * k * norm
    return LowPass(b0, 2.0 * b0, b0, 2.0 * (k * k - 1.0) * norm, (1.0 - math.sqrt(2.0) * k + k * k) * norm)


@njit(cache=True)
def _at(column, place, first, last):  # type: ignore[no-untyped-def]
    """Return a column at a place between its samples [first, last)."""
    place = min(max(place, float(first)), float(last - 1))
    i = min(int(place), last - 2)
    w = place - i
    return (1.0 - w) * column[i] + w * column[i + 1]


@njit(cache=True)
def _force(slip, B, peak, shape):  # type: ignore[no-untyped-def]
    return peak * sine(shape * arctangent(B * slip, 1.0))


@njit(cache=True)
def _slip_of(force, B, peak, shape):  # type: ignore[no-untyped-def]
    """Return the slip at which an axle has a force; that of 0.9 of its peak beyond."""
    share = min(max(force / peak, -0.9), 0.9)
    return math.tan(math.asin(share) / shape) / B


@njit(cache=True)
def _slope(slip, B, peak, shape):  # type: ignore[no-untyped-def]
    """Return the derivative of a force by its slip, 0 beyond the peak, where it is negative."""
    return max(peak * math.cos(shape * math.atan(B * slip)) * shape * B / (1.0 + (B * slip) ** 2), 0.0)


@njit(cache=True)
def _predict_covariance(P, A, work):  # type: ignore[no-untyped-def]
    """Replace P [4, 4] by A P A^T + Q."""
    for i in range(4):
        for j in range(4):
            work[i, j] = A[i, 0] * P[0, j] + A[i, 1] * P[1, j] + A[i, 2] * P[2, j] + A[i, 3] * P[3, j]
    for i in range(4):
        for j in range(4):
            P[i, j] = work[i, 0] * A[j, 0] + work[i, 1] * A[j, 1] + work[i, 2] * A[j, 2] + work[i, 3] * A[j, 3]


@njit(cache=True)
def _update(P, h, variance, innovation, gained):  # type: ignore[no-untyped-def]
    """Update P by one measurement h [4]; write what the state gains. Return the normalised squared innovation."""
    gain = P @ h
    total = variance + h @ gain
    gained += gain * (innovation / total)
    for i in range(4):
        for j in range(4):
            P[i, j] -= gain[i] * gain[j] / total
    return innovation * innovation / total


@njit(cache=True)
def _parts(step_s, p):  # type: ignore[no-untyped-def]
    """Return into how many parts a step of the grid is divided, for the yaw oscillation of a light car."""
    front, rear = p.front_B * p.front_peak * p.shape, p.rear_B * p.rear_peak * p.shape
    turning = p.mass_over_inertia * (p.front_m**2 * front + p.rear_m**2 * rear)
    return 1 + int(step_s * math.sqrt(max(front + rear, turning) / p.relaxation_m) / LARGEST_STEP_RAD)


@njit(cache=True)
def simulate(columns, stretches, step_s, p, out):  # type: ignore[no-untyped-def]
    """Drive the model through the stretches [k, 2] of a grid, [first, last) each.

    ``columns`` [6, N] as named above. ``out`` [3, N] takes yaw rate and a_y as sensors would read them, and v_y.
    """
    steer, speed, rate, ay = columns[0], columns[1], columns[2], columns[3]
    friction, slow_turn = columns[4], columns[5]
    P, A, work = np.zeros((4, 4)), np.zeros((4, 4)), np.zeros((4, 4))
    h, gained = np.zeros(4), np.zeros(4)
    parts = _parts(step_s, p)
    h_s = step_s / parts
    for s in range(stretches.shape[0]):
        first, last = stretches[s, 0], stretches[s, 1]
        mu = friction[first] / p.friction
        v, r = speed[first], rate[first] - p.rate_bias
        planar = (ay[first] - p.ay_bias) / p.ay_gain
        length = p.front_m + p.rear_m
        ff, fr = planar * p.rear_m / length, planar * p.front_m / length
        vy = p.rear_m * r - v * math.tan(_slip_of(fr, p.rear_B / mu, p.rear_peak * mu, p.shape))
        angle = p.steer_gain * _at(steer, first - p.steer_delay, first, last) + p.steer_added
        P[:, :] = 0.0
        P[0, 0], P[1, 1] = START_STD[0] ** 2, START_STD[1] ** 2
        for k in range(first, last):
            ffc = ff * math.cos(angle)
            r_dot = p.mass_over_inertia * (p.front_m * ffc - p.rear_m * fr)
            out[0, k] = r + p.rate_bias
            out[1, k] = p.ay_gain * (ffc + fr) + p.imu_x_m * r_dot + p.ay_bias
            out[2, k] = vy
            if k + 1 == last:
                break
            gained[:] = 0.0
            h[:] = 0.0
            h[1] = 1.0
            contradicted = _update(P, h, p.rate_std**2, rate[k] - out[0, k], gained)
            h[1] = 0.0
            h[2] = p.ay_gain + p.imu_x_m * p.mass_over_inertia * p.front_m
            h[3] = p.ay_gain - p.imu_x_m * p.mass_over_inertia * p.rear_m
            measured = _at(ay, k + p.ay_delay, first, last) - out[1, k] - h @ gained
            contradicted += _update(P, h, p.ay_std**2, measured, gained)
            vy, r, ff, fr = vy + gained[0], r + gained[1], ff + gained[2], fr + gained[3]
            ffc = ff * math.cos(angle)
            r_dot = p.mass_over_inertia * (p.front_m * ffc - p.rear_m * fr)
            mu = friction[k] / p.friction
            slope = p.superelevation * slow_turn[k]
            lost = (contradicted / CONTRADICTED) ** 2
            first_angle = angle
            last_angle = p.steer_gain * _at(steer, k + 1 - p.steer_delay, first, last) + p.steer_added
            for i in range(parts):
                v = speed[k] + (speed[k + 1] - speed[k]) * i / parts
                middle = v + 0.5 * (speed[k + 1] - speed[k]) / parts
                after = first_angle + (last_angle - first_angle) * (i + 1) / parts
                x = h_s * middle / p.relaxation_m
                kept = math.exp(-x)
                t = h_s * (1.0 - (1.0 - x * kept / (1.0 - kept)) / x) if x > 1e-3 else 0.5 * h_s
                # the tyres, asked at the instant for which the lag's kernel stands
                turning = r + t * r_dot
                sideways = vy + t * (ffc + fr + slope - v * r)
                asked = angle + (after - angle) * t / h_s
                front_slip = asked - arctangent(sideways + p.front_m * turning, middle)
                rear_slip = -arctangent(sideways - p.rear_m * turning, middle)
                sf = _force(front_slip, p.front_B / mu, p.front_peak * mu, p.shape)
                sr = _force(rear_slip, p.rear_B / mu, p.rear_peak * mu, p.shape)
                cf = (1.0 - kept) * _slope(front_slip, p.front_B / mu, p.front_peak * mu, p.shape) / middle
                cr = (1.0 - kept) * _slope(rear_slip, p.rear_B / mu, p.rear_peak * mu, p.shape) / middle
                A[2, 0], A[2, 1], A[2, 2], A[2, 3] = -cf, -cf * p.front_m, kept, 0.0
                A[3, 0], A[3, 1], A[3, 2], A[3, 3] = -cr, cr * p.rear_m, 0.0, kept
                for n in range(4):  # the new forces act on the velocities, or the oscillation of a light car would grow
                    A[0, n] = h_s * (A[2, n] + A[3, n])
                    A[1, n] = h_s * p.mass_over_inertia * (p.front_m * A[2, n] - p.rear_m * A[3, n])
                A[0, 0] += 1.0
                A[0, 1] -= h_s * middle
                A[1, 1] += 1.0
                _predict_covariance(P, A, work)
                P[0, 0] += h_s * lost * WANDER_STD[0] ** 2
                P[1, 1] += h_s * lost * WANDER_STD[1] ** 2
                ff1, fr1 = sf + (ff - sf) * kept, sr + (fr - sr) * kept
                mf, mr = 0.5 * (ffc + ff1 * math.cos(after)), 0.5 * (fr + fr1)
                r1 = r + h_s * p.mass_over_inertia * (p.front_m * mf - p.rear_m * mr)
                vy += h_s * (mf + mr + slope - middle * 0.5 * (r + r1))
                r, ff, fr, angle = r1, ff1, fr1, after
                ffc = ff * math.cos(angle)
                r_dot = p.mass_over_inertia * (p.front_m * ffc - p.rear_m * fr)


@njit(cache=True)
def errors(columns, stretches, step_s, p, passed, forget, out, found):  # type: ignore[no-untyped-def]
    """Write what sensors read less what the model says [2, N], through the low-pass; ``out`` [3, N] as above.

    ``forget`` [2] : share of an error's slow part that leaves it at each step.
    """
    simulate(columns, stretches, step_s, p, out)
    for s in range(stretches.shape[0]):
        first, last = stretches[s, 0], stretches[s, 1]
        for row in range(2):
            delay = p.ay_delay if row == 1 else 0.0
            measured = columns[2 + row]
            z1, z2 = 0.0, 0.0
            slow, rate = 0.0, forget[row]
            for k in range(first, last):
                x = _at(measured, k + delay, first, last) - out[row, k]
                if k == first:  # as if it had always been so
                    z1, z2 = (1.0 - passed.b0) * x, (passed.b2 - passed.a2) * x
                    slow = x if rate > 0.0 else 0.0
                y = passed.b0 * x + z1
                z1 = passed.b1 * x - passed.a1 * y + z2
                z2 = passed.b2 * x - passed.a2 * y
                slow += rate * (y - slow)
                found[row, k] = y - slow
