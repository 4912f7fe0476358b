"""Linear interpolation between the two samples around each stamp, except across gaps."""

from collections.abc import Callable

import numpy as np

from pdhef_logtool.records.geometry import wrap_angle
from pdhef_logtool.records.signals import BoolArray, FloatArray, IntArray


class Bracket:
    """The samples around each of M stamps, searched once for many columns.

    Parameters
    ----------
    stamps_ns : int64 [N], ascending. at_ns : int64 [M]. max_gap_ns : longest step between samples that is bridged.

    Attributes
    ----------
    inside : bool [M], True on a sample and between two samples no further apart than ``max_gap_ns``.
    """

    def __init__(self, stamps_ns: IntArray, at_ns: IntArray, max_gap_ns: int) -> None:
        n = len(stamps_ns)
        stamps_ns = stamps_ns if n else np.zeros(1, np.int64)  # nothing is inside
        right = np.searchsorted(stamps_ns, at_ns, side="left")
        hit = stamps_ns[np.minimum(right, n - 1)] == at_ns
        left = np.where(hit, right, right - 1)
        bracketed = (left >= 0) & (right < n)
        left, right = np.clip(left, 0, n - 1), np.minimum(right, n - 1)
        step = stamps_ns[right] - stamps_ns[left]
        self.inside: BoolArray = bracketed & (step <= max_gap_ns)
        if not self.inside.all():
            at_ns, left, right, step = (c[self.inside] for c in (at_ns, left, right, step))
        self._left, self._right = left, right
        self._share = (at_ns - stamps_ns[left]) / np.maximum(step, 1)

    def linear(self, values: FloatArray) -> FloatArray:
        """Return [M] or [M, k] of a column [N] or [N, k]; NaN outside."""
        return self._between(values, lambda a, b: b - a)

    def angle(self, values: FloatArray) -> FloatArray:
        """Return [M] in [−π, π) of angles [N] in rad, the shorter way round; NaN outside."""
        return wrap_angle(self._between(values, lambda a, b: wrap_angle(b - a)))

    def quaternion(self, values: FloatArray) -> FloatArray:
        """Return [M, 4] of quaternions [N, 4], not normalised; q and −q are the same attitude."""
        return self._between(values, lambda a, b: np.where((a * b).sum(axis=1, keepdims=True) < 0, -b, b) - a)

    def _between(self, values: FloatArray, difference: Callable[[FloatArray, FloatArray], FloatArray]) -> FloatArray:
        a, b = values[self._left], values[self._right]
        share = self._share.reshape(-1, *([1] * (values.ndim - 1)))
        values_inside: FloatArray = a + share * difference(a, b)
        if len(values_inside) == len(self.inside):
            return values_inside
        out = np.full((self.inside.shape[0], *values.shape[1:]), np.nan)
        out[self.inside] = values_inside
        return out
