"""Single-track model for the calibration by a log: axle forces with relaxation from steering, speed and yaw rate.

See docs/method.md#self-calibration.

State [v_y, r, f_f, f_r] with f = F_y / m of an axle; (σ / v_x) ḟ + f = f_ss(α). The measured yaw rate enters the v_y
equation, and the model's yaw rate enters the slip angles (series-parallel model, Ljung 1999, chapter 7): the tyres damp
v_y and r separately at any speed, so that the model cannot spin, and low frequencies of both errors remain informative.
The yaw rate is slowly corrected, so that the effect of disturbances that the driver compensates decays.
"""

import math
from typing import NamedTuple

from pdhef_logtool.car.elementary_functions import arctangent, sine
from pdhef_logtool.compiled.cache import njit

#: Columns of a drive on its grid.
STEER, SPEED, YAW_RATE, AY, FRICTION = range(5)
#: Rows of the errors.
OF_RATE, OF_AY = range(2)
#: Cutoff for the road bank; share of a_y beyond the linear range that slides may contribute, m/s².
BANK_HZ, BANK_SHARE, LINEAR_AY = 0.1, 0.25, 3.0
#: Gain of the yaw-rate correction, 1/s, with the lowest error on simulated cars with wrong files.
RATE_GAIN = 2.0
#: Limit of the initial force of an axle, as a share of its peak force.
_LARGEST_START_SHARE = 0.9


class TrackParameters(NamedTuple):
    """Model parameters; the steering angle is (signal + offset of the file) · gain − offset."""

    front_m: float
    rear_m: float
    mass_over_inertia: float  # m / I_z, 1/m²
    front_stiffness: float  # over the mass, m/(s² rad)
    rear_stiffness: float
    front_peak: float  # over the mass, at ``friction``, m/s²
    rear_peak: float
    shape: float  # C of Eq 2; E is 0
    friction: float
    relaxation_m: float
    ay_gain: float
    imu_x_m: float
    ay_bias: float
    rate_bias: float
    steer_gain: float
    steer_added: float
    steer_delay: float  # in grid steps


class LowPass(NamedTuple):
    """A second-order Butterworth filter on the grid, direct form II transposed."""

    b0: float
    b1: float
    b2: float
    a1: float
    a2: float


def low_pass(cutoff_hz: float, step_s: float) -> LowPass:
    """Return the filter for a cutoff frequency; bilinear with prewarping, exact at the cutoff."""
    k = math.tan(math.pi * cutoff_hz * step_s)
    norm = 1.0 / (1.0 + math.sqrt(2.0) * k + k * k)
    b0 = k * k * norm
    return LowPass(b0, 2.0 * b0, b0, 2.0 * (k * k - 1.0) * norm, (1.0 - math.sqrt(2.0) * k + k * k) * norm)


@njit(cache=True)
def _sample(column, place, first, last):  # type: ignore[no-untyped-def]
    """Return the interpolated value of a column at a fractional index in [first, last)."""
    place = min(max(place, float(first)), float(last - 1))
    i = min(int(place), last - 2)
    w = place - i
    return (1.0 - w) * column[i] + w * column[i + 1]


@njit(cache=True)
def _force(slip, stiffness, peak, shape):  # type: ignore[no-untyped-def]
    return peak * sine(shape * arctangent(stiffness * slip / (shape * peak), 1.0))


@njit(cache=True)
def _slip_of(force, stiffness, peak, shape):  # type: ignore[no-untyped-def]
    """Return the slip angle at which an axle has a force."""
    return math.tan(math.asin(force / peak) / shape) * shape * peak / stiffness


@njit(cache=True)
def _start_force(force, peak):  # type: ignore[no-untyped-def]
    return min(max(force, -_LARGEST_START_SHARE * peak), _LARGEST_START_SHARE * peak)


@njit(cache=True)
def _filter(values, first, last, backwards, passed):  # type: ignore[no-untyped-def]
    """Filter the values [first, last) in place, with the steady state of the first value as initial state."""
    step = -1 if backwards else 1
    k = last - 1 if backwards else first
    z1, z2 = (1.0 - passed.b0) * values[k], (passed.b2 - passed.a2) * values[k]
    for _ in range(last - first):
        x = values[k]
        y = passed.b0 * x + z1
        z1 = passed.b1 * x - passed.a1 * y + z2
        z2 = passed.b2 * x - passed.a2 * y
        values[k] = y
        k += step


