"""Numbers of a column of texts, with an account of its cells: numbers, empty cells and unreadable cells."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pdhef_logtool.records.signals import FloatArray, Loss

if TYPE_CHECKING:
    from polars import DataFrame, Expr, Series

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
    frame = _readings(texts)
    point, comma = frame["point"], frame["comma"]
    needs = {".": (point.is_not_null() & comma.is_null()).sum(), ",": (comma.is_not_null() & point.is_null()).sum()}
    undecided = needs["."] == needs[","]
    ambiguous = texts.filter(point != comma) if undecided else texts.clear()
    mark = decimal or ("," if ambiguous.str.contains(",", literal=True).all() else ".")
    mark = mark if undecided else max(needs, key=lambda m: needs[m])
    first, second = (comma, point) if mark == "," else (point, comma)
    numbers = frame.select(pl.coalesce(first, second, "other")).to_series()
    unreadable = (numbers.is_null() & ~frame["empty"]).to_numpy()
    row = int(unreadable.argmax())
    return Cells(
        numbers.fill_null(float("nan")).to_numpy(),
        int((numbers.is_null() & frame["empty"]).sum()),
        int(unreadable.sum()),
        texts[row][:40] if unreadable.any() else "",
        row,
        "" if undecided else mark,
        ambiguous[0] if len(ambiguous) else "",
    )


def _readings(texts: Series) -> DataFrame:
    """Return the numbers of texts by their decimal mark, in ``other`` spellings, and which texts are ``empty``."""
    import polars as pl

    text = pl.col("text")
    plain = texts.str.to_lowercase().str.replace_all("[−–]", "-").to_frame("text")
    spaces = pl.when(text.str.contains(_SPACED)).then(text.str.replace_all(r"[\s'’]", "")).otherwise(text)
    hexadecimal = pl.when(text.str.contains("^0x[0-9a-f]+$")).then(text.str.slice(2))
    hexadecimal = hexadecimal.str.to_integer(base=16, strict=False).cast(pl.Float64)
    return plain.with_columns(spaces).select(
        point=_numbers(".", ","),
        comma=_numbers(",", "."),
        other=hexadecimal.fill_null(text.replace_strict(_TRUTHS, default=None, return_dtype=pl.Float64)),
        empty=text.str.contains(EMPTY),
    )


def _numbers(decimal: str, group: str) -> Expr:
    """Return the finite numbers of a column ``text`` with these marks, null where a cell has another spelling."""
    import polars as pl

    text = pl.col("text")
    spelling = rf"^[-+]?(\d+|[1-9]\d{{0,2}}([{group}]\d{{3}})+)?([{decimal}]\d*)?(e[-+]?\d+)?$"
    plain = text.str.replace_all(group, "", literal=True).str.replace(decimal, ".", literal=True)
    number = pl.when(text.str.contains(spelling)).then(plain).cast(pl.Float64, strict=False)
    return pl.when(number.is_finite()).then(number)
