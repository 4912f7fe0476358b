"""``lag_s``: by how much an estimate is late."""

from __future__ import annotations

import numpy as np

from pdhef_logtool.drive.correlation import CommonGrid, EvenGrid, find_shift, on_common_grid
from pdhef_logtool.evaluation.blocks import row_blocks
from pdhef_logtool.evaluation.metrics.metric import ALL, Figure, Metric, OfSignal, Reference, SignalBlock
from pdhef_logtool.evaluation.track_errors import selected
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray
from pdhef_logtool.records.tracks import StateTrack

MAX_LAG_S = 0.3
MIN_LAG_CORRELATION = 0.5
LAG_SPAN_NS = 3_600_000_000_000
#: Grids on which lags are sought that are in memory at once: of motion, sideslip and acceleration.
GRIDS_HELD = 3


class _Lag:
    """Lag of one signal of an estimate."""

    def __init__(self, reference: Reference, estimate: StateTrack, signal: str) -> None:
        self._lags, self._estimate, self._signal = reference.once(_Lags), estimate, signal
        self._scored: list[BoolArray] = []

    def add(self, block: SignalBlock) -> None:
        """Take the next block."""
        self._scored.append(block.scored & block.inside[ALL])

    def of(self, segment: str) -> dict[str, Figure]:
        """Return the lag over the whole drive; none of other segments, and none where nothing is scored."""
        if segment != ALL:
            return {}
        scored = np.concatenate(self._scored)
        if not scored.any():
            return {}
        return {"lag_s": (self._lags.of(self._estimate, self._signal, scored), int(np.count_nonzero(scored)))}


class _Lags:
    """Lags behind ground truth [N] in its first hour; estimates that are scored at the same stamps share the grid."""

    def __init__(self, reference: Reference) -> None:
        self._truth = reference.truth
        self._end = _end_of_first_hour(reference.truth)
        self._grids: list[tuple[BoolArray, EvenGrid, dict[str, FloatArray]]] = []

    def of(self, estimate: StateTrack, signal: str, scored: BoolArray) -> float:
        """Return the lag of a signal that is ``scored`` at [N]; NaN when there is no clear peak."""
        scored = scored[: self._end]
        if np.count_nonzero(scored) < 2:
            return float("nan")
        grid, of_truth = self._grid(scored)
        if signal not in of_truth:
            of_truth[signal] = grid.of_a(selected(getattr(self._truth.rows(0, self._end), signal), scored))
        of_estimate = grid.of_b(selected(getattr(estimate.rows(0, self._end), signal), scored))
        return _clear_lag_s(CommonGrid(grid.step_s, of_truth[signal], of_estimate))

    def _grid(self, scored: BoolArray) -> tuple[EvenGrid, dict[str, FloatArray]]:
        cached = next((g for g in self._grids if np.array_equal(g[0], scored)), None)
        if cached is None:
            stamps = selected(self._truth.rows(0, self._end).stamps_ns, scored)
            cached = scored, EvenGrid(stamps, stamps), {}
        latest = [g for g in self._grids if g is not cached][1 - GRIDS_HELD :]
        self._grids = [*latest, cached]
        return cached[1:]


def _end_of_first_hour(truth: StateTrack) -> int:
    if not len(truth):
        return 0
    end_ns, end = truth.rows(0, 1).stamps_ns[0] + LAG_SPAN_NS, 0
    for a, b in row_blocks(len(truth)):
        end = a + int(np.searchsorted(truth.rows(a, b).stamps_ns, end_ns))
        if end < b:
            break
    return end


def lag_s(stamps_ns: IntArray, estimate: FloatArray, truth: FloatArray) -> float:
    """Return by how many seconds the estimate [N] follows the ground truth [N]; NaN when there is no clear peak."""
    finite = np.isfinite(estimate) & np.isfinite(truth)
    if np.count_nonzero(finite) < 2:
        return float("nan")
    stamps = stamps_ns[finite]
    return _clear_lag_s(on_common_grid(stamps, truth[finite], stamps, estimate[finite]))


def _clear_lag_s(grid: CommonGrid) -> float:
    shift = find_shift(grid, MAX_LAG_S)
    clear = shift.inside and shift.correlation >= MIN_LAG_CORRELATION
    return shift.shift_s if clear else float("nan")


METRICS = (
    Metric(
        "lag_s",
        "lag",
        "shift, within ± 0.3 s, at which the estimate correlates best with ground truth; positive = estimate late. "
        "Segment `all` only, its first hour; NaN when the correlation stays below 0.5 or has no peak",
        OfSignal(_Lag),
        best=0.0,
        unit="s",
        digits=0,
        terminal=("sideslip_rad",),
    ),
)
