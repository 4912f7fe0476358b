"""Numbers of a column of texts, with an account of its cells: numbers, empty cells and unreadable cells."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl
from polars import Series

from pdhef_logtool.records.signals import FloatArray, Loss

#: Spellings of a missing value.
EMPTY = re.compile(r"(?i)\s*([-+]?(nan|1\.#(qnan|snan|ind))(\(\w*\))?0*|#?n/?a|#n/a!|<na>|nat|null|none|-*)\s*")
_BOOLEANS = {"true": "1", "false": "0"}
#: Groups of three digits with spaces or apostrophes between them.
_SPACED = r"^[-+]?[1-9]\d{0,2}([\s'’]\d{3})+([.,]\d*)?$"


@dataclass(frozen=True, slots=True, eq=False)
class Cells:
    """Contents of a column: every cell is a number, empty or unreadable.

    Attributes
    ----------
    values : float64 [N], NaN where a cell contains no number; all numbers are finite.
    empty, unreadable : cells without a number. example, row : first unreadable cell and its row, from 0.
    decimal : decimal mark that the cells need, ``.`` or ``,``; empty if they fit both.
    ambiguous : first cell with two readings, such as ``1,234``, and its value, if no evidence decides between them.
    """

    values: FloatArray
    empty: int = 0
    unreadable: int = 0
    example: str = ""
    row: int = 0
    decimal: str = ""
    ambiguous: str = ""

    @property
    def is_text(self) -> bool:
        """Whether most cells that are not empty contain no number: texts, dates or times of day."""
        return 2 * self.unreadable > len(self.values) - self.empty

    def losses(self, column: str, where: str, lines: Sequence[int] | None = None) -> Iterator[Loss]:
        """Yield the losses of a column of numbers; ``lines`` [N] are the lines of the rows in a file of text."""
        if self.unreadable and not self.is_text:
            place = f"from row {self.row + 1} on" if lines is None else f"from line {lines[self.row]} on"
            what = f"cells of {column} are not numbers, such as {self.example!r}"
            yield Loss("bad-cell", what, f"{where}, {place}", count=self.unreadable)
        if self.ambiguous and not self.is_text:
            yield Loss("ambiguous-number", f"{self.ambiguous} in {column}", where, severity="note")


def read_cells(texts: Series, decimal: str = "") -> Cells:
    """Read a column of texts [N] as numbers.

    One decimal mark applies to the whole column: the one that more of its cells need; if no cell decides, ``decimal``,
    or else the only mark that the cells contain. A cell that fits only the other mark is read with that one.
    """
    texts = texts.str.strip_chars()
    plain = texts.cast(pl.Float64, strict=False).to_numpy()
    if decimal == "." and np.count_nonzero(np.isfinite(plain)) == len(texts) - texts.null_count():
        return Cells(plain, texts.null_count())
    texts = texts.fill_null("")
    point, comma = _numbers(texts, "."), _numbers(texts, ",")
    rest = np.isnan(point) & np.isnan(comma)
    cleaned = _cleaned(texts.filter(rest))
    point[rest], comma[rest] = _numbers(cleaned, "."), _numbers(cleaned, ",")
    more = np.count_nonzero(np.isfinite(point)) - np.count_nonzero(np.isfinite(comma))
    needed = "." if more > 0 else "," if more < 0 else ""
    double = np.abs(point - comma) > 0.0
    ambiguous = texts.filter(double)
    mark = needed or decimal or ("," if ambiguous.str.contains(",", literal=True).all() else ".")
    values, others = (comma, point) if mark == "," else (point, comma)
    values = np.where(np.isnan(values), others, values)
    empty = np.isnan(values) & texts.str.contains(f"^{EMPTY.pattern}$").to_numpy()
    bad = np.flatnonzero(np.isnan(values) & ~empty)
    example, row = (texts[int(bad[0])][:40], int(bad[0])) if len(bad) else ("", 0)
    reading = ""
    if double.any() and not needed and "," in ambiguous[0] + mark and not (mark == decimal and mark in ambiguous[0]):
        reading = f"{ambiguous[0]} is read as {values[double][0]:.12g}"
    return Cells(values, int(empty.sum()), len(bad), example, row, needed, reading)


def _cleaned(texts: Series) -> Series:
    """Return texts with hexadecimal numbers, booleans, minus signs and groups of digits in plain spelling."""
    texts = texts.str.to_lowercase().str.replace_all("[−–]", "-").replace(_BOOLEANS)
    hexadecimal = texts.str.extract("^0x([0-9a-f]+)$").str.to_integer(base=16, strict=False).cast(pl.String)
    spaced = pl.when(texts.str.contains(_SPACED)).then(texts.str.replace_all(r"[\s'’]", ""))
    return pl.select(pl.coalesce(hexadecimal, spaced, texts)).to_series()


def _numbers(texts: Series, decimal: str) -> FloatArray:
    """Return the finite numbers [N] of texts with this decimal mark, NaN where a text has another spelling."""
    group = ",.".replace(decimal, "")
    spelling = rf"^[-+]?(\d+|[1-9]\d{{0,2}}([{group}]\d{{3}})+)?([{decimal}]\d*)?([eE][-+]?\d+)?$"
    plain = texts.str.replace_all(group, "", literal=True).str.replace(decimal, ".", literal=True)
    numbers = plain.cast(pl.Float64, strict=False).fill_null(float("nan")).to_numpy()
    return np.where(texts.str.contains(spelling).to_numpy() & np.isfinite(numbers), numbers, np.nan)
