"""Which figures two runs are compared by, and how much worse each may become: strict reading of gate.toml."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from pdhef_logtool.evaluation.metrics.registry import registered
from pdhef_logtool.evaluation.segments import SEGMENTS
from pdhef_logtool.evaluation.thresholds import unit_of
from pdhef_logtool.evaluation.units import LABELS, SIGNALS
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.storage.documents import checked, read_toml, unknown

#: Name for the selected estimate of each drive in A.
MAIN = "main"
_SHARE = re.compile(r"\s*([0-9]*\.?[0-9]+)\s*(%?)\s*")


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of metrics.parquet whose lower value is better.

    ``estimator``: a name on both sides, or :data:`MAIN`. ``limit``: the share by which it may become worse, None where
    nothing is asked of it. ``floor``: figures below count as the floor, in the unit of metrics.parquet.
    """

    signal: str = "sideslip_rad"
    metric: str = "rmse"
    segment: str = "all"
    estimator: str = MAIN
    limit: float | None = None
    floor: float = 0.0

    @property
    def label(self) -> str:
        """``sideslip_rad rmse (all)``, with the estimator unless it is the selected one, for tables and reports."""
        of = "" if self.estimator == MAIN else f" of {self.estimator}"
        return f"{self.signal} {self.metric} ({self.segment}){of}"

    @property
    def short(self) -> str:
        """``sideslip RMSE`` or ``sideslip, braking``, for the axis of a figure."""
        name = LABELS[self.signal]
        what = name if self.metric == "rmse" and self.segment != "all" else f"{name} {registered()[self.metric].label}"
        return what if self.segment == "all" else f"{what}, {self.segment}"


@dataclass(frozen=True, slots=True)
class Gate:
    """What must not become worse; ``allow_unpaired``: drives on one side only do not break it."""

    figures: tuple[Figure, ...]
    allow_unpaired: bool = False


_Name = Annotated[str, Field(min_length=1)]


class _FigureTable(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    signal: _Name = "sideslip_rad"
    metric: _Name = "rmse"
    segment: _Name = "all"
    estimator: _Name = MAIN
    max_regression: str | float | int
    floor: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.0
    unit: _Name | None = None


def load_gate(path: Path) -> Gate:
    """Read gate.toml.

    Raises
    ------
    UsageError
        The file is missing, is no TOML, or contains wrong, unknown or missing entries; all are named.
    """
    return gate_from_dict(read_toml(path, "a gate TOML file", UsageError), where=str(path))


def gate_from_dict(raw: dict[str, Any], *, where: str) -> Gate:
    """Build a gate from parsed TOML; raises UsageError with every problem in one line."""
    expected = ("allow_unpaired", "figure")
    problems = [unknown(key, expected) for key in raw if key not in expected]
    allowed = raw.get("allow_unpaired", False)
    if not isinstance(allowed, bool):
        problems.append("allow_unpaired: should be true or false")
    tables = raw.get("figure", [])
    if not isinstance(tables, list) or not tables:
        problems.append("figure: give at least one [[figure]] table")
        tables = []
    figures = [_read_figure(table, f"figure[{i}]", problems) for i, table in enumerate(tables)]
    labels = [f.label for f in figures if f is not None]
    problems += [f"figure: {label} is there twice" for label in sorted(set(labels)) if labels.count(label) > 1]
    if problems:
        raise UsageError(
            expected="the entries of gate.toml", got="; ".join(problems), where=where, remedy="see docs/compare.md"
        )
    return Gate(tuple(f for f in figures if f is not None), bool(allowed))


def _read_figure(raw: object, where: str, problems: list[str]) -> Figure | None:
    table = checked(_FigureTable, raw, where, problems)
    if table is None:
        return None
    before = len(problems)
    problems += figure_problems(table.signal, table.metric, table.segment, f"{where}.")
    limit = share_of(table.max_regression)
    if limit is None:
        problems.append(f"{where}.max_regression: should be a share such as '5%' or 0.05, got {table.max_regression!r}")
    if len(problems) > before or limit is None:
        return None
    _, factor = unit_of(table.signal, table.metric, table.unit, where, problems)
    return Figure(table.signal, table.metric, table.segment, table.estimator, limit, table.floor * factor)


def figure_problems(signal: str, metric: str, segment: str, where: str = "") -> list[str]:
    """Return what is wrong with the words of a figure."""
    # Less is better, and 0 is best: those that a ratio states something of.
    compared = tuple(name for name, metric in registered().items() if metric.best == "lower")
    choices = (("signal", signal, tuple(SIGNALS)), ("metric", metric, compared), ("segment", segment, SEGMENTS))
    return [f"{where}{key} = {unknown(value, allowed)}" for key, value, allowed in choices if value not in allowed]


def share_of(text: str | float) -> float | None:
    """Return the share that ``5%``, ``0.05`` or a number represents; None for what is none, or above 10."""
    if isinstance(text, str):
        match = _SHARE.fullmatch(text)
        if match is None:
            return None
        share = float(match[1]) / (100.0 if match[2] else 1.0)
    else:
        share = float(text)
    return share if math.isfinite(share) and 0.0 <= share <= 10.0 else None
