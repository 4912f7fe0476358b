"""One log or a hundred thousand of them: planned, worked on by so many processes, and told of.

A drive's work is one function, :func:`run_drive`, which writes the drive's files and returns a small record; it stands
in the journal before the next drive counts (:mod:`~.journal`). At every end metrics.parquet and run.json are made of
the journal and the files of figures, ``metrics/run=…/car=…/part-….parquet``. No report and no figure is held here.
"""

from __future__ import annotations

import itertools
import math
import os
import platform
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, nullcontext, suppress
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pdhef_logtool.car.parts import car_folder
from pdhef_logtool.estimators.table import FILTERS
from pdhef_logtool.logs.discovery import (
    RUN_FILE,
    LogInput,
    Logs,
    as_taken,
    find_logs,
    folders_of,
    hash_log,
    identity_of,
    with_free_stem,
)
from pdhef_logtool.mapping import Mapping, mapping_of
from pdhef_logtool.records.errors import OutputError, PdhefError, UsageError, WorkerError
from pdhef_logtool.records.processes import process_name
from pdhef_logtool.results.opened_run import (
    JOURNAL_FILE,
    LOGS,
    METRICS_FILE,
    PAGE_FILE,
    PARTS,
    REPORT_FILE,
    OpenedLog,
    open_run,
)
from pdhef_logtool.results.run_report import LogOutcome, build_run, run_versions, tool_versions, write_json
from pdhef_logtool.runs.cars import RunCars, car_record
from pdhef_logtool.runs.config import Keep, RunConfig
from pdhef_logtool.runs.journal import Entry, Journal, Place, changes, digest_of, outputs_digest
from pdhef_logtool.runs.pipeline import (
    FEW_LOGS,
    LogResult,
    Progress,
    RunResult,
    check_places,
    judge,
    log_place,
    read_thresholds,
    run_log,
    write_run,
    write_verdicts,
)
from pdhef_logtool.runs.self_calibrating import calibrate_pool
from pdhef_logtool.runs.stored_output import StoredEnd, StoredOutput, stored_drive
from pdhef_logtool.storage.documents import file_sha256
from pdhef_logtool.storage.files import writing
from pdhef_logtool.storage.object_store import is_url
from pdhef_logtool.storage.outputs import OutputFolder
from pdhef_logtool.workers.ray_supervisor import supervise_on_ray
from pdhef_logtool.workers.supervisor import Ended, Limits, Tell, supervise

if TYPE_CHECKING:
    from pdhef_logtool.car.car import Car
    from pdhef_logtool.estimators.calibration.calibration import SelfCalibration
    from pdhef_logtool.evaluation.thresholds import Threshold

#: Drives with the largest errors that are kept in full where the run itself chose to keep metrics alone.
FULL_WORST = 5
#: Nothing heard of a log for so long is the end of it, where several are worked on at once or there are many.
SILENCE_S = 600.0
#: What each choice keeps includes what those before it keep.
_KEPT = ("metrics", "estimates", "full")
#: What the workers have loaded; polars starts threads at its first query, and none of these makes one.
_PRELOAD = ("pdhef_logtool.runs.*", "pdhef_logtool.logs.*", "pdhef_logtool.results.parquet_sink", *FILTERS)
#: Entries of the configuration that change no figure and no file that is kept, or are told apart by themselves.
_NO_SETTING = frozenset(
    {
        "keep",
        "annotate",
        "cache",
        "cache_max_gb",
        "allow_private_redirects",
        "window_s",
        "car",
        "cars",
        "network",
        "intervals",
    }
)
_FILES = ("mapping", "msgs", "thresholds", "cars")
_READERS = 16
_AGAIN = "they are tried again"
_DAMAGED = "their outputs are damaged"
_GOES_ON = "; --resume goes on"
#: Begins the name of a file by which nodes know the output's folder.
_MARK = ".nodes-"


@dataclass(frozen=True, slots=True, eq=False)
class DriveTask:
    """One drive to work on.

    Attributes
    ----------
    log : with the label that it has in the run. output : folder of the run. setting : digest of what it is run with.
    pool : what all logs of the run together say of the car. page : whether its page is written.
    run : a name of this run, by which cars that were read are known. there : names of what a store has of the drive.
    """

    log: LogInput
    output: Path
    config: RunConfig
    setting: str
    thresholds: tuple[Threshold, ...] | None
    pool: SelfCalibration | None
    page: bool
    run: str
    there: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class DriveEnd:
    """How a drive ended; small, for it crosses from a worker's process.

    Attributes
    ----------
    identity : what its log is known by. car : :func:`~.cars.car_record`. part, error_rad : as in the journal.
    warned : lines for people. again : whether a failure may be none the next time. outputs : as in the journal.
    """

    outcome: LogOutcome
    identity: str | None
    car: dict[str, Any] | None = None
    part: str | None = None
    failed_checks: int = 0
    error_rad: float | None = None
    warned: tuple[str, ...] = ()
    again: bool = False
    outputs: str | None = None


