"""Summary of a run of many logs: distribution of errors, drives with the largest errors, and failures.

Only the figures of sideslip are read, as columns, so that a drive takes some bytes of memory.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pdhef_logtool.results.fleet import ANSWER, JUDGED, Failures, grouped
from pdhef_logtool.results.opened_run import OpenedRun

if TYPE_CHECKING:
    import polars as pl

#: Number of drives with the largest errors, and estimators that are listed beside the selected estimate.
WORST = 10
_RIVALS = ("physics", "zero")


@dataclass(frozen=True, slots=True)
class ErrorsOf:
    """RMSE of sideslip in rad of one estimator over drives with independent ground truth."""

    estimator: str
    drives: int
    median_rad: float
    p90_rad: float
    max_rad: float


@dataclass(frozen=True, slots=True)
class WorstDrive:
    """A drive with a large error: RMSE of sideslip in rad by estimator, the selected estimate first."""

    log: str
    main: str
    errors_rad: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class RunSummary:
    """Summary of a run of many logs.

    Attributes
    ----------
    output : folder or URL. exit_code : of the run. logs, done, lost : logs, those with figures, those with input lost.
    scored : drives with a scored selected estimate. remaining : logs that are not done. checks_failed : logs with
        failed checks that count.
    """

    output: Path | str
    exit_code: int
    logs: int
    done: int
    lost: int
    scored: int
    remaining: int
    errors: tuple[ErrorsOf, ...]
    worst: tuple[WorstDrive, ...]
    failed: tuple[Failures, ...]
    checks_failed: tuple[str, ...]
    plan: Mapping[str, Any] | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the summary as one JSON-able document; its drives are one by one in run.json."""
        return {**asdict(self), "output": str(self.output)}


def summarise(run: OpenedRun, exit_code: int, checks_failed: Sequence[str]) -> RunSummary:
    """Return the summary of a run; raises OutputError where metrics.parquet is damaged."""
    import polars as pl

    errors = _independent_errors(run)
    answers = errors.filter(pl.col("estimator") == pl.col("main"))
    error_rows = [ErrorsOf(ANSWER, *_spread(answers))] if answers.height else []
    for name in _RIVALS:
        of_estimator = errors.filter(pl.col("estimator") == name)
        if of_estimator.height and set(answers["main"].unique()) != {name}:
            error_rows.append(ErrorsOf(name, *_spread(of_estimator)))
    failed = [(log.label, log.outcome.partition(": ")[2]) for log in run.logs if log.outcome.startswith("failed")]
    return RunSummary(
        output=run.place,
        exit_code=exit_code,
        logs=len(run.logs),
        done=len(run.logs) - len(failed),
        lost=sum(log.outcome.startswith("lost") for log in run.logs),
        scored=answers.height,
        remaining=int(run.document.get("remaining", 0)),
        errors=tuple(error_rows),
        worst=tuple(_worst(errors, answers)),
        failed=grouped(failed),
        checks_failed=tuple(checks_failed),
        plan=run.document.get("plan"),
    )


def _independent_errors(run: OpenedRun) -> pl.DataFrame:
    """Return log, estimator, RMSE (value) and main (selected estimator) of tracks with independent ground truth.

    Raises
    ------
    OutputError : metrics.parquet of the run is damaged.
    """
    import polars as pl

    texts = {"log": pl.String, "main": pl.String}
    mains = pl.DataFrame([(log.label, log.main()) for log in run.logs], schema=texts, orient="row")
    rows = run.metrics().filter(pl.col("signal") == JUDGED)
    dependent = rows.filter(pl.col("metric") == "not_independent").select("log", "estimator")
    scored = rows.filter(pl.col("metric") == "rmse", pl.col("segment") == "all", pl.col("value").is_finite())
    scored = scored.select("log", "estimator", "value").join(dependent, on=["log", "estimator"], how="anti")
    return scored.collect().join(mains, on="log").sort("log", "estimator")


def _spread(errors: pl.DataFrame) -> tuple[int, float, float, float]:
    values = errors["value"]
    median, p90 = values.median(), values.quantile(0.9, "linear")
    return errors.height, _number(median), _number(p90), _number(values.max())


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def _worst(errors: pl.DataFrame, answers: pl.DataFrame) -> list[WorstDrive]:
    import polars as pl

    worst = []
    for log, main in answers.sort("value", "log", descending=[True, False]).head(WORST).select("log", "main").rows():
        error_by_name = dict(errors.filter(pl.col("log") == log).select("estimator", "value").rows())
        names = dict.fromkeys((main, *(name for name in _RIVALS if name in error_by_name)))
        worst.append(WorstDrive(log, main, {name: error_by_name[name] for name in names}))
    return worst
