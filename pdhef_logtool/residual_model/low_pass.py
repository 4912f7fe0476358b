"""Compiled causal first-order low pass with state."""

import math

from pdhef_logtool.compiled.cache import njit


@njit(cache=True)
def low_pass(values, dt_s, corner_hz, memory, out):  # type: ignore[no-untyped-def]
    """Write the low-passed ``values`` [N, k] to ``out``; exact for values that are constant over each step.

    Parameters
    ----------
    dt_s : [N], step that ends at each value; NaN at the start of a sequence, where the output is the value.
    memory : [k], the last output, updated in place; rows with NaN are passed through and do not change it.
    """
    for n in range(values.shape[0]):
        share = 1.0
        if math.isfinite(dt_s[n]):
            share = 1.0 - math.exp(-2.0 * math.pi * corner_hz * dt_s[n])
        for i in range(values.shape[1]):
            value = values[n, i]
            if math.isfinite(value):
                memory[i] += share * (value - memory[i])
                out[n, i] = memory[i]
            else:
                out[n, i] = value
