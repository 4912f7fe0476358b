"""Conditions on the columns of tracks: ``abs(sideslip_error_deg) > 2 and speed_m_s > 10 for 0.5s``.

The syntax is that of Python's expressions (:mod:`ast` parses it, nothing is evaluated): comparisons joined by ``and``,
``or`` and ``not``; ``+ - * /``, ``abs`` and brackets within them; at the end an optional minimum duration
``for NUMBER s``. A column is ``[TRACK.]COLUMN``; a track whose name has other characters than letters, digits and
hyphens is quoted: ``"pd-hef:gain=1".sideslip_rad``.

A column is one of estimates.parquet, ``speed_m_s``, or the error of a scored signal against the ground truth, with
``error`` before its unit: ``sideslip_error_rad``, ``vx_error_m_s``. Columns in rad are also available in deg, columns
in m/s in km_h. ``segment == "NAME"`` is true within the segments and manoeuvres of that name. A missing value, such as
an error without ground truth, is neither true nor false.
"""

from __future__ import annotations

import ast
import math
import operator
import re
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any, TypeAlias

import numpy as np

from pdhef_logtool.evaluation.segments import SEGMENTS
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
#: A track before its column; hyphens are no part of a name for :mod:`ast`.
_TRACK = re.compile(r"[A-Za-z_]\w*(?:-\w+)+(?=\.)", re.ASCII)
_DURATION = re.compile(r"\bfor\b\s*(?:(?P<number>[\d.]+(?:[eE][+-]?\d+)?)\s*)?(?P<rest>.*)$", re.ASCII)
_COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")
_SIGNS: dict[type[ast.AST], str] = {
    ast.And: "and", ast.Or: "or", ast.Not: "not", ast.USub: "minus",
    ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/",
    ast.Lt: "<", ast.LtE: "<=", ast.Gt: ">", ast.GtE: ">=", ast.Eq: "==", ast.NotEq: "!=",
}  # fmt: skip
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
    """A column of a track; ``track`` None: of the selected estimate. ``factor``: to the unit that was asked for."""

    track: str | None
    name: str
    factor: float = 1.0


@dataclass(frozen=True, slots=True)
class Applied:
    """An operator or function on one or two operands: ``abs``, ``-``, ``not``, ``and``, ``<`` and so on."""

    of: str
    operands: tuple[Node, ...]


@dataclass(frozen=True, slots=True)
class Within:
    """True within the segments of a name."""

    segment: str


