"""What an estimator is, and the release of its output at the scored stamps."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Protocol, runtime_checkable

import numpy as np

from pdhef_logtool.signals import BoolArray, IntArray, Signals
from pdhef_logtool.tracks import StateTrack

#: An output is not predicted further than this beyond the newest processed step; the stamp is then not valid.
MAX_PREDICTION_S = 0.3

#: Magnitudes beyond which a reading is no motion of a ground vehicle (10 g; eight turns a second; 540 km/h; wheels
#: across): an input has no innovation that a gate could judge, and one such value would end a filter.
POSSIBLE_MAGNITUDE = {
    "steer_rad": 0.5 * math.pi,
    "ax_m_s2": 100.0,
    "ay_m_s2": 100.0,
    "yaw_rate_rad_s": 50.0,
    "speed_m_s": 150.0,
}
#: Friction below ice or above any tyre is no friction.
POSSIBLE_FRICTION = (0.01, 5.0)


class Estimator(Protocol):
    """Turns aligned signals into estimates; immutable, so that its only memory is the carry."""

    @property
    def name(self) -> str:
        """Name in the tables, for example ``phy-ukf``."""
        ...

    @property
    def needs(self) -> frozenset[str]:
        """Aligned signals without which it cannot run."""
        ...

    @property
    def causal(self) -> bool:
        """Whether an estimate at t uses only what had arrived by t."""
        ...

    def run(self, signals: Signals, carry: Any | None) -> tuple[StateTrack, Any]:
        """Process one window.

        Parameters
        ----------
        signals : the window. carry : what the previous window's call returned, None at the start of a log.

        Returns
        -------
        track : estimates at ``signals.stamps_ns``. carry : for the next window. Joining the tracks of consecutive
            windows gives the same bits as one call over the whole log.
        """
        ...


@runtime_checkable
class LookingAhead(Protocol):
    """An estimator that is not causal: beside the window it may see what follows."""

    @property
    def look_ahead_s(self) -> float:
        """How much of what follows a window it must be given for its result not to depend on the windows."""
        ...

    def run(self, signals: Signals, carry: Any | None, ahead: Signals | None = None) -> tuple[StateTrack, Any]:
        """Process one window as :meth:`Estimator.run`; ``ahead`` is what follows, and the next window begins with it.

        Without it the log ends with the window for all that the estimator knows.
        """
        ...


def look_ahead_of(estimator: Estimator) -> float:
    """Return how much of what follows a window an estimator must be given, s; 0 for a causal one."""
    return estimator.look_ahead_s if isinstance(estimator, LookingAhead) else 0.0


def run_window(
    estimator: Estimator, signals: Signals, carry: Any | None, ahead: Signals | None
) -> tuple[StateTrack, Any]:
    """Process one window; only an estimator that is not causal gets what follows."""
    if isinstance(estimator, LookingAhead):
        return estimator.run(signals, carry, ahead)
    return estimator.run(signals, carry)


def notes_of(estimator: Estimator) -> tuple[str, ...]:
    """Return what a reader of the report must know of an estimator; only some have something to say."""
    return tuple(getattr(estimator, "notes", ()))


def released_steps(ready_ns: IntArray, stamps_ns: IntArray) -> IntArray:
    """Return for each scored stamp the newest step whose data had arrived by then, −1 for none.

    ``ready_ns`` [K] is non-decreasing, ``stamps_ns`` [M]; the result is int64 [M] (METHOD §1, §6 "Delay").
    """
    return np.searchsorted(ready_ns, stamps_ns, side="right").astype(np.int64) - 1


def impossible_readings(signals: Signals) -> dict[str, BoolArray]:
    """Return by column where a reading is one that no vehicle can have, [N]; columns without any are left out."""
    bad = {c: ~(np.abs(getattr(signals, c)) <= limit) for c, limit in POSSIBLE_MAGNITUDE.items()}
    low, high = POSSIBLE_FRICTION
    bad["friction"] = ~((signals.friction >= low) & (signals.friction <= high))
    read = {c: mask & ~np.isnan(getattr(signals, c)) for c, mask in bad.items()}
    return {c: mask for c, mask in read.items() if mask.any()}


def without_impossible(signals: Signals) -> Signals:
    """Return the signals with impossible readings as missing; the same object where there are none."""
    changed: dict[str, Any] = {
        c: np.where(mask, np.nan, getattr(signals, c)) for c, mask in impossible_readings(signals).items()
    }
    return replace(signals, **changed) if changed else signals
