"""Base of the peers: samples with a short history, and the rates of v_y for the latency compensation."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.base import QUANTITIES, VX, VY, YAW_RATE, Steps
from pdhef_logtool.estimators.peers.single_track import LEAST_SPEED_M_S
from pdhef_logtool.estimators.stepwise import StepState, measured_speed
from pdhef_logtool.records.readings import without_impossible
from pdhef_logtool.records.signals import S_PER_NS, FloatArray, IntArray, Signals, step_durations_s
from pdhef_logtool.records.steps import StepColumns, last_known

#: Rate of the published filters, Hz. Their noise per sample is converted from it to the step between two samples.
PUBLISHED_HZ = 100.0
#: Time before a window for which its samples are kept: the yaw acceleration of ``slip-ukf`` and held samples.
HISTORY_NS = 1_600_000_000
#: v̇_y for the latency compensation is the mean change of v_y over this time.
RATE_SPAN_NS = 50_000_000


@dataclass(frozen=True, slots=True, eq=False)
class Samples(StepColumns):
    """Samples of a window and of the time before it, [K]; ``states`` [K, 2] are the estimated v_y and yaw rate."""

    stamps_ns: IntArray
    vx: FloatArray
    steer: FloatArray
    ax: FloatArray
    ay: FloatArray
    yaw_rate: FloatArray
    states: FloatArray

    def held(self, name: str) -> FloatArray:
        """Return a column [K] with its last finite value held over short gaps."""
        return last_known(self.stamps_ns, getattr(self, name))


class PeerState(NamedTuple):
    """State between windows: of the measured speed, the last samples, and the memory of the filter."""

    speed: StepState
    samples: Samples
    memory: FloatArray


@dataclass(frozen=True, slots=True)
class Peer:
    """A published estimator. Subclasses fill ``samples.states``."""

    version = 1
    memory_size = 0

    vehicle: VehicleParameters
    name: str
    causal: bool = True

    def estimate(self, samples: Samples, first: int, steps_s: FloatArray, memory: FloatArray) -> None:
        """Fill ``samples.states`` from row ``first`` on, NaN without an estimate; update ``memory`` in place.

        Below :data:`~.single_track.LEAST_SPEED_M_S` they are replaced.

        ``steps_s`` [K] is the time before each sample. ``memory`` [``memory_size``] is NaN at the start of a log.
        """
        raise NotImplementedError

    def _roll(self, samples: Samples) -> None:
        """Let a slow car roll without slip, in place: r = v_x tan δ / l, v_y = l_r r."""
        slow = samples.vx < LEAST_SPEED_M_S
        r = (samples.vx * np.tan(samples.held("steer")) / self.vehicle.wheelbase_m)[slow]
        samples.states[slow] = np.stack([self.vehicle.cg_to_rear_axle_m * r, r], axis=1)

    def run(self, signals: Signals, state: PeerState | None) -> tuple[Steps, PeerState]:
        """Process one window (see :class:`~pdhef_logtool.estimators.base.Estimator`)."""
        signals = without_impossible(signals)
        vx, speed = measured_speed(signals, self.vehicle.sensors.speed_hold_s, None if state is None else state.speed)
        sensors = signals.steer_rad, signals.ax_m_s2, signals.ay_m_s2, signals.yaw_rate_rad_s
        samples = Samples(signals.stamps_ns, vx, *sensors, np.full((len(vx), 2), np.nan))
        memory = np.full(self.memory_size, np.nan)
        if state is not None:
            samples, memory = state.samples.joined(samples), state.memory.copy()
        stamps_ns, first = samples.stamps_ns, len(samples.vx) - len(vx)
        if len(vx):
            self.estimate(samples, first, step_durations_s(stamps_ns), memory)
        self._roll(samples)
        values, rates = np.full((2, len(stamps_ns), len(QUANTITIES)), np.nan)
        values[:, VX], values[:, VY], values[:, YAW_RATE] = samples.vx, *samples.states.T
        before = np.searchsorted(stamps_ns, stamps_ns - RATE_SPAN_NS)
        span_s = np.maximum((stamps_ns - stamps_ns[before]) * S_PER_NS, 1e-3)
        rates[:, VY] = (values[:, VY] - values[before, VY]) / span_s
        valid = np.isfinite(values[:, : YAW_RATE + 1]).all(axis=1)
        kept = int(np.searchsorted(stamps_ns, stamps_ns[-1] - HISTORY_NS)) if len(stamps_ns) else 0
        steps = Steps(values, np.nan_to_num(rates), valid).at(slice(first, None))
        return steps, PeerState(speed, samples.at(slice(kept, None)), memory)
