"""Compiled code of residual models: features, residual and distance of steps (:mod:`~.ladder`)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from pdhef_logtool.compiled.cache import njit
from pdhef_logtool.records.signals import FloatArray


class LadderArrays(NamedTuple):
    """A fitted residual model as arrays, with the fields of :class:`~.ladder.LadderModel`."""

    scale: FloatArray
    odd_directions: FloatArray
    even_directions: FloatArray
    phases: FloatArray
    weights: FloatArray
    whitening: FloatArray


@njit(cache=True)
def _features(z, e, odd_directions, even_directions, phases, out):  # type: ignore[no-untyped-def]
    """Write the features of a step: z, then the random products."""
    count = z.shape[0]
    out[:count] = z
    for j in range(phases.shape[0]):
        a, b = 0.0, phases[j]
        for i in range(count):
            a += z[i] * odd_directions[j, i]
        for i in range(e.shape[0]):
            b += e[i] * even_directions[j, i]
        out[count + j] = math.sqrt(2.0) * math.sin(a) * math.cos(b)


@njit(cache=True)
def evaluate(odd, even, arrays, even_mean, even_scale, residual, distance2):  # type: ignore[no-untyped-def]
    """Write the residual, m/s², and the squared whitened distance of steps [K]."""
    z, e, phi = np.empty(odd.shape[1]), np.empty(even.shape[1]), np.empty(arrays.weights.shape[0])
    for k in range(odd.shape[0]):
        residual[k], distance2[k] = 0.0, math.nan
        if not math.isfinite(odd[k].sum() + even[k].sum()):
            continue
        for i in range(z.shape[0]):
            z[i] = odd[k, i] / arrays.scale[i]
        for i in range(e.shape[0]):
            e[i] = (even[k, i] - even_mean[i]) / even_scale[i]
        _features(z, e, arrays.odd_directions, arrays.even_directions, arrays.phases, phi)
        for i in range(phi.shape[0]):
            residual[k] += phi[i] * arrays.weights[i]
        distance2[k] = 0.0
        for j in range(z.shape[0]):
            part = 0.0
            for i in range(z.shape[0]):
                part += arrays.whitening[j, i] * z[i]
            distance2[k] += part * part


@njit(cache=True)
def expand(z, e, odd_directions, even_directions, phases, out):  # type: ignore[no-untyped-def]
    """Write the features of steps [K]: standardised odd ones z, even ones e, and ``out`` [K, 16 + random]."""
    for k in range(z.shape[0]):
        _features(z[k], e[k], odd_directions, even_directions, phases, out[k])
