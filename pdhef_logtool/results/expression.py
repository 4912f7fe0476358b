"""Conditions on the columns of tracks: ``abs(sideslip_error_deg) > 2 and speed_m_s > 10 for 0.5s``.

::

    condition:  either [for NUMBER s]        holds at least so long
    either:     both {or both}
    both:       one {and one}
    one:        not one | sum [(< | <= | > | >= | == | !=) sum]
    sum:        product {(+ | -) product}
    product:    atom {(* | /) atom}
    atom:       NUMBER | [-] atom | abs(sum) | (either) | [TRACK.]COLUMN

A column is one of estimates.parquet, ``speed_m_s``, or the error of a scored signal against the truth, with ``error``
before its unit: ``sideslip_error_rad``, ``vx_error_m_s``. Each column in rad may be asked for in deg, each in m/s in
km_h. What is not known, as an error without truth, is neither true nor false.
"""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, NoReturn, TypeAlias

import numpy as np

from pdhef_logtool.evaluation.units import SCORED_SIGNALS
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import BoolArray, FloatArray
from pdhef_logtool.records.tracks import TRACK_COLUMNS

SPEED = "speed_m_s"
#: Columns that are true or false.
FLAGS = frozenset({"valid", "diverged"})
ERRORS = {re.sub(r"_(rad|rad_s|m_s|m_s2)$", r"_error_\1", s): s for s in SCORED_SIGNALS}
COLUMNS = (*(c for c in TRACK_COLUMNS if c != "stamp_ns"), SPEED, *ERRORS)
#: Ends of names that people may write instead: the end in our files, and the factor from it.
_UNITS = {"_deg": ("_rad", math.degrees(1.0)), "_deg_s": ("_rad_s", math.degrees(1.0)), "_km_h": ("_m_s", 3.6)}
_MOST_SIGNS, _DEEPEST = 2000, 40
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)"
    r"|(?P<name>[A-Za-z_]\w*(?:(?:-\w+)*\.[A-Za-z_]\w*)?)"
    r"|(?P<sign><=|>=|==|!=|[-+*/<>()]))",
    re.ASCII,
)
_COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")
#: What an :class:`Applied` does, on arrays as on expressions of polars.
OPERATIONS: dict[str, Callable[..., Any]] = {
    "not": operator.invert, "minus": operator.neg, "abs": abs, "and": operator.and_, "or": operator.or_,
    "+": operator.add, "-": operator.sub, "*": operator.mul, "/": operator.truediv,
    "<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge, "==": operator.eq, "!=": operator.ne,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Number:
    """A number as it was written."""

    value: float


@dataclass(frozen=True, slots=True)
class Column:
    """A column of a track; ``track`` None: of the main estimator. ``factor``: to the unit that was asked for."""

    track: str | None
    name: str
    factor: float = 1.0


@dataclass(frozen=True, slots=True)
class Applied:
    """An operator or function on one or two operands: ``abs``, ``-``, ``not``, ``and``, ``<`` and so on."""

    of: str
    operands: tuple[Node, ...]


Node: TypeAlias = Number | Column | Applied


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition with the time for which it must hold.

    ``peak`` is what an event has a peak of, the left side of the first comparison, None without one; ``falls``: its
    smallest value is the peak.
    """

    text: str
    node: Node
    least_s: float
    peak: Node | None
    falls: bool

    def columns(self) -> Iterator[Column]:
        """Yield the columns that it reads."""
        return _columns(self.node)


def parse_condition(text: str, columns: tuple[str, ...] = COLUMNS, guide: str = "docs/compare.md") -> Condition:
    """Read a condition on the columns of tracks, or on others, which are all numbers and of no track.

    ``guide``: the page that tells of the columns.

    Raises
    ------
    UsageError
        It does not parse, names no column, or mixes numbers with what is true or false; the place is told.
    """
    parser = _Parser(text, columns, guide)
    node = parser.condition()
    compared = next((n for n in _all(node) if isinstance(n, Applied) and n.of in _COMPARISONS), None)
    return Condition(
        text=" ".join(text.split()),
        node=node,
        least_s=parser.least_s,
        peak=None if compared is None else compared.operands[0],
        falls=compared is not None and compared.of in ("<", "<="),
    )


def where_holds(condition: Condition, columns: Mapping[str, FloatArray]) -> BoolArray:
    """Return where a condition on columns [N] holds, its time aside; of a NaN no comparison holds but !=."""
    count = len(next(iter(columns.values())))
    with np.errstate(all="ignore"):
        return np.broadcast_to(np.asarray(_value(condition.node, columns), dtype=np.bool_), count)


def _value(node: Node, columns: Mapping[str, FloatArray]) -> Any:
    if isinstance(node, Number):
        return np.float64(node.value)
    if isinstance(node, Column):
        return columns[node.name] * node.factor
    return OPERATIONS[node.of](*(_value(operand, columns) for operand in node.operands))


def _all(node: Node) -> Iterator[Node]:
    yield node
    for operand in node.operands if isinstance(node, Applied) else ():
        yield from _all(operand)


def _columns(node: Node) -> Iterator[Column]:
    return (n for n in _all(node) if isinstance(n, Column))


def is_flag(node: Node) -> bool:
    """Tell whether a node is true or false rather than a number."""
    if isinstance(node, Applied):
        return node.of in ("and", "or", "not", *_COMPARISONS)
    return isinstance(node, Column) and node.name in FLAGS


#: A rule of the grammar.
_Rule: TypeAlias = Callable[[], Node]


class _Parser:
    def __init__(self, text: str, columns: tuple[str, ...], guide: str) -> None:
        self._text, self._columns, self._guide = text, columns, guide
        self.least_s = 0.0
        self._depth = 0
        if len(text) > _MOST_SIGNS:
            raise UsageError(
                expected=f"a condition of at most {_MOST_SIGNS} signs", got=f"{len(text)} signs", where="--where"
            )
        self._tokens = list(self._split())
        self._at = 0

    def condition(self) -> Node:
        node = self._flag(self._either, "a condition")
        if self._take("for"):
            self.least_s = self._number("a time such as 0.5s")
            if not self._take("s"):
                self._fail("s, for seconds")
        if self._kind != "end":
            self._fail("and, or, for, or the end")
        return node

    def _either(self) -> Node:
        return self._joined(self._both, "or")

    def _both(self) -> Node:
        return self._joined(self._one, "and")

    def _joined(self, part: _Rule, word: str) -> Node:
        start = self._at
        node = part()
        while self._word == word:
            self._must_be_flag(node, start)
            self._at += 1
            start = self._at
            other = part()
            self._must_be_flag(other, start)
            node = Applied(word, (node, other))
        return node

    def _one(self) -> Node:
        if self._take("not"):
            start = self._at
            node = self._deeper(self._one)
            self._must_be_flag(node, start)
            return Applied("not", (node,))
        start = self._at
        node = self._sum()
        if self._word in _COMPARISONS:
            self._must_be_number(node, start)
            sign = self._next()
            start = self._at
            other = self._sum()
            self._must_be_number(other, start)
            node = Applied(sign, (node, other))
            if self._word in _COMPARISONS:
                self._fail("and between two comparisons")
        return node

    def _sum(self) -> Node:
        return self._calculated(self._product, ("+", "-"))

    def _product(self) -> Node:
        return self._calculated(self._atom, ("*", "/"))

    def _calculated(self, part: _Rule, signs: tuple[str, ...]) -> Node:
        start = self._at
        node = part()
        while self._word in signs:
            self._must_be_number(node, start)
            sign = self._next()
            start = self._at
            other = part()
            self._must_be_number(other, start)
            node = Applied(sign, (node, other))
        return node

    def _atom(self) -> Node:
        if self._take("-"):
            start = self._at
            node = self._deeper(self._atom)
            self._must_be_number(node, start)
            return Applied("minus", (node,))
        if self._take("("):
            node = self._deeper(self._either)
            self._close()
            return node
        if self._kind == "number":
            return Number(self._number(""))
        if self._kind != "name" or self._word in ("and", "or", "not", "for"):
            self._fail("a column, a number, abs or (")
        if self._word == "abs" and self._tokens[self._at + 1][1] == "(":
            self._at += 2
            start = self._at
            node = self._deeper(self._sum)
            self._must_be_number(node, start)
            self._close()
            return Applied("abs", (node,))
        return self._column()

    def _column(self) -> Column:
        track, _, name = self._word.rpartition(".")
        ours, factor = name, 1.0
        for end, (ending, times) in _UNITS.items():
            if name.endswith(end) and name.removesuffix(end) + ending in self._columns:
                ours, factor = name.removesuffix(end) + ending, times
        if ours not in self._columns:
            near = get_close_matches(name, [*self._columns, *_in_other_units(self._columns)], n=1, cutoff=0.5)
            self._fail(f"a column such as {near[0]}" if near else f"a column: {', '.join(self._columns)}")
        if track and self._columns is not COLUMNS:
            self._fail(f"{name} alone")
        if track == "truth" and ours in ERRORS:
            self._fail("an estimator before an error")
        self._at += 1
        return Column(track or None, ours, factor)

    def _close(self) -> None:
        if not self._take(")"):
            self._fail(")")

    def _number(self, expected: str) -> float:
        if self._kind != "number":
            self._fail(expected)
        return float(self._next())

    def _flag(self, rule: _Rule, expected: str) -> Node:
        start = self._at
        node = rule()
        if not is_flag(node):
            self._fail(f"{expected}, such as a comparison", start)
        return node

    def _must_be_flag(self, node: Node, place: int) -> None:
        if not is_flag(node):
            self._fail("a comparison or a flag", place)

    def _must_be_number(self, node: Node, place: int) -> None:
        if is_flag(node):
            self._fail("a number", place)

    def _deeper(self, rule: _Rule) -> Node:
        self._depth += 1
        if self._depth > _DEEPEST:
            self._fail(f"at most {_DEEPEST} brackets and signs inside one another")
        node = rule()
        self._depth -= 1
        return node

    @property
    def _kind(self) -> str:
        return self._tokens[self._at][0]

    @property
    def _word(self) -> str:
        return self._tokens[self._at][1]

    def _next(self) -> str:
        self._at += 1
        return self._tokens[self._at - 1][1]

    def _take(self, word: str) -> bool:
        if self._word != word:
            return False
        self._at += 1
        return True

    def _split(self) -> Iterator[tuple[str, str, int]]:
        at, end = 0, len(self._text.rstrip())
        while at < end:
            found = _TOKEN.match(self._text, at)
            if found is None:
                at += len(self._text[at:]) - len(self._text[at:].lstrip())
                self._point("a column, a number or a sign", self._text[at], at)
            kind = str(found.lastgroup)
            yield kind, found[kind], found.start(kind)
            at = found.end()
        yield "end", "", end

    def _fail(self, expected: str, place: int | None = None) -> NoReturn:
        _, word, at = self._tokens[self._at if place is None else place]
        self._point(expected, word or "the end", at)

    def _point(self, expected: str, got: str, at: int) -> NoReturn:
        before, after = self._text[:at], self._text[at:]
        raise UsageError(
            expected=expected,
            got=got,
            where=f"--where, sign {at + 1} (here: {before[-30:]}»{after[:30]})",
            remedy=f"{self._guide} has the columns and what joins them",
        )


def _in_other_units(columns: tuple[str, ...]) -> Iterator[str]:
    for end, (ours, _) in _UNITS.items():
        yield from (c.removesuffix(ours) + end for c in columns if c.endswith(ours))
