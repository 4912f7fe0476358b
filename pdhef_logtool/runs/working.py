"""The work on one drive of a run: :func:`run_drive` writes the drive's files and returns a small record."""

import os
import platform
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from pdhef_logtool.evaluation.validation_plan import ValidationPlan
from pdhef_logtool.logs.byte_source import ChangedError, SourceError
from pdhef_logtool.logs.discovery import LogInput, identity_of
from pdhef_logtool.mapping import Mapping as LogMapping, mapping_of
from pdhef_logtool.records.errors import OutputError, PdhefError
from pdhef_logtool.records.reporter import Reporter
from pdhef_logtool.results.no_position import without_names
from pdhef_logtool.results.opened_run import JOURNAL_FILE, PARTS
from pdhef_logtool.results.run_report import LogOutcome
from pdhef_logtool.results.tables import write_part
from pdhef_logtool.runs.cars import RunCars, car_record
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.drive_outputs import LOG_FILES, log_place
from pdhef_logtool.runs.journal import digest_of, states_of
from pdhef_logtool.storage.outputs import OutputFolder
from pdhef_logtool.workers.supervisor import Tell


@dataclass(frozen=True, slots=True, eq=False)
class DriveTask:
    """One drive to process.

    Attributes
    ----------
    log : the log with its label in the run. output : folder of the run.
    page : whether the drive's page is written.
    run : name of this run in its process, the key of cars that were read.
    is_first : whether the log is the first of the run's list, which has the full causality check.
    """

    log: LogInput
    output: Path
    config: RunConfig
    validation: ValidationPlan
    page: bool
    run: str
    is_first: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class DriveEnd:
    """How a drive ended; small, because it crosses from a worker's process.

    Attributes
    ----------
    identity : of the log's content. car : :func:`~.cars.car_record`. part, error_rad : as in the journal.
    warned : lines for users. again : whether a failed drive may succeed next time.
    outputs : size and digest of its files.
    """

    outcome: LogOutcome
    identity: str | None
    car: dict[str, Any] | None = None
    part: str | None = None
    error_rad: float | None = None
    warned: tuple[str, ...] = ()
    again: bool = False
    outputs: Mapping[str, str] = field(default_factory=dict)


Work = Callable[[DriveTask, Tell], DriveEnd | OutputError]
#: Waits before a log that cannot be reached is read again.
_WAITS_S = (0.5, 2.0)


def run_drive(task: DriveTask, tell: Tell) -> DriveEnd | OutputError:
    """Run one drive, write its files, and return how it ended; raises only errors that end the process.

    An error that all drives would meet, such as a full disk, is returned: it ends the run.
    """
    for wait_s in (*_WAITS_S, None):
        warned: list[str] = []
        try:
            return _run_drive(task, tell, warned)
        except MemoryError:
            raise  # the supervisor reports it
        except Exception as error:  # noqa: BLE001 (one bad log never stops the others, for any error)
            if isinstance(error, OutputError) and error.ends_run:
                return error
            unreachable = isinstance(error, SourceError) or (isinstance(error, PdhefError) and error.missing)
            if unreachable and wait_s is not None and not isinstance(error, ChangedError):
                tell(f"{task.log.stem}: waits for the log", 0.0)
                time.sleep(wait_s)
                continue
            expected = isinstance(error, PdhefError)
            reason = str(error) if expected else f"internal error, {type(error).__name__}: {error}"
            outcome = failed_outcome(task.log, reason, task.config)
            again = not expected or unreachable or isinstance(error, OutputError)
            return DriveEnd(outcome, log_identity(task.log), warned=tuple(warned), again=again)
    raise AssertionError


def failed_outcome(log: LogInput, reason: str, config: RunConfig) -> LogOutcome:
    """Return the record of a failed log in run.json."""
    texts: dict[str, Any] = {"file": log.path.name, "failed": reason}
    texts = without_names(texts, log.path, log.stem) if config.no_position else texts
    return LogOutcome(log=log.stem, sha256=None, **texts)


def run_on_node(work: Callable[[DriveTask, Tell], Any], here: Path, shared: bool, task: DriveTask, tell: Tell) -> Any:
    """Process a drive on a node of a cluster, in the folder that the run was started in if the node has it.

    ``shared``: the output is a folder that the node must see; it contains the journal of the run.
    """
    with suppress(OSError):
        os.chdir(here)
    if shared and not (task.output / JOURNAL_FILE).is_file():
        return OutputError(
            expected="a folder that all nodes of the cluster see under this path",
            got=f"another one, or none, on {platform.node()}",
            where=str(task.output),
            remedy="choose one on a shared file system, or a URL, with -o",
        )
    return work(task, tell)


def log_identity(log: LogInput) -> str | None:
    """Return the identity of a log's content, None if the log cannot be read."""
    try:
        return _identity_of_slice(log, identity_of(log))
    except (PdhefError, OSError):
        return None  # the run reports the reason


def _identity_of_slice(log: LogInput, identity: str) -> str:
    return identity if log.span_s is None else f"{identity} {log.span_s}"


def _run_drive(task: DriveTask, tell: Tell, warned: list[str]) -> DriveEnd:
    from pdhef_logtool.runs.run_drive import run_log  # loads the compiler

    cars, mapping = _cars_and_mapping(task.run, task.config)
    cars = replace(cars, warn=warned.append)
    car = cars.of_log(task.log)
    outputs = OutputFolder(task.output)  # locked by the run
    result = run_log(
        task.log, outputs, task.config, car, mapping,
        validation=task.validation, is_first=task.is_first,
        reporter=Reporter(progress=tell, warn=warned.append),
    )  # fmt: skip
    part = f"{PARTS}/part-{digest_of(task.log.stem)}.parquet"
    write_part(task.output / part, result.part)
    if task.page:
        from pdhef_logtool.reports.pages import write_drive_page

        if wrong := write_drive_page(result.opened).wrong:
            warned.append(f"no page of {result.outcome.log}: {wrong}")
    return DriveEnd(
        result.outcome,
        _identity_of_slice(task.log, str(result.outcome.sha256)),
        car_record(car),
        part,
        result.part["drives"][0][0]["sideslip_rmse_rad"].as_py(),
        tuple(warned),
        outputs=states_of(task.output, [part, *(f"{log_place(task.log.stem)}/{name}" for name in LOG_FILES)]),
    )


@lru_cache(maxsize=1)
def _cars_and_mapping(_run: str, config: RunConfig) -> tuple[RunCars, LogMapping | None]:
    """Return cars and mapping of a run, read once by this process."""
    return RunCars.of(config, lambda _: None), mapping_of(config.mapping)
