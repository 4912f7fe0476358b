"""Summary of a run of many logs: distribution of errors, drives with the largest errors, and failures.

Only the figures of sideslip are read, as columns, so that a drive takes some bytes of memory.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from pdhef_logtool.results.fleet import ANSWER, JUDGED, grouped
from pdhef_logtool.results.opened_run import OpenedRun

if TYPE_CHECKING:
    import polars as pl

#: Number of drives with the largest errors, and estimators that are listed beside the selected estimate.
WORST = 10
_RIVALS = ("physics", "zero")


def summarise(run: OpenedRun, exit_code: int, checks_failed: Sequence[str]) -> dict[str, Any]:
    """Return the summary of a run as one JSON-able document; its drives are one by one in run.json.

    Logs with figures are ``done``, with a scored selected estimate ``scored``; errors need independent ground truth.

    Parameters
    ----------
    checks_failed : logs with failed checks that are not waived.

    Raises
    ------
    OutputError : metrics.parquet is damaged.
    """
    import polars as pl

    errors = _independent_errors(run)
    answers = errors.filter(pl.col("estimator") == pl.col("main"))
    error_rows = [_errors_of(ANSWER, answers)] if answers.height else []
    for name in _RIVALS:
        of_estimator = errors.filter(pl.col("estimator") == name)
        if of_estimator.height and set(answers["main"].unique()) != {name}:
            error_rows.append(_errors_of(name, of_estimator))
    failed = [(log.label, log.outcome.partition(": ")[2]) for log in run.logs if log.outcome.startswith("failed")]
    return {
        "output": str(run.place),
        "exit_code": exit_code,
        "logs": len(run.logs),
        "done": len(run.logs) - len(failed),
        "lost": sum(log.outcome.startswith("lost") for log in run.logs),
        "scored": answers.height,
        "remaining": int(run.document.get("remaining", 0)),
        "errors": error_rows,
        "worst": _worst(errors, answers),
        "failed": [asdict(f) for f in grouped(failed)],
        "checks_failed": list(checks_failed),
        "plan": run.document.get("plan"),
    }


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


def _errors_of(estimator: str, errors: pl.DataFrame) -> dict[str, Any]:
    """Return the distribution of the sideslip RMSE in rad of one estimator over drives."""
    values = errors["value"]
    spread = {"median": values.median(), "p90": values.quantile(0.9, "linear"), "max": values.max()}
    figures = {f"{name}_rad": _number(value) for name, value in spread.items()}
    return {"estimator": estimator, "drives": errors.height, **figures}


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else math.nan


def _worst(errors: pl.DataFrame, answers: pl.DataFrame) -> list[dict[str, Any]]:
    """Return the drives with the largest sideslip RMSE in rad by estimator, the selected estimate first."""
    import polars as pl

    worst = []
    for log, main in answers.sort("value", "log", descending=[True, False]).head(WORST).select("log", "main").rows():
        error_by_name = dict(errors.filter(pl.col("log") == log).select("estimator", "value").rows())
        names = dict.fromkeys((main, *(name for name in _RIVALS if name in error_by_name)))
        worst.append({"log": log, "main": main, "errors_rad": {name: error_by_name[name] for name in names}})
    return worst
