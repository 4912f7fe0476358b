"""``physics`` and ``pd-hef``: the physics filter with trust times a network's residual, and an adaptive mechanism.

There is one set of noise, that of the car's physics: trust scales the residual only, and ``physics`` is trust 0 without
a network. The mechanism (METHOD §7, §15) does not read model error as noise.

Bottom layer: :mod:`~.sensor_faults` looks at a_y and yaw rate alone. What it finds goes into every filter here, the
parallel one too, and keeps bad samples from the network.

Top layer: two filters on one pass of the network. F1 is the car's filter; F2 has a state that scales all forces. Where
the car's parts have that state there is F1 alone. White
noise does not repeat itself, a model error does, and in proportion to the force. So the mean product of innovations of
a_y three steps apart is what a filter's model misses. F2 gets weight as its own product stays below that of F1, beyond
chance: a force scale that does not explain a_y is the wrong cure, for another car or a spin, and is not taken. More is
asked of it where the sideslip is uncertain, for at the grip limit force and sideslip can be traded for each other, and
it counts for nothing at a very large sideslip. The output is the mixture of both, its covariance with their difference.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from pdhef_logtool.estimators.checked_inputs import CheckedInputs, InputCarry, check_inputs, r_scale, residual_rate
from pdhef_logtool.estimators.filter_shell import VX, VY, YAW_RATE, Z_AY, PosteriorSteps, sideslip_std
from pdhef_logtool.estimators.physics import FilterCarry
from pdhef_logtool.estimators.physics_ukf import PhysicsFilter, of_car
from pdhef_logtool.records.compiled import njit
from pdhef_logtool.records.release import StepColumns, last_stamp_ns, release, step_durations_s
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.tracks import ESTIMATED_COLUMNS, StateTrack
from pdhef_logtool.residual_model.service import NetworkService
from pdhef_logtool.watches.sensor_faults import AY, SensorFaults, no_faults

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.table import Options

# The constants below were chosen on simulated condition drives (``pdhef simulate conditions --drives 8 --seed 1``) and
# checked on others (``--drives 12 --seed 5``): in no row more than 4 % above the fixed filter, in those with a wrong
# friction at half of it.

#: Steps between the innovations that are multiplied.
LAG_STEPS = 3
#: Time constant of the mean product.
MEAN_S = 0.5
#: Time constants of the evidence: when it rises, when it falls, and when F2 is the worse of the two.
ATTACK_S, RELEASE_S, DISPROVED_S = 0.05, 3.0, 0.2
#: The mean innovation, which is the sensor's bias, is learnt in this time where the car drives straight.
BIAS_S, STRAIGHT_AY_M_S2, STRAIGHT_YAW_RATE_RAD_S = 2.0, 0.6, 0.04
#: F2's product counts by this much more than F1's: s is a free parameter, and fits something in any case.
FREEDOM = 1.3
#: Evidence up to which F2 has no weight, and from which on it has all, at a certain sideslip, over the usual noise
#: variance of a_y: a car that shakes has more innovation that repeats itself, and no wrong force.
EVIDENCE_LOW, EVIDENCE_HIGH = 0.35, 2.1
#: The usual noise of a_y is at least this share of the filter's: identified noise holds the model's usual error.
IDENTIFIED_SHARE = 0.4
#: 1-sigma of F1's sideslip at which twice that evidence is asked for.
UNCERTAIN_RAD = math.radians(0.1)
#: Sideslip between which F2 loses its weight.
SIDESLIP_FROM_RAD, SIDESLIP_TO_RAD = math.radians(10.0), math.radians(15.0)
#: A longer step starts the mixture anew, as it does the filters.
RESTART_GAP_S = 0.5

# Memory of the mixture: the last innovations, mean product and mean innovation of F1 and F2, and the evidence.
M_INNOVATION, M_PRODUCT, M_BIAS, M_EVIDENCE = 0, 2 * LAG_STEPS, 2 * LAG_STEPS + 2, 2 * LAG_STEPS + 4
MEMORY = 2 * LAG_STEPS + 5


@dataclass(frozen=True, slots=True, eq=False)
class MixtureSteps(StepColumns):
    """By step on measurement time, [K]: when it arrived, weight of F2, factor on R, and the detector's bit mask."""

    ready_ns: IntArray
    weight: FloatArray
    r_scale: FloatArray
    reason: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class AdaptiveCarry:
    """What the inputs, the filters and the mixture take from window to window; ``scaled`` is None without F2."""

    inputs: InputCarry
    plain: FilterCarry
    scaled: FilterCarry | None
    memory: FloatArray
    last_stamp_ns: int | None
    waiting: MixtureSteps


