"""Which figures two runs are compared by, and how much worse each may become."""

from __future__ import annotations

from dataclasses import dataclass

from pdhef_logtool.evaluation.metrics.registry import registered
from pdhef_logtool.evaluation.segments import SEGMENTS
from pdhef_logtool.evaluation.units import LABELS, SIGNALS, share_of
from pdhef_logtool.evaluation.validation_plan import ValidationPlan
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.storage.documents import unknown

#: Name for the selected estimate of each drive in A.
MAIN = "main"


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure of metrics.parquet; lower is better.

    ``estimator``: a name on both sides, or :data:`MAIN`. ``limit``: the share by which it may become worse, None:
    any.
    """

    signal: str = "sideslip_rad"
    metric: str = "rmse"
    segment: str = "all"
    estimator: str = MAIN
    limit: float | None = None

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


def figures_of(plan: ValidationPlan) -> tuple[Figure, ...]:
    """Return the figures of a plan's requirements for which lower is better, without limits."""
    figures = [Figure(r.signal, r.metric, r.segment, r.estimator or MAIN) for r in plan.requirements]
    return tuple(dict.fromkeys(f for f in figures if not figure_problems(f.signal, f.metric, f.segment))) or (Figure(),)


def asked_figures(
    plan: ValidationPlan | None, max_regression: str | None, estimator: str | None, metric: str | None
) -> tuple[Figure, ...]:
    """Return the figures to compare by, with their limits, from the options; raises UsageError."""
    single = {"--max-regression": max_regression, "--estimator": estimator, "--metric": metric}
    given = [name for name, value in single.items() if value is not None]
    if plan is not None:
        if given:
            raise UsageError(expected=f"--plan or {given[0]}", got="both", where="--plan")
        return figures_of(plan)
    limit = None if max_regression is None else share_of(max_regression)
    if max_regression is not None and limit is None:
        raise UsageError(expected="a share such as 5% or 0.05", got=max_regression, where="--max-regression")
    figure = Figure(metric=metric or "rmse", estimator=estimator or MAIN, limit=limit)
    if problems := figure_problems(figure.signal, figure.metric, figure.segment):
        raise UsageError(expected="a figure; lower is better", got="; ".join(problems), where="--metric")
    return (figure,)


def figure_problems(signal: str, metric: str, segment: str, where: str = "") -> list[str]:
    """Return the error in the specification of a figure."""
    # Less is better, and 0 is best: those that a ratio states something of.
    compared = tuple(name for name, metric in registered().items() if metric.best == "lower")
    choices = (("signal", signal, tuple(SIGNALS)), ("metric", metric, compared), ("segment", segment, SEGMENTS))
    return [f"{where}{key} = {unknown(value, allowed)}" for key, value, allowed in choices if value not in allowed]
