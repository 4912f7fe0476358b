"""The interface of estimators: steps on measurement time, from which the scored tracks are computed.

An estimator returns one step per sample of a window, each from that sample and earlier ones, and has no access to
scored stamps. :mod:`~.latency_compensation` determines for all estimators which step is available at a scored stamp,
and how far it is extrapolated.
"""

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray, Signals
from pdhef_logtool.records.steps import Extrapolation, StepColumns
from pdhef_logtool.records.tracks import StateTrack, make_track

# Entries of a step's values and of their time derivatives.
VX, VY, YAW_RATE, AY = 0, 1, 2, 3
QUANTITIES = ("vx_m_s", "vy_m_s", "yaw_rate_rad_s", "ay_m_s2")


@dataclass(frozen=True, slots=True, eq=False)
class Steps(StepColumns):
    """Estimates on measurement time, [K]: the state after the update with all samples of the stamp.

    ``values`` [K, 4] over [v_x, v_y, r, a_y], NaN where unknown; ``rates`` [K, 4] their time derivatives for the
    latency compensation; ``valid`` [K].
    """

    values: FloatArray
    rates: FloatArray
    valid: BoolArray


def make_steps(
    vx_m_s: FloatArray, vy_m_s: FloatArray, yaw_rate_rad_s: FloatArray, ay_m_s2: FloatArray | None = None
) -> Steps:
    """Return steps of quantities [K] without rates, NaN where unknown; valid where v_x and yaw rate are finite."""
    ay = np.full(len(vx_m_s), np.nan) if ay_m_s2 is None else ay_m_s2
    values = np.stack([vx_m_s, vy_m_s, yaw_rate_rad_s, ay], axis=1)
    return Steps(values, np.zeros_like(values), np.isfinite(vx_m_s) & np.isfinite(yaw_rate_rad_s))


class Estimator(Protocol):
    """An algorithm with a name: a :class:`StepEstimator` or a :class:`Smoother`."""

    @property
    def algorithm(self) -> str:
        """Stable name of the algorithm, a class attribute, for example ``vehicle-ukf`` (:mod:`~.algorithm`)."""

    @property
    def version(self) -> int:
        """Version of the algorithm, a class attribute: incremented when the same inputs give other estimates."""

    @property
    def name(self) -> str:
        """Name in the tables, for example ``phy-ukf``."""

    @property
    def causal(self) -> bool:
        """Whether each step uses only its own sample and earlier ones; checked in every run."""


class StepEstimator(Estimator, Protocol):
    """Converts aligned signals to steps; immutable: its only memory is the state that it returns."""

    def run(self, signals: Signals, state: Any | None) -> tuple[Any, Any]:
        """Process one window.

        Parameters
        ----------
        signals : the window. state : the state returned for the previous window, None at the start of a log.

        Returns
        -------
        steps : one row per stamp of ``signals``: :class:`Steps`, or another record if the estimator is a
            :class:`ModelPredictor`. Joined steps of consecutive windows equal one call over the whole log bit for bit.
        state : for the next window.
        """


@runtime_checkable
class ModelPredictor(Protocol):
    """An estimator that extrapolates its steps with its model; others are extrapolated by their rates."""

    def predict(self, steps: Any, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
        """Return the track at the scored stamps [M]; rows that are not ``usable`` are not valid."""


@runtime_checkable
class Smoother(Estimator, Protocol):
    """An estimator that is not causal and returns the track of a drive from all of its samples."""

    def smooth(self, signals: Signals) -> StateTrack:
        """Return the track of a drive at the stamps of its signals [N]."""


def predict_track(estimator: Estimator, steps: Any, ahead: Extrapolation, stamps_ns: IntArray) -> StateTrack:
    """Extrapolate steps to the scored stamps [M], by the estimator's model, otherwise to first order by their rates."""
    if isinstance(estimator, ModelPredictor):
        return estimator.predict(steps, ahead, stamps_ns)
    out = steps.values[ahead.step] + steps.rates[ahead.step] * ahead.horizon_s[:, None]
    out[~ahead.usable] = np.nan
    columns = dict(zip(QUANTITIES, out.T.copy(), strict=True))
    return make_track(estimator.name, stamps_ns, **columns, valid=ahead.usable)


def notes_of(estimator: Estimator) -> tuple[str, ...]:
    """Return the notes on an estimator for the report; empty for most."""
    return tuple(getattr(estimator, "notes", ()))
