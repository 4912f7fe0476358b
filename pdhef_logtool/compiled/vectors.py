"""Vectors of eight doubles for compiled code. This is the only module that generates LLVM instructions.

Loops over small matrices wait for memory that was just written; these functions keep the numbers in registers. A
processor with shorter vectors uses several of its own for each. Interface, for use in functions under ``njit``:

- ``LANES``: numbers in a vector; ``ROOM``, ``MOST``: length of a padded state and its maximum number of entries
- ``load(array, i)``, ``store(array, i, vector)``: the vector that begins at number i of a C-contiguous float64 array;
  i counts numbers of the flat array, and bounds are not checked
- ``+ - * /`` of two vectors, element by element; a product and a sum may be fused
- ``spread(number)``, ``first_half_twice(vector)``, ``total(vector)``: broadcast, repeat of lanes 0 to 3, sum
- ``inner_products(rows, width, i, j, count)``: products of one row with up to eight others
- ``factor(P, there, L)``: lower Cholesky factor of a padded matrix
- ``aligned(size)``: zeros that begin at a cache line

``tests/compiled/plain_vectors.py`` implements the same interface in plain NumPy, and the tests compare the two.
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

from pdhef_logtool.compiled.cache import njit

#: Numbers in a vector.
LANES = 8
#: Length of a padded state: two vectors; and the largest number of entries in it.
ROOM, MOST = 2 * LANES, 13

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
    """The numbers of an array, for code that is written as LLVM instructions."""

    builder: Any
    data: Any

    def load(self, index: Any) -> Any:
        """Return the vector that begins at ``at``."""
        value = self.builder.load(self._pointer(index))
        value.align = _NUMBER_BYTES
        return value

    def store(self, index: Any, vector: Any) -> None:
        """Write a vector that begins at ``at``."""
        self.builder.store(vector, self._pointer(index)).align = _NUMBER_BYTES

    def _pointer(self, index: Any) -> Any:
        index = ir.IntType(64)(index) if isinstance(index, int) else index
        return self.builder.bitcast(self.builder.gep(self.data, [index]), _VECTOR.as_pointer())


def _vectors_at(context: Any, builder: Any, kind: Any, array: Any) -> _Place:
    """Return the vectors of an array of doubles in C order, inside an intrinsic."""
    if kind.layout != "C" or kind.dtype != types.float64:
        raise TypingError("expected a float64 array in C order")
    return _Place(builder, context.make_array(kind)(context, builder, array).data)


def _chosen(builder: Any, a: Any, b: Any, lanes: Sequence[int]) -> Any:
    """Return the vector of the ``lanes`` of a, and behind them of b, inside an intrinsic."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), LANES), list(lanes)))


def _transposed(builder: Any, rows: Sequence[Any]) -> list[Any]:
    """Return the columns of eight vectors, inside an intrinsic."""
    rows = list(rows)
    for step in (1, 2, 4):
        for i in (i for i in range(LANES) if not i & step):
            a, b = rows[i], rows[i + step]
            rows[i] = _chosen(builder, a, b, [k if not k & step else LANES + (k ^ step) for k in range(LANES)])
            rows[i + step] = _chosen(builder, a, b, [k ^ step if not k & step else LANES + k for k in range(LANES)])
    return rows


def _totals(builder: Any, vectors: Sequence[Any]) -> Any:
    """Return the sums of eight vectors' numbers as one vector, inside an intrinsic."""
    vectors = list(vectors)
    for step in (1, 2, 4):
        pairs = zip(vectors[::2], vectors[1::2], strict=True)
        vectors = [
            builder.fadd(
                _chosen(builder, a, b, [k if not k & step else LANES + k for k in range(LANES)]),
                _chosen(builder, a, b, [k ^ step if not k & step else LANES + (k ^ step) for k in range(LANES)]),
            )
            for a, b in pairs
        ]
    return vectors[0]


