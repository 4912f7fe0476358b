"""The files of a whole run, written from the journal and the drives' files: tables, run.json, pages."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pdhef_logtool.evaluation.validation_plan import ValidationPlan
from pdhef_logtool.logs.discovery import folders_of
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.results.opened_run import PAGE_FILE, TABLES_FOLDER, open_run
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.drive_outputs import log_place, write_run, write_run_tables
from pdhef_logtool.runs.journal import Entry
from pdhef_logtool.runs.judging import judge
from pdhef_logtool.runs.planning import Plan
from pdhef_logtool.runs.run_result import FEW_LOGS, LogResult

if TYPE_CHECKING:
    from pdhef_logtool.results.plan_verdicts import PlanVerdicts


def collect(plan: Plan, config: RunConfig, validation: ValidationPlan) -> tuple[list[LogResult], PlanVerdicts | None]:
    """Write the tables and run.json of all drives that are done.

    Returns their results in the order of the plan of the run, and the verdicts of the validation plan.
    """
    output = plan.output
    folders = folders_of([p.log for p in plan.logs])
    entries = [(e, f) for p, f in zip(plan.logs, folders, strict=True) if (e := plan.entry(p)) is not None]
    remaining = len(plan.logs) - len(entries)
    if not entries and remaining:
        return [], None
    results = [_result(plan, entry, folder) for entry, folder in entries]
    write_run_tables(output, results)
    cars = plan.journal.described["car"] | plan.cars_of_run()  # the journal's line of a car may be damaged
    networks = {cars[e.car]["network"] and tuple(cars[e.car]["network"]) for e, _ in entries if e.car is not None}
    verdicts = judge(validation, results, config.strict, output / TABLES_FOLDER)
    network = networks.pop() if len(networks) == 1 else None
    write_run(output, config.to_dict(), results, verdicts, network, remaining)
    if remaining:
        (output / PAGE_FILE).unlink(missing_ok=True)  # it shows other drives
    return results, verdicts


def _result(plan: Plan, entry: Entry, folder: str) -> LogResult:
    outcome = replace(plan.journal.outcome(entry), folder=folder)
    part = None if entry.part is None else plan.output / entry.part
    output = None if part is None else plan.output / log_place(entry.label)
    return LogResult(outcome, output, part=part, failed_checks=entry.failed_checks)


def write_run_pages(output: Path, report: bool, labels: Collection[str] | None, reporter: Reporter) -> None:
    """Write the page of the run and the pages of the named logs (None: all); without ``report``, remove all pages."""
    from pdhef_logtool.reports.pages import remove_pages, write_pages

    run = open_run(output)
    if not report:
        return remove_pages(run)
    logs = None if labels is None else [log for log in run.logs if log.label in labels]
    for line in write_pages(run, lambda text, _: reporter.progress(text, 1.0), logs=logs).wrong:
        reporter.warn(line)
    return None


@dataclass(slots=True)
class FleetProgress:
    """Progress of several logs as one line: the present log of a few, or the count and rate of many."""

    progress: Callable[[str, float], None]
    count: int
    ended: int = 0
    failed: int = 0
    _shares: dict[int, float] = field(default_factory=dict)
    _since: float = field(default_factory=time.monotonic)

    def update(self, number: int, text: str, share: float) -> None:
        """Show the progress of one log."""
        self._shares[number] = min(share, 1.0)
        self._show(text)

    def end(self, number: int) -> None:
        """Count a log as finished."""
        self._shares.pop(number, None)
        self.ended += 1
        if self.count > FEW_LOGS:
            self._show("")

    def _show(self, text: str) -> None:
        if self.count > FEW_LOGS:
            rate = self.ended / max(time.monotonic() - self._since, 1e-9)
            failed = f", {self.failed} failed" if self.failed else ""
            text = f"{self.ended} of {self.count}{failed}, {rate:.1f}/s"
        self.progress(text, (self.ended + sum(self._shares.values())) / self.count)
