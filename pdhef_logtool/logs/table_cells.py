"""Numbers of a column of texts, with an account of its cells: numbers, empty cells and unreadable cells."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.records.signals import BoolArray, FloatArray, Loss

if TYPE_CHECKING:
    from polars import Series

#: Spellings of a missing value, in lower case.
EMPTY = r"^([-+]?(nan|1\.#(qnan|snan|ind))(\(\w*\))?0*|#?n/?a|#n/a!|<na>|nat|null|none|-*)$"
_TRUTHS = {"true": 1.0, "false": 0.0}
#: Groups of three digits with spaces or apostrophes between them, and with points.
_SPACED, _POINTS = r"^[-+]?[1-9]\d{0,2}([\s'’]\d{3})+([.,]\d*)?$", r"^[-+]?[1-9]\d{0,2}(\.\d{3})+$"


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Contents of a column: every cell is a number, empty or unreadable.

    Attributes
    ----------
    values : float64 [N], NaN where a cell contains no number; all numbers are finite.
    empty, unreadable : cells without a number. example, row : first unreadable cell and its row, from 0.
    decimal : decimal mark that the cells need, ``.`` or ``,``; empty if they fit both.
    ambiguous : first cell with two readings, such as ``1,234``, if no other cell of the column decides.
    """

    values: FloatArray
    empty: int = 0
    unreadable: int = 0
    example: str = ""
    row: int = 0
    decimal: str = ""
    ambiguous: str = ""

    @property
    def numbers(self) -> int:
        """Number of cells that contain a number."""
        return len(self.values) - self.empty - self.unreadable

    @property
    def is_text(self) -> bool:
        """Whether most of the cells that are not empty contain no number: texts, dates or times of day."""
        return self.unreadable > self.numbers

    def losses(self, column: str, where: str, lines: Sequence[int] | None = None) -> Iterator[Loss]:
        """Yield the losses of a column of numbers; ``lines`` [N] are the lines of the rows in a file of text."""
        place = f"row {self.row + 1}" if lines is None else f"line {lines[self.row]}"
        if self.unreadable:
            what = f"{column} has cells that are not numbers, the first in {place}: {self.example!r}"
            yield Loss("bad-cell", what, where, count=self.unreadable)


def read_cells(texts: Series, decimal: str = "") -> Cells:
    """Read a column of texts [N] as numbers.

    One decimal mark applies to the whole column: the one that more of its cells need; if no cell decides, ``decimal``,
    or else the only mark that the cells contain. A cell that fits only the other mark is read with that one.
    """
    import polars as pl

    texts = texts.fill_null("").str.strip_chars()
    values = texts.cast(pl.Float64, strict=False).fill_null(float("nan")).to_numpy()
    if decimal != "," and np.isfinite(values).all():
        marked = texts.filter(texts.str.contains(".", literal=True))
        open_ = len(marked) > 0 and marked.str.contains(_POINTS).all()
        return Cells(values, decimal="" if open_ or not len(marked) else ".", ambiguous=marked[0] if open_ else "")
    point, comma, other, empty = _readings(texts)
    more = np.count_nonzero(np.isfinite(point)) - np.count_nonzero(np.isfinite(comma))
    needed = "." if more > 0 else "," if more < 0 else ""
    double = texts.filter(np.abs(point - comma) > 0.0)
    mark = needed or decimal or ("," if double.str.contains(",", literal=True).all() else ".")
    values = comma if mark == "," else point
    for numbers in (point, comma, other):
        values = np.where(np.isnan(values), numbers, values)
    unreadable = np.isnan(values) & ~empty
    row = int(unreadable.argmax())
    return Cells(
        values,
        int(np.count_nonzero(empty)),
        int(np.count_nonzero(unreadable)),
        texts[row][:40] if unreadable.any() else "",
        row,
        needed,
        double[0] if len(double) and not needed else "",
    )


def _readings(texts: Series) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """Return the numbers [N] by decimal point, by decimal comma and of other spellings, and which cells are empty."""
    import polars as pl

    point, comma = _numbers(texts, ".", ","), _numbers(texts, ",", ".")
    other, rest = np.full(len(texts), np.nan), np.isnan(point) & np.isnan(comma)
    empty = np.zeros(len(texts), np.bool_)
    if rest.any():
        text = texts.filter(rest).str.to_lowercase().str.replace_all("[−–]", "-")
        spaced = pl.when(text.str.contains(_SPACED)).then(text.str.replace_all(r"[\s'’]", "")).otherwise(text)
        text = pl.select(spaced).to_series()
        point[rest], comma[rest] = _numbers(text, ".", ","), _numbers(text, ",", ".")
        hexadecimal = text.str.extract("^0x([0-9a-f]+)$").str.to_integer(base=16, strict=False).cast(pl.Float64)
        truths = text.replace_strict(_TRUTHS, default=None, return_dtype=pl.Float64)
        other[rest] = hexadecimal.fill_null(truths).fill_null(float("nan")).to_numpy()
        empty[rest] = text.str.contains(EMPTY).to_numpy()
    return point, comma, other, empty


def _numbers(texts: Series, decimal: str, group: str) -> FloatArray:
    """Return the finite numbers [N] of texts with these marks, NaN where a text has another spelling."""
    import polars as pl

    spelling = rf"^[-+]?(\d+|[1-9]\d{{0,2}}([{group}]\d{{3}})+)?([{decimal}]\d*)?([eE][-+]?\d+)?$"
    plain = texts.str.replace_all(group, "", literal=True).str.replace(decimal, ".", literal=True)
    numbers = plain.cast(pl.Float64, strict=False).fill_null(float("nan")).to_numpy()
    return np.where(texts.str.contains(spelling).to_numpy() & np.isfinite(numbers), numbers, np.nan)
