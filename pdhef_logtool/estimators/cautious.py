"""``pd-hef`` where no evidence lets it follow its network: the strongest filter on physics, with checked sensors.

A hybrid filter at trust 0 is a single-track filter on the nominal model alone, and the noise that belongs to it was
chosen with a network. Without evidence (METHOD §14) the estimate comes from a filter on physics instead, and the fault
detector of ``pd-hef`` takes stuck, dead and spiking samples away from it. Which filter is decided by drives with truth:

- ``physics``, where ``pdhef identify`` found the car through it;
- else the better of ``phy-ukf-tuned`` and ``physics`` by the scores that ``pdhef tune`` left beside their noise;
- without such scores ``phy-ukf-tuned``, where ``pdhef identify`` chose its noise on this car;
- else ``physics``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.estimators.adaptive_hybrid import MixtureSteps
from pdhef_logtool.estimators.physics import FilterCarry, PhysicsUkf
from pdhef_logtool.estimators.physics_tuned import NAME as TUNED
from pdhef_logtool.estimators.physics_tuned import physics_ukf_tuned
from pdhef_logtool.estimators.physics_ukf import PhysicsFilter, of_car
from pdhef_logtool.records.release import released_steps
from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.watches.sensor_faults import FaultCarry, find_faults

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car


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
    physics : the filter, with the noise of the car.
    notes : what the report says of it.
    """

    physics: PhysicsUkf | PhysicsFilter
    name: str = "pd-hef"
    causal: bool = True
    notes: tuple[str, ...] = ()

    @property
    def calibrated_as(self) -> PhysicsUkf | PhysicsFilter:
        """Whose calibrated intervals hold for it where it has none of its own."""
        return self.physics

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


def strongest_physics(car: Car, *, use_speed: bool = True) -> PhysicsUkf | PhysicsFilter:
    """Return the filter on physics that drives with truth say is the best on this car (see the head of the file)."""
    scores = {n: s for n in (TUNED, PHYSICS) if n in car.noise and (s := car.noise[n].score_deg) is not None}
    if car.fitted_physics is not None or TUNED not in car.noise:
        better = PHYSICS
    elif len(scores) < 2:
        better = TUNED
    else:
        better = min(TUNED, PHYSICS, key=lambda name: scores[name])
    if better == TUNED:
        return physics_ukf_tuned(car.vehicle, car.noise[TUNED], use_speed=use_speed)
    return of_car(car, use_speed=use_speed)