@njit(cache=True)
def _weights(steps, low, high, memory, out):  # type: ignore[no-untyped-def]
    """Write the weight of F2 at each step; ``memory`` is updated in place."""
    dt, innovations, starts, skip, ay, noise, usual, vx, vy, vy_variance, yaw_rate = steps
    for k in range(dt.shape[0]):
        step = dt[k] if dt[k] <= RESTART_GAP_S else 0.0
        if starts[k] or step == 0.0:
            memory[:] = 0.0
            memory[: 2 * LAG_STEPS] = math.nan
        usable = math.isfinite(innovations[k, 0]) and math.isfinite(innovations[k, 1]) and not skip[k]
        straight = abs(ay[k]) < STRAIGHT_AY_M_S2 and abs(yaw_rate[k]) < STRAIGHT_YAW_RATE_RAD_S
        gain = 1.0 - math.exp(-step / MEAN_S)
        for i in range(2):
            nu = math.nan
            last = M_INNOVATION + i * LAG_STEPS
            if usable:
                nu = innovations[k, i]
                if straight:
                    memory[M_BIAS + i] += (1.0 - math.exp(-step / BIAS_S)) * (nu - memory[M_BIAS + i])
                nu -= memory[M_BIAS + i]
                before = memory[last + LAG_STEPS - 1]
                if math.isfinite(before):
                    memory[M_PRODUCT + i] += gain * (nu * before - memory[M_PRODUCT + i])
            for j in range(LAG_STEPS - 1, 0, -1):
                memory[last + j] = memory[last + j - 1]
            memory[last] = nu
        # What a mean over so few products of white noise may be by chance.
        chance = 2.0 * noise[k] * noise[k] * math.sqrt(0.5 * step / MEAN_S)
        evidence = memory[M_PRODUCT] - FREEDOM * max(memory[M_PRODUCT + 1], 0.0) - chance
        tau = ATTACK_S if evidence > memory[M_EVIDENCE] else RELEASE_S if evidence > -2.0 * chance else DISPROVED_S
        memory[M_EVIDENCE] += (1.0 - math.exp(-step / tau)) * (max(evidence, 0.0) - memory[M_EVIDENCE])
        v = max(vx[k], 1.0)
        needed = 1.0 + vy_variance[k] / (v * UNCERTAIN_RAD) ** 2
        share = min(1.0, max(0.0, (memory[M_EVIDENCE] / (needed * usual[k] ** 2) - low) / (high - low)))
        sideslip = abs(math.atan2(vy[k], v))
        fade = min(1.0, max(0.0, (SIDESLIP_TO_RAD - sideslip) / (SIDESLIP_TO_RAD - SIDESLIP_FROM_RAD)))
        out[k] = share * fade if math.isfinite(share * fade) else 0.0


@njit(cache=True)
def _mix(w, first, second, P1, P2, x, P):  # type: ignore[no-untyped-def]
    """Write the mixtures of states [N, 4] and covariances [N, 3, 3]; the first three states have a covariance."""
    for k in range(w.shape[0]):
        if w[k] <= 0.0:
            x[k] = first[k]
            P[k] = P1[k]
            continue
        if w[k] >= 1.0:
            x[k] = second[k]
            P[k] = P2[k]
            continue
        for i in range(4):
            x[k, i] = first[k, i] + w[k] * (second[k, i] - first[k, i])
        for i in range(3):
            for j in range(3):
                spread = (second[k, i] - first[k, i]) * (second[k, j] - first[k, j])
                P[k, i, j] = (1.0 - w[k]) * P1[k, i, j] + w[k] * P2[k, i, j] + w[k] * (1.0 - w[k]) * spread


