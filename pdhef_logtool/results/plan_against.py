"""The verdicts of a validation plan with another run as baseline: run A of a comparison, or an earlier output."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

from pdhef_logtool.evaluation.validation_plan import RUN, ValidationPlan
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.results.opened_run import OpenedLog, OpenedRun, open_run
from pdhef_logtool.results.pairing import pair_logs
from pdhef_logtool.results.plan_verdicts import Against, JudgedDrive, PlanVerdicts, figures_of_file, plan_verdicts


def plan_verdicts_against(plan: ValidationPlan, a: OpenedRun, b: OpenedRun, *, strict: bool) -> PlanVerdicts:
    """Return the verdicts on the drives of B; raises OutputError where a table is damaged."""
    drives = [judged_drive(log) for log in b.logs]
    figures = figures_of_file(b.table("metrics"), plan, [d.main for d in drives])
    against = {**other_runs(plan, b.logs), RUN: _against(plan, a, b.logs)}
    return plan_verdicts(plan, figures, drives, strict=strict, against=against)


def other_runs(plan: ValidationPlan, logs: Sequence[OpenedLog]) -> dict[str, Against]:
    """Return the outputs that requirements name as baseline, by their path or URL, paired with logs of this run.

    Raises
    ------
    OutputError : One of them is missing (exit code 2) or damaged.
    """
    names = dict.fromkeys(n for r in plan.requirements if (n := r.other_run) not in (None, RUN))
    return {name: _against(plan, open_run(name), logs) for name in names if name is not None}


def _against(plan: ValidationPlan, run: OpenedRun, logs: Sequence[OpenedLog]) -> Against:
    partners = {pair.b.label: judged_drive(pair.a) for pair in pair_logs(run.logs, logs).pairs}
    return figures_of_file(run.table("metrics"), plan, [d.main for d in partners.values()]), partners


def judged_drive(log: OpenedLog, read_report: Callable[[], Mapping[str, Any] | None] | None = None) -> JudgedDrive:
    """Return a log of a run for :func:`~.plan_verdicts.plan_verdicts`; ``read_report`` None: from its file."""
    main = log.entry.get("main")
    factors = {"car": (log.entry.get("car") or {}).get("name"), **{k: log.entry.get(k) for k in ("day", "route")}}
    return JudgedDrive(log.label, None if main is None else str(main), read_report or partial(_report, log), factors)


def _report(log: OpenedLog) -> Mapping[str, Any] | None:
    with suppress(OutputError):  # the comparison states it
        return log.report()
    return None
