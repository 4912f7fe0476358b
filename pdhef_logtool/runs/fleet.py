"""A run of one log or of a hundred thousand: planned (:mod:`~.planning`), processed (:mod:`~.working`), reported.

Each drive is in the journal (:mod:`~.journal`) before the next one counts. At every end the tables and run.json are
written from the journal and the drives' parts of the tables. No report and no figure is kept in memory.
"""

import itertools
import json
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, nullcontext, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from pdhef_logtool.drive.reading import logs_of
from pdhef_logtool.estimators.table import FILTERS
from pdhef_logtool.evaluation.validation_plan import ValidationPlan
from pdhef_logtool.logs.discovery import RUN_FILE, LogInput, Logs, folders_of
from pdhef_logtool.mapping import Mapping, mapping_of
from pdhef_logtool.records.errors import OutputError, PdhefError, UsageError, WorkerError
from pdhef_logtool.records.processes import process_name
from pdhef_logtool.records.reporter import SILENT, Reporter
from pdhef_logtool.results.no_position import neutral_stem
from pdhef_logtool.results.opened_run import JOURNAL_FILE, LOGS, PAGE_FILE, TABLES_FOLDER, open_run
from pdhef_logtool.results.plan_verdicts import PlanVerdicts
from pdhef_logtool.runs.cars import RunCars
from pdhef_logtool.runs.config import Keep, RunConfig
from pdhef_logtool.runs.drive_outputs import check_places, log_place, write_run, write_run_tables
from pdhef_logtool.runs.journal import Journal
from pdhef_logtool.runs.judging import judge, read_validation_plan, write_verdicts
from pdhef_logtool.runs.planning import Plan, plan_logs, settings_of, sweep_parts
from pdhef_logtool.runs.run_result import FEW_LOGS, LogResult, RunResult
from pdhef_logtool.runs.stored_output import StoredOutput, stored_drive
from pdhef_logtool.runs.working import DriveEnd, DriveTask, Work, failed_outcome, log_identity, run_drive, run_on_node
from pdhef_logtool.storage.object_store import is_url
from pdhef_logtool.storage.outputs import OutputFolder
from pdhef_logtool.workers.supervisor import Ended, Limits, Tell, supervise

#: Drives with the largest errors that keep all files if the run keeps metrics only because of their number.
FULL_WORST = 5
#: Value of ``Schedule.repeat`` for all logs that failed.
FAILED = "failed"
#: Time without progress after which a log is aborted, if several logs are processed at once or there are many.
SILENCE_S = 600.0
#: Modules that workers have loaded, and with them the compiler, which the process of the run has no need for. polars
#: starts threads at its first query, and none of these makes one.
_PRELOAD = ("pdhef_logtool.runs.run_drive", "pdhef_logtool.runs.working", "pdhef_logtool.logs.mcap_log", *FILTERS)
#: Numbers the runs of this process.
_RUNS = itertools.count()


@dataclass(frozen=True, slots=True)
class Schedule:
    """How a run's logs are processed; results do not depend on ``jobs`` and ``ray``.

    Attributes
    ----------
    jobs : number of processes.
    ray : address of a Ray cluster that processes the drives, one per processor at a time. The output folder, the logs
        and the files of the configuration must have the same path on every node.
    resume : keep the drives that the output's journal has with these settings.
    repeat : :data:`FAILED` keeps them but those that failed; else labels of logs to run now with all their files.
    limits : of one log; None: from the configuration, else :data:`SILENCE_S` for several jobs or many logs.
    """

    jobs: int = 1
    ray: str | None = None
    resume: bool = False
    repeat: Sequence[str] = ()
    limits: Limits | None = None

    @property
    def resumes(self) -> bool:
        """Whether the journal in the output folder is read."""
        return self.resume or bool(self.repeat)

    @property
    def only(self) -> Sequence[str]:
        """Labels of the only logs to run; empty: all."""
        return [name for name in self.repeat if name != FAILED]


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """Inputs that all logs of a run share."""

    config: RunConfig
    cars: RunCars
    mapping: Mapping | None
    validation: ValidationPlan
    junit: Path | None
    report: bool