def mix(weight: FloatArray, first: StateTrack, second: StateTrack) -> StateTrack:
    """Return (1 − w) of the first track and w of the second as one Gaussian, its covariance with their difference.

    With d = x₂ − x₁: x = x₁ + w d, P = (1 − w) P₁ + w P₂ + w (1 − w) d dᵀ. Where only one is valid, it is the result.
    """
    w = np.where(second.valid, np.where(first.valid, weight, 1.0), 0.0)
    count = len(w)
    x, P = np.empty((count, 4)), np.empty((count, 3, 3))
    states = [np.stack([t.vx_m_s, t.vy_m_s, t.yaw_rate_rad_s, t.ay_m_s2], axis=1) for t in (first, second)]
    _mix(w, states[0], states[1], first.covariance, second.covariance, x, P)
    mostly = w > 0.5
    return replace(
        first,
        vx_m_s=x[:, 0].copy(),
        vy_m_s=x[:, 1].copy(),
        yaw_rate_rad_s=x[:, 2].copy(),
        ay_m_s2=x[:, 3].copy(),
        sideslip_rad=np.arctan2(x[:, 1], x[:, 0]),
        covariance=P,
        sideslip_std_rad=sideslip_std(x[:, 0], x[:, 1], P),
        nis=np.where(mostly, second.nis, first.nis),
        nis_dof=np.where(mostly, second.nis_dof, first.nis_dof),
        friction=np.where(first.valid, first.friction, second.friction),
        valid=first.valid | second.valid,
        diverged=np.where(mostly, second.diverged, first.diverged),
        **_mixed_columns(w, first, second),
    )


def _mixed_columns(w: FloatArray, first: StateTrack, second: StateTrack) -> dict[str, Any]:
    """Return what the second track estimates beside the motion, mixed; a force scale that the first has not is 0."""
    mixed = {}
    for name in ESTIMATED_COLUMNS:
        b: FloatArray = getattr(second, name)
        if len(b) == len(second):
            a = getattr(first, name) if len(getattr(first, name)) == len(first) else np.zeros(len(b))
            a = np.where(first.valid, a, np.nan)
            mixed[name] = np.where(w <= 0.0, a, np.where(w >= 1.0, b, a + w * (b - a)))
    return mixed


