"""``pdhef run``, ``metrics``, ``view`` and ``plan init``: estimate, score recorded estimates, show recordings."""

import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer
from typer import Option

from pdhef_logtool.cli import console, options
from pdhef_logtool.records.errors import OutputError, UsageError

if TYPE_CHECKING:
    from pdhef_logtool.runs.config import RunConfig
    from pdhef_logtool.runs.run_result import RunResult


def _list_estimators(show: bool) -> None:
    if show:
        from pdhef_logtool.estimators.table import all_specs

        rows = ((spec.name, spec.text) for spec in all_specs())
        console.stdout().print(console.table("name", "description", rows=rows))
        raise typer.Exit


@options.command()
def run(
    logs: list[str],
    *,
    output: str,
    config: "RunConfig",
    junit: Path | None = None,
    report: bool = True,
    jobs: int = 1,
    ray: str | None = None,
    resume: bool = False,
    repeat: list[str] | None = None,
    list_estimators: Annotated[
        bool,
        Option("--list-estimators", callback=_list_estimators, is_eager=True, help="List the estimators and exit."),
    ] = False,
) -> None:
    """Run estimators on logs, score them, write reports and annotated logs."""
    del list_estimators
    from pdhef_logtool.runs.fleet import Schedule, run_logs

    schedule = Schedule(jobs, ray, resume, repeat or ())
    with console.reporter() as reporter:
        result = run_logs(logs, output, config, schedule=schedule, junit=junit, report=report, reporter=reporter)
    _finish(result)


@options.command()
def metrics(
    log: str,
    *,
    config: "RunConfig",
    estimate: list[str] | None = None,
    truth: list[str] | None = None,
    name: str | None = None,
    output: Path | None = None,
    junit: Path | None = None,
) -> None:
    """Score an estimate that the log contains, with the metrics of pdhef run."""
    from pdhef_logtool.runs.recorded_estimates import score_log

    with console.reporter() as reporter:
        result = score_log(
            log,
            config,
            estimates=estimate or (),
            truth=truth or (),
            name=name,
            output=output,
            junit=junit,
            reporter=reporter,
        )
    _finish(result)


@options.command()
def view(output: str, *, log: list[str] | None = None, web: bool = False, catalog: bool = False) -> None:
    """Open the recordings of a run in the Rerun viewer."""
    folder = options.local_folder(output)
    recordings = find_recordings(folder, log or ())
    if catalog:
        raise typer.Exit(serve_catalog(recordings, folder.resolve().stem, web=web))
    if not web and not console.has_display():
        raise UsageError(
            expected="a display to open the viewer on",
            got="neither DISPLAY nor WAYLAND_DISPLAY",
            where="pdhef view",
            remedy="add --web and open the address that it prints, or copy the .rrd files to a machine with a display",
        )
    console.say(f"opening {recordings[0] if len(recordings) == 1 else f'{len(recordings)} recordings of {folder}'}")
    raise typer.Exit(open_viewer(recordings, web=web))


def _finish(result: "RunResult") -> NoReturn:
    """Print and exit; failed requirements, and failures that the exit code does not show, are printed on stderr."""
    from pdhef_logtool.cli.run_tables import render_fleet, render_run

    if result.is_fleet and result.output is not None:
        from pdhef_logtool.results.fleet import summarise
        from pdhef_logtool.results.opened_run import open_run

        summary = summarise(open_run(result.output), result.exit_code) | {"output": str(result.place)}
        console.show(summary, render_fleet)
    else:
        # Only the report is printed; to make the texts of all rows printable takes as long as to print it.
        shown = tuple(replace(r, document=r.report, rows=(), part=None) for r in result.results)
        console.show(replace(result, results=shown), render_run)
        for entry in result.results:
            if entry.outcome.failed is not None and entry.report is not None:  # the tables show the others
                console.error(f"pdhef: {entry.outcome.log}: {entry.outcome.failed}")
    if (plan := result.requirements) is not None and plan.closing:
        for verdict in plan.closing:
            where = f"{verdict.requirement.id} ({verdict.requirement.label})"
            console.error(f"pdhef: {verdict.outcome}: {where}: {verdict.reason}")
        for entry in result.results if not result.is_fleet else ():
            if entry.outcome.outcome != "ok":
                console.error(f"pdhef: {entry.outcome.log} besides {entry.outcome.outcome}")
    raise typer.Exit(result.exit_code)


def find_recordings(output: Path, logs: Sequence[str]) -> list[Path]:
    """Return the recordings of a run.

    Parameters
    ----------
    output : output folder of a run, the folder of one log, or the recording itself.
    logs : names of logs; empty selects all logs with a recording, in the order of the run.

    Raises
    ------
    OutputError
        There is no finished run, or a selected log has no recording; the error lists the available ones.
    """
    from pdhef_logtool.results.opened_run import RECORDING_FILE, open_run

    if output.is_file():
        return [output]
    if not logs and (output / RECORDING_FILE).is_file():
        return [output / RECORDING_FILE]
    recordings = {log.label: path for log in open_run(output).logs if (path := log.file(RECORDING_FILE)) is not None}
    missing = [name for name in logs if name not in recordings]
    if not recordings or missing:
        raise OutputError(
            expected=f"a log named {missing[0]}" if missing else RECORDING_FILE,
            got=", ".join(recordings) or "none",
            where=output,
            remedy="" if recordings else "pdhef run LOG -o OUT --keep full writes one",
        )
    return [recordings[name] for name in dict.fromkeys(logs)] if logs else list(recordings.values())


def serve_catalog(recordings: Sequence[Path], name: str, *, web: bool) -> int:
    """Serve recordings as one dataset of Rerun's catalog on this machine, until the viewer or the command ends."""
    from rerun.server import Server

    with Server(host="127.0.0.1", datasets={name: recordings}) as server:
        console.stdout().print(f"catalog at {server.url()}, dataset {name}; Ctrl-C ends it", soft_wrap=True)
        if web or console.has_display():
            return open_viewer([server.url()], web=web)
        threading.Event().wait()
    return 0


def open_viewer(recordings: Sequence[Path | str], *, web: bool) -> int:
    """Open recordings or a catalog in one viewer, not reachable from the network, and return its exit code."""
    command = [sys.executable, "-m", "rerun", "--bind", "127.0.0.1", "--new", *(["--web-viewer"] if web else [])]
    return subprocess.call([*command, *map(str, recordings)])  # noqa: S603 (our own interpreter)


@options.command()
def plan(action: str, *, output: Path) -> None:
    """Write a validation plan: requirements for run, metrics and compare."""
    from pdhef_logtool.evaluation.validation_plan import example_plan
    from pdhef_logtool.storage.files import write_bytes

    if action != "init":
        raise UsageError(expected="init", got=action, where="pdhef plan", remedy="pdhef plan init -o plan.toml")
    if output.exists():
        raise UsageError(expected="a new file", got="one that exists", where=output, remedy="choose another name")
    write_bytes(output, example_plan().encode())
    console.say(f"{output} written; use it: pdhef run LOGS -o OUT --plan {output}")