@intrinsic
def load(_typing, array, _at):  # type: ignore[no-untyped-def]
    """Return the numbers of an array from ``at`` on."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return _vectors_at(context, builder, signature.args[0], args[0]).load(args[1])

    return _vector(array, types.intp), generate


@intrinsic
def store(_typing, array, _at, vector):  # type: ignore[no-untyped-def]
    """Write a vector to an array from ``at`` on."""

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        _vectors_at(context, builder, signature.args[0], args[0]).store(args[1], args[2])
        return context.get_dummy_value()

    return types.void(array, types.intp, vector), generate


@intrinsic
def spread(_typing, _number):  # type: ignore[no-untyped-def]
    """Return a number eight times."""

    def generate(_context, builder, _signature, args):  # type: ignore[no-untyped-def]
        nothing, first = ir.Constant(_VECTOR, ir.Undefined), ir.IntType(32)
        first_lane = builder.insert_element(nothing, args[0], first(0))
        return builder.shuffle_vector(first_lane, nothing, ir.Constant(ir.VectorType(first, LANES), [0] * LANES))

    return _vector(types.float64), generate


@intrinsic
def first_half_twice(_typing, vector):  # type: ignore[no-untyped-def]
    """Return the first four numbers of a vector, and again."""

    def generate(_context, builder, _signature, args):  # type: ignore[no-untyped-def]
        return _chosen(builder, args[0], args[0], [*range(LANES // 2)] * 2)

    return _vector(vector), generate


@intrinsic(prefer_literal=True)
def inner_products(_typing, rows, width, _at, _to, count):  # type: ignore[no-untyped-def]
    """Return the products of a row with up to eight others, 0 for those that are missing.

    ``rows`` is a flat array of rows of ``width``, ``at`` where the row begins, ``to`` where the first of the ``count``
    others does. Both numbers are known when this is compiled.
    """

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        array = _vectors_at(context, builder, signature.args[0], args[0])
        place = ir.IntType(64)
        row = [array.load(builder.add(args[2], place(k))) for k in range(0, wide, LANES)]
        products = [ir.Constant(_VECTOR, [0.0] * LANES)] * LANES
        for i in range(others):
            terms = [array.load(builder.add(args[3], place(i * wide + k))) for k in range(0, wide, LANES)]
            products[i] = builder.fmul(row[0], terms[0], flags=("contract",))
            for a, b in zip(row[1:], terms[1:], strict=True):
                products[i] = builder.fadd(builder.fmul(a, b, flags=("contract",)), products[i], flags=("contract",))
        return _totals(builder, products)

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


@intrinsic
def factor(_typing, P, there, L):  # type: ignore[no-untyped-def]
    """Write the lower Cholesky factor of P [ROOM, ROOM] to L; False if P is not positive definite.

    Entries of the first MOST that are not ``there`` [ROOM] have zeros in P, and get zeros. The block above the diagonal
    (rows 0 to 7, columns 8 to 15) is not written. All numbers stay in registers: a loop would wait for its own writes.
    """

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        P, L = (_vectors_at(context, builder, signature.args[i], args[i]) for i in (0, 2))
        is_there = context.make_array(signature.args[1])(context, builder, args[1]).data
        number, lane = ir.DoubleType(), ir.IntType(32)
        vector = ir.VectorType(number, LANES)
        unit, nothing, unknown = number(1.0), number(0.0), ir.Constant(vector, ir.Undefined)
        root = cgutils.get_or_insert_function(builder.module, ir.FunctionType(number, (number,)), "llvm.sqrt.f64")

        def spread(of: Any, position: int) -> Any:
            return builder.shuffle_vector(of, unknown, ir.Constant(ir.VectorType(lane, LANES), [position] * LANES))

        def everywhere(value: Any) -> Any:
            return spread(builder.insert_element(unknown, value, lane(0)), 0)

        zeros = ir.Constant(vector, [0.0] * LANES)
        rows = {(i, half): P.load(i * ROOM + half * LANES) for i in range(MOST) for half in range(i // LANES, 2)}
        good = ir.IntType(1)(1)
        for k in range(MOST):
            halves = range(k // LANES, 2)
            pivot = builder.extract_element(rows[k, k // LANES], lane(k % LANES))
            positive = builder.fcmp_ordered(">", pivot, nothing)
            lacks = builder.icmp_unsigned(
                "==", builder.load(builder.gep(is_there, [ir.IntType(64)(k)])), ir.IntType(8)(0)
            )
            good = builder.and_(good, builder.or_(positive, lacks))
            per_pivot = builder.select(positive, builder.fdiv(unit, pivot), nothing)
            per_root = builder.select(positive, builder.fdiv(unit, builder.call(root, (pivot,))), nothing)
            shares = {half: builder.fmul(rows[k, half], everywhere(per_pivot)) for half in halves}
            for i in range(k + 1, MOST):  # what the pivot's row leaves of those behind it
                share = spread(shares[i // LANES], i % LANES)
                for half in range(i // LANES, 2):
                    taken = builder.fmul(share, rows[k, half], flags=("contract",))
                    rows[i, half] = builder.fsub(rows[i, half], taken, flags=("contract",))
            for half in halves:
                rows[k, half] = builder.fmul(rows[k, half], everywhere(per_root))
            before = k % LANES  # entries before the diagonal are not part of the column
            lanes = [LANES + i if i < before else i for i in range(LANES)]
            rows[k, k // LANES] = _chosen(builder, rows[k, k // LANES], zeros, lanes)
        for columns, half in ((0, 0), (0, 1), (1, 1)):
            block = [rows.get((columns * LANES + i, half), zeros) for i in range(LANES)]
            for i, row in enumerate(_transposed(builder, block)):
                if half * LANES + i < MOST:
                    L.store((half * LANES + i) * ROOM + columns * LANES, row)
        return good

    return types.boolean(P, there, L), generate


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
