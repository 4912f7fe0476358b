"""``washout``: integral of v̇_y = a_y − v_x r, high-passed, plus the low-passed stationary solution of the single track.

Piyabongkarn, Rajamani, Grogg and Lew, IEEE Transactions on Control Systems Technology 17 (2009) 78–88, after Fukada,
Vehicle System Dynamics 32 (1999) 375–388:

    v_y = 1 / (1 + T s) · v_y,model + T / (1 + T s) · (a_y − v_x r)

Differences: without a roll sensor, a_y contains the roll angle; T is equal to the leak of ``kinematic``, chosen on
simulated drives.
"""

import math

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.estimators.kinematic import LEAK_S
from pdhef_logtool.estimators.peers.peer import Peer, Samples
from pdhef_logtool.estimators.peers.single_track import LEAST_SPEED_M_S, matrices, single_track, solve
from pdhef_logtool.records.signals import FloatArray
from pdhef_logtool.records.steps import RESTART_GAP_S


@njit(cache=True, error_model="numpy")
def _washout(samples, first, p, time_constant_s, memory):  # type: ignore[no-untyped-def]
    steps_s, vx, steer, ay, yaw_rate, states = samples
    vy = memory[0]
    for k in range(first, len(vx)):
        dt = steps_s[k]
        if not vx[k] >= LEAST_SPEED_M_S:
            vy = math.nan
            continue
        a, b = matrices(vx[k], p)
        model, _ = solve(a, -b[0] * steer[k], -b[1] * steer[k])
        if dt <= RESTART_GAP_S and math.isfinite(vy):  # a step of the implicit Euler rule
            share = dt / (time_constant_s + dt)
            vy = (1.0 - share) * (vy + dt * (ay[k] - vx[k] * yaw_rate[k])) + share * model
        else:
            vy = model
        states[k, 0], states[k, 1] = vy, yaw_rate[k]
    memory[0] = vy


class Washout(Peer):
    """The filter of this file as an estimator."""

    algorithm = "washout"
    memory_size = 1

    def estimate(self, samples: Samples, first: int, steps_s: FloatArray, memory: FloatArray) -> None:
        """Run the filter (see :class:`~.peer.Peer`)."""
        held = [samples.held(name) for name in ("steer", "ay", "yaw_rate")]
        columns = (steps_s, samples.vx, *held, samples.states)
        _washout(columns, first, single_track(self.vehicle), LEAK_S, memory)
