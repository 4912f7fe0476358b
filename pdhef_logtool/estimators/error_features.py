"""Terms of a calibrated confidence interval: indicators of the estimation error that are available online.

============  ====  ================================================================================================
term          unit  definition
============  ====  ================================================================================================
``floor``     rad   a constant, 1e-4
``filter``    rad   the estimator's own 1-sigma of sideslip
``sideslip``  rad   abs β̂: an error of the cornering stiffness is proportional to the slip angles
``grip``      rad   0.003 x, x = abs a_y / (μ g), a_y smoothed (0.05 s), peak decay 0.5 s, μ as given
``grip2``     rad   0.01 x²: uncertainty of the tyres beyond the linear range
``kinematic`` rad   rms over 1 s of w / v_x, w = leaky integral (0.3 s) of a_y / (1 + g K_φ) − v̂_x r_m less v̂_y seen
                    through the same high-pass; its slow mean (3 s: bias, bank) removed. The accelerometer and the
                    gyro against the estimate's changes, without a vehicle model
``yaw_rate``  rad/s rms over 1 s of r_m − r̂, smoothed over 0.15 s, which removes noise and keeps model error
``cure``      rad   abs β̂ times the weight of the filters with a force scale or bank
``bank``      rad   abs of the estimated road bank
============  ====  ================================================================================================

Samples arrive later than their stamps. The terms are computed on measurement time, and a scored stamp has the terms of
the newest available step (:mod:`~.latency_compensation`), as for estimates. Samples that the estimator reports as
faulty are ignored.
"""

from __future__ import annotations

import math

import numpy as np

from pdhef_logtool.car.vehicle import GRAVITY_M_S2
from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.reasons import BURST_AY, DEAD_AY, MISSING_AY, SPIKE_AY, STUCK_AY
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.steps import RESTART_GAP_S, release, step_durations_s
from pdhef_logtool.records.tracks import StateTrack

#: In the order of the columns.
TERMS = ("floor", "filter", "sideslip", "grip", "grip2", "kinematic", "yaw_rate", "cure", "bank")
FLOOR_RAD = 1e-4
GRIP_RAD, GRIP2_RAD = 0.003, 0.01
GRIP_SMOOTHING_S, GRIP_HOLD_S = 0.05, 0.5
KINEMATIC_S, SLOW_MEAN_S = 0.3, 3.0
YAW_SMOOTHING_S = 0.15
MEMORY_S = 1.0
MIN_SPEED_M_S = 3.0
#: Friction if neither log nor estimator provides it.
ASSUMED_FRICTION = 1.0
#: Reason bits of a_y; the bits of the yaw rate are shifted left by one.
_AY_BITS = BURST_AY | SPIKE_AY | STUCK_AY | DEAD_AY | MISSING_AY

# Entries of the memory.
AY, GRIP, KIN, VY_SLOW, W_SLOW, W_SQUARE, RATE, RATE_SQUARE, HAS_VY, HAS_AY = range(10)
MEMORY_SIZE = 10
# Columns of a step: grip share, kinematic disagreement, yaw-rate residual.
STEP_SIZE = 3


def error_terms(track: StateTrack, signals: Signals, roll_gradient_rad_per_m_s2: float) -> FloatArray:
    """Return the terms [N, 9] of :data:`TERMS`.

    Unknown terms are 0, for instance before the first sample.

    Parameters
    ----------
    track, signals : [N] at the same stamps.
    """
    signals = without_impossible(signals)
    count = len(signals)
    friction = np.where(np.isfinite(track.friction), track.friction, signals.friction)
    friction = np.where(np.isfinite(friction), friction, ASSUMED_FRICTION)
    steps = np.empty((count, STEP_SIZE))
    dt_s = step_durations_s(signals.stamps_ns, None)
    motion = (
        dt_s, *believed(track, signals), friction, track.vx_m_s, track.vy_m_s, track.yaw_rate_rad_s
    )  # fmt: skip
    _advance(motion, 1.0 + GRAVITY_M_S2 * roll_gradient_rad_per_m_s2, np.zeros(MEMORY_SIZE), steps)
    released = release(signals.ready_ns, signals.stamps_ns)
    arrived_terms = np.where(released.arrived[:, None], steps[released.row], 0.0)
    grip = arrived_terms[:, 0]
    return np.stack(
        [
            np.full(count, FLOOR_RAD),
            _known(track.sideslip_std_rad),
            _known(np.abs(track.sideslip_rad)),
            GRIP_RAD * grip,
            GRIP2_RAD * grip**2,
            arrived_terms[:, 1],
            arrived_terms[:, 2],
            _known(np.abs(track.sideslip_rad)) * _column(track, track.mixture_weight),
            np.abs(_column(track, track.bank_rad)),
        ],
        axis=1,
    )


