"""Summary of a run of many logs: distribution of errors, drives with the largest errors, and failures."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from pdhef_logtool.results.fleet import ANSWER, grouped, sideslip_errors
from pdhef_logtool.results.opened_run import OpenedRun

if TYPE_CHECKING:
    import polars as pl

#: Number of drives with the largest errors.
WORST = 10


def summarise(run: OpenedRun, exit_code: int) -> dict[str, Any]:
    """Return the summary of a run as one JSON-able document; its drives are one by one in run.json.

    Logs with figures are ``done``, with a scored selected estimate ``scored``; errors need independent ground truth.

    Raises
    ------
    OutputError : A table is damaged.
    """
    drives = run.table("drives").collect()
    scored = drives.drop_nulls("sideslip_rmse_rad").sort("sideslip_rmse_rad", "log", descending=[True, False])
    errors = sideslip_errors(run).collect()
    selected, failed = set(scored["estimator"]), drives.filter(outcome="failed")
    names = list(dict.fromkeys(errors["estimator"]))
    if len(selected) > 1:
        selected, names = {ANSWER}, [ANSWER, *names]
    else:
        names.sort(key=lambda name: name not in selected)
    worst = scored.head(WORST).select("log", "estimator").rows()
    return {
        "output": str(run.place),
        "exit_code": exit_code,
        "logs": len(drives),
        "done": len(drives) - len(failed),
        "lost": len(drives.filter(outcome="lost")),
        "scored": len(scored),
        "remaining": int(run.document.get("remaining", 0)),
        "errors": [
            _errors_of(n, scored["sideslip_rmse_rad"] if n in selected else errors.filter(estimator=n)["value"])
            for n in names
        ],
        "worst": [
            {"log": log, "main": main, "errors_rad": dict(errors.filter(log=log).select("estimator", "value").rows())}
            for log, main in worst
        ],
        "failed": [asdict(f) for f in grouped(failed.select("log", "reason").rows())],
        "checks_failed": drives.filter(drives["failed_checks"] > 0)["log"].to_list(),
        "plan": run.document.get("plan"),
    }


def _errors_of(estimator: str, values: pl.Series) -> dict[str, Any]:
    """Return the distribution of the sideslip RMSE in rad of one estimator over drives."""
    median, p90, largest = (values.quantile(q, "linear") for q in (0.5, 0.9, 1.0))
    return {"estimator": estimator, "drives": len(values), "median_rad": median, "p90_rad": p90, "max_rad": largest}
