"""The hybrid filter with fixed settings: a grid of trust, σ of a_y, and a factor on the process noise.

It answers what an adaptive mechanism has to beat: the one fixed setting that is best on calibration drives, and, per
row, the one that nobody could have known beforehand. All settings share one pass of the network.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.latency_compensation import compensate
from pdhef_logtool.evaluation.metrics import ALL, MetricRow
from pdhef_logtool.records.signals import Signals
from studies.condition_drives import ConditionDrive, bin_masks, rmse_row

TRUSTS = (0.0, 0.5, 1.0)
#: Factors on the 1-sigma of a_y and on all of the process noise, from those of the hybrid filter with fixed noise.
AY_FACTORS = (0.5, 1.0, 2.0)
Q_FACTORS = (0.5, 1.0, 2.0)
PREFIX = "fixed"
#: The estimator whose trust and noise the grid varies.
BASE = "pd-hef:fixed-r"
#: What the best setting on the calibration drives is called in the tables.
BEST = "fixed-best"


@dataclass(frozen=True, slots=True)
class Setting:
    """One point of the grid."""

    trust: float
    ay_factor: float
    q_factor: float

    @property
    def name(self) -> str:
        """Name in the tables."""
        return f"{PREFIX}(trust {self.trust:g}, R {self.ay_factor:g}, Q {self.q_factor:g})"


GRID = tuple(Setting(*point) for point in product(TRUSTS, AY_FACTORS, Q_FACTORS))


def is_setting(name: str) -> bool:
    """Tell whether an estimator's name is one of the grid."""
    return name.startswith(f"{PREFIX}(")


def at(base: AdaptivePhysics, setting: Setting) -> AdaptivePhysics:
    """Return the filter at a point of the grid."""
    physics = base.physics
    ay, rate, speed = physics.measurement_std.tolist()
    q_std = tuple(setting.q_factor * q for q in physics.q_std)
    changed = replace(physics, q_std=q_std, r_std=(setting.ay_factor * ay, rate, speed), name=setting.name)
    return replace(base, physics=changed, trust=setting.trust, name=setting.name)


def run_grid(base: AdaptivePhysics, signals: Signals, drive: ConditionDrive) -> Iterator[MetricRow]:
    """Yield the sideslip RMSE and availability of every setting, over everything and in the nonlinear range."""
    rate = base.inputs(signals, None)[0].rate
    masks = {name: m for name, m in bin_masks(drive).items() if name in (ALL, "nonlinear")}
    for setting in GRID:
        physics = at(base, setting).physics
        track, _ = compensate(physics, signals, physics.run(signals, None, setting.trust * rate)[0])
        error = drive.error(track)
        for segment, mask in masks.items():
            yield from rmse_row(drive.name, setting.name, segment, error[mask])