def run_logs(
    arguments: Logs,
    output: Path | str,
    config: RunConfig,
    *,
    schedule: Schedule = Schedule(),
    junit: Path | str | None = None,
    report: bool = True,
    work: Work = run_drive,
    reporter: Reporter = SILENT,
) -> RunResult:
    """Run the configured estimators on logs and write the outputs of docs/formats.md#outputs to ``output``.

    A log that fails is reported and never stops the others. Logs of equal content are run once.

    Parameters
    ----------
    arguments : logs, folders, glob patterns.
    output : a folder, or the URL of one in an object store.
    junit : file for the verdicts of the validation plan as JUnit XML.
    report : whether pages are written (:mod:`pdhef_logtool.reports`); without, pages of an earlier run are removed.
    work : processes one drive.

    Raises
    ------
    UsageError, VehicleError, MappingError
        An input that all logs share is wrong: arguments, vehicle or mapping file, or an output would replace an input.
    OutputError
        The output cannot be written, or another command is writing to it.
    """
    inputs = logs_of(arguments, config.read_options)
    junit = None if junit is None else Path(junit)
    validation = read_validation_plan(config.plan, junit)
    job = _Job(config, RunCars.of(config, reporter.warn), mapping_of(config.mapping), validation, junit, report)
    alone = len(inputs) == 1 and schedule == Schedule() and work is run_drive and not is_url(output)
    if alone and _given_limits(config) is None:
        return _run_alone(inputs[0], Path(output), job, reporter)
    with StoredOutput(str(output)) if is_url(output) else nullcontext() as stored:
        fleet = _prepare(inputs, Path(output), job, schedule, work, reporter, stored)
        results, verdicts = fleet.run()
        return RunResult(fleet.plan.output, tuple(results), stored, verdicts)


def _check_names(logs: Sequence[LogInput], output: Path, job: _Job, reporter: Reporter) -> None:
    """Note neutral names of logs; raises UsageError if an output would replace an input, or has names of logs."""
    check_places(logs, output, job.config, job.mapping, job.junit, job.cars.paths)
    if not job.config.no_position:
        return
    with suppress(OSError, ValueError):
        if not json.loads((output / RUN_FILE).read_bytes())["config"]["no_position"]:
            raise UsageError(
                expected="a folder without outputs of another kind of run",
                got="outputs of a run without --no-position, which contain names and positions",
                where=str(output),
                remedy="choose another folder with -o, or delete this one",
            )
    names = [f"{log.path.name} is {log.stem}" for log in logs[:FEW_LOGS]]
    reporter.note(f"--no-position: outputs name a log by its SHA-256: {', '.join(names)}")


def _given_limits(config: RunConfig) -> Limits | None:
    """Return the limits of a log that users give; None if they give none."""
    silence_s, memory_mb = config.log_timeout_s, config.max_memory_mb
    if silence_s is None and memory_mb is None:
        return None
    return Limits(SILENCE_S if silence_s is None else silence_s, None if memory_mb is None else memory_mb * 1_000_000)


def _run_alone(log: LogInput, output: Path, job: _Job, reporter: Reporter) -> RunResult:
    """Run one log in this process; its error ends the run."""
    from pdhef_logtool.runs.run_drive import run_log

    config, car = job.config, job.cars.of_log(log)
    log = replace(log, stem=neutral_stem(log_identity(log))) if config.no_position else log
    _check_names([log], output, job, reporter)
    with OutputFolder(output, (LOGS,)) as outputs:
        result = run_log(log, outputs, config, car, job.mapping, validation=job.validation, reporter=reporter)
        verdicts = judge(job.validation, [result], config.strict)
        write_run_tables(output, [result])
        network = None if car.network is None else (Path(car.network_name).name, car.network.sha256)
        write_run(output, config.to_dict(), [result], verdicts, network)
        journal = Journal(output / JOURNAL_FILE)  # of a run that this one replaces
        journal.path.unlink(missing_ok=True)
        sweep_parts(journal, output)
        write_verdicts(job.junit, verdicts, [result])
        write_run_pages(output, job.report, None, reporter)
    return RunResult(output, (result,), requirements=verdicts)