Work = Callable[[DriveTask, Tell], DriveEnd]


def run_logs(
    arguments: Logs,
    output: Path | str,
    config: RunConfig,
    *,
    jobs: int = 1,
    ray: str | None = None,
    resume: bool = False,
    retry: bool = False,
    only: Sequence[str] = (),
    limits: Limits | None = None,
    full_worst: int | None = None,
    junit: Path | str | None = None,
    report: bool = True,
    work: Work | None = None,
    progress: Progress = lambda _text, _share: None,
    warn: Callable[[str], None] = lambda _text: None,
    say: Callable[[str], None] = lambda _text: None,
) -> RunResult:
    """Run the configured estimators on logs and write the outputs of docs/formats.md#outputs to ``output``.

    A log that fails is reported and never stops the others. One whose content another has is run once.

    Parameters
    ----------
    arguments : logs, folders, glob patterns.
    output : a folder, or the URL of one in an object store.
    jobs : processes at work; changes no number.
    ray : address of a Ray cluster that does the work instead, one drive a processor at a time; a folder ``output``, the
        logs and what the configuration names lie where every node sees them under the same path.
    resume : what the folder's journal has of these logs and settings stays; ``retry`` : but for logs that failed.
    only : labels of logs that are run now, everything of them kept; the rest of the run in the folder stays.
    limits : of one log; None: none for a few logs and one job, else :data:`SILENCE_S`.
    full_worst : drives with the largest errors of sideslip of which everything is kept; None: :data:`FULL_WORST`
        where the run itself chose to keep metrics alone, that is of more than :data:`~.pipeline.FEW_LOGS`.
    junit : where the verdicts of the thresholds are written as JUnit XML.
    report : whether pages are written (:mod:`pdhef_logtool.reports`); those of an earlier run go.
    work : of one drive; None: :func:`run_drive`.
    progress, warn, say : called with lines for people.

    Raises
    ------
    UsageError, VehicleError, MappingError
        What holds for all logs is wrong: arguments, vehicle or mapping file, or an output would replace an input.
    OutputError
        The output cannot be written, or another command is writing to it.
    """
    if is_url(output):
        stored = StoredOutput(str(output))
        output = stored.folder
    else:
        stored, output = None, Path(output)
    junit = None if junit is None else Path(junit)
    inputs = find_logs(arguments, private_redirects=config.allow_private_redirects)
    cars = RunCars.of(config, warn)
    mapping = mapping_of(config.mapping)
    thresholds = read_thresholds(config, junit)
    resume = resume or retry or bool(only)
    many = len(inputs) > FEW_LOGS
    if limits is None:
        limits = Limits(SILENCE_S) if jobs > 1 or many or ray else Limits()
    alone = len(inputs) == 1 and jobs == 1 and not ray and not resume and work is None
    if alone and limits == Limits() and stored is None:
        check_places(inputs, output, config, mapping, junit, cars.paths)
        return _run_alone(inputs[0], output, config, cars, mapping, thresholds, junit, report, progress, warn)
    if full_worst is None:
        full_worst = FULL_WORST if config.keep is None and many else 0
    if config.keep is None and many and not only:
        say(
            f"{len(inputs)} logs: figures and a short report of each are kept, no tracks, recordings or pages; all of "
            f"it of the {full_worst} worst, of any other later by --only NAME, of every one by --keep full"
        )
    config = replace(config, keep=config.keep or ("metrics" if many else "full"))
    with nullcontext() if stored is None else stored:
        if stored is not None:
            stored.check_no_input(inputs)
            if resume:
                stored.fetch_journal()
        journal = Journal.read(output) if resume else Journal.of(output)
        if journal.damaged:
            lines = "1 line is" if journal.damaged == 1 else f"{journal.damaged} lines are"
            say(f"{JOURNAL_FILE}: {lines} damaged or of another version: the drives of these are run again")
        planned = _plan(inputs, journal, twice=config.cars is not None, warn=warn)
        check_places([p.log for p in planned], output, config, mapping, junit, cars.paths)
        pools = _pools(planned, cars, mapping, config)
        told = _setting(config, pools)
        fleet = _Fleet(
            output, config, cars, journal, planned, told, digest_of(told), thresholds, pools,
            jobs, ray, limits, report, work or run_drive, progress, warn, say, stored,
        )  # fmt: skip
        if only:
            fleet.check_only(only)
        with OutputFolder(output, (LOGS,)) as outputs:
            journal.begin()
            journal.add_setting(fleet.setting, told)
            for one in planned:
                if one.moved:
                    journal.add_place(one.log.stem, one.place, one.identity or "")
            _sweep_parts(output, {e.part for e in journal.entries.values()})
            try:
                if stored is not None:
                    stored.begin()
                fleet.run(*((only, "full") if only else (None, config.kept)), retry=retry or bool(only))
                if full_worst and not only:
                    fleet.run(fleet.worst(full_worst), "full")
            except BaseException as stop:
                if fleet.done:
                    stop.add_note("--resume goes on")
                stop.add_note(f"{fleet.done} of {len(planned)} logs are done")
                _sweep_parts(output, {e.part for e in journal.entries.values()})
                with suppress(PdhefError):
                    fleet.collect()
                    if stored is not None:
                        stored.publish()
                raise
            if fleet.lost or ray:  # a node that was lost has been made good and is not told of
                outputs.sweep()
                _sweep_parts(output, {e.part for e in journal.entries.values()})
            results = fleet.collect()
            write_verdicts(junit, results)
            fleet.write_pages()
            if stored is not None:
                stored.publish()
        return RunResult(output, tuple(results), stored)


