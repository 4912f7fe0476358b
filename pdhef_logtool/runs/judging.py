"""The verdicts of a validation plan on one drive and on all drives of a run."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pdhef_logtool.drive.reading import Drive
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.evaluation.requirement_blocks import RequirementBlocks
from pdhef_logtool.evaluation.requirement_verdicts import JudgedDrive
from pdhef_logtool.evaluation.statistics import LEAST_DRIVES
from pdhef_logtool.evaluation.validation_plan import ValidationPlan, default_plan, load_plan
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.results import plan_verdicts
from pdhef_logtool.results.plan_verdicts import PlanVerdicts
from pdhef_logtool.runs.run_result import LogResult
from pdhef_logtool.storage.documents import jsonable
from pdhef_logtool.storage.files import write_bytes


def read_validation_plan(file: Path | None, junit: Path | None) -> ValidationPlan:
    """Return the plan of a file or the default plan; raises UsageError if it is wrong, or missing for ``junit``."""
    if file is not None:
        plan = load_plan(file)
        plan_verdicts.other_runs(plan, ())  # a missing one ends the command before the work
        return plan
    if junit is not None:
        raise UsageError(
            expected="a validation plan to give verdicts on", got="none", where="--junit", remedy="--plan FILE"
        )
    return default_plan()


def judge_drive(
    plan: ValidationPlan,
    drive: Drive,
    main: str | None,
    rows: Sequence[MetricRow],
    blocks: Sequence[RequirementBlocks],
    space: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the entries of report.json on one drive: verdicts of a plan file, blocks of time, operating space."""
    stated = [{k: v for k, v in jsonable(block).items() if v != []} for block in blocks]
    entries = {"requirement_blocks": stated, "operating_space": jsonable(space)}
    if not plan.file:
        return {"plan": None, **entries}
    judged = JudgedDrive(drive.name, main, lambda: entries, {"car": drive.car.vehicle.name})
    drives, figures = [plan_verdicts.in_space(judged, entries)], plan_verdicts.figures_of_rows(rows)
    verdicts = plan_verdicts.plan_verdicts(plan, figures, drives).to_dict()["requirements"]
    return {"plan": {"file": plan.file, "requirements": verdicts}, **entries}


def judge(
    plan: ValidationPlan, results: Sequence[LogResult], strict: bool, tables: Path | None = None
) -> PlanVerdicts | None:
    """Return the verdicts of a plan on logs; None for the default plan on few logs.

    ``tables``: folder of the tables of all logs, None: figures and reports are in memory. A log that failed has no
    figures.
    """
    done = [r for r in results if r.outcome.failed is None or r.document is not None]
    if not plan.file and len(done) < LEAST_DRIVES:
        return None
    drives: Sequence[JudgedDrive] = [plan_verdicts.judged_drive(r.opened) for r in done]
    if tables is None:
        figures = plan_verdicts.figures_of_rows(row for r in done for row in r.rows)
        drives = [plan_verdicts.in_space(d, d.read_report() or {}) for d in drives]
    else:
        figures = plan_verdicts.figures_of_file(tables / "metrics.parquet", plan, [d.main for d in drives])
        drives = plan_verdicts.in_spaces(drives, plan, lambda name: tables / f"{name}.parquet")
    against = plan_verdicts.other_runs(plan, [r.opened for r in done])
    return plan_verdicts.plan_verdicts(plan, figures, drives, strict=strict, against=against)


def write_verdicts(junit: Path | None, verdicts: PlanVerdicts | None, results: Sequence[LogResult]) -> None:
    """Write JUnit XML if ``junit`` is a file; raises OutputError."""
    if junit is not None and verdicts is not None:
        from pdhef_logtool.results.junit import junit_bytes

        write_bytes(junit, junit_bytes(verdicts, {r.outcome.log: r.tables["checks"][0].as_py() for r in results}))
