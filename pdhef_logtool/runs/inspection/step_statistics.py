"""Rates, gaps, jitter and delays of a stream of times, gathered window by window in bounded memory."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pdhef_logtool.records.signals import FloatArray, IntArray

#: Each window adds at most this many values to the quantiles; counts, extremes and gaps see all of them.
KEPT_PER_WINDOW = 20_000
#: When a stream has kept more, every second value of it goes, now and from then on: hours take no more memory.
MOST_KEPT = 120_000
#: A gap is more than this many median steps, and more than ``MIN_GAP_S``.
GAP_PERIODS = 5.0
MIN_GAP_S = 0.1
#: Messages whose median step differs from the mean step by more come in bursts.
BURST = 0.75
#: Parts of a log whose extremes are kept.
COLUMNS = 100


@dataclass(slots=True)
class Thinned:
    """Evenly spread values of a stream, at most ``KEPT_PER_WINDOW`` a window and ``MOST_KEPT`` in all."""

    parts: list[FloatArray] = field(default_factory=list)
    stride: int = 1

    def add(self, values: FloatArray) -> None:
        """Add a window's values, float64 [N]."""
        # Copies: a view would keep all of the window.
        self.parts.append(thin(values)[:: self.stride].copy())
        while sum(p.shape[0] for p in self.parts) > MOST_KEPT:
            self.parts = [p[::2].copy() for p in self.parts]
            self.stride *= 2

    @property
    def values(self) -> FloatArray:
        """All that is kept, in order."""
        return np.concatenate(self.parts) if self.parts else np.empty(0)


