"""Vectors of eight doubles for compiled code: sums that stay in registers, whatever a compiler makes of a loop.

A processor with shorter vectors takes several of its own for one of these. Arrays are taken as flat, by the place of
the first number, and nobody checks that eight follow it.
"""

from __future__ import annotations

import operator
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.datamodel import models
from numba.core.errors import TypingError
from numba.extending import intrinsic, overload, register_model

from pdhef_logtool.records.compiled import njit

LANES = 8

_NUMBER, _VECTOR = ir.DoubleType(), ir.VectorType(ir.DoubleType(), LANES)
_NUMBER_BYTES, _LINE_BYTES = 8, 64


class _Vector(types.Type):  # type: ignore[misc]
    def __init__(self) -> None:
        super().__init__("eight float64")


@register_model(_Vector)
class _Model(models.PrimitiveModel):  # type: ignore[misc]
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


_vector = _Vector()


@dataclass(frozen=True)
class _Place:
    """The numbers of an array for who says in the compiler's language what is to be done."""

    builder: Any
    data: Any

    def load(self, at: Any) -> Any:
        """Return the vector that begins at ``at``."""
        value = self.builder.load(self._pointer(at))
        value.align = _NUMBER_BYTES
        return value

    def store(self, at: Any, vector: Any) -> None:
        """Write a vector that begins at ``at``."""
        self.builder.store(vector, self._pointer(at)).align = _NUMBER_BYTES

    def _pointer(self, at: Any) -> Any:
        at = ir.IntType(64)(at) if isinstance(at, int) else at
        return self.builder.bitcast(self.builder.gep(self.data, [at]), _VECTOR.as_pointer())


def vectors_at(context: Any, builder: Any, kind: Any, array: Any) -> _Place:
    """Return the vectors of an array of doubles in C order, inside an intrinsic."""
    if kind.layout != "C" or kind.dtype != types.float64:
        raise TypingError("expected a float64 array in C order")
    return _Place(builder, context.make_array(kind)(context, builder, array).data)


def chosen(builder: Any, a: Any, b: Any, lanes: Sequence[int]) -> Any:
    """Return the vector of the ``lanes`` of a, and behind them of b, inside an intrinsic."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), LANES), list(lanes)))


def transposed(builder: Any, rows: Sequence[Any]) -> list[Any]:
    """Return the columns of eight vectors, inside an intrinsic."""
    rows = list(rows)
    for step in (1, 2, 4):
        for i in (i for i in range(LANES) if not i & step):
            a, b = rows[i], rows[i + step]
            rows[i] = chosen(builder, a, b, [k if not k & step else LANES + (k ^ step) for k in range(LANES)])
            rows[i + step] = chosen(builder, a, b, [k ^ step if not k & step else LANES + k for k in range(LANES)])
    return rows


def totals(builder: Any, vectors: Sequence[Any]) -> Any:
    """Return the sums of eight vectors' numbers as one vector, inside an intrinsic."""
    vectors = list(vectors)
    for step in (1, 2, 4):
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        vectors = [
            builder.fadd(
                chosen(builder, a, b, [k if not k & step else LANES + k for k in range(LANES)]),
                chosen(builder, a, b, [k ^ step if not k & step else LANES + (k ^ step) for k in range(LANES)]),
            )
            for a, b in pairs
        ]
    return vectors[0]


@intrinsic
def load(_typing, array, _at):  # type: ignore[no-untyped-def]
    """Return the numbers of an array from ``at`` on."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return vectors_at(context, builder, signature.args[0], args[0]).load(args[1])

    return _vector(array, types.intp), generate


@intrinsic
def store(_typing, array, _at, vector):  # type: ignore[no-untyped-def]
    """Write a vector to an array from ``at`` on."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        vectors_at(context, builder, signature.args[0], args[0]).store(args[1], args[2])
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


@intrinsic
def spread(_typing, _number):  # type: ignore[no-untyped-def]
    """Return a number eight times."""

    def generate(_context, builder, _signature, args):  # type: ignore[no-untyped-def]
        nothing, first = ir.Constant(_VECTOR, ir.Undefined), ir.IntType(32)
        one = builder.insert_element(nothing, args[0], first(0))
        return builder.shuffle_vector(one, nothing, ir.Constant(ir.VectorType(first, LANES), [0] * LANES))

    return _vector(types.float64), generate


@intrinsic
def first_half_twice(_typing, vector):  # type: ignore[no-untyped-def]
    """Return the first four numbers of a vector, and again."""

    def generate(_context, builder, _signature, args):  # type: ignore[no-untyped-def]
        return chosen(builder, args[0], args[0], [*range(LANES // 2)] * 2)

    return _vector(vector), generate


@intrinsic(prefer_literal=True)
def inner_products(_typing, rows, width, _at, _to, count):  # type: ignore[no-untyped-def]
    """Return the products of a row with up to eight others, 0 for those that are missing.

    ``rows`` is a flat array of rows of ``width``, ``at`` where the row begins, ``to`` where the first of the ``count``
    others does. Both numbers are known when this is compiled.
    """

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        array = vectors_at(context, builder, signature.args[0], args[0])
        place = ir.IntType(64)
        row = [array.load(builder.add(args[2], place(k))) for k in range(0, wide, LANES)]
        products = [ir.Constant(_VECTOR, [0.0] * LANES)] * LANES
        for i in range(others):
            terms = [array.load(builder.add(args[3], place(i * wide + k))) for k in range(0, wide, LANES)]
            products[i] = builder.fmul(row[0], terms[0], flags=("contract",))
            for a, b in zip(row[1:], terms[1:], strict=True):
                products[i] = builder.fadd(builder.fmul(a, b, flags=("contract",)), products[i], flags=("contract",))
        return totals(builder, products)

    wide, others = width.literal_value, count.literal_value
    return _vector(rows, width, types.intp, types.intp, count), generate


@intrinsic
def total(_typing, vector):  # type: ignore[no-untyped-def]
    """Return the sum of a vector's numbers, in an order that suits the processor."""

    def generate(_context, builder, _signature, args):  # type: ignore[no-untyped-def]
        kind = ir.FunctionType(_NUMBER, (_NUMBER, _VECTOR))
        add = cgutils.get_or_insert_function(builder.module, kind, "llvm.vector.reduce.fadd.v8f64")
        return builder.call(add, (_NUMBER(-0.0), args[0]), fastmath=("reassoc",))

    return types.float64(vector), generate


def _of_two(name: str) -> Any:
    """Return what does one operation of LLVM to two vectors; a product and a sum may become one instruction."""

    @intrinsic
    def combine(_typing, a, b):  # type: ignore[no-untyped-def]
        def generate(_context, builder, _signature, args):  # type: ignore[no-untyped-def]
            return getattr(builder, name)(*args, flags=("contract",))

        return _vector(a, b), generate

    return combine


def _overload(symbol: Any, name: str) -> None:
    combine = _of_two(name)

    @overload(symbol)
    def typed(a, b):  # type: ignore[no-untyped-def]
        if isinstance(a, _Vector) and isinstance(b, _Vector):
            return lambda a, b: combine(a, b)
        return None


for _symbol, _name in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _overload(_symbol, _name)


@njit
def aligned(size):  # type: ignore[no-untyped-def]
    """Return zeros [size] that begin where a line of the cache does: vectors that cross lines take longer."""
    memory = np.zeros(size + _LINE_BYTES // _NUMBER_BYTES)
    first = -memory.ctypes.data % _LINE_BYTES // _NUMBER_BYTES
    return memory[first : first + size]
