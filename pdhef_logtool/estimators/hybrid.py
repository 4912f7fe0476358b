"""The hybrid filter: the network's residual enters the sigma points and the predicted a_y (METHOD §6, Eq 19-21)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.car.parts import FilterNoise
from pdhef_logtool.car.vehicle import VehicleParameters
from pdhef_logtool.estimators.parallel_physics import parallel_filter, run_features
from pdhef_logtool.estimators.physics import FilterCarry, PhysicsUkf
from pdhef_logtool.records.signals import FloatArray, Signals
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.residual_model.service import NetworkCarry, NetworkService

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.table import Options

#: Name under which a car holds this filter's noise.
FILTER = "pd-hef"
#: Used where the car has none. Measurement noise at model-error level (METHOD §6): a_y m/s², yaw rate rad/s;
#: the speed's is the sensor's.
HYBRID_R_STD = (1.0, 0.003)
HYBRID_Q_STD = (0.089, 0.06, 0.03, 0.021)


@dataclass(frozen=True, slots=True, eq=False)
class HybridCarry:
    """What the parallel filter, the network and the hybrid filter take from window to window."""

    physics: FilterCarry
    network: NetworkCarry
    hybrid: FilterCarry


@dataclass(frozen=True, slots=True)
class HybridUkf:
    """Unscented filter on the nominal model plus trust times the network's residual; fixed R and trust.

    Parameters
    ----------
    trust : β of Eq 19 in [0, 1].
    q_std, r_std, slip_gate : as for :class:`~.physics.PhysicsUkf`; ``r_std`` without the speed's.
    """

    vehicle: VehicleParameters
    network: NetworkService
    trust: float = 1.0
    q_std: tuple[float, float, float, float] = HYBRID_Q_STD
    r_std: tuple[float, float] = HYBRID_R_STD
    use_speed: bool = True
    slip_gate: bool = True
    name: str = "pd-hef-fixed-r"
    causal: bool = True

    @property
    def filter(self) -> PhysicsUkf:
        """The filter that the residual goes into."""
        return PhysicsUkf(
            self.vehicle,
            q_std=self.q_std,
            r_std=(*self.r_std, self.vehicle.sensors.speed_std_m_s),
            use_speed=self.use_speed,
            slip_gate=self.slip_gate,
            roll_correction=True,
            name=self.name,
        )

    def run(self, signals: Signals, carry: HybridCarry | None) -> tuple[StateTrack, HybridCarry]:
        """Process one window (see :class:`~.base.Estimator`)."""
        rate, physics, network = self.residual_rate(signals, carry)
        track, hybrid = self.filter.run(signals, carry.hybrid if carry else None, self.trust * rate)
        trust = np.where(track.valid, self.trust, np.nan)
        return replace(track, network_trust=trust), HybridCarry(physics, network, hybrid)

    def residual_rate(
        self, signals: Signals, carry: HybridCarry | None
    ) -> tuple[FloatArray, FilterCarry, NetworkCarry]:
        """Return the network's residual rate [N, 2] in m/s² and rad/s², which no noise of this filter changes."""
        features, steps, physics = run_features(
            parallel_filter(self.vehicle, use_speed=self.use_speed, slip_gate=self.slip_gate),
            signals,
            carry.physics if carry else None,
        )
        starts = ~np.isfinite(steps.prior[:, 0])
        rate, network = self.network.run(features, starts, carry.network if carry else None)
        return rate, physics, network


def hybrid_ukf(
    vehicle: VehicleParameters,
    network: NetworkService,
    noise: FilterNoise | None = None,
    *,
    trust: float = 1.0,
    use_speed: bool = True,
    name: str = "pd-hef-fixed-r",
) -> HybridUkf:
    """Return the filter with a noise; what that leaves out is the default."""
    noise = noise or FilterNoise()
    q = (*noise.q_std, *HYBRID_Q_STD[len(noise.q_std) :])
    r = (noise.r_std.get("ay_m_s2", HYBRID_R_STD[0]), noise.r_std.get("yaw_rate_rad_s", HYBRID_R_STD[1]))
    return HybridUkf(
        vehicle,
        network,
        trust=trust,
        q_std=(q[0], q[1], q[2], q[3]),
        r_std=r,
        use_speed=use_speed,
        name=name,
    )


def build(name: str, car: Car, options: Options) -> HybridUkf:
    """Return the hybrid filter at a fixed trust: 0 for ``pd-hef-trust0``, else 1, unless the options have one."""
    usual = 0.0 if name == "pd-hef-trust0" else 1.0
    trust = usual if options.trust is None else options.trust
    noise = car.noise.get(FILTER)
    return hybrid_ukf(car.vehicle, options.service(car), noise, trust=trust, use_speed=options.use_speed, name=name)
