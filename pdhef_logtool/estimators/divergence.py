"""Divergence that no innovation shows: the estimate's changes of v_y against accelerometer and gyro.

Beyond the peak of the tyre force two sideslip angles give the same a_y and nearly the same yaw rate. A filter that
converges to the wrong one agrees with all its sensors, so that its normalized innovation stays small
(docs/method.md#divergence). The way there is visible: at the IMU, for any tyre forces,

    v̇_y,i = a_y / (1 + g K_φ) − v_x,i r,    v_x,i = v_x − y_i r,  v_y,i = v_y + x_i r.

D, the leaky sum of the changes of v̂_y,i beyond that, is the error that the estimate accumulated recently. The leak is
fast (``LINEAR_S``) in the linear range of the tyres, where only one solution exists and D would accumulate bank, bias
and noise. It is slow (``LIMIT_S``) near the limit of grip, and while the flag is set, so that a return to the right
solution clears the flag. The flag is set where abs D exceeds both v̂_x times ``ON_RAD`` (``OFF_RAD`` while it is set)
and ``SIGMAS`` standard deviations of what the sensors contribute to D: their white noise, as the vehicle file states
it, or larger as the drive shows it; the bank of the road; and an error of the accelerometer's gain (its own, or of the
roll gradient). The last two act in one direction for as long as D remembers.

Not detected: an estimate that is wrong from its start, or drifts more slowly than the leak forgets. Errors of
accelerometer or gyro are attributed to the estimate, except for missing and stuck samples, which are not judged.
"""

import math
from dataclasses import replace

import numpy as np

from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.vehicle import GRAVITY_M_S2, VehicleParameters
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.vehicle_model import BANK_STD
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.steps import RESTART_GAP_S, release
from pdhef_logtool.records.tracks import StateTrack

ON_RAD, OFF_RAD = math.radians(5.0), math.radians(3.0)
LINEAR_S, LIMIT_S = 0.5, 3.0
#: Shares of the grip, abs a_y / (μ g), between which the leak changes from fast to slow.
GRIP_LOW, GRIP_HIGH = 0.5, 0.7
GRIP_SMOOTHING_S, GRIP_HOLD_S = 0.1, 1.0
#: Tolerance for noise, bank and gain in D, in standard deviations, and that of the gain of a_y.
SIGMAS, AY_GAIN_STD = 3.0, 0.04
#: Smallest speed in the limit of D, as a multiple of the low-speed blend.
LEAST_SPEED_BLENDS = 3.0

# Entries of the memory.
D, FLAG, HAS_LAST, VY, VX, AY, GYRO, AY_AGE = range(8)
GYRO_AGE, AY_RUN, GYRO_RUN, AY_SLOW, GRIP, FRICTION, VAR, STEADY = range(8, 16)


#: The noise of the sensors is that of the vehicle file.
AS_STATED = FilterNoise()


def watched_track(
    track: StateTrack, signals: Signals, vehicle: VehicleParameters, noise: FilterNoise = AS_STATED
) -> StateTrack:
    """Return a track [N] with ``diverged`` set also where the sensors contradict it.

    Computed on measurement time; a scored stamp has the flag of the newest step that had arrived. Estimates without a
    covariance are not monitored: they make no claim about their accuracy.

    Parameters
    ----------
    track, signals : [N] at the same stamps.
    noise : of the measurements as the drive shows it, if it is larger than in the vehicle file.
    """
    if track.covariance.shape[0] == 0:
        return track
    signals = without_impossible(signals)
    friction = np.where(np.isfinite(track.friction), track.friction, signals.friction)
    flags = np.empty(len(signals), dtype=np.bool_)
    of_track = map(np.ascontiguousarray, (track.vx_m_s, track.vy_m_s, track.yaw_rate_rad_s))
    motion = (signals.steps_s, signals.ay_m_s2, signals.yaw_rate_rad_s, friction, *of_track, track.valid)
    sensors, tilt = vehicle.sensors, 1.0 + GRAVITY_M_S2 * vehicle.roll_gradient_rad_per_m_s2
    car = (
        vehicle.assumed_friction, tilt, *noise.measurement_std(sensors)[:2], *vehicle.imu_position_m[:2],
        LEAST_SPEED_BLENDS * vehicle.low_speed_blend_m_s, sensors.imu_hold_s, float(sensors.stuck_samples),
    )  # fmt: skip
    _watch(motion, car, np.zeros(STEADY + 1), flags)
    released = release(signals.ready_ns, signals.stamps_ns)
    return replace(track, diverged=track.diverged | (flags[released.step] & released.arrived & track.valid))