def limits_of(silence_s: float | None, memory_mb: int | None) -> Limits | None:
    """Return the limits of a log as a person gives them; None where none is given, so that the run decides."""
    if silence_s is None and memory_mb is None:
        return None
    return Limits(SILENCE_S if silence_s is None else silence_s, None if memory_mb is None else memory_mb * 1_000_000)


def run_drive(task: DriveTask, tell: Tell) -> DriveEnd:
    """Run one drive, write its files, and return how it ended; it raises nothing but what ends the process."""
    warned: list[str] = []
    try:
        return _run_drive(task, tell, warned)
    except MemoryError:
        raise  # the supervisor knows what becomes of it
    except Exception as error:  # noqa: BLE001 (one bad log never stops the others, whatever is wrong with it)
        own = isinstance(error, PdhefError)
        reason = str(error) if own else f"internal error, {type(error).__name__}: {error}"
        outcome = LogOutcome(log=task.log.stem, file=task.log.path.name, sha256=None, failed=reason)
        again = not own or isinstance(error, OutputError)
        return DriveEnd(outcome, _identity(task.log), warned=tuple(warned), again=again)


def _on_node(work: Callable[[DriveTask, Tell], Any], here: Path, mark: Path | None, task: DriveTask, tell: Tell) -> Any:
    """Do a drive's work on a node of a cluster, in the folder that the run was begun in if the node has it.

    ``mark``: a file by which the node sees the output's folder; None where it needs not.
    """
    if mark is not None and not mark.is_file():
        return OutputError(
            expected="a folder that all nodes of the cluster see under this path",
            got=f"another one, or none, on {platform.node()}",
            where=str(mark.parent),
            remedy="choose one on a shared file system, or a URL, with -o",
        )
    with suppress(OSError):
        os.chdir(here)
    return work(task, tell)


def _run_drive(task: DriveTask, tell: Tell, warned: list[str]) -> DriveEnd:
    from pdhef_logtool.results.parquet_sink import write_metrics

    cars, mapping = _opened(task)
    cars = replace(cars, warn=warned.append)
    car = cars.of_log(task.log)
    outputs = OutputFolder(task.output)  # the run holds it
    result = run_log(
        task.log, outputs, task.config, car, mapping,
        pool=task.pool, thresholds=task.thresholds, progress=tell, warn=warned.append,
    )  # fmt: skip
    record = car_record(car)
    place = car_folder(car.vehicle.name, car.physics_sha256)
    part = f"{PARTS}/run={task.setting}/{place}/part-{digest_of(task.log.stem)}.parquet"
    write_metrics(task.output / part, result.rows)
    if task.page:
        warned += _page_of(task.output, result.outcome)
    return DriveEnd(
        result.outcome,
        _known_as(task.log, str(result.outcome.sha256)),
        {"digest": digest_of(record["parts"]), **record},
        part,
        result.failed_checks,
        _error_of(result),
        tuple(warned),
        outputs=outputs_digest(task.output / log_place(task.log.stem) / REPORT_FILE, task.output / part),
    )


