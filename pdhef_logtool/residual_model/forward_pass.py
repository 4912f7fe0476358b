"""Compiled forward pass of the network: LSTM layers and head, in float32, for an input and its mirror image at a time.

Training uses PyTorch; runs do not need it and agree to 1e-5 (a test checks this). A step depends on earlier ones only
through the state, so that windows do not change the result. The order of sums does not depend on the BLAS.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np

from pdhef_logtool.compiled.cache import inline, njit

Float32Array: TypeAlias = np.ndarray[Any, np.dtype[np.float32]]

#: Inputs per step: an input and its mirror image (or zeros).
SIDES = 2
#: Number of steps per layer before the next layer, so that weights and intermediate values stay in the cache.
_TILE_STEPS = 128

_compiled = njit(cache=True, error_model="numpy", fastmath={"contract"})

# tanh(x) = x P(x²) / Q(x²) for |x| < 8 with a relative error of 1e-8: the rational function of least error (iterated
# weighted least squares). The rounding error of float32 is ten times larger.
_LIMIT = np.float32(8.0)
_P0, _P1, _P2, _P3, _P4 = (
    np.float32(p) for p in (0.99999999357, 0.13444496296, 0.003571596023773, 2.189462883168e-5, 1.5230371066748e-8)
)
_Q1, _Q2, _Q3, _Q4 = (np.float32(q) for q in (0.46777823615, 0.026164435329905, 0.000341128873931, 8.52242771269e-7))
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@inline
def _tanh(x):  # type: ignore[no-untyped-def]
    x = min(max(x, -_LIMIT), _LIMIT)
    s = x * x
    over = (((_P4 * s + _P3) * s + _P2) * s + _P1) * s + _P0
    under = (((_Q4 * s + _Q3) * s + _Q2) * s + _Q1) * s + _ONE
    return x * over / under


@_compiled
def _multiply(x, weights, out):  # type: ignore[no-untyped-def]
    """Add x [2, K] times weights [K, M] to out [2, M], four rows of weights at a time, in order."""
    rows, columns = weights.shape
    whole = rows - rows % 4
    straight, mirrored = out[0], out[1]
    for k in range(0, whole, 4):
        a, b, c, d = x[0, k], x[0, k + 1], x[0, k + 2], x[0, k + 3]
        e, f, g, h = x[1, k], x[1, k + 1], x[1, k + 2], x[1, k + 3]
        w0, w1, w2, w3 = weights[k], weights[k + 1], weights[k + 2], weights[k + 3]
        for m in range(columns):
            straight[m] = straight[m] + a * w0[m] + b * w1[m] + c * w2[m] + d * w3[m]
            mirrored[m] = mirrored[m] + e * w0[m] + f * w1[m] + g * w2[m] + h * w3[m]
    for k in range(whole, rows):
        for m in range(columns):
            straight[m] += x[0, k] * weights[k, m]
            mirrored[m] += x[1, k] * weights[k, m]


@_compiled
def _dense(x, weights, bias, cut, out):  # type: ignore[no-untyped-def]
    """Write x [T, 2, K] times weights plus bias [M] to out [T, 2, M]; ``cut`` applies a ReLU."""
    for t in range(x.shape[0]):
        out[t, 0] = bias
        out[t, 1] = bias
        _multiply(x[t], weights, out[t])
        if cut:
            for side in range(SIDES):
                for m in range(bias.shape[0]):
                    out[t, side, m] = max(out[t, side, m], _ZERO)


@_compiled
def _recur(gates, weights, h, c, out):  # type: ignore[no-untyped-def]
    """Run one LSTM layer over the contributions of its inputs to the gates [T, 2, 4 H], which are overwritten.

    The gates are input, forget, cell, output. Arguments of sigmoid gates are halved, because
    σ(x) = (1 + tanh(x/2)) / 2. ``h`` and ``c`` [2, H] are updated; ``h`` of each step is written to out [T, 2, H].
    """
    width = c.shape[1]
    for t in range(gates.shape[0]):
        _multiply(h, weights, gates[t])
        for side in range(SIDES):
            gate, cell, hidden = gates[t, side], c[side], h[side]
            for m in range(4 * width):
                gate[m] = _tanh(gate[m])
            for m in range(width):
                kept = (_HALF * gate[width + m] + _HALF) * cell[m]
                cell[m] = kept + (_HALF * gate[m] + _HALF) * gate[2 * width + m]
                hidden[m] = (_HALF * gate[3 * width + m] + _HALF) * _tanh(cell[m])
        out[t] = h


#: h and c of all layers, [layers, 2 of h and c, 2 sides, H].
NetworkState: TypeAlias = Float32Array


@dataclass(frozen=True, slots=True, eq=False)
class ForwardPass:
    """A network's weights in the layout of the compiled code, [K, M] each.

    ``layers`` are (of the input, of the state, bias), ``head`` is (weights, bias).
    """

    layers: tuple[tuple[Float32Array, Float32Array, Float32Array], ...]
    head: tuple[tuple[Float32Array, Float32Array], ...]
    hidden: int

    @classmethod
    def of(cls, weights: dict[str, Float32Array], layers: int, head: Sequence[int]) -> "ForwardPass":
        """Convert the weights of a bundle; ``layers`` of the LSTM, widths of the ``head`` without its last layer."""
        stacked = []
        for n in range(layers):
            bias = weights[f"lstm.bias_ih_l{n}"] + weights[f"lstm.bias_hh_l{n}"]
            half = np.full(len(bias), 0.5, dtype=np.float32)
            half[len(bias) // 2 : len(bias) * 3 // 4] = 1.0  # the cell's gate is a tanh
            of_input, of_state = (
                np.ascontiguousarray(weights[f"lstm.weight_{of}_l{n}"].T * half) for of in ("ih", "hh")
            )
            stacked.append((of_input, of_state, bias * half))
        dense = [f"head.{3 * n}" for n in range(len(head) + 1)]
        return cls(
            layers=tuple(stacked),
            head=tuple((np.ascontiguousarray(weights[f"{d}.weight"].T), weights[f"{d}.bias"]) for d in dense),
            hidden=len(weights["lstm.weight_hh_l0"]) // 4,
        )

    def run(self, inputs: Float32Array, state: NetworkState | None) -> tuple[Float32Array, NetworkState]:
        """Run [T, 2, k] from a state, None: zeros; returns [T, 2, outputs] and the state after."""
        shape = len(self.layers), 2, SIDES, self.hidden
        after = np.zeros(shape, dtype=np.float32) if state is None else state.copy()
        said = np.empty((len(inputs), SIDES, len(self.head[-1][1])), dtype=np.float32)
        for first in range(0, len(inputs), _TILE_STEPS):
            x = np.ascontiguousarray(inputs[first : first + _TILE_STEPS], dtype=np.float32)
            for (of_input, of_state, bias), (h, c) in zip(self.layers, after, strict=True):
                gates, hidden = (np.empty((len(x), SIDES, n), dtype=np.float32) for n in (len(bias), self.hidden))
                _dense(x, of_input, bias, False, gates)
                _recur(gates, of_state, h, c, hidden)
                x = hidden
            for n, (weights, bias) in enumerate(self.head):
                dense = np.empty((len(x), SIDES, len(bias)), dtype=np.float32)
                _dense(x, weights, bias, n + 1 < len(self.head), dense)
                x = dense
            said[first : first + len(x)] = x
        return said, after