def _prepare(
    inputs: Sequence[LogInput],
    output: Path,
    job: _Job,
    schedule: Schedule,
    work: Work,
    reporter: Reporter,
    stored: StoredOutput | None,
) -> "_Fleet":
    """Plan a run of several logs; raises UsageError and OutputError before anything is written."""
    config, many = job.config, len(inputs) > FEW_LOGS
    limits = schedule.limits or _given_limits(config)
    if limits is None:
        limits = Limits(SILENCE_S) if schedule.jobs > 1 or many or schedule.ray else Limits()
    full_worst = config.full_worst
    if full_worst is None:
        full_worst = FULL_WORST if config.keep is None and many else 0
    if config.keep is None and many and not schedule.only:
        reporter.note(
            f"{len(inputs)} logs: figures and a short report of each are kept, no tracks, recordings or pages; all of "
            f"it of the {full_worst} worst, of any other later by --repeat NAME, of every one by --keep full"
        )
    job = replace(job, config=replace(config, keep=config.keep or ("metrics" if many else "full")))
    if stored is not None:
        output = stored.folder
        stored.check_no_input(inputs)
        if schedule.resumes:
            stored.fetch_journal()
    journal = Journal.read(output) if schedule.resumes else Journal(output / JOURNAL_FILE)
    if journal.damaged:
        lines = "1 line is" if journal.damaged == 1 else f"{journal.damaged} lines are"
        reporter.note(f"{JOURNAL_FILE}: {lines} damaged or of another version: the drives of these are run again")
    planned = plan_logs(inputs, journal, twice=config.cars is not None, neutral=config.no_position, reporter=reporter)
    _check_names([p.log for p in planned], output, job, reporter)
    plan = Plan(output, journal, planned, settings_of(job.config), job.cars, stored is not None)
    plan.check_only(schedule.only)
    return _Fleet(job, plan, schedule, limits, full_worst, work, reporter, stored)


