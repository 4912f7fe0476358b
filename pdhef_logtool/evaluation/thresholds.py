"""Limits on figures: strict reading of thresholds.toml, and one verdict a threshold and estimator.

A threshold that finds no figure is *not evaluated*, which fails like a figure beyond its limit, so that a renamed
signal or a log without ground truth cannot pass a gate silently; ``optional = true`` turns that into *skipped*.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

from pydantic import BaseModel, ConfigDict, Field

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.metrics.registry import registered
from pdhef_logtool.evaluation.metrics.sensor_residuals import SENSORS
from pdhef_logtool.evaluation.segments import SEGMENTS
from pdhef_logtool.evaluation.units import SIGNALS, typed_unit
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.storage.documents import checked, read_toml, unknown

Finite = Annotated[float, Field(allow_inf_nan=False)]
Name = Annotated[str, Field(min_length=1)]
Outcome: TypeAlias = Literal["pass", "fail", "not evaluated", "skipped"]


@dataclass(frozen=True, slots=True)
class Threshold:
    """One limit: ``minimum`` ≤ figure ≤ ``maximum``, in ``unit``, for every estimator whose name matches the glob.

    ``factor`` turns ``unit`` into the unit of metrics.parquet.
    """

    signal: str
    metric: str
    estimator: str = "*"
    segment: str = "all"
    minimum: float | None = None
    maximum: float | None = None
    unit: str = "1"
    factor: float = 1.0
    optional: bool = False

    @property
    def label(self) -> str:
        """``sideslip_rad rmse (all) <= 0.5 deg``, for tables and test reports."""
        unit = "" if self.unit == "1" else f" {self.unit}"
        limits = []
        if self.minimum is not None:
            limits.append(f">= {self.minimum:g}{unit}")
        if self.maximum is not None:
            limits.append(f"<= {self.maximum:g}{unit}")
        return f"{self.signal} {self.metric} ({self.segment}) {' and '.join(limits)}"


@dataclass(frozen=True, slots=True)
class Verdict:
    """How one estimator is against one threshold in one log.

    Attributes
    ----------
    estimator : its name, or the threshold's pattern where no estimator matched.
    value, margin : in the threshold's unit; None where there is no figure. A margin below 0 is a failure.
    n : samples behind the figure.
    independent : False where ground truth of the figure is an input or the estimate itself.
    reason : one sentence for a person, empty for a plain pass.
    """

    log: str
    estimator: str
    threshold: Threshold
    outcome: Outcome
    value: float | None = None
    margin: float | None = None
    n: int = 0
    independent: bool = True
    reason: str = ""

    @property
    def failed(self) -> bool:
        """Whether the gate is closed by it: a figure beyond its limit, or none where one is demanded."""
        return self.outcome in ("fail", "not evaluated")

    def to_dict(self) -> dict[str, Any]:
        """Return the verdict as JSON-able values; limits, value and margin in ``unit``."""
        limit = self.threshold
        return {
            "log": self.log,
            "estimator": self.estimator,
            "signal": limit.signal,
            "segment": limit.segment,
            "metric": limit.metric,
            "min": limit.minimum,
            "max": limit.maximum,
            "unit": limit.unit,
            "value": self.value,
            "margin": self.margin,
            "n": self.n,
            "independent": self.independent,
            "outcome": self.outcome,
            "reason": self.reason,
        }


class _ThresholdTable(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    estimator: Name = "*"
    signal: Name
    segment: Name = "all"
    metric: Name
    min: Finite | None = None
    max: Finite | None = None
    unit: Name | None = None
    optional: bool = False


def load_thresholds(path: Path) -> tuple[Threshold, ...]:
    """Read thresholds.toml.

    Raises
    ------
    UsageError
        The file is missing, is no TOML, or contains wrong, unknown, missing or contradicting entries; all are named.
    """
    return thresholds_from_dict(read_toml(path, "a thresholds TOML file", UsageError), where=str(path))


def thresholds_from_dict(raw: dict[str, Any], *, where: str) -> tuple[Threshold, ...]:
    """Build thresholds from parsed TOML; every problem is reported in one line.

    Raises
    ------
    UsageError : Entries are wrong, unknown, missing or contradict one another, or there is no threshold at all.
    """
    problems = [unknown(key, ("threshold",)) for key in raw if key != "threshold"]
    tables = raw.get("threshold", [])
    if not isinstance(tables, list) or not tables:
        problems.append("threshold: give at least one [[threshold]] table")
        tables = []
    thresholds = [_read_table(table, f"threshold[{i}]", problems) for i, table in enumerate(tables)]
    seen: dict[tuple[str, ...], int] = {}
    for i, threshold in enumerate(thresholds):
        if threshold is None:
            continue
        key = (threshold.estimator, threshold.signal, threshold.segment, threshold.metric)
        if key in seen:
            problems.append(f"threshold[{i}]: limits the same figure as threshold[{seen[key]}]")
        seen.setdefault(key, i)
    if problems:
        raise UsageError(
            expected="the entries of thresholds.toml",
            got="; ".join(problems),
            where=where,
            remedy="see docs/formats.md for every entry",
        )
    return tuple(t for t in thresholds if t is not None)


def _read_table(raw: object, where: str, problems: list[str]) -> Threshold | None:
    table = checked(_ThresholdTable, raw, where, problems)
    if table is None:
        return None
    before = len(problems)
    for key, value, allowed in (
        ("signal", table.signal, tuple(SIGNALS)),
        ("metric", table.metric, tuple(registered())),
        ("segment", table.segment, SEGMENTS),
    ):
        if value not in allowed:
            problems.append(f"{where}.{key} = {unknown(value, allowed)}")
    if table.min is None and table.max is None:
        problems.append(f"{where}: give min, max or both")
    elif table.min is not None and table.max is not None and table.min > table.max:
        problems.append(f"{where}: min must not be above max")
    if len(problems) > before:
        return None
    unit, factor = unit_of(table.signal, table.metric, table.unit, where, problems)
    if len(problems) > before:
        return None
    rest = table.model_dump(exclude={"min", "max", "unit"})
    return Threshold(minimum=table.min, maximum=table.max, unit=unit, factor=factor, **rest)


def unit_of(signal: str, metric: str, unit: str | None, where: str, problems: list[str]) -> tuple[str, float]:
    """Return the unit that an entry is in and its factor to that of metrics.parquet; a wrong one adds to ``problems``.

    ``unit``: what the entry states; None: that of metrics.parquet.
    """
    native = registered()[metric].unit_of(signal)
    typed, factor = typed_unit(native)
    if unit is None or unit == native:
        return native, 1.0
    if unit != typed:
        allowed = " or ".join(dict.fromkeys((native, typed)))
        problems.append(f"{where}.unit: {signal} {metric} is in {allowed}, not {unit!r}")
    return unit, 1.0 / factor


def check_thresholds(thresholds: Sequence[Threshold], rows: Sequence[MetricRow], *, log: str) -> list[Verdict]:
    """Compare the figures of one log with the thresholds.

    Parameters
    ----------
    rows : figures of this log; none when it failed.

    Returns
    -------
    In the order of the thresholds, a verdict for every estimator that matches and has the figure; one verdict, *not
    evaluated* or *skipped*, where there is none. Rows of ``sensors`` and of pairs (``a~b``) are only meant by a
    threshold that names them, or whose pattern has a ``~``.
    """
    verdicts = []
    for threshold in thresholds:
        figure = (threshold.signal, threshold.segment, threshold.metric)
        matching = [r for r in rows if (r.signal, r.segment, r.metric) == figure and _is_meant(threshold, r.estimator)]
        if not matching:
            verdicts.append(_without_figure(threshold, log, threshold.estimator, "no such figure in this log"))
        for row in matching:
            if math.isfinite(row.value):
                verdicts.append(_judge(threshold, row))
            else:
                verdicts.append(_without_figure(threshold, log, row.estimator, "the figure could not be computed"))
    return verdicts


def _is_meant(threshold: Threshold, name: str) -> bool:
    pattern = threshold.estimator
    if (name == SENSORS or "~" in name) and "~" not in pattern:
        return name == pattern
    return fnmatchcase(name, pattern)


def _without_figure(threshold: Threshold, log: str, estimator: str, reason: str) -> Verdict:
    outcome: Outcome = "skipped" if threshold.optional else "not evaluated"
    return Verdict(log, estimator, threshold, outcome, reason=reason)


def _judge(threshold: Threshold, row: MetricRow) -> Verdict:
    value = row.value / threshold.factor
    margins = []
    if threshold.maximum is not None:
        margins.append(threshold.maximum - value)
    if threshold.minimum is not None:
        margins.append(value - threshold.minimum)
    margin = min(margins)
    passed = margin >= 0.0
    reasons = [] if passed else [f"{value:.6g} {threshold.unit} is beyond the limit by {-margin:.3g}"]
    if not row.independent:
        reasons.append("not independent of ground truth")
    return Verdict(
        log=row.log,
        estimator=row.estimator,
        threshold=threshold,
        outcome="pass" if passed else "fail",
        value=value,
        margin=margin,
        n=row.n,
        independent=row.independent,
        reason="; ".join(reasons),
    )