def _error_of(result: LogResult) -> float | None:
    """Return the RMSE of the answer's sideslip in rad, None where it is not scored against an independent truth."""
    wanted = (result.outcome.main, "sideslip_rad", "all", "rmse")
    rows = (r for r in result.rows if (r.estimator, r.signal, r.segment, r.metric) == wanted)
    return next((r.value for r in rows if r.independent and math.isfinite(r.value)), None)


def _page_of(output: Path, outcome: LogOutcome) -> list[str]:
    """Write the page of a drive; return what is wrong with it."""
    from pdhef_logtool.reports.pages import write_drive_page

    entry = {"main": outcome.main, "files": outcome.files}
    log = OpenedLog(outcome.log, outcome.outcome, output / log_place(outcome.log), entry)
    wrong = write_drive_page(log).wrong
    return [f"no page of {outcome.log}: {wrong}"] if wrong else []


#: The runs of this process.
_RUNS = itertools.count()
#: Cars and mapping of the run that this process works for.
_at_hand: dict[str, tuple[RunCars, Mapping | None]] = {}


def _opened(task: DriveTask) -> tuple[RunCars, Mapping | None]:
    """Return cars and mapping of a task, read once a run."""
    if task.run not in _at_hand:
        _at_hand.clear()
        config = task.config
        _at_hand[task.run] = (
            RunCars.of(config, lambda _: None),
            mapping_of(config.mapping),
        )
    return _at_hand[task.run]


def _run_alone(  # positional: what `run_logs` has made of its arguments
    log: LogInput,
    output: Path,
    config: RunConfig,
    cars: RunCars,
    mapping: Mapping | None,
    thresholds: tuple[Threshold, ...] | None,
    junit: Path | None,
    report: bool,
    progress: Progress,
    warn: Callable[[str], None],
) -> RunResult:
    """Run one log, whose error is that of the run."""
    from pdhef_logtool.runs.compiling import compile_for

    car = cars.of_log(log)
    pool = calibrate_pool([log], car, mapping, config) if config.calibrate == "pool" else None
    with OutputFolder(output, (LOGS,)) as outputs:
        try:
            result = run_log(
                log, outputs, config, car, mapping,
                pool=pool, thresholds=thresholds, prepare=compile_for, progress=progress, warn=warn,
            )  # fmt: skip
        except Exception:
            raise
        except BaseException as stop:
            stop.add_note("0 of 1 logs are done")
            raise
        result = judge(result, thresholds)
        write_run(output, config.to_dict(), result, car)
        _forget(output)
        write_verdicts(junit, [result])
        _write_pages(output, report, None, lambda text: progress(text, 1.0), warn)
    return RunResult(output, (result,))


@dataclass(frozen=True, slots=True)
class _Planned:
    """A log under its label; ``moved``: it is known, and lay elsewhere."""

    log: LogInput
    place: Place
    identity: str | None = None
    moved: bool = False


def _plan(inputs: Sequence[LogInput], journal: Journal, *, twice: bool, warn: Callable[[str], None]) -> list[_Planned]:
    """Return the logs of a run with their labels; one whose content another has is left out, but for ``twice``.

    No log is read that lies where it lay and has not been changed; of new ones those that are as large as another.
    """
    places = [Place.of(log) for log in inputs]
    sizes = Counter(place.bytes for place in places)
    found: dict[int, _Planned] = {}
    owner: dict[str, str] = {}
    claimed: set[str] = set()

    def claim(number: int, one: _Planned) -> None:
        found[number] = one
        claimed.add(one.log.stem)
        if one.identity is not None:
            owner.setdefault(one.identity, one.log.path.name)

    later: list[tuple[int, str | None]] = []
    for number, (log, place) in enumerate(zip(inputs, places, strict=True)):
        label, identity = (place.is_local and journal.known(place)) or ("", None)
        if label and label not in claimed:
            claim(number, _Planned(replace(log, stem=label), place, identity))
        else:
            later.append((number, identity))
    unknown = [n for n, identity in later if identity is None and _may_be_known(places[n], journal, sizes)]
    identities = dict(later) | dict(zip(unknown, _identities([inputs[n] for n in unknown]), strict=True))
    taken = {as_taken(label) for label in journal.entries}
    for number, identity in identities.items():
        log, place = inputs[number], places[number]
        labels = [] if identity is None else journal.labels_of(identity)
        free = next((label for label in labels if label not in claimed), None)
        if identity in owner and not twice:
            warn(f"{log.path.name} holds what {owner[identity]} holds: the drive is run once")
        elif free is not None:
            claim(number, _Planned(replace(log, stem=free), place, identity, moved=True))
        elif (was := journal.label_at(place)) is not None and was not in claimed:
            claim(number, _Planned(replace(log, stem=was), place, identity))  # another content: it is run anew
        else:
            new = with_free_stem(log, taken)
            taken.add(as_taken(new.stem))
            claim(number, _Planned(new, place, identity))
    return [found[number] for number in sorted(found)]


