"""``pd-hef`` where no evidence lets it follow its network: the strongest filter on physics, with checked sensors.

A hybrid filter at trust 0 is a single-track filter on the nominal model alone, and the noise that belongs to it was
chosen with a network. Without evidence (METHOD §14) the estimate comes from a filter on physics instead, and the fault
detector of ``pd-hef`` takes stuck, dead and spiking samples away from it. Which filter is decided by drives with truth:

- the better of ``phy-ukf-tuned`` and ``physics-plus`` by the scores that ``pdhef tune`` left in the vehicle file;
- without such scores ``phy-ukf-tuned``, where ``pdhef identify`` chose its noise on this car;
- else ``physics-plus``, the better one on simulated cars (docs/many_cars.md).
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from pdhef_logtool.car.vehicle import FilterTuning, VehicleParameters
from pdhef_logtool.estimators.adaptive_hybrid import MixtureSteps, adaptive_hybrid_ukf
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.physics import FilterCarry, PhysicsUkf
from pdhef_logtool.estimators.physics_plus import NAME as PLUS
from pdhef_logtool.estimators.physics_plus import PhysicsPlusUkf, physics_plus
from pdhef_logtool.estimators.physics_tuned import NAME as TUNED
from pdhef_logtool.estimators.physics_tuned import physics_ukf_tuned
from pdhef_logtool.estimators.smoothed import TABLE as SMOOTHED
from pdhef_logtool.estimators.smoothed import SmoothedHybrid, smoothed_hybrid
from pdhef_logtool.records.release import released_steps
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.service import NetworkService
from pdhef_logtool.watches.sensor_faults import FaultCarry, find_faults

_SCORE = re.compile(r"(?P<name>[a-z-]+): (?P<deg>[0-9.]+) deg\b.*")


@dataclass(frozen=True, slots=True)
class CautiousCarry:
    """What detector and filter take from window to window."""

    faults: FaultCarry
    physics: FilterCarry
    waiting: MixtureSteps


@dataclass(frozen=True, slots=True)
class CautiousPhysics:
    """A filter on physics behind the fault detector.

    Parameters
    ----------
    physics : the filter, with the noise of the vehicle file.
    notes : what the report says of it.
    """

    physics: PhysicsUkf | PhysicsPlusUkf
    name: str = "pd-hef"
    causal: bool = True
    notes: tuple[str, ...] = ()

    @property
    def needs(self) -> frozenset[str]:
        """What the filter needs."""
        return self.physics.needs

    @property
    def calibrated_as(self) -> str:
        """Whose calibrated intervals hold for it."""
        return self.physics.name

    def run(self, signals: Signals, carry: CautiousCarry | None) -> tuple[StateTrack, CautiousCarry]:
        """Filter one window; joined windows give the same bits as one call over the whole log."""
        faults, fault_carry = find_faults(signals, self.physics.vehicle, carry.faults if carry else None)
        track, physics = self.physics.run(faults.filtered, carry.physics if carry else None)
        count = len(signals)
        steps = MixtureSteps(signals.ready_ns, np.zeros(count), np.ones(count), faults.reason)
        if carry is not None:
            steps = carry.waiting.joined(steps)
        index = released_steps(steps.ready_ns, signals.stamps_ns)
        unknown = np.where(track.valid, 0.0, np.nan)
        reason = np.where(index >= 0, steps.reason[np.maximum(index, 0)], 0) if count else np.empty(0, dtype=np.int64)
        track = replace(track, name=self.name, network_trust=unknown, mixture_weight=unknown, reason=reason)
        newest = max(int(index[-1]), 0) if count else 0
        return track, CautiousCarry(fault_carry, physics, steps.since(newest))


def strongest_physics(vehicle: VehicleParameters, *, use_speed: bool = True) -> PhysicsUkf | PhysicsPlusUkf:
    """Return the filter on physics that drives with truth say is the best on this car (see the head of the file)."""
    listed = vehicle.identification.get("tuning_scores", [])
    found = [m for text in (listed if isinstance(listed, list) else []) if (m := _SCORE.fullmatch(text))]
    scores = {m["name"]: float(m["deg"]) for m in found}
    if TUNED not in vehicle.filter:
        better = PLUS
    elif PLUS not in vehicle.filter or not {TUNED, PLUS} <= scores.keys():
        better = TUNED
    else:
        better = min(TUNED, PLUS, key=lambda name: scores[name])
    if better == TUNED:
        return physics_ukf_tuned(vehicle, use_speed=use_speed)
    return physics_plus(vehicle, use_speed=use_speed)


def at_trust(
    vehicle: VehicleParameters,
    network: NetworkService,
    trust: float,
    *,
    use_speed: bool = True,
    notes: tuple[str, ...] = (),
) -> Estimator:
    """Return ``pd-hef`` at a trust in [0, 1]: the adaptive hybrid filter, or this file's where it is 0."""
    if trust == 0.0:
        physics = strongest_physics(vehicle, use_speed=use_speed)
        said = f"without trust in its network it is {physics.name}, with faulty samples of a_y and gyro left out"
        return CautiousPhysics(physics, notes=(*notes, said))
    return adaptive_hybrid_ukf(vehicle, network, trust=trust, use_speed=use_speed, notes=notes)


def smoothed_at_trust(
    vehicle: VehicleParameters,
    network: NetworkService,
    trust: float,
    *,
    use_speed: bool = True,
    notes: tuple[str, ...] = (),
) -> SmoothedHybrid:
    """Return ``pd-hef-smoothed`` at a trust in [0, 1]; where it is 0 and ``phy-ukf-tuned`` is best, that one smoothed.

    ``physics-plus`` has no smoother: where it is best, the hybrid filter at trust 0 is smoothed.
    """
    if trust > 0.0 or strongest_physics(vehicle).name != TUNED:
        return smoothed_hybrid(vehicle, network, trust=trust, use_speed=use_speed, notes=notes)
    forward = physics_ukf_tuned(vehicle)
    assert forward.r_std is not None  # it has every measurement
    ay_std, yaw_rate_std, speed_std = forward.r_std
    noise = FilterTuning(q_std=forward.q_std, r_std={"ay_m_s2": ay_std, "yaw_rate_rad_s": yaw_rate_std})
    sensors = vehicle.sensors.model_copy(update={"speed_std_m_s": speed_std})
    own = vehicle.model_copy(update={"filter": {SMOOTHED: noise}, "sensors": sensors})
    said = f"without trust in its network it is {TUNED}, smoothed"
    smoothed = smoothed_hybrid(own, network, trust=0.0, use_speed=use_speed, notes=(*notes, said))
    return replace(smoothed, bias_states=False)  # as the filter whose noise it has
