"""Compiled code of residual models: features, residual and distance of steps (:mod:`~.ladder`)."""

import math
from typing import NamedTuple

import numpy as np

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.records.signals import FloatArray


class Basis(NamedTuple):
    """Scales of the features and directions of the random ones (:class:`~.ladder.LadderModel`)."""

    scale: FloatArray
    even_mean: FloatArray
    even_scale: FloatArray
    odd_directions: FloatArray
    even_directions: FloatArray
    phases: FloatArray


@njit(cache=True)
def _features(odd, even, basis, out):  # type: ignore[no-untyped-def]
    """Write the features of a step: odd signals over their scale, then random products; return whether they are known.

    Unknown features are 0.
    """
    out[:] = 0.0
    count, random = odd.shape[0], basis.phases.shape[0]
    if not math.isfinite(odd.sum() + even.sum()):
        return False
    for i in range(count):
        out[i] = odd[i] / basis.scale[i]
    for j in range(random):
        a, b = 0.0, basis.phases[j]
        for i in range(count):
            a += out[i] * basis.odd_directions[j, i]
        for i in range(even.shape[0]):
            b += (even[i] - basis.even_mean[i]) / basis.even_scale[i] * basis.even_directions[j, i]
        out[count + j] = math.sqrt(2.0) * math.sin(a) * math.cos(b)
    return True


@njit(cache=True)
def evaluate(odd, even, basis, weights, whitening, residual, distance2):  # type: ignore[no-untyped-def]
    """Write the residual, m/s², and the squared whitened distance of steps [K]."""
    phi = np.empty(weights.shape[0])
    for k in range(odd.shape[0]):
        residual[k], distance2[k] = 0.0, math.nan
        if not _features(odd[k], even[k], basis, phi):
            continue
        for i in range(phi.shape[0]):
            residual[k] += phi[i] * weights[i]
        distance2[k] = 0.0
        for j in range(whitening.shape[0]):
            part = 0.0
            for i in range(whitening.shape[1]):
                part += whitening[j, i] * phi[i]
            distance2[k] += part * part


@njit(cache=True)
def expand(odd, even, basis, out):  # type: ignore[no-untyped-def]
    """Write the features of steps [K] to ``out`` [K, 16 + random]."""
    for k in range(odd.shape[0]):
        _features(odd[k], even[k], basis, out[k])
