"""Rates, gaps and jitter of a stream of times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pdhef_logtool.records.signals import FloatArray, IntArray

#: A gap is more than this many median steps, and more than ``MIN_GAP_S``.
GAP_PERIODS = 5.0
MIN_GAP_S = 0.1
#: If the median step differs from the mean step by more, messages come in bursts.
BURST = 0.75


@dataclass(frozen=True, eq=False)
class Steps:
    """Steps between ascending times.

    Attributes
    ----------
    count : number of times. steps_s : float64 [N]. starts_ns : int64 [N], start of each step.
    """

    count: int
    steps_s: FloatArray
    starts_ns: IntArray

    @classmethod
    def of(cls, parts: Sequence[IntArray]) -> Steps:
        """Return the steps within each part, int64 [K] ascending; a step from one part to the next is left out."""
        steps = [np.diff(part) * 1e-9 for part in parts]
        starts = [part[:-1] for part in parts]
        return cls(sum(map(len, parts)), np.concatenate([np.empty(0), *steps]), np.concatenate([_NONE, *starts]))

    @cached_property
    def median_s(self) -> float:
        """Median step; NaN without a step."""
        return float(np.median(self.steps_s)) if self.steps_s.shape[0] else float("nan")

    @property
    def rate_hz(self) -> float:
        """Rate by the median step; for bursts, by the mean of the steps that are no gaps."""
        steps = self.steps_s
        if not steps.shape[0]:
            return float("nan")
        # The step that half of the time is spent in, without the longest 1 %: of bursts, that from one to the next.
        usual = np.sort(steps)[: max(1, len(steps) - max(1, len(steps) // 100))]
        half = usual[np.searchsorted(np.cumsum(usual), 0.5 * usual.sum())]
        limit = max(MIN_GAP_S, GAP_PERIODS * float(half))
        mean, median = float(steps[steps <= limit].mean()), self.median_s
        step = median if BURST * mean <= median <= mean / BURST else mean
        return 1.0 / step if step > 0.0 else float("nan")

    @property
    def jitter_p95_s(self) -> float:
        """95th percentile of |step − median|; NaN without a step."""
        steps = self.steps_s
        return float(np.quantile(np.abs(steps - self.median_s), 0.95)) if steps.shape[0] else float("nan")

    def longest(self, since_ns: int, above_s: float = MIN_GAP_S) -> tuple[float, float]:
        """Return the longest step above a limit and its start since a stamp, both in s; NaN without one."""
        i = int(np.argmax(self.steps_s)) if self.steps_s.shape[0] else 0
        if not (self.steps_s[i : i + 1] > above_s).any():
            return float("nan"), float("nan")
        return float(self.steps_s[i]), (int(self.starts_ns[i]) - since_ns) * 1e-9

    @property
    def gap_limit_s(self) -> float:
        """Steps above this limit are gaps."""
        return max(MIN_GAP_S, GAP_PERIODS * self.median_s)

    @property
    def gaps(self) -> int:
        """Number of gaps."""
        return int(np.count_nonzero(self.steps_s > self.gap_limit_s))


_NONE = np.empty(0, dtype=np.int64)


def number_text(value: float) -> str:
    """Return a number in few digits, a dash without one."""
    if not math.isfinite(value):
        return "-"
    if value == 0.0:
        return "0"
    if 100.0 <= abs(value) < 1e5:
        return f"{value:.0f}"
    return f"{value:.3g}" if 1e-4 <= abs(value) < 1e4 else f"{value:.1e}"