@dataclass(frozen=True, slots=True)
class AdaptivePhysics:
    """The filter of this file as an estimator.

    Parameters
    ----------
    physics : the car's filter with its parts and noise, which is F1.
    network : what its model lacks, None without; trust : share of that which both filters take, in [0, 1].
    adaptive : False leaves the mechanism out: no detector, and F1 alone.
    evidence_low, evidence_high : between which F2 gains its weight, over the noise variance of a_y.
    notes : what the report says of it, such as the reason for its trust.
    """

    physics: PhysicsFilter
    network: NetworkService | None = None
    trust: float = 0.0
    adaptive: bool = True
    evidence_low: float = EVIDENCE_LOW
    evidence_high: float = EVIDENCE_HIGH
    name: str = "pd-hef"
    causal: bool = True
    notes: tuple[str, ...] = ()

    @property
    def scaled(self) -> PhysicsFilter | None:
        """F2; None where there is no mixture."""
        vehicle = self.physics.vehicle
        if not self.adaptive or vehicle.physics.force_scale:
            return None
        parts = vehicle.physics.model_copy(update={"force_scale": True})
        read_with = self.physics.read_with or vehicle
        return replace(self.physics, vehicle=vehicle.model_copy(update={"physics": parts}), read_with=read_with)

    def inputs(self, signals: Signals, carry: InputCarry | None) -> tuple[CheckedInputs, InputCarry]:
        """Return what the filters take: checked signals with the residual at trust 1; and the carry."""
        if self.adaptive:
            return check_inputs(self.physics, self.network, signals, carry)
        rate, after = residual_rate(self.physics, self.network, signals, carry)
        return CheckedInputs(no_faults(signals), rate), after

    def run(self, signals: Signals, carry: AdaptiveCarry | None) -> tuple[StateTrack, AdaptiveCarry]:
        """Process one window (see :class:`~.base.Estimator`)."""
        c = carry
        checked, inputs = self.inputs(signals, c.inputs if c else None)
        faults, rate = checked.faults, self.trust * checked.rate
        plain, plain_after = self.physics.filter_steps(faults.filtered, c.plain if c else None, rate, faults.extra_r)
        weight, memory, second, scaled_carry = np.zeros(len(signals)), np.zeros(MEMORY), None, None
        if (twin := self.scaled) is not None:
            before = c.scaled if c else None
            scaled, scaled_after = twin.filter_steps(faults.filtered, before, rate, faults.extra_r)
            weight, memory = self._mixture(plain, scaled, faults, c)
            # Only what the mixture takes is predicted to the stamps.
            scaled = replace(scaled, valid=scaled.valid & ((weight > 0.0) | ~plain.valid))
            plain = replace(plain, valid=plain.valid & ((weight < 1.0) | ~scaled.valid))
            second, scaled_carry = twin.outputs(signals, before, scaled, scaled_after)
        track, plain_carry = self.physics.outputs(signals, c.plain if c else None, plain, plain_after)

        r_std = self.physics.measurement_std
        steps = MixtureSteps(signals.ready_ns, weight, r_scale(faults.extra_r, r_std), faults.reason)
        if c is not None:
            steps = c.waiting.joined(steps)
        released = release(steps.ready_ns, signals.stamps_ns)
        at = released.at
        if second is not None:
            track = mix(steps.weight[at], track, second)
        told: dict[str, Any] = {"network_trust": np.where(track.valid, self.trust, np.nan)}
        if self.adaptive:
            told["r_scale"] = np.where(track.valid, steps.r_scale[at], 1.0)
            told["mixture_weight"] = np.where(track.valid, steps.weight[at], np.nan)
            told["reason"] = np.where(released.arrived, steps.reason[at], 0)
        track = replace(track, name=self.name, **told)
        last = last_stamp_ns(signals.stamps_ns, c.last_stamp_ns if c else None)
        return track, AdaptiveCarry(inputs, plain_carry, scaled_carry, memory, last, steps.since(released.needed))

    def _mixture(
        self, plain: PosteriorSteps, scaled: PosteriorSteps, faults: SensorFaults, carry: AdaptiveCarry | None
    ) -> tuple[FloatArray, FloatArray]:
        """Return the weight of F2 at each step and the memory after the window."""
        count = len(plain.stamps_ns)
        memory = np.zeros(MEMORY) if carry is None else carry.memory.copy()
        dt = step_durations_s(plain.stamps_ns, carry.last_stamp_ns if carry else None)
        innovations = np.stack([plain.innovation[:, Z_AY], scaled.innovation[:, Z_AY]], axis=1)
        starts: BoolArray = ~np.isfinite(plain.prior[:, VX])
        skip = faults.extra_r[:, AY] > 0.0
        usual = np.maximum(faults.usual_std[:, AY], IDENTIFIED_SHARE * self.physics.measurement_std[Z_AY])
        out = np.empty(count)
        given = (
            dt, innovations, starts, skip, faults.filtered.ay_m_s2, faults.noise_std[:, AY], usual,
            plain.x[:, VX], plain.x[:, VY], plain.P[:, VY, VY], plain.x[:, YAW_RATE],
        )  # fmt: skip
        _weights(given, self.evidence_low, self.evidence_high, memory, out)
        return out, memory


def build(name: str, car: Car, options: Options) -> AdaptivePhysics:
    """Return ``physics`` of a car."""
    return AdaptivePhysics(of_car(car, use_speed=options.use_speed), name=name)
