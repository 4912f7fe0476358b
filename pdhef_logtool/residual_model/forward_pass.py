"""The network's pass in compiled code: LSTM layers and head, in float32, a step's two sides at a time.

Training has PyTorch; a run does without, and gives the same to 1e-5 (a test checks it). A step depends on those before
it through the state alone, so that no window changes a bit. Sums are taken in one order with any BLAS.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic

from pdhef_logtool.compiled.cache import njit

Float32Array: TypeAlias = np.ndarray[Any, np.dtype[np.float32]]

#: A step is run for an input and its mirror image, or for an input and nothing.
SIDES = 2
#: Columns of weights come in blocks of so many, each of two vectors; what is missing is 0.
_COLUMNS, _LANES = 32, 16
#: Steps that a layer takes before the next one does: its weights and what passes between stay in the cache.
_TILE_STEPS = 128

_compiled = njit(cache=True, error_model="numpy", fastmath={"contract"})
_inline = njit(forceinline=True, error_model="numpy", fastmath={"contract"})

# tanh(x) = x P(x²) / Q(x²) for |x| < 8, to 1e-8 of itself: the rational function of least error (iterated weighted
# least squares). What is rounded of it in float32 is ten times as much.
_LIMIT = np.float32(8.0)
_P0, _P1, _P2, _P3, _P4 = (
    np.float32(p) for p in (0.99999999357, 0.13444496296, 0.003571596023773, 2.189462883168e-5, 1.5230371066748e-8)
)
_Q1, _Q2, _Q3, _Q4 = (np.float32(q) for q in (0.46777823615, 0.026164435329905, 0.000341128873931, 8.52242771269e-7))
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)


@_inline
def _tanh(x):  # type: ignore[no-untyped-def]
    x = min(max(x, -_LIMIT), _LIMIT)
    s = x * x
    over = (((_P4 * s + _P3) * s + _P2) * s + _P1) * s + _P0
    under = (((_Q4 * s + _Q3) * s + _Q2) * s + _Q1) * s + _ONE
    return x * over / under


@intrinsic
def _add_products(_typing, x, weights, out, first):  # type: ignore[no-untyped-def]
    """Add the products of vectors x [2, K] with a block of weights [K, 32] to the columns of out [2, M] from ``first``.

    Written in the compiler's own language: sums stay in registers over the loop, which of a loop in Python it does not
    find out. ``contract`` lets a product and a sum be one instruction, where the processor has one.
    """
    if any(a.layout != "C" or a.dtype != types.float32 for a in (x, weights, out)):
        raise TypingError("expected float32 arrays in C order")

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        x, weights, out = (
            context.make_array(kind)(context, builder, value)
            for kind, value in zip(signature.args[:3], args[:3], strict=True)
        )
        rows, columns = (cgutils.unpack_tuple(builder, a.shape)[axis] for a, axis in ((weights, 0), (out, 1)))
        lane, vector = ir.FloatType(), ir.VectorType(ir.FloatType(), _LANES)
        number, undefined = ir.IntType(64), ir.Constant(vector, ir.Undefined)
        first_lane = ir.Constant(ir.VectorType(ir.IntType(32), _LANES), [0] * _LANES)

        def place(base: Any, index: Any, add: int = 0) -> Any:
            return builder.bitcast(builder.gep(base, [builder.add(index, number(add))]), vector.as_pointer())

        def load(base: Any, index: Any, add: int = 0) -> Any:
            value = builder.load(place(base, index, add))
            value.align = lane.get_abi_size(context.target_data)
            return value

        sums = []
        for side in range(SIDES):
            start = builder.add(args[3], builder.mul(number(side), columns))
            for add in range(0, _COLUMNS, _LANES):
                kept = cgutils.alloca_once_value(builder, load(out.data, start, add))
                sums.append((side, add, place(out.data, start, add), kept))
        with cgutils.for_range(builder, rows) as loop:
            row = builder.mul(loop.index, number(_COLUMNS))
            of_row = {add: load(weights.data, row, add) for add in range(0, _COLUMNS, _LANES)}
            both = []
            for side in range(SIDES):
                index = builder.add(loop.index, builder.mul(number(side), rows))
                value = builder.insert_element(undefined, builder.load(builder.gep(x.data, [index])), ir.IntType(32)(0))
                both.append(builder.shuffle_vector(value, undefined, first_lane))
            for side, add, _, kept in sums:
                product = builder.fmul(both[side], of_row[add], flags=("contract",))
                builder.store(builder.fadd(product, builder.load(kept), flags=("contract",)), kept)
        for _, _, target, kept in sums:
            stored = builder.store(builder.load(kept), target)
            stored.align = lane.get_abi_size(context.target_data)
        return context.get_dummy_value()

    return types.void(x, weights, out, first), generate


@_compiled
def _multiply(x, weights, out):  # type: ignore[no-untyped-def]
    """Add x [2, K] times weights, in blocks [M/32, K, 32], to out [2, M]."""
    for block in range(weights.shape[0]):
        _add_products(x, weights[block], out, block * _COLUMNS)


@_compiled
def _dense(x, weights, bias, cut, out):  # type: ignore[no-untyped-def]
    """Write x [T, 2, K] times weights plus bias [M] to out [T, 2, M]; ``cut``: what is below 0 is 0."""
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
    """Run one LSTM layer over what its inputs give to the gates [T, 2, ≥4 H], which are changed.

    The gates are input, forget, cell, output; those with a sigmoid come as half of what it is taken of, for
    σ(x) = (1 + tanh(x/2)) / 2. ``h`` and ``c`` [2, H] are moved, ``h`` of each step goes to out [T, 2, H].
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
    """A network's weights as the compiled code takes them, [blocks, K, 32] each.

    ``layers`` are (of the input, of the state, bias), ``head`` is (weights, bias), its ``widths`` without filling.
    """

    layers: tuple[tuple[Float32Array, Float32Array, Float32Array], ...]
    head: tuple[tuple[Float32Array, Float32Array], ...]
    hidden: int
    widths: tuple[int, ...]

    @classmethod
    def of(cls, weights: dict[str, Float32Array], layers: int, head: Sequence[int]) -> ForwardPass:
        """Take the weights of a bundle; ``layers`` of the LSTM, widths of the ``head``'s layers but the last."""
        stacked = []
        for n in range(layers):
            bias = weights[f"lstm.bias_ih_l{n}"] + weights[f"lstm.bias_hh_l{n}"]
            half = np.full(len(bias), 0.5, dtype=np.float32)
            half[len(bias) // 2 : len(bias) * 3 // 4] = 1.0  # the cell's gate is a tanh
            of_input, of_state = (weights[f"lstm.weight_{of}_l{n}"].T * half for of in ("ih", "hh"))
            stacked.append((_blocks(of_input), _blocks(of_state), _filled(bias * half)))
        dense = [f"head.{3 * n}" for n in range(len(head) + 1)]
        return cls(
            layers=tuple(stacked),
            head=tuple((_blocks(weights[f"{d}.weight"].T), _filled(weights[f"{d}.bias"])) for d in dense),
            hidden=len(weights["lstm.weight_hh_l0"]) // 4,
            widths=tuple(len(weights[f"{d}.bias"]) for d in dense),
        )

    def initial_state(self) -> NetworkState:
        """Return a state of zeros."""
        return _aligned((len(self.layers), 2, SIDES, self.hidden))

    def run(self, inputs: Float32Array, state: NetworkState) -> tuple[Float32Array, NetworkState]:
        """Run [T, 2, k] from a state; returns [T, 2, outputs] and the state after."""
        after = self.initial_state()
        after[...] = state
        steps = min(len(inputs), _TILE_STEPS)
        gates, hidden = (_aligned((steps, SIDES, width)) for width in (len(self.layers[0][2]), self.hidden))
        dense = [_aligned((steps, SIDES, len(bias))) for _, bias in self.head]
        said = np.empty((len(inputs), SIDES, self.widths[-1]), dtype=np.float32)
        for first in range(0, len(inputs), _TILE_STEPS):
            x = np.ascontiguousarray(inputs[first : first + _TILE_STEPS], dtype=np.float32)
            gate = gates[: len(x)]
            for (of_input, of_state, bias), (h, c) in zip(self.layers, after, strict=True):
                _dense(x, of_input, bias, False, gate)
                x = hidden[: len(x)]
                _recur(gate, of_state, h, c, x)
            for n, ((weights, bias), out) in enumerate(zip(self.head, dense, strict=True)):
                _dense(x, weights, bias, n + 1 < len(self.head), out[: len(x)])
                x = np.ascontiguousarray(out[: len(x), :, : self.widths[n]])
            said[first : first + len(x)] = x
        return said, after


def _aligned(shape: tuple[int, ...]) -> Float32Array:
    """Return zeros that begin where a line of the cache does: vectors that cross lines take half as long again."""
    size, line = 4 * math.prod(shape), 64
    memory = np.zeros(size + line, dtype=np.uint8)
    first = -memory.ctypes.data % line
    view: Float32Array = memory[first : first + size].view(np.float32).reshape(shape)
    return view


def _filled(values: Float32Array) -> Float32Array:
    """Return values [..., M] with zeros up to whole blocks."""
    *before, columns = values.shape
    filled = _aligned((*before, -(-columns // _COLUMNS) * _COLUMNS))
    filled[..., :columns] = values
    return filled


def _blocks(weights: Float32Array) -> Float32Array:
    """Return weights [K, M] as blocks [M/32, K, 32]."""
    filled = _filled(weights).reshape(len(weights), -1, _COLUMNS).transpose(1, 0, 2)
    blocks = _aligned(filled.shape)
    blocks[...] = filled
    return blocks