@dataclass(slots=True)
class StepStatistics:
    """Steps of one stream of ascending times.

    Attributes
    ----------
    count : times seen. steps_s : a thinned sample of the steps. long_steps : the longest steps with their starts.
    """

    count: int = 0
    last_ns: int | None = None
    steps_s: Thinned = field(default_factory=Thinned)
    long_steps: list[tuple[float, int]] = field(default_factory=list)

    def add(self, times_ns: IntArray) -> None:
        """Add the next window's times, int64 [N], ascending."""
        if times_ns.shape[0] == 0:
            return
        self.count += int(times_ns.shape[0])
        joined = times_ns if self.last_ns is None else np.concatenate([[np.int64(self.last_ns)], times_ns])
        self.last_ns = int(times_ns[-1])
        steps = np.diff(joined) * 1e-9
        if steps.shape[0] == 0:
            return
        self.steps_s.add(steps)
        # All steps that can count as gaps once the median is known, the longest first, within bounds.
        longest = np.argsort(-steps, kind="stable")[:1000]
        longest = longest[steps[longest] > MIN_GAP_S]
        self.long_steps += [(float(steps[i]), int(joined[i])) for i in longest]

    @property
    def median_s(self) -> float:
        """Median step; NaN with fewer than two times."""
        steps = self.steps_s.values
        return float(np.median(steps)) if steps.shape[0] else float("nan")

    @property
    def rate_hz(self) -> float:
        """By the median step; of bursts, whose mean step is another, by the mean of the steps that are no gaps."""
        steps = self.steps_s.values
        if not steps.shape[0]:
            return float("nan")
        # The step that half of the time is spent in, without the few longest: of bursts, that from one to the next.
        usual = np.sort(steps)[: max(1, len(steps) - max(1, len(steps) // 100))]
        half = usual[np.searchsorted(np.cumsum(usual), 0.5 * usual.sum())]
        limit = max(MIN_GAP_S, GAP_PERIODS * float(half))
        mean, median = float(steps[steps <= limit].mean()), self.median_s
        step = median if BURST * mean <= median <= mean / BURST else mean
        return 1.0 / step if step > 0.0 else float("nan")

    @property
    def jitter_p95_s(self) -> float:
        """95th percentile of |step − median|; NaN with fewer than two times."""
        steps = self.steps_s.values
        return float(np.quantile(np.abs(steps - np.median(steps)), 0.95)) if steps.shape[0] else float("nan")

    @property
    def largest(self) -> tuple[float, int] | None:
        """Longest step above ``MIN_GAP_S`` and where it starts."""
        return max(self.long_steps, key=lambda s: s[0]) if self.long_steps else None

    def gaps(self) -> list[tuple[float, int]]:
        """Return the steps that are gaps: their length in s and start in ns, in time order."""
        limit = max(MIN_GAP_S, GAP_PERIODS * self.median_s)
        return sorted((s for s in self.long_steps if s[0] > limit), key=lambda s: s[1])


@dataclass(slots=True)
class DelayStatistics:
    """Delays of messages: log time less another time of theirs."""

    times_s: Thinned = field(default_factory=Thinned)
    delays_s: Thinned = field(default_factory=Thinned)
    count: int = 0
    negative: int = 0

    def add(self, log_time_ns: IntArray, other_ns: IntArray) -> None:
        """Add a window's messages, int64 [N] each."""
        delays = (log_time_ns - other_ns).astype(np.float64) * 1e-9
        self.count += int(delays.shape[0])
        self.negative += int(np.count_nonzero(delays < 0.0))
        self.times_s.add(log_time_ns.astype(np.float64) * 1e-9)
        self.delays_s.add(delays)

    def quantile(self, q: float) -> float:
        """Return a quantile of the delays in s; NaN without messages."""
        delays = self.delays_s.values
        return float(np.quantile(delays, q)) if delays.shape[0] else float("nan")

    @property
    def drift_ppm(self) -> float:
        """Slope of the delay over time by least squares, in parts per million; NaN without a span."""
        times, delays = self.times_s.values, self.delays_s.values
        times = times - times.mean() if times.shape[0] else times
        spread = float(np.dot(times, times))
        return float(np.dot(times, delays - delays.mean()) / spread * 1e6) if spread > 0.0 else float("nan")


@dataclass(slots=True)
class ValueStatistics:
    """Mean, spread and extremes of the values of a channel, by Chan's pairwise update."""

    count: int = 0
    mean: float = 0.0
    squares: float = 0.0
    low: float = float("inf")
    high: float = float("-inf")

    def add(self, values: FloatArray) -> None:
        """Add a window's values, float64 [N]."""
        n = int(values.shape[0])
        if n == 0:
            return
        with np.errstate(over="ignore", invalid="ignore"):  # of values that are no measurements
            mean = float(values.mean())
            squares = float(np.square(values - mean).sum())
        total = self.count + n
        by = mean - self.mean
        self.squares += squares + by * by * self.count * n / total
        self.mean += by * n / total
        self.count = total
        self.low, self.high = min(self.low, float(values.min())), max(self.high, float(values.max()))

    @property
    def std(self) -> float:
        """Standard deviation; NaN without values."""
        return float(np.sqrt(self.squares / self.count)) if self.count else float("nan")


@dataclass(slots=True)
class Outline:
    """Smallest and largest value in each of ``COLUMNS`` equal parts of ``span_ns`` from the first stamp on [C]."""

    span_ns: int
    first_ns: int | None = None
    low: FloatArray = field(default_factory=lambda: np.full(COLUMNS, np.inf))
    high: FloatArray = field(default_factory=lambda: np.full(COLUMNS, -np.inf))

    def add(self, stamps_ns: IntArray, values: FloatArray) -> None:
        """Add a window's values, float64 [N], at their stamps, int64 [N]."""
        if stamps_ns.shape[0] == 0:
            return
        self.first_ns = int(stamps_ns[0]) if self.first_ns is None else self.first_ns
        column = (stamps_ns - self.first_ns) * (COLUMNS / max(1, self.span_ns))
        column = np.clip(column, 0, COLUMNS - 1).astype(np.int64)
        np.fmin.at(self.low, column, values)
        np.fmax.at(self.high, column, values)


def thin(values: FloatArray) -> FloatArray:
    """Keep evenly spread values, at most ``KEPT_PER_WINDOW``."""
    stride = -(-values.shape[0] // KEPT_PER_WINDOW) if values.shape[0] else 1
    return np.asarray(values[::stride], dtype=np.float64)