def _may_be_known(place: Place, journal: Journal, sizes: Counter[int]) -> bool:
    """Whether a log that lies elsewhere than any that is known may be one of them, or what another one holds."""
    return journal.may_know(place) or (place.is_local and sizes[place.bytes] > 1)


def _identities(logs: Sequence[LogInput]) -> list[str | None]:
    """Return what logs are known by, None for one that cannot be read; several at a time, as servers wait."""
    with ThreadPoolExecutor(_READERS) as readers:
        return list(readers.map(_identity, logs))


def _identity(log: LogInput) -> str | None:
    try:
        return _known_as(log, identity_of(log))
    except (PdhefError, OSError):
        return None  # the run says what is wrong with it


def _known_as(log: LogInput, identity: str) -> str:
    """Return what a slice of a log is known by: the log's identity, and the slice."""
    return identity if log.span_s is None else f"{identity} {log.span_s}"


def _pools(
    planned: Sequence[_Planned], cars: RunCars, mapping: Mapping | None, config: RunConfig
) -> dict[str, SelfCalibration | None]:
    """Return what all logs of a car together say of it, by label; nothing where nobody asks for it."""
    if config.calibrate != "pool":
        return {}
    logs: dict[int, tuple[Car, list[LogInput]]] = {}
    for one in planned:
        with suppress(Exception):  # the run says what is wrong with it
            car = cars.of_log(one.log)
            logs.setdefault(id(car), (car, []))[1].append(one.log)
    found = {key: calibrate_pool(of, car, mapping, config) for key, (car, of) in logs.items()}
    return {log.stem: found[key] for key, (_, of) in logs.items() for log in of}


def _setting(config: RunConfig, pools: dict[str, SelfCalibration | None]) -> dict[str, str]:
    """Return what, beside the log and its car, decides what a drive's files hold; in words."""
    told = {
        f"--{key.replace('_', '-')}": ",".join(map(str, value)) if isinstance(value, tuple | list) else str(value)
        for key, value in asdict(config).items()
        if key not in _NO_SETTING and key not in _FILES and value is not None
    }
    for key in _FILES:
        path = getattr(config, key)
        if path is not None:
            told[f"--{key}"] = hash_log(path) if path.exists() else str(path)
    told["--annotate"] = config.annotate or "none named"
    told |= {f"version of {name}": version for name, version in tool_versions().items()}
    if pools:
        told["the pool's calibration"] = digest_of([p and p.to_dict() for p in pools.values()])
    return told


