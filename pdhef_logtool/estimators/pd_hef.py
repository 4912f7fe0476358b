"""``pd-hef`` and ``pd-hef-smoothed``: which algorithm they are on a car, by the trust that its evidence allows.

Without evidence a hybrid filter at trust 0 would be a single-track filter with noise that was chosen for a network; the
strongest filter on physics stands in its place (:mod:`~.cautious`).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.estimators.adaptive_hybrid import adaptive_hybrid_ukf
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.cautious import CautiousPhysics, strongest_physics
from pdhef_logtool.estimators.hybrid import FILTER
from pdhef_logtool.estimators.physics_tuned import NAME as TUNED
from pdhef_logtool.estimators.smoothed import SmoothedHybrid, smoothed_hybrid

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.table import Options


def build(name: str, car: Car, options: Options) -> Estimator:
    """Return the adaptive hybrid filter, or the strongest filter on physics behind its detector where trust is 0."""
    del name
    trust, notes = _trust(car, options)
    if trust == 0.0:
        physics = strongest_physics(car, use_speed=options.use_speed)
        said = f"without trust in its network it is {physics.name}, with faulty samples of a_y and gyro left out"
        return CautiousPhysics(physics, notes=(*notes, said))
    noise = car.noise.get(FILTER)
    network = options.service(car)
    return adaptive_hybrid_ukf(car.vehicle, network, noise, trust=trust, use_speed=options.use_speed, notes=notes)


def build_smoothed(name: str, car: Car, options: Options) -> SmoothedHybrid:
    """Return the hybrid filter smoothed; where trust is 0 and ``phy-ukf-tuned`` is best, that one smoothed.

    Where ``physics`` is best, the hybrid filter at trust 0 is smoothed.
    """
    trust, notes = _trust(car, options)
    network, use_speed = options.service(car), options.use_speed
    if trust > 0.0 or strongest_physics(car).name != TUNED:
        noise = car.noise.get(name, car.noise.get(FILTER))
        return smoothed_hybrid(car.vehicle, network, noise, trust=trust, use_speed=use_speed, notes=notes)
    forward = strongest_physics(car)
    assert forward.r_std is not None  # it has every measurement
    ay_std, yaw_rate_std, speed_std = forward.r_std
    noise = FilterNoise(q_std=forward.q_std, r_std={"ay_m_s2": ay_std, "yaw_rate_rad_s": yaw_rate_std})
    sensors = car.vehicle.sensors.model_copy(update={"speed_std_m_s": speed_std})
    own = car.vehicle.model_copy(update={"sensors": sensors})
    said = f"without trust in its network it is {TUNED}, smoothed"
    smoothed = smoothed_hybrid(own, network, noise, trust=0.0, use_speed=use_speed, notes=(*notes, said))
    return replace(smoothed, bias_states=False)  # as the filter whose noise it has


def _trust(car: Car, options: Options) -> tuple[float, tuple[str, ...]]:
    if options.trust is not None:
        return options.trust, ()
    allowed = car.allowed_trust
    return allowed.cap, (allowed.note,)