Node: TypeAlias = Number | Column | Applied | Within


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition with the time for which it must contain.

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

    ``guide``: the page that shows of the columns.

    Raises
    ------
    UsageError
        It does not parse, names no column, or mixes numbers with what is true or false; the place is given.
    """
    plain = "".join(" " if sign.isspace() else sign for sign in text)
    parser = _Parser(plain, columns, guide)
    node, least_s = parser.condition()
    compared = next((n for n in _all(node) if isinstance(n, Applied) and n.of in _COMPARISONS), None)
    return Condition(
        text=" ".join(text.split()),
        node=node,
        least_s=least_s,
        peak=None if compared is None else compared.operands[0],
        falls=compared is not None and compared.of in ("<", "<="),
    )


def where_holds(condition: Condition, columns: Mapping[str, FloatArray]) -> BoolArray:
    """Return where a condition on columns [N] is true, its time aside; of a NaN only != is true."""
    count = len(next(iter(columns.values())))
    with np.errstate(all="ignore"):
        return np.broadcast_to(np.asarray(_value(condition.node, columns), dtype=np.bool_), count)


def _value(node: Node, columns: Mapping[str, FloatArray]) -> Any:
    if isinstance(node, Number):
        return np.float64(node.value)
    if isinstance(node, Column):
        return columns[node.name] * node.factor
    if isinstance(node, Within):
        raise TypeError(f"segment {node.segment} of columns without a drive")
    return OPERATIONS[node.of](*(_value(operand, columns) for operand in node.operands))


def _all(node: Node) -> Iterator[Node]:
    yield node
    for operand in node.operands if isinstance(node, Applied) else ():
        yield from _all(operand)


def _columns(node: Node) -> Iterator[Column]:
    return (n for n in _all(node) if isinstance(n, Column))


def is_flag(node: Node) -> bool:
    """Return whether a node is true or false rather than a number."""
    if isinstance(node, Applied):
        return node.of in ("and", "or", "not", *_COMPARISONS)
    return isinstance(node, Within) or (isinstance(node, Column) and node.name in FLAGS)


class _Parser:
    """Turns a text into nodes; every failure is a UsageError with its place in the text."""

    def __init__(self, text: str, columns: tuple[str, ...], guide: str) -> None:
        self._text, self._columns, self._guide = text, columns, guide
        self._start = len(text) - len(text.lstrip())

    def condition(self) -> tuple[Node, float]:
        """Return the condition and its minimum duration in s."""
        if len(self._text) > _MOST_SIGNS:
            raise UsageError(
                expected=f"a condition of at most {_MOST_SIGNS} signs", got=f"{len(self._text)} signs", where="--where"
            )
        if not self._text.isascii():
            raise self._error(
                "a column, a number or an operator", next(k for k, c in enumerate(self._text) if not c.isascii())
            )
        duration = _DURATION.search(self._text)
        end = len(self._text) if duration is None else duration.start()
        root = self._parsed(self._text[self._start : end].rstrip())
        node = self._node(root, 0)
        if not is_flag(node):
            raise self._error("a condition, such as a comparison", self._start)
        return node, 0.0 if duration is None else self._seconds(duration)

    def _seconds(self, duration: re.Match[str]) -> float:
        try:
            seconds = float(duration["number"] or "")
        except ValueError:
            raise self._error(
                "a time such as 0.5s", duration.start("number" if duration["number"] else "rest")
            ) from None
        if duration["rest"].strip() != "s":
            raise self._error("s, for seconds", duration.start("rest"))
        return seconds

    def _parsed(self, text: str) -> ast.expr:
        #: The names of tracks as they were written, by the names that represent them.
        self._tracks = {name.replace("-", "_"): name for name in _TRACK.findall(text)}
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                return ast.parse(_TRACK.sub(lambda name: name[0].replace("-", "_"), text), mode="eval").body
        except (MemoryError, RecursionError):
            raise self._error(f"at most {_DEEPEST} brackets and signs inside one another", self._start) from None
        except (SyntaxError, ValueError) as error:
            offset = getattr(error, "offset", None) or len(text) + 1  # 0: at the end
            place = self._start + min(offset - 1, len(text))
            raise self._error("a condition on columns, numbers and abs()", place) from None

    def _node(self, of: ast.expr, depth: int) -> Node:
        if depth > _DEEPEST:
            raise self._error(f"at most {_DEEPEST} brackets and signs inside one another", of)
        match of:
            case ast.BoolOp(op=op, values=[first, *others]):
                node = self._flag(first, depth)
                for other in others:
                    node = Applied(_SIGNS[type(op)], (node, self._flag(other, depth)))
                return node
            case ast.UnaryOp(op=ast.Not(), operand=operand):
                return Applied("not", (self._flag(operand, depth),))
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return Applied("minus", (self._number(operand, depth),))
            case ast.BinOp(left=left, op=op, right=right) if type(op) in _SIGNS:
                return Applied(_SIGNS[type(op)], (self._number(left, depth), self._number(right, depth)))
            case ast.Compare(left=ast.Name(id="segment"), comparators=[ast.Constant(value=str() as name), *_]):
                return self._segment(of, name)
            case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in _SIGNS:
                return Applied(_SIGNS[type(op)], (self._number(left, depth), self._number(right, depth)))
            case ast.Compare(comparators=[_, second, *_]):
                raise self._error("and between two comparisons", second)
            case ast.Call(func=ast.Name(id="abs"), args=[operand], keywords=[]):
                return Applied("abs", (self._number(operand, depth),))
            case ast.Constant(value=bool()):
                raise self._error("a column, a number, abs or (", of)
            case ast.Constant(value=int() | float() as value):
                return Number(float(value))
            case ast.Name(id=name):
                return self._column(None, name, of)
            case ast.Attribute(value=ast.Name(id=track), attr=name):
                return self._column(self._tracks.get(track, track), name, of)
            case ast.Attribute(value=ast.Constant(value=str() as track), attr=name):
                return self._column(track, name, of)
        raise self._error("a column, a number, abs or (", of)

    def _flag(self, of: ast.expr, depth: int) -> Node:
        node = self._node(of, depth + 1)
        if not is_flag(node):
            raise self._error("a comparison or a flag", of)
        return node

    def _number(self, of: ast.expr, depth: int) -> Node:
        node = self._node(of, depth + 1)
        if is_flag(node):
            raise self._error("a number", of)
        return node

    def _segment(self, of: ast.Compare, name: str) -> Within:
        if self._columns is not COLUMNS:
            raise self._error("a column", of.left)
        if len(of.ops) > 1 or not isinstance(of.ops[0], ast.Eq):
            raise self._error('segment == "NAME"', of)
        if name not in SEGMENTS:
            raise self._error(f"one of {', '.join(SEGMENTS)}", of.comparators[0])
        return Within(name)

    def _column(self, track: str | None, name: str, place: ast.expr) -> Column:
        ours, factor = name, 1.0
        for end, (ending, times) in _UNITS.items():
            if name.endswith(end) and name.removesuffix(end) + ending in self._columns:
                ours, factor = name.removesuffix(end) + ending, times
        if ours not in self._columns:
            near = get_close_matches(name, [*self._columns, *_in_other_units(self._columns)], n=1, cutoff=0.5)
            raise self._error(f"a column such as {near[0]}" if near else f"a column: {', '.join(self._columns)}", place)
        if track and self._columns is not COLUMNS:
            raise self._error(f"{name} alone", place)
        if track == "truth" and ours in ERRORS:
            raise self._error("an estimator before an error", place)
        return Column(track, ours, factor)

    def _error(self, expected: str, place: ast.expr | int) -> UsageError:
        position = place if isinstance(place, int) else self._start + place.col_offset
        before, after = self._text[:position], self._text[position:]
        if isinstance(place, ast.expr) and place.end_col_offset is not None:
            got = self._text[position : self._start + place.end_col_offset][:40]
        else:
            got = "".join(re.findall(r"^\s*(\w+|\S)", after)) or "the end"
        return UsageError(
            expected=expected,
            got=got,
            where=f"--where, character {position + 1} (here: {before[-30:]}»{after[:30]})",
            remedy=f"{self._guide} has the columns and what joins them",
        )


def _in_other_units(columns: tuple[str, ...]) -> Iterator[str]:
    for end, (ours, _) in _UNITS.items():
        yield from (c.removesuffix(ours) + end for c in columns if c.endswith(ours))