@dataclass(slots=True, eq=False)
class _Fleet:
    """A run of several logs under way."""

    output: Path
    config: RunConfig
    cars: RunCars
    journal: Journal
    planned: Sequence[_Planned]
    told: dict[str, str]
    setting: str
    thresholds: tuple[Threshold, ...] | None
    pools: dict[str, SelfCalibration | None]
    jobs: int
    ray: str | None
    limits: Limits
    report: bool
    work: Work
    progress: Progress
    warn: Callable[[str], None]
    say: Callable[[str], None]
    stored: StoredOutput | None = None
    lost: int = 0
    _current: dict[str, dict[str, Any]] | None = None
    _said: set[str] = field(default_factory=set)
    _run: str = field(default_factory=lambda: f"{process_name()}-{next(_RUNS)}")
    _quiet: bool = False
    _sound: dict[int, bool] = field(default_factory=dict)

    @property
    def done(self) -> int:
        """Logs that are done."""
        return sum(self._entry(p) is not None for p in self.planned)

    def check_only(self, names: Sequence[str]) -> None:
        """Raise UsageError where ``--only`` names no log, or the settings are not those of the run in the folder."""
        labels = {p.log.stem for p in self.planned}
        if missing := [name for name in names if name not in labels]:
            near = ", ".join(sorted(labels)[:10]) + (" and more" if len(labels) > 10 else "")
            raise UsageError(expected=f"the name of a log ({near})", got=missing[0], where="--only")
        for one in self.planned:
            entry = self.journal.entries.get(one.log.stem)
            if entry is not None and (why := [*self._changes(entry)]):
                raise UsageError(
                    expected="the settings of the run in the folder",
                    got=", ".join(why),
                    where="--only",
                    remedy="--resume runs its logs anew",
                )

    def run(self, names: Sequence[str] | None, keep: Keep, *, retry: bool = False) -> None:
        """Work on what is to be done of the logs, or of those named."""
        if names is not None and not names:
            return
        chosen = [p for p in self.planned if names is None or p.log.stem in set(names)]
        reasons = {p.log.stem: self._reason(p, keep, retry) for p in chosen}
        todo = [p for p in chosen if reasons[p.log.stem] is not None]
        if names is None and self.journal.entries:
            self._tell_of(chosen, [r for r in reasons.values() if r], retry)
        elif damaged := sum(
            self._reason(p, "metrics", retry=False) == _DAMAGED for p in self.planned if p not in chosen
        ):
            self.say(f"{damaged} other drives are left out of the run until --resume: {_DAMAGED}")
        if not todo:
            return
        self._quiet = len(self.planned) > FEW_LOGS
        told = _Told(self.progress, len(todo))
        tasks = (self._task(p, keep) for p in todo)
        for ended in self._supervised(tasks, told.hear):
            one = todo[ended.number]
            end = self._end(ended)
            if end.outcome.failed is not None and len(self.planned) > 1:
                told.failed += 1
                self._warn(f"{one.log.path.name} failed, the others go on")  # why stands with the results
            for line in end.warned:
                self._warn(line)
            self._note(one, end, keep, quarantined=ended.failure is not None and ended.failure.tries > 1)
            told.end(ended.number)

    def _supervised(
        self, tasks: Iterator[DriveTask], hear: Callable[[int, str, float], None]
    ) -> Iterator[Ended[DriveTask, DriveEnd]]:
        """Yield how the tasks end, here or on a cluster."""
        work = self.work if self.stored is None else partial(stored_drive, self.stored.objects, self.work)
        ends = (
            supervise(work, tasks, jobs=self.jobs, limits=self.limits, preload=_PRELOAD, progress=hear, warn=self.warn)
            if self.ray is None
            else self._on_cluster(work, tasks, self.ray)
        )
        with closing(ends):
            try:
                for ended in ends:
                    result = ended.result
                    if isinstance(result, OutputError):
                        if self.stored is not None:
                            result.remedy += _GOES_ON
                        raise result
                    if isinstance(result, StoredEnd):
                        assert self.stored is not None
                        result = self.stored.take(result)
                    yield Ended(ended.number, ended.item, result, ended.failure)
            except WorkerError as error:
                error.remedy += _GOES_ON
                raise

    def _on_cluster(
        self, work: Callable[[DriveTask, Tell], Any], tasks: Iterator[DriveTask], address: str
    ) -> Generator[Ended[DriveTask, Any], None, None]:
        """Yield how the tasks end on the nodes of a cluster, which see the output's folder if it is none of a store."""
        mark = None if self.stored is not None else self.output.resolve() / f"{_MARK}{self._run}"
        on_node = partial(_on_node, work, Path.cwd(), mark)
        if mark is not None:
            with writing(mark):
                mark.touch()
        try:
            yield from supervise_on_ray(on_node, tasks, address=address, limits=self.limits, preload=_PRELOAD)
        finally:
            if mark is not None:
                mark.unlink(missing_ok=True)

    def _task(self, one: _Planned, keep: Keep) -> DriveTask:
        full = keep == "full"
        config = replace(self.config, keep=keep)
        pool = self.pools.get(one.log.stem)
        page = self.report and full
        there: tuple[str, ...] = ()
        if self.stored is not None:
            there = self.stored.there(one.log.stem)
            if (entry := self.journal.entries.get(one.log.stem)) is not None:
                self.stored.forget(entry.part)
        return DriveTask(one.log, self.output, config, self.setting, self.thresholds, pool, page, self._run, there)

    def _end(self, ended: Ended[DriveTask, DriveEnd]) -> DriveEnd:
        if ended.result is not None:
            return ended.result
        assert ended.failure is not None
        self.lost += 1
        log, failure = ended.item.log, ended.failure
        last = f"; last heard: {failure.last}" if failure.last else ""
        tries = f", {failure.tries} tries" if failure.tries > 1 else ""
        outcome = LogOutcome(log=log.stem, file=log.path.name, sha256=None, failed=f"{failure.reason}{tries}{last}")
        return DriveEnd(outcome, None, again=True)

    def _note(self, one: _Planned, end: DriveEnd, keep: str, *, quarantined: bool) -> None:
        """Write down how a drive ended; then the figures that it had before go."""
        car = None
        if end.car is not None:
            car = end.car["digest"]
            self.journal.add_car(car, end.car)
            self._cars_now()[car] = end.car
        before = self.journal.entries.get(one.log.stem)
        failed = end.outcome.failed is not None and end.part is None
        entry = Entry(
            one.log.stem, one.place, end.identity or one.identity, self.setting, car, keep, end.part, end.outputs,
            end.failed_checks, end.error_rad, failed, end.again, quarantined,
        )  # fmt: skip
        self.journal.add(entry, end.outcome)
        if before is not None and before.part not in (None, end.part):
            _remove_part(self.output, str(before.part))

    def _warn(self, line: str) -> None:
        """Print a warning, but for those of each of many drives, which stand in their reports."""
        if not self._quiet and line not in self._said:
            self._said.add(line)
            self.warn(line)

    def _reason(self, one: _Planned, keep: str, retry: bool) -> str | None:
        """Return why a log is to be run, empty for a new one; None where it is done."""
        entry = self.journal.entries.get(one.log.stem)
        if entry is None:
            return ""
        if entry.quarantined:
            return _AGAIN if retry else None
        if entry.place != one.place and entry.identity != one.identity:
            return "their logs have changed"
        if why := [*self._changes(entry)]:
            return ", ".join(why)
        if entry.failed:
            return _AGAIN if retry or entry.again else None
        if _KEPT.index(entry.keep) < _KEPT.index(keep):
            return f"{keep} is to be kept of them"
        folder = self.output / log_place(entry.label)
        if not (folder / REPORT_FILE).is_file() or entry.part is None or not (self.output / entry.part).is_file():
            return "their outputs are gone"
        return None if self._is_sound(entry) else _DAMAGED

    def _is_sound(self, entry: Entry) -> bool:
        """Whether report and figures of a drive are as they were written; read once for each line of the journal."""
        if entry.outputs is None:
            return True
        if entry.at not in self._sound:
            paths = self.output / log_place(entry.label) / REPORT_FILE, self.output / str(entry.part)
            try:
                self._sound[entry.at] = outputs_digest(*paths) == entry.outputs
            except OSError:
                self._sound[entry.at] = False
        return self._sound[entry.at]

    def _changes(self, entry: Entry) -> Iterator[str]:
        """Yield in words what a drive was run with that is not so now."""
        if entry.setting != self.setting:
            yield from changes(self.journal.settings.get(entry.setting, {}), self.told)
        if entry.car is not None and entry.car not in self._cars_now():
            old = self.journal.cars.get(entry.car, {})
            new = next((c for c in self._cars_now().values() if c["name"] == old.get("name")), {})
            yield from [*changes(old.get("parts", {}), new.get("parts", {}))] if new else ["another car"]

    def _cars_now(self) -> dict[str, dict[str, Any]]:
        """Return the cars of the run as they are now, by digest; those that cannot be read are left out."""
        if self._current is None:
            self._current, cars = {}, replace(self.cars, warn=lambda _: None)
            for path in cars.paths:
                with suppress(PdhefError):
                    record = car_record(cars.read(path))
                    self._current[digest_of(record["parts"])] = record
        return self._current

    def _tell_of(self, chosen: Sequence[_Planned], reasons: Sequence[str], retry: bool) -> None:
        """Say what of an earlier run stays and what is run anew, and why."""
        for why, count in Counter(reasons).most_common():
            self.say(f"{count} of {len(chosen)} drives are run anew: {why}")
        quarantined = sum(self.journal.entries[p.log.stem].quarantined for p in chosen if self._known(p))
        if quarantined and not retry:
            self.say(f"{quarantined} logs that took their worker along are not tried again; --retry does")
        if other := len(self.journal.entries) - sum(map(self._known, chosen)):
            place = self.output if self.stored is None else self.stored.objects.shown
            self.say(f"{other} drives in {place} are of logs that are not named now: they are left out of the run")

    def _known(self, one: _Planned) -> bool:
        return one.log.stem in self.journal.entries

    def _entry(self, one: _Planned) -> Entry | None:
        """Return what the journal has of a log if it is done, whatever was kept of it."""
        entry = self.journal.entries.get(one.log.stem)
        if entry is None or self._reason(one, "metrics", retry=False) not in (None, _AGAIN):
            return None
        return entry

    def collect(self) -> list[LogResult]:
        """Write metrics.parquet and run.json of all that is done, and return it in the order of the plan."""
        from pdhef_logtool.results.parquet_sink import join_metrics

        folders = folders_of([p.log for p in self.planned])
        entries = [(e, f) for p, f in zip(self.planned, folders, strict=True) if (e := self._entry(p)) is not None]
        remaining = len(self.planned) - len(entries)
        if not entries and remaining:
            return []
        results = [self._result(entry, folder) for entry, folder in entries]
        metrics = self.output / METRICS_FILE
        join_metrics(metrics, [r.figures_file for r in results if r.figures_file is not None])
        cars = self.journal.cars | self._cars_now()  # a line that says what a car is may be damaged
        networks = {
            None if (network := cars[e.car]["network"]) is None else (network[0], network[1])
            for e, _ in entries
            if e.car is not None
        }
        only = networks.pop() if len(networks) == 1 else None
        network = None if only is None else {"name": only[0], "sha256": only[1]}
        files, outcomes = {METRICS_FILE: file_sha256(metrics)}, [r.outcome for r in results]
        run = build_run(run_versions(), self.config.to_dict(), network, outcomes, remaining, files)
        write_json(self.output / RUN_FILE, run)
        if remaining:
            (self.output / PAGE_FILE).unlink(missing_ok=True)  # it is of other drives
        return results

    def _result(self, entry: Entry, folder: str) -> LogResult:
        outcome = replace(self.journal.outcome(entry), folder=folder)
        part = None if entry.part is None else self.output / entry.part
        output = None if part is None else self.output / log_place(entry.label)
        checks = entry.failed_checks
        result = LogResult(outcome, output, figures=None, figures_file=part, failed_checks=checks)
        return judge(result, self.thresholds)

    def worst(self, count: int) -> list[str]:
        """Return the labels of the scored drives whose answers have the largest errors of sideslip."""
        entries = [e for p in self.planned if (e := self._entry(p)) is not None and e.error_rad is not None]
        return [e.label for e in sorted(entries, key=lambda e: (-(e.error_rad or 0.0), e.label))[:count]]

    def write_pages(self) -> None:
        """Write the page of the run, and those of drives that no worker has written; or remove what there is."""
        failed = {p.log.stem for p in self.planned if (e := self._entry(p)) is not None and e.failed}
        _write_pages(
            self.output,
            self.report,
            failed if self.config.kept == "full" else (),
            lambda text: self.progress(text, 1.0),
            self.warn,
        )