def believed(track: StateTrack, signals: Signals) -> tuple[FloatArray, FloatArray]:
    """Return a_y and yaw rate [N] without the samples that the estimator reports as faulty.

    A stuck gyro disagrees with a correct estimate. The estimator reports it a few steps late, when the sample arrived.
    """
    if len(track.reason) != len(track):
        return signals.ay_m_s2, signals.yaw_rate_rad_s
    bad = [np.bitwise_and(track.reason, bits) != 0 for bits in (_AY_BITS, _AY_BITS << 1)]
    return np.where(bad[0], np.nan, signals.ay_m_s2), np.where(bad[1], np.nan, signals.yaw_rate_rad_s)


def grip_share(terms: FloatArray) -> FloatArray:
    """Return the grip utilization [N] of terms [N, 9]."""
    return terms[:, TERMS.index("grip")] / GRIP_RAD


def _column(track: StateTrack, values: FloatArray) -> FloatArray:
    """Return an optional column of a track [N]; zeros if it is missing."""
    return _known(values) if len(values) == len(track) else np.zeros(len(track))


def _known(values: FloatArray) -> FloatArray:
    return np.where(np.isfinite(values), values, 0.0)


@njit(cache=True)
def _advance(motion, tilt, memory, out):  # type: ignore[no-untyped-def]
    """Advance the memory over the steps [N] and write grip share, kinematic and yaw-rate terms [N, 3] in place.

    A missing sample leaves the low-pass filters that need it unchanged.
    """
    dt, ay, rate, friction, vx, vy, yaw_rate = motion
    for k in range(dt.shape[0]):
        step = dt[k]
        if not step <= RESTART_GAP_S:
            memory[:] = 0.0
            step = 0.0
        if math.isfinite(ay[k]):
            if memory[HAS_AY] == 0.0:
                memory[AY] = ay[k]
                memory[HAS_AY] = 1.0
            memory[AY] += (1.0 - math.exp(-step / GRIP_SMOOTHING_S)) * (ay[k] - memory[AY])
        share = abs(memory[AY]) / (friction[k] * GRAVITY_M_S2)
        memory[GRIP] = max(share, memory[GRIP] * math.exp(-step / GRIP_HOLD_S))
        keep = math.exp(-step / MEMORY_S)
        if math.isfinite(ay[k]) and math.isfinite(rate[k]) and math.isfinite(vx[k]) and math.isfinite(vy[k]):
            if memory[HAS_VY] == 0.0:
                memory[VY_SLOW] = vy[k]
                memory[HAS_VY] = 1.0
            speed = max(abs(vx[k]), MIN_SPEED_M_S)
            gain = 1.0 - math.exp(-step / KINEMATIC_S)
            memory[KIN] += gain * (ay[k] / tilt - vx[k] * rate[k] - memory[KIN])
            memory[VY_SLOW] += gain * (vy[k] - memory[VY_SLOW])
            w = KINEMATIC_S * memory[KIN] - (vy[k] - memory[VY_SLOW])
            memory[W_SLOW] += (1.0 - math.exp(-step / SLOW_MEAN_S)) * (w - memory[W_SLOW])
            w = (w - memory[W_SLOW]) / speed
            memory[W_SQUARE] = keep * memory[W_SQUARE] + (1.0 - keep) * w * w
        if math.isfinite(rate[k]) and math.isfinite(yaw_rate[k]):
            memory[RATE] += (1.0 - math.exp(-step / YAW_SMOOTHING_S)) * (rate[k] - yaw_rate[k] - memory[RATE])
            memory[RATE_SQUARE] = keep * memory[RATE_SQUARE] + (1.0 - keep) * memory[RATE] ** 2
        out[k, 0] = memory[GRIP]
        out[k, 1] = math.sqrt(memory[W_SQUARE])
        out[k, 2] = math.sqrt(memory[RATE_SQUARE])
