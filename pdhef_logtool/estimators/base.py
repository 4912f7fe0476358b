"""What an estimator is, and the release of its output at the scored stamps."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from pdhef_logtool.signals import IntArray, Signals
from pdhef_logtool.tracks import StateTrack

#: An output is not predicted further than this beyond the newest processed step; the stamp is then not valid.
MAX_PREDICTION_S = 0.3


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


def released_steps(ready_ns: IntArray, stamps_ns: IntArray) -> IntArray:
    """Return for each scored stamp the newest step whose data had arrived by then, −1 for none.

    ``ready_ns`` [K] is non-decreasing, ``stamps_ns`` [M]; the result is int64 [M] (METHOD §1, §6 "Delay").
    """
    return np.searchsorted(ready_ns, stamps_ns, side="right").astype(np.int64) - 1