@dataclass(slots=True)
class _Told:
    """What is told while several logs are worked on."""

    progress: Progress
    count: int
    ended: int = 0
    failed: int = 0
    _shares: dict[int, float] = field(default_factory=dict)
    _since: float = field(default_factory=time.monotonic)

    def hear(self, number: int, text: str, share: float) -> None:
        """Take the progress of one log."""
        self._shares[number] = min(share, 1.0)
        done = (self.ended + sum(self._shares.values())) / self.count
        if self.count <= FEW_LOGS:
            self.progress(text, done)
            return
        rate = self.ended / max(time.monotonic() - self._since, 1e-9)
        failed = f", {self.failed} failed" if self.failed else ""
        speed = f", {rate:.1f}/s" if self.ended else ""
        self.progress(f"{self.ended} of {self.count}{failed}{speed}", done)

    def end(self, number: int) -> None:
        """Take that a log ended."""
        self._shares.pop(number, None)
        self.ended += 1
        if self.count > FEW_LOGS:
            self.hear(number, "", 0.0)


def _sweep_parts(output: Path, kept: set[str | None]) -> None:
    """Remove the files of figures that no drive of the journal has, and what killed workers left beside them."""
    root = output / PARTS
    for path in list(itertools.chain(root.rglob("*.parquet"), root.rglob(".*.partial"))):
        if path.relative_to(output).as_posix() not in kept:
            _remove_part(output, path.relative_to(output).as_posix())


def _remove_part(output: Path, part: str) -> None:
    """Remove a file of figures, and the folders that it leaves empty."""
    with suppress(OSError):
        (output / part).unlink(missing_ok=True)
        for folder in itertools.islice((output / part).parents, 3):
            folder.rmdir()


def _forget(output: Path) -> None:
    """Remove the journal of the run that a run of one log has replaced."""
    Journal.of(output).path.unlink(missing_ok=True)
    _sweep_parts(output, set())


def _write_pages(
    output: Path, report: bool, labels: Sequence[str] | set[str] | None, tell: Callable[[str], None],
    warn: Callable[[str], None],
) -> None:  # fmt: skip
    """Write the run's page and those of the logs named, None: of all; or remove what pages there are."""
    from pdhef_logtool.reports.pages import remove_pages, write_pages

    run = open_run(output)
    if not report:
        return remove_pages(run)
    logs = None if labels is None else [log for log in run.logs if log.label in labels]
    for line in write_pages(run, lambda text, _: tell(text), logs=logs).wrong:
        warn(line)
    return None
