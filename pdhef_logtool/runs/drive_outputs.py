"""The output files of a drive, and run.json."""

import json
import re
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from shutil import copyfile
from typing import TYPE_CHECKING, Any

from pdhef_logtool.car.car import SHOWN_DIGITS
from pdhef_logtool.car.parts import PHYSICS
from pdhef_logtool.estimators.table import ALL_ESTIMATORS, all_specs
from pdhef_logtool.evaluation.metrics import MetricRow
from pdhef_logtool.logs.discovery import RUN_FILE, LogInput
from pdhef_logtool.mapping import Mapping as SignalMapping
from pdhef_logtool.records.signals import NS_PER_S
from pdhef_logtool.records.tracks import StateTrack
from pdhef_logtool.results import opened_run
from pdhef_logtool.results.no_position import topics_with_position, without_pose
from pdhef_logtool.results.parquet_sink import write_estimates
from pdhef_logtool.results.run_report import build_run, tool_versions, write_json
from pdhef_logtool.results.sink import TRUTH, Event
from pdhef_logtool.results.tables import add_verdicts, write_metrics, write_tables
from pdhef_logtool.runs.config import RunConfig
from pdhef_logtool.runs.run_result import LogResult
from pdhef_logtool.storage.documents import file_sha256
from pdhef_logtool.storage.files import PendingFile, write_bytes, writing
from pdhef_logtool.storage.outputs import FolderTransaction, check_no_input

if TYPE_CHECKING:
    from pdhef_logtool.results.mcap_sink import AnnotatedMcap
    from pdhef_logtool.results.plan_verdicts import PlanVerdicts
    from pdhef_logtool.results.selected_estimate import MainFacts
    from pdhef_logtool.runs.estimating import Estimated, PreparedDrive

_ANNOTATED, _FOXGLOVE, _PLOTJUGGLER = "annotated.mcap", "foxglove.json", "plotjuggler.xml"
#: Files of an earlier run, deleted unless the new run writes them.
STALE_FILES = (
    opened_run.MODEL_FILE,
    opened_run.PAGE_FILE,
    opened_run.METRICS_FILE,
    opened_run.ESTIMATES_FILE,
    opened_run.RECORDING_FILE,
)
#: All files that a run writes into the folder of a log.
LOG_FILES = (*STALE_FILES, _ANNOTATED, _FOXGLOVE, _PLOTJUGGLER, opened_run.REPORT_FILE)

_NO_COPY = "annotated.mcap contains the tool's topics only: a log of kind {} has no messages to copy"


class DriveOutputs:
    """The output files of an estimated drive, as far as its configuration keeps them.

    Parameters
    ----------
    folders : of the log and of the run. run : the estimators that are written. main : selected estimate.
    """

    def __init__(
        self, folders: tuple[FolderTransaction, Path], run: "PreparedDrive", estimated: "Estimated", main: "MainFacts"
    ) -> None:
        (self._change, self._run_folder), self._run, self._main = folders, run, main
        self._signals, names, self._is_copy = estimated.signals, run.names, run.config.annotation == "full"
        steer_rad = estimated.signals.steer_rad
        tracks = [t if t.name == TRUTH else replace(t, steer_rad=steer_rad) for t in estimated.drawn]
        self.tracks = [without_pose(track) for track in tracks] if run.config.no_position else tracks
        # Recordings show the selected estimate beside physics alone, otherwise beside the naive estimate.
        order = dict.fromkeys([main.name, PHYSICS, *filter(None, [main.naive]), *main.shown])
        self._shown = [name for name in order if name in names][:2]

    def annotated(self) -> "AbstractContextManager[AnnotatedMcap | None]":
        """Return the annotated log as a context, None if it is not requested; add remarks of the drive."""
        config, drive = self._run.config, self._run.drive
        left_out = self._left_out() if config.no_position else None
        if config.annotation == "none":
            return nullcontext()
        from pdhef_logtool.results.mcap_sink import AnnotatedMcap, thinned_step_ns

        if self._is_copy and drive.log.messages is None:
            drive.remarks.append(_NO_COPY.format(drive.log.kind))
        is_named = bool(config.estimators) and config.estimators != (ALL_ESTIMATORS,)
        span_ns = drive.plan.end_ns - drive.plan.start_ns
        step_ns = thinned_step_ns(
            drive.log.size, rows=len(self._signals), others=len(self._run.estimators) - 1, span_ns=span_ns
        )
        return AnnotatedMcap(
            self._change.file(_ANNOTATED),
            drive.log if self._is_copy else None,
            shown={self._main.name, TRUTH},
            others_step_ns=None if is_named else step_ns,
            min_speed_m_s=self._run.car.vehicle.low_speed_blend_m_s,
            left_out=left_out,
        )

    def _left_out(self) -> frozenset[str]:
        """Return the topics that ``--no-position`` keeps out of the copy, if there is one; add a remark."""
        drive = self._run.drive
        topics = topics_with_position(drive.log, drive.plan.mapping) if self._is_copy else frozenset()
        names = f"topics {', '.join(sorted(topics))}, " if topics else ""
        drive.remarks.append(f"--no-position leaves out {names}attachments, metadata and file names")
        return topics

    def write(self, report: dict[str, Any], rows: Sequence[MetricRow], events: Sequence[Event]) -> None:
        """Write all files but the annotated log."""
        config, drive = self._run.config, self._run.drive
        colours = {s.name: s.colour for s in all_specs()}
        if config.annotation != "none":
            self._write_layouts(colours)
        if config.kept == "full":
            self._write_recording(report, events, colours)
        head = f"Sensors and car of {drive.name}, for pdhef run --model."
        write_bytes(self._change.file(opened_run.MODEL_FILE), self._run.model.file.toml(head).encode())
        if config.kept == "metrics":
            write_json(self._change.file(opened_run.REPORT_FILE), report)
        else:
            write_drive_tables(self._change, report, rows, self.tracks, self._main.name, self._causal_from_ns())

    def _causal_from_ns(self) -> dict[str, int]:
        """Return the first stamp from which the rows of each causal estimator depend on past samples only."""
        drive = self._run.drive
        after_s = drive.plan.decided_s if drive.causal_from_s is None else drive.causal_from_s
        first_ns = drive.plan.start_ns + round(after_s * NS_PER_S)
        return {e.name: first_ns for e in self._run.estimators if e.causal and not drive.not_causal}

    def _write_layouts(self, colours: dict[str, int]) -> None:
        from pdhef_logtool.mapping.recognition import FIX_TYPES, type_of
        from pdhef_logtool.results.layouts import write_layouts

        fixes = [t.name for t in self._run.drive.log.topics if type_of(t) in FIX_TYPES]
        write_layouts(
            self._change.file(_FOXGLOVE),
            self._change.file(_PLOTJUGGLER),
            self.tracks,
            colours,
            shown={self._main.name, TRUTH},
            fixes=fixes if self._is_copy and not self._run.config.no_position else (),
        )

    def _write_recording(self, report: dict[str, Any], events: Sequence[Event], colours: dict[str, int]) -> None:
        from pdhef_logtool.results.rerun_sink import write_recording

        drive = self._run.drive
        # Recordings of a run have the same application, by which a viewer shows them as one dataset.
        identity = json.dumps([self._run.config.to_dict(), tool_versions()], sort_keys=True)
        # Rerun warns of other characters and of long names.
        folder = re.sub(r"[^A-Za-z0-9_]+", "-", self._run_folder.resolve().name)[:64]
        run = f"pdhef-{folder}-{sha256(identity.encode()).hexdigest()[:SHOWN_DIGITS]}"
        write_recording(
            self._change.file(opened_run.RECORDING_FILE),
            self._signals,
            self.tracks,
            report,
            events,
            application_id=run,
            input_hash=sha256(f"{run} {drive.sha256} {drive.name}".encode()).hexdigest(),
            shown=self._shown,
            colours=colours,
        )


