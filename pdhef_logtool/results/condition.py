"""Conditions on columns, in the SQL of Polars: ``abs(sideslip_error_deg) > 2 AND speed_m_s > 10``.

A condition contains columns, numbers, operators and functions of one row. All other words are refused before Polars
parses the condition, because Polars executes a subquery when it parses it, and a subquery can read files.

A column is ``COLUMN`` or ``TRACK.COLUMN``; a name with other characters than letters and digits is in double quotes.
Columns in rad are also available in deg, columns in m/s in km/h. NaN is a missing value; a comparison with a missing
value is neither true nor false.
"""

import math
import operator
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from difflib import get_close_matches

import polars as pl

from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.signals import KM_H, BoolArray, FloatArray

#: Units of a condition: the unit of our columns, and the factor from it.
_UNITS = {"_deg": ("_rad", math.degrees(1.0)), "_deg_s": ("_rad_s", math.degrees(1.0)), "_km_h": ("_m_s", KM_H)}
#: Operators and functions of one row.
_WORDS = frozenset(
    """
    and or not is null true false in between case when then else end
    abs sign sqrt power exp ln sin cos tan asin acos atan atan2 degrees radians round floor ceil
    least greatest coalesce nullif
    """.split()  # noqa: SIM905 - a list with quotes is longer
)
_NAME = r'"[^"]+"|[A-Za-z_]\w*'
_NUMBER = r"(?P<decimal>\d*\.\d+)(?![eE\d])|[\d.]+(?:[eE][+-]?\d+)?"
_SIGN = r"-(?!-)|/(?!\*)|[+*%<>=!(),\s]"  # no comments
_TOKEN = re.compile(rf"(?:(?P<track>{_NAME})\.)?(?P<word>{_NAME})|{_NUMBER}|{_SIGN}", re.ASCII)
_LONGEST = 2000


@dataclass(frozen=True, slots=True)
class Reference:
    """A column of a track; ``track`` None: the selected estimate. ``factor`` converts it to the unit of its name."""

    track: str | None
    column: str
    factor: float


@dataclass(frozen=True, slots=True)
class Condition:
    """A condition. ``expression`` is on the columns ``references``, without NaN.

    ``peak``: left side of the first comparison, None without one; ``falls``: its smallest value is the peak.
    """

    text: str
    references: Mapping[str, Reference]
    expression: pl.Expr
    peak: pl.Expr | None
    falls: bool

    def is_true(self, columns: Mapping[str, FloatArray]) -> BoolArray:
        """Return the mask [N] of the rows that fulfil it, for columns [N] of one track."""
        frame = pl.DataFrame(dict(columns)).with_columns(
            (pl.col(r.column) * r.factor).fill_nan(None).alias(name) for name, r in self.references.items()
        )
        return frame.with_columns(condition=self.expression.fill_null(value=False))["condition"].to_numpy()


def parse_condition(
    text: str, columns: Collection[str], *, flags: Collection[str] = (), of_tracks: bool = True
) -> Condition:
    """Read a condition.

    Parameters
    ----------
    columns : names of numbers; flags : names of columns that are true or false.
    of_tracks : whether a column may have a track.

    Raises
    ------
    UsageError
        The condition does not parse, contains an unknown name, or is a number.
    """
    names = _names(columns, flags)
    references: dict[str, Reference] = {}

    def quoted(token: re.Match[str]) -> str:
        track, word = token["track"], token["word"]
        if token["decimal"]:
            return f"{token[0]}e0"  # a float; without an exponent it would be a fixed-point number
        if word is None or (track is None and word.lower() in _WORDS):
            return token[0]
        column = word.strip('"')
        if column not in names or (track and not of_tracks):
            raise _unknown(token[0], column, [*columns, *flags], names)
        name = token[0].replace('"', "")
        references[name] = Reference(track and track.strip('"'), *names[column])
        return f'"{name}"'

    unexpected = _TOKEN.sub("", text)
    if unexpected or len(text) > _LONGEST:
        got = unexpected[:20] if unexpected else f"{len(text)} characters"
        raise _error(f"columns, numbers and operators in at most {_LONGEST} characters", got)
    sql = _TOKEN.sub(quoted, text)
    schema = {name: pl.Boolean if r.column in flags else pl.Float64 for name, r in references.items()}
    try:
        expression = pl.sql_expr(sql)
        kind = pl.LazyFrame(schema=schema).select(condition=expression).collect_schema()["condition"]
    except pl.exceptions.PolarsError as error:
        raise _error("a condition in the SQL of Polars", str(error).splitlines()[0][:100]) from None
    if kind != pl.Boolean:
        raise _error("a condition, such as a comparison", text)
    peak, falls = _first_comparison(expression) or (None, False)
    return Condition(" ".join(text.split()), references, expression, peak, falls)


def _names(columns: Collection[str], flags: Collection[str]) -> dict[str, tuple[str, float]]:
    """Return all names that a condition may have: column and factor to the unit of the name."""
    names = {name: (name, 1.0) for name in (*columns, *flags)}
    for ending, (ours, factor) in _UNITS.items():
        names |= {c.removesuffix(ours) + ending: (c, factor) for c in columns if c.endswith(ours)}
    return names


def _first_comparison(expression: pl.Expr) -> tuple[pl.Expr, bool] | None:
    """Return the left side of the first comparison, and whether it is to be below the right side."""
    inputs = expression.meta.pop()[::-1]
    if len(inputs) == 2:
        for compare in (operator.lt, operator.le, operator.gt, operator.ge, operator.eq, operator.ne):
            if expression.meta.eq(compare(*inputs)):
                return inputs[0], compare in (operator.lt, operator.le)
    return next(filter(None, map(_first_comparison, inputs)), None)


def _unknown(got: str, column: str, listed: list[str], names: Collection[str]) -> UsageError:
    near = get_close_matches(column, names, n=1)
    remedy = f"{near[0]} is similar" if near else "docs/compare.md describes conditions"
    return _error(f"one of the columns {', '.join(listed)}", got, remedy)


def _error(expected: str, got: str, remedy: str = "docs/compare.md describes conditions") -> UsageError:
    return UsageError(expected=expected, got=got or "nothing", where="--where", remedy=remedy)