@dataclass(slots=True, eq=False)
class _Fleet:
    """A run of several logs in progress."""

    job: _Job
    plan: Plan
    schedule: Schedule
    limits: Limits
    full_worst: int
    work: Work
    reporter: Reporter
    stored: StoredOutput | None
    _lost_workers: int = 0
    _warned: set[str] = field(default_factory=set)
    _name: str = field(default_factory=lambda: f"{process_name()}-{next(_RUNS)}")

    def run(self) -> tuple[list[LogResult], PlanVerdicts | None]:
        """Process all pending logs and write the files of the run, also if the run is interrupted."""
        output, journal = self.plan.output, self.plan.journal
        with OutputFolder(output, (LOGS,)) as outputs:
            self.plan.begin()
            sweep_parts(journal, output)
            try:
                if self.stored is not None:
                    self.stored.begin()
                if self.schedule.only:
                    self._process(self.schedule.only, "full")
                else:
                    self._process(None, self.job.config.kept)
                    if worst := self.plan.worst(self.full_worst):
                        self._process(worst, "full")
            except BaseException as stop:
                self._save(stop)
                raise
            if self._lost_workers or self.schedule.ray:  # a lost node was replaced without being reported
                outputs.sweep()
                sweep_parts(journal, output)
            results, verdicts = collect(self.plan, self.job.config, self.job.validation)
            write_verdicts(self.job.junit, verdicts, results)
            failed = {e.label for p in self.plan.logs if (e := self.plan.entry(p)) is not None and e.failed}
            pages = failed | self.plan.damaged_pages() if self.job.config.kept == "full" else ()
            write_run_pages(output, self.job.report, pages, self.reporter)
            if self.stored is not None:
                self.stored.publish()
        return results, verdicts

    def _save(self, stop: BaseException) -> None:
        """Write the files of the drives that are done when a run is interrupted."""
        logs, done = self.plan.logs, sum(self.plan.entry(p) is not None for p in self.plan.logs)
        notes = [f"{done} of {len(logs)} logs are done", "--resume goes on"]
        if isinstance(stop, OutputError | WorkerError):
            stop.remedy = "; ".join(filter(None, [stop.remedy, *notes]))
        else:
            stop.__notes__ = notes[::-1]
        sweep_parts(self.plan.journal, self.plan.output)
        with suppress(PdhefError):
            collect(self.plan, self.job.config, self.job.validation)
            if self.stored is not None:
                self.stored.publish()

    def _process(self, names: Sequence[str] | None, keep: Keep) -> None:
        """Process the pending drives, of all or of those named."""
        todo = self.plan.pending(names, keep, bool(self.schedule.repeat), self.reporter)
        if not todo:
            return
        progress = FleetProgress(self.reporter.progress, len(todo))
        for ended in self._supervised((self._task(p.log, keep) for p in todo), progress.update):
            planned = todo[ended.number]
            end = self._end(ended)
            if end.outcome.failed is not None and len(self.plan.logs) > 1:
                progress.failed += 1
                self._warn(f"{planned.log.path.name} failed, the others go on")  # the results give the reason
            for line in end.warned:
                self._warn(line)
            self.plan.record(planned, end, keep, quarantined=ended.failure is not None and ended.failure.tries > 1)
            if self.stored is not None:
                self.stored.note_end()
            progress.end(ended.number)

    def _supervised(
        self, tasks: Iterator[DriveTask], update: Callable[[int, str, float], None]
    ) -> Iterator[Ended[DriveTask, DriveEnd]]:
        """Yield how the tasks end, on this machine or on a cluster."""
        work: Callable[[DriveTask, Tell], Any] = self.work
        if self.stored is not None:
            work = partial(stored_drive, self.stored.objects, work)
        schedule, limits = self.schedule, self.limits
        if schedule.ray is None:
            ends = supervise(
                work, tasks, jobs=schedule.jobs, limits=limits, preload=_PRELOAD, progress=update,
                warn=self.reporter.warn,
            )  # fmt: skip
        else:
            from pdhef_logtool.workers.ray_supervisor import supervise_on_ray

            on_node = partial(run_on_node, work, Path.cwd(), self.stored is None)
            ends = supervise_on_ray(on_node, tasks, address=schedule.ray, limits=limits, preload=_PRELOAD)
        with closing(ends):
            for ended in ends:
                if isinstance(ended.result, OutputError):
                    raise ended.result
                result = ended.result if self.stored is None else self.stored.take(ended.result)
                yield Ended(ended.number, ended.item, result, ended.failure)

    def _task(self, log: LogInput, keep: Keep) -> DriveTask:
        config, page = replace(self.job.config, keep=keep), self.job.report and keep == "full"
        is_first = log.stem == self.plan.logs[0].log.stem
        return DriveTask(log, self.plan.output, config, self.job.validation, page, self._name, is_first)

    def _end(self, ended: Ended[DriveTask, DriveEnd]) -> DriveEnd:
        if ended.result is not None:
            return ended.result
        assert ended.failure is not None
        self._lost_workers += 1
        log, failure = ended.item.log, ended.failure
        last = f"; last heard: {failure.last}" if failure.last else ""
        tries = f", {failure.tries} tries" if failure.tries > 1 else ""
        return DriveEnd(failed_outcome(log, f"{failure.reason}{tries}{last}", self.job.config), None, again=True)

    def _warn(self, line: str) -> None:
        """Print a warning once; with many drives, only their reports contain it."""
        if len(self.plan.logs) <= FEW_LOGS and line not in self._warned:
            self._warned.add(line)
            self.reporter.warn(line)


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
    results = []
    for entry, folder in entries:
        part = None if entry.part is None else output / entry.part
        place = None if part is None else output / log_place(entry.label)
        outcome = replace(plan.journal.outcome(entry), folder=folder)
        results.append(LogResult(outcome, place, part=part))
    write_run_tables(output, results)
    cars = plan.journal.described["car"] | plan.cars_of_run()  # the journal's line of a car may be damaged
    networks = {cars[e.car]["network"] and tuple(cars[e.car]["network"]) for e, _ in entries if e.car is not None}
    verdicts = judge(validation, results, config.strict, output / TABLES_FOLDER)
    network = networks.pop() if len(networks) == 1 else None
    write_run(output, config.to_dict(), results, verdicts, network, remaining)
    if remaining:
        (output / PAGE_FILE).unlink(missing_ok=True)  # it shows other drives
    return results, verdicts


def write_run_pages(output: Path, report: bool, labels: Collection[str] | None, reporter: Reporter) -> None:
    """Write the page of the run and the pages of the named logs (None: all); without ``report``, remove all pages."""
    from pdhef_logtool.reports.pages import remove_pages, write_pages

    run = open_run(output)
    if not report:
        remove_pages(run)
        return
    logs = None if labels is None else [log for log in run.logs if log.label in labels]
    for line in write_pages(run, lambda text, _: reporter.progress(text, 1.0), logs=logs).wrong:
        reporter.warn(line)


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