@njit(cache=True)
def _hold(sample, dt, value, age, run, memory):  # type: ignore[no-untyped-def]
    """Store a sensor's newest sample, its age and its number of consecutive repetitions."""
    if math.isfinite(sample):
        memory[run] = memory[run] + 1.0 if sample == memory[value] else 1.0
        memory[value] = sample
        memory[age] = 0.0
    else:
        memory[age] += dt


@njit(cache=True)
def _watch(motion, car, memory, flags):  # type: ignore[no-untyped-def]
    """Advance the memory over the steps [N] and write the flags [N] in place; ``dt[k]`` ends at step k."""
    dt, ay, gyro, friction, vx, vy, rate, valid = motion
    default_friction, tilt, ay_std, gyro_std, imu_x, imu_y, least_speed, hold_s, stuck_samples = car
    for k in range(dt.shape[0]):
        step = dt[k]
        if not step <= RESTART_GAP_S:
            memory[:] = 0.0
            memory[AY_AGE] = memory[GYRO_AGE] = math.inf
            step = 0.0
        before_ay, before_gyro = memory[AY], memory[GYRO]
        could = memory[AY_AGE] <= hold_s and memory[GYRO_AGE] <= hold_s
        _hold(ay[k], step, AY, AY_AGE, AY_RUN, memory)
        _hold(gyro[k], step, GYRO, GYRO_AGE, GYRO_RUN, memory)
        can = memory[AY_AGE] <= hold_s and memory[GYRO_AGE] <= hold_s
        # Stuck, or with a resolution too coarse to judge.
        stuck = memory[AY_RUN] >= stuck_samples or memory[GYRO_RUN] >= stuck_samples
        if math.isfinite(friction[k]):
            memory[FRICTION] = friction[k]
        mu = memory[FRICTION] if memory[FRICTION] > 0.0 else default_friction
        if memory[AY_AGE] <= hold_s:
            memory[AY_SLOW] += (1.0 - math.exp(-step / GRIP_SMOOTHING_S)) * (memory[AY] - memory[AY_SLOW])
        share = abs(memory[AY_SLOW]) / (mu * GRAVITY_M_S2)
        memory[GRIP] = max(share, memory[GRIP] * math.exp(-step / GRIP_HOLD_S))

        r = rate[k] if math.isfinite(rate[k]) else memory[GYRO]
        if not valid[k] or not math.isfinite(vx[k]) or not math.isfinite(vy[k]):
            memory[D] = memory[VAR] = memory[STEADY] = memory[FLAG] = memory[HAS_LAST] = 0.0
            flags[k] = False
            continue
        vx_imu, vy_imu = vx[k] - imu_y * r, vy[k] + imu_x * r
        if memory[HAS_LAST] > 0.0:
            if could and can and not stuck:
                turned = 0.5 * (memory[VX] * before_gyro + vx_imu * memory[GYRO])
                sensed = 0.5 * (before_ay + memory[AY]) / tilt - turned
                memory[D] += (vy_imu - memory[VY]) - sensed * step
                memory[VAR] += ((ay_std / tilt) ** 2 + (vx_imu * gyro_std) ** 2) * step * step
                memory[STEADY] += math.hypot(GRAVITY_M_S2 * BANK_STD, AY_GAIN_STD * memory[AY_SLOW]) * step
            near = min(max((memory[GRIP] - GRIP_LOW) / (GRIP_HIGH - GRIP_LOW), 0.0), 1.0)
            if memory[FLAG] > 0.0:
                near = 1.0
            keep = math.exp(-step * ((1.0 - near) / LINEAR_S + near / LIMIT_S))
            memory[D] *= keep
            memory[VAR] *= keep * keep
            memory[STEADY] *= keep
        memory[VX], memory[VY], memory[HAS_LAST] = vx_imu, vy_imu, 1.0
        angle = OFF_RAD if memory[FLAG] > 0.0 else ON_RAD
        by_sensors = SIGMAS * math.sqrt(memory[VAR] + memory[STEADY] ** 2)
        limit = max(angle * max(vx[k], least_speed), by_sensors)
        memory[FLAG] = 1.0 if abs(memory[D]) > limit else 0.0
        flags[k] = memory[FLAG] > 0.0
