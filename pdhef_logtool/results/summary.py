"""Summary of a run of many logs: distribution of errors, drives with the largest errors, and failures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from pdhef_logtool.results.fleet import ANSWER, JUDGED, grouped, independent_errors, read_figures
from pdhef_logtool.results.opened_run import OpenedRun

#: Number of drives with the largest errors.
WORST = 10


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
    mains, errors = {log.label: log.main() for log in run.logs}, dict[str, dict[str, float]]()
    for label, figures in read_figures(run).items():
        errors[label] = {e: value for (e, signal), value in independent_errors(figures).items() if signal == JUDGED}
    answers = {label: of[mains[label]] for label, of in errors.items() if mains.get(label) in of}
    selected = {mains[label] for label in answers}
    others = [name for name in dict.fromkeys(n for of in errors.values() for n in of) if {name} != selected]
    failed = [(log.label, log.outcome.partition(": ")[2]) for log in run.logs if log.outcome.startswith("failed")]
    return {
        "output": str(run.place),
        "exit_code": exit_code,
        "logs": len(run.logs),
        "done": len(run.logs) - len(failed),
        "lost": sum(log.outcome.startswith("lost") for log in run.logs),
        "scored": len(answers),
        "remaining": int(run.document.get("remaining", 0)),
        "errors": [
            *([_errors_of(ANSWER, [*answers.values()])] if answers else ()),
            *(_errors_of(name, [of[name] for of in errors.values() if name in of]) for name in others),
        ],
        "worst": [
            {"log": label, "main": mains[label], "errors_rad": {mains[label]: answers[label], **errors[label]}}
            for label in sorted(answers, key=lambda label: (-answers[label], label))[:WORST]
        ],
        "failed": [asdict(f) for f in grouped(failed)],
        "checks_failed": list(checks_failed),
        "plan": run.document.get("plan"),
    }


def _errors_of(estimator: str, values: Sequence[float]) -> dict[str, Any]:
    """Return the distribution of the sideslip RMSE in rad of one estimator over drives."""
    median, p90, largest = np.quantile(values, [0.5, 0.9, 1.0]).tolist()
    return {"estimator": estimator, "drives": len(values), "median_rad": median, "p90_rad": p90, "max_rad": largest}
