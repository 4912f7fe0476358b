"""Metrics of the size and the mean of errors: one pass over the errors serves all of them.

a_y is the lateral specific force at the CG in the road plane (:data:`~pdhef_logtool.evaluation.units.AY_NOTE`), of
estimates and of ground truth; a ground truth that lacks it is not scored.
"""

from __future__ import annotations

import numpy as np

from pdhef_logtool.evaluation.blocks import ErrorSums
from pdhef_logtool.evaluation.metrics.metric import Figure, Metric, OfSignal, Reference, SignalBlock
from pdhef_logtool.evaluation.track_errors import selected
from pdhef_logtool.records.signals import BoolArray
from pdhef_logtool.records.tracks import StateTrack


class _Errors:
    """Errors of one signal of an estimate by segment."""

    def __init__(self, reference: Reference, _estimate: StateTrack, _signal: str) -> None:
        self._truth = reference.once(_TruthSquares)
        self._errors = {s: ErrorSums(int(np.count_nonzero(mask))) for s, mask in reference.masks.items()}
        self._squares: dict[str, list[list[float]]] = {}

    def add(self, block: SignalBlock) -> None:
        """Take the next block."""
        squares = self._truth.of(block)
        for segment, mask in block.inside.items():
            errors = selected(block.error, mask & block.scored)
            self._errors[segment].add(errors)
            if errors.size:
                self._squares.setdefault(segment, []).append([errors.size, squares[segment]])

    def of(self, segment: str) -> dict[str, Figure]:
        """Return the figures of a segment; none without an error."""
        n = self._errors[segment].n
        if n == 0:
            return {}
        figures = self._errors[segment].figures()
        size = float(np.sqrt(np.sum(self._squares[segment], axis=0)[1] / n))
        figures["rmse_relative"] = figures["rmse"] / size if size > 0 else float("nan")
        return {name: (value, n) for name, value in figures.items()}


class _TruthSquares:
    """Sums of the ground-truth squares by segment of each block; most estimates are known at the same stamps."""

    def __init__(self, _reference: Reference) -> None:
        self._found: dict[tuple[str, int], tuple[BoolArray, dict[str, float]]] = {}

    def of(self, block: SignalBlock) -> dict[str, float]:
        key = block.signal, block.start
        cached = self._found.get(key)
        if cached is None or not np.array_equal(cached[0], block.scored):
            values = getattr(block.truth, block.signal)
            sums = {s: float(np.sum(selected(values, mask & block.scored) ** 2)) for s, mask in block.inside.items()}
            self._found[key] = cached = block.scored, sums
        return cached[1]


_FUNCTION = OfSignal(_Errors)
_ALWAYS = ("vy_m_s", "vx_m_s", "yaw_rate_rad_s", "ay_m_s2", "lateral_1s_m")
METRICS = (
    Metric(
        "rmse",
        "RMSE",
        "√ mean e²",
        _FUNCTION,
        best="lower",
        terminal=("sideslip_rad", *_ALWAYS),
        brief=("sideslip_rad",),
    ),
    Metric("mae", "MAE", "mean abs e", _FUNCTION, best="lower"),
    Metric("bias", "bias", "mean e; positive = estimate too large", _FUNCTION, best=0.0),
    Metric("p95_abs", "p95", "95th percentile of abs e", _FUNCTION, best="lower", terminal=("sideslip_rad",)),
    Metric("max_abs", "max", "maximum of abs e", _FUNCTION, best="lower", digits=2, terminal=("sideslip_rad",)),
    Metric("rmse_relative", "relative", "rmse / √ mean truth² over the same stamps", _FUNCTION, best="lower", unit="1"),
)
