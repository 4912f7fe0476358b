"""Check in every run that an estimator which declares itself causal does not look ahead.

The harness compensates latency (:mod:`~.latency_compensation`), so that an estimate can only see the future through its
steps: step k of a causal estimator is the same for any samples after k. The check runs a window again from the same
state with the samples behind a few stamps masked, and compares the steps before them.
"""

from copy import deepcopy
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pdhef_logtool.estimators.base import Estimator, StepEstimator
from pdhef_logtool.records.signals import Signals

#: A full check masks samples behind two stamps, one anywhere and one among the first samples; a short one behind the
#: latter alone.
SHORT_CUT = 256
#: Largest relative change of a step that counts as rounding: matrix products, which networks compute in single
#: precision, may depend on the window's length.
RELATIVE_TOLERANCE = 4.0 * float(np.finfo(np.float32).eps)


@dataclass(slots=True)
class CausalityCheck:
    """The check over one drive; ``failed`` has the reason by estimator, also for other failures.

    A check that is not ``full`` costs little: the first drive of a run has the full one.
    """

    full: bool = True
    failed: dict[str, str] = field(default_factory=dict)
    _windows: dict[str, int] = field(default_factory=dict)

    def state_before(self, estimator: Estimator, state: Any) -> Any:
        """Return a copy of the state to check the next window from; None where that window is not checked."""
        number = self._windows[estimator.name] = self._windows.get(estimator.name, 0) + 1
        # Windows 1, 4, 16, 64, ...: look-ahead that the first does not show has more chances, at a falling cost.
        is_checked = number & (number - 1) == 0 and number.bit_length() % 2 == 1 if self.full else number == 1
        if not estimator.causal or not is_checked or estimator.name in self.failed:
            return None
        return (deepcopy(state),)

    def check(self, estimator: StepEstimator, signals: Signals, before: Any, steps: Any) -> None:
        """Compare the ``steps`` of a window with the steps of its first part; ``before`` from :meth:`state_before`."""
        if before is None or len(signals) < 2:
            return
        random = np.random.default_rng((len(signals), self._windows[estimator.name]))  # the same in every run
        for most in (min(len(signals), SHORT_CUT), len(signals))[: 1 + self.full]:
            count = int(random.integers(1, most))
            again, _ = estimator.run(signals.rows(0, count), deepcopy(before[0]))
            columns = zip(steps.at(slice(count)).arrays, again.arrays, strict=True)
            if not all(_agree(*pair) for pair in columns):
                self.failed[estimator.name] = (
                    "failed the causality check: it declares that it is causal, but its steps up to "
                    f"{signals.stamps_ns[count - 1]} ns change when the samples that follow are masked; declare "
                    "causal = False, or use no later sample"
                )
                return


def _agree(a: Any, b: Any) -> bool:
    """Return whether two columns are equal up to rounding, relative to the largest value."""
    if np.array_equal(a, b, equal_nan=True):
        return True
    size = float(np.abs(a[np.isfinite(a)]).max(initial=0.0))
    return a.shape == b.shape and np.allclose(a, b, 0.0, RELATIVE_TOLERANCE * size, equal_nan=True)
