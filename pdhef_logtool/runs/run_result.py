"""The result of a run and of each of its logs."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.records.errors import EXIT_FAILURE, EXIT_GATE, EXIT_OK, EXIT_PARTIAL
from pdhef_logtool.results.opened_run import OpenedLog
from pdhef_logtool.results.plan_verdicts import PlanVerdicts
from pdhef_logtool.results.run_report import LogOutcome
from pdhef_logtool.results.tables import drive_part, read_part
from pdhef_logtool.storage.documents import jsonable
from pdhef_logtool.storage.object_store import Mirror

#: Largest number of logs that are reported one by one and keep all files.
FEW_LOGS = 50


@dataclass(frozen=True, slots=True, eq=False)
class LogResult:
    """Result of one log. A report that is no longer in memory is read from the output files.

    Attributes
    ----------
    output : folder of the log, None if no file was written.
    document : report in memory, None: in the folder. rows : figures in memory.
    part : its rows of the tables (:mod:`~pdhef_logtool.results.tables`), or their file; None: it has no report.
    """

    outcome: LogOutcome
    output: Path | None
    document: dict[str, Any] | None = None
    rows: tuple[MetricRow, ...] = ()
    part: Any = None

    @property
    def report(self) -> dict[str, Any] | None:
        """The document of report.json, None if the log failed; raises OutputError for a damaged file."""
        return self.document if self.document is not None or self.output is None else self.opened.report()

    @property
    def tables(self) -> Any:
        """The rows of the log in all tables (:func:`~pdhef_logtool.results.tables.drive_part`)."""
        if self.part is None:
            return drive_part(self.outcome, None)
        return read_part(self.part) if isinstance(self.part, Path) else self.part

    @property
    def opened(self) -> OpenedLog:
        """The log as commands read it back from its files; without any, with its report in memory."""
        entry, document = asdict(self.outcome), None if self.output else self.document
        return OpenedLog(self.outcome.log, self.outcome.outcome, self.output or Path(), entry, document=document)


@dataclass(frozen=True, slots=True, eq=False)
class RunResult:
    """Result of a run; ``output`` is None without an output folder.

    ``requirements``: the verdicts of the validation plan on all logs.

    ``stored``: the outputs at a URL; ``output`` is then a local folder with reports and figures, which is deleted with
    this result.
    """

    output: Path | None
    results: tuple[LogResult, ...]
    stored: Mirror | None = None
    requirements: PlanVerdicts | None = None

    @property
    def place(self) -> Path | str | None:
        """Folder or URL of the outputs."""
        return self.output if self.stored is None else self.stored.objects.shown

    @property
    def is_fleet(self) -> bool:
        """Whether there are too many logs to report each."""
        return len(self.results) > FEW_LOGS

    @property
    def exit_code(self) -> int:
        """0: success, 4: a requirement failed, 3: input was lost, a check or some logs failed, 1: all logs failed."""
        if all(r.outcome.failed is not None for r in self.results):
            return EXIT_FAILURE
        if self.requirements is not None and self.requirements.closing:
            return EXIT_GATE
        is_whole = all(r.outcome.outcome == "ok" and not r.outcome.failed_checks for r in self.results)
        return EXIT_OK if is_whole else EXIT_PARTIAL

    def to_dict(self) -> dict[str, Any]:
        """Return the result as one JSON-able document; of many logs without their reports."""
        return {
            "output": None if self.place is None else str(self.place),
            "exit_code": self.exit_code,
            "plan": None if self.requirements is None else jsonable(self.requirements.to_dict()),
            "logs": [
                {
                    "log": r.outcome.log,
                    "outcome": r.outcome.outcome,
                    "output": None if r.output is None else str(r.output).replace(str(self.output), str(self.place), 1),
                    "report": None if self.is_fleet else r.report,
                }
                for r in self.results
            ],
        }