@njit(cache=True)
def disturbance(turn_low, ay_low, speed, p):  # type: ignore[no-untyped-def]
    """Return the lateral acceleration due to road bank: low-passed v_x r − a_y, without the part that slides explain.

    Crossfall is as large as errors of a_y, and superelevation increases with a_y like body roll: they are not
    distinguishable within a drive, and bias and roll gain keep their priors.
    """
    lacks = turn_low - speed * p.rate_bias - (ay_low - p.ay_bias) / p.ay_gain
    return math.copysign(max(0.0, abs(lacks) - BANK_SHARE * max(0.0, abs(ay_low) - LINEAR_AY)), lacks)


@njit(cache=True)
def slow_parts(columns, stretches, passed):  # type: ignore[no-untyped-def]
    """Write the low-passed v_x r and a_y of a grid to its last two rows."""
    columns[5] = columns[1] * columns[2]
    columns[6] = columns[3]
    for s in range(stretches.shape[0]):
        for row in (5, 6):
            for backwards in (False, True):
                _filter(columns[row], stretches[s, 0], stretches[s, 1], backwards, passed)


@njit(cache=True)
def simulate(columns, stretches, step_s, p, out):  # type: ignore[no-untyped-def]
    """Simulate the model over the stretches [k, 2] of a grid, [first, last) each.

    ``columns`` [7, N] as named above, then low-passed v_x r and a_y. ``out`` [3, N] receives simulated yaw rate and a_y
    of the sensors, and v_y.
    """
    steer, speed, rate, ay, friction = columns[0], columns[1], columns[2], columns[3], columns[4]
    length = p.front_m + p.rear_m
    for s in range(stretches.shape[0]):
        first, last = stretches[s, 0], stretches[s, 1]
        mu = friction[first] / p.friction
        r = rate[first] - p.rate_bias
        planar = (ay[first] - p.ay_bias) / p.ay_gain
        ff = _start_force(planar * p.rear_m / length, p.front_peak * mu)
        fr = _start_force(planar * p.front_m / length, p.rear_peak * mu)
        slip = _slip_of(fr, p.rear_stiffness, p.rear_peak * mu, p.shape)
        vy = p.rear_m * r - speed[first] * math.tan(slip)
        angle = p.steer_gain * _sample(steer, first - p.steer_delay, first, last) + p.steer_added
        for k in range(first, last):
            ffc = ff * math.cos(angle)
            r_dot = p.mass_over_inertia * (p.front_m * ffc - p.rear_m * fr)
            out[0, k] = r + p.rate_bias
            out[1, k] = p.ay_gain * (ffc + fr) + p.imu_x_m * r_dot + p.ay_bias
            out[2, k] = vy
            if k + 1 == last:
                break
            middle = 0.5 * (speed[k] + speed[k + 1])
            after = p.steer_gain * _sample(steer, k + 1 - p.steer_delay, first, last) + p.steer_added
            mu = friction[k] / p.friction
            x = step_s * middle / p.relaxation_m
            kept = math.exp(-x)
            # t: centroid of the exponential kernel of the lag; the slip angles are evaluated at this instant
            t = step_s * (1.0 - (1.0 - x * kept / (1.0 - kept)) / x) if x > 1e-3 else 0.5 * step_s
            measured = rate[k] - p.rate_bias
            turning = r + t * r_dot
            banked = disturbance(columns[5, k], columns[6, k], speed[k], p)
            sideways = vy + t * (ffc + fr + banked - speed[k] * measured)
            turned = angle + (after - angle) * t / step_s
            front = turned - arctangent(sideways + p.front_m * turning, middle)
            rear = -arctangent(sideways - p.rear_m * turning, middle)
            sf = _force(front, p.front_stiffness, p.front_peak * mu, p.shape)
            sr = _force(rear, p.rear_stiffness, p.rear_peak * mu, p.shape)
            ff1, fr1 = sf + (ff - sf) * kept, sr + (fr - sr) * kept
            mf, mr = 0.5 * (ffc + ff1 * math.cos(after)), 0.5 * (fr + fr1)
            vy += step_s * (mf + mr + banked - middle * 0.5 * (measured + rate[k + 1] - p.rate_bias))
            r += step_s * (p.mass_over_inertia * (p.front_m * mf - p.rear_m * mr) + RATE_GAIN * (measured - r))
            ff, fr, angle = ff1, fr1, after


@njit(cache=True)
def errors(columns, stretches, step_s, p, passed, out, differences):  # type: ignore[no-untyped-def]
    """Write sensor minus model [2, N], low-passed forward and backward; ``out`` [3, N] as in :func:`simulate`."""
    simulate(columns, stretches, step_s, p, out)
    for s in range(stretches.shape[0]):
        first, last = stretches[s, 0], stretches[s, 1]
        for row in range(2):
            for k in range(first, last):
                differences[row, k] = columns[2 + row, k] - out[row, k]
            _filter(differences[row], first, last, False, passed)
            _filter(differences[row], first, last, True, passed)
