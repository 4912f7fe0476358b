"""The verdicts of a validation plan on run B of a comparison, with run A as a possible baseline."""

from __future__ import annotations

from contextlib import suppress
from functools import partial

from pdhef_logtool.evaluation.requirement_blocks import RequirementBlocks
from pdhef_logtool.evaluation.validation_plan import ValidationPlan
from pdhef_logtool.records.errors import OutputError
from pdhef_logtool.results.opened_run import OpenedLog, OpenedRun
from pdhef_logtool.results.pairing import pair_logs
from pdhef_logtool.results.plan_verdicts import (
    JudgedDrive,
    PlanVerdicts,
    blocks_of,
    figures_of_file,
    plan_verdicts,
)


def plan_verdicts_against(plan: ValidationPlan, a: OpenedRun, b: OpenedRun, *, strict: bool) -> PlanVerdicts:
    """Return the verdicts on the drives of B; raises OutputError where metrics.parquet is damaged."""
    pairs = pair_logs(a.logs, b.logs).pairs
    drives_b = [_judged(log) for log in b.logs]
    partners = {pair.b.label: _judged(pair.a) for pair in pairs}
    figures_a = figures_of_file(a.metrics(), plan, [d.main for d in partners.values()])
    figures_b = figures_of_file(b.metrics(), plan, [d.main for d in drives_b])
    return plan_verdicts(plan, figures_b, drives_b, strict=strict, against=(figures_a, partners))


def _judged(log: OpenedLog) -> JudgedDrive:
    main = log.entry.get("main")
    return JudgedDrive(log.label, None if main is None else str(main), partial(_blocks, log))


def _blocks(log: OpenedLog) -> list[RequirementBlocks]:
    report = None
    with suppress(OutputError):  # the comparison states it
        report = log.report()
    return blocks_of(report)
