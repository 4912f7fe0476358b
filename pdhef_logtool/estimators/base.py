"""What an estimator is, and the release of its output at the scored stamps."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

from pdhef_logtool.records.signals import Signals
from pdhef_logtool.records.tracks import StateTrack


class Estimator(Protocol):
    """Turns aligned signals into estimates; immutable, so that its only memory is the carry."""

    @property
    def algorithm(self) -> str:
        """Stable name of the algorithm, a class attribute, for example ``physics-ukf`` (:mod:`~.algorithm`)."""
        ...

    @property
    def version(self) -> int:
        """Version of the algorithm, a class attribute: raised whenever the same inputs give other estimates."""
        ...

    @property
    def name(self) -> str:
        """Name in the tables, for example ``phy-ukf``."""
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