def write_drive_tables(
    change: FolderTransaction,
    report: dict[str, Any],
    rows: Sequence[MetricRow],
    tracks: Sequence[StateTrack],
    selected: str | None = None,
    causal_from_ns: Mapping[str, int] | None = None,
) -> None:
    """Write estimates.parquet, metrics.parquet and report.json of a drive."""
    write_estimates(change.file(opened_run.ESTIMATES_FILE), tracks, selected=selected, causal_from_ns=causal_from_ns)
    write_metrics(change.file(opened_run.METRICS_FILE), rows)
    write_json(change.file(opened_run.REPORT_FILE), report)


def files_of(folder: Path) -> dict[str, str]:
    """Return the sha256 of the files in a log's folder that commands read back, by name."""
    paths = (folder / name for name in (opened_run.REPORT_FILE, opened_run.ESTIMATES_FILE))
    return {path.name: file_sha256(path) for path in paths if path.is_file()}


def write_run_tables(output: Path, results: Sequence[LogResult]) -> None:
    """Write the tables of logs, and metrics.parquet also beside run.json, for readers of earlier versions."""
    write_tables(output / opened_run.TABLES_FOLDER, (r.tables for r in results), [r.outcome.folder for r in results])
    with writing(output / opened_run.METRICS_FILE), PendingFile(output / opened_run.METRICS_FILE) as pending:
        copyfile(output / opened_run.table_file("metrics"), pending.path)


def write_run(
    output: Path,
    config: dict[str, Any],
    results: Sequence[LogResult],
    verdicts: "PlanVerdicts | None",
    network: tuple[str, str] | None = None,
    remaining: int = 0,
) -> None:
    """Write run.json beside the tables, with the configuration as JSON-able values; arguments as of build_run."""
    if verdicts is not None:
        add_verdicts(output / opened_run.TABLES_FOLDER, verdicts.to_dict())
    names = (opened_run.METRICS_FILE, *map(opened_run.table_file, opened_run.TABLES))
    files = {name: file_sha256(output / name) for name in names}
    outcomes = [r.outcome for r in results]
    write_json(output / RUN_FILE, build_run(config, network, outcomes, remaining=remaining, files=files, plan=verdicts))


def log_place(stem: str) -> str:
    """Return the folder of a log within the outputs."""
    return f"{opened_run.LOGS}/{stem}"


def check_places(
    inputs: Sequence[LogInput],
    output: Path | None,
    config: RunConfig,
    mapping: SignalMapping | None,
    junit: Path | None,
    cars: Sequence[Path | None] = (),
) -> None:
    """Refuse to write over an input; raises UsageError."""
    files, folders = [*filter(None, [junit])], list[Path]()
    if output is not None:
        folders = [output / log_place(i.stem) for i in inputs]
        files += [output / name for name in (opened_run.METRICS_FILE, RUN_FILE, opened_run.PAGE_FILE)]
        files += [folder / name for folder in folders for name in LOG_FILES]
    can = () if mapping is None else mapping.dbc
    check_no_input([*(i.local for i in inputs), *config.files, *cars, *can], files, folders)
