"""Innovations of filters by channel, on a minute of a drive: what a whole track's NIS does not distinguish.

``mean`` and ``rms`` in the channel's unit; ``autocorrelation`` from one sample of the channel to the next. White
innovations of a right model have mean 0 and an autocorrelation within ± 2/√n.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pdhef_logtool.estimators.adaptive_physics import AdaptivePhysics
from pdhef_logtool.estimators.base import Estimator
from pdhef_logtool.estimators.phy_ukf import PhysicsUkf
from pdhef_logtool.estimators.physics_filter import PhysicsFilter
from pdhef_logtool.records.signals import SIGNAL_UNITS, FloatArray, Signals
from pdhef_logtool.runs.drive_sample import DriveSample, bare_filter

#: The channels of a filter in the order of its innovations.
CHANNELS = ("ay_m_s2", "yaw_rate_rad_s", "speed_m_s")
#: Of fewer pairs no autocorrelation is given.
LEAST_PAIRS = 10


@dataclass(frozen=True, slots=True)
class ChannelInnovations:
    """Innovations of one channel of one filter: ``n`` samples; NaN where too few."""

    estimator: str
    channel: str
    unit: str
    n: int
    mean: float
    rms: float
    autocorrelation: float


def channel_innovations(estimators: Sequence[Estimator], sample: DriveSample) -> list[ChannelInnovations]:
    """Return the innovations of those estimators that have any, by channel; a channel without a sample has no row."""
    innovations = []
    for estimator in estimators:
        nu = _innovations(*bare_filter(estimator, sample.signals))
        if nu is None:
            continue
        for column, channel in enumerate(CHANNELS):
            values = nu[:, column]
            scored = np.flatnonzero((sample.block >= 0) & np.isfinite(values))
            if scored.size:
                x, block = values[scored], sample.block[scored]
                pair = block[1:] == block[:-1]
                innovations.append(
                    ChannelInnovations(
                        estimator=estimator.name,
                        channel=channel,
                        unit=SIGNAL_UNITS[channel],
                        n=int(scored.size),
                        mean=float(x.mean()),
                        rms=float(np.sqrt(np.mean(x**2))),
                        autocorrelation=_correlation(x[:-1][pair], x[1:][pair]),
                    )
                )
    return innovations


def _innovations(estimator: Estimator, signals: Signals) -> FloatArray | None:
    """Return [M, 3], NaN where a channel has no sample; None for an estimator without."""
    if isinstance(estimator, AdaptivePhysics):
        checked, _ = estimator.inputs(signals, None)
        rate = estimator.trust * checked.rate
        steps, _ = estimator.filters[0].run(checked.faults.filtered, None, rate, checked.faults.extra_r)
        return steps.innovation
    if isinstance(estimator, PhysicsUkf | PhysicsFilter):
        return estimator.run(signals, None)[0].innovation
    return None


def _correlation(x: FloatArray, y: FloatArray) -> float:
    if x.size < LEAST_PAIRS:
        return float("nan")
    x, y = x - x.mean(), y - y.mean()
    power = float(np.sqrt(np.sum(x**2) * np.sum(y**2)))
    return float(np.sum(x * y)) / power if power > 0.0 else float("nan")
