"""The command line ``pdhef``: each command parses, calls one public function, and prints."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from pdhef_logtool.errors import EXIT_FAILURE, EXIT_PARTIAL, PdhefError, UsageError

if TYPE_CHECKING:
    from rich.console import Console

app = typer.Typer(
    name="pdhef",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Estimate sideslip on recorded drives (MCAP, rosbag1, rosbag2), score it against truth, annotate the logs.",
    epilog="Exit codes: 0 ok, 1 failure, 2 usage, 3 finished but some input was lost or some logs failed, "
    "4 a threshold or regression gate failed.",
)


def _version(show: bool) -> None:
    if show:
        from pdhef_logtool import __version__

        print(f"pdhef {__version__}")  # noqa: T201
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    del version


JsonFlag = Annotated[bool, typer.Option("--json", help="One JSON document on stdout instead of tables.")]
MappingFile = Annotated[
    Path | None, typer.Option("--mapping", "-m", help="mapping.toml: topic.field -> signal. Default: recognised types.")
]
TruthChoice = Annotated[
    str | None, typer.Option("--prefer-truth", help="perfect or rtk: which truth of a simulated log counts.")
]


@app.command(
    epilog="""Examples:

  pdhef inspect drive.mcap

  pdhef inspect drive.bag --json | jq .signals

  pdhef inspect drive.mcap --write-mapping mapping.toml"""
)
def inspect(
    log: Annotated[Path, typer.Argument(help="MCAP file, rosbag1 file, rosbag2 folder or .db3 file.")],
    mapping: MappingFile = None,
    write_mapping: Annotated[
        Path | None, typer.Option("--write-mapping", help="Write a ready-to-edit mapping.toml (never overwrites).")
    ] = None,
    prefer_truth: TruthChoice = None,
    as_json: JsonFlag = False,
) -> None:
    """Show topics, rates, gaps, clock jitter, what maps to what, and what is missing."""
    from pdhef_logtool.config import load_config
    from pdhef_logtool.inspection import inspect_log, render_inspection
    from pdhef_logtool.inspection import write_mapping as write_mapping_file
    from pdhef_logtool.mapping import load_mapping

    config = load_config(None, {"mapping": mapping, "prefer_truth": prefer_truth})
    chosen = None if config.mapping is None else load_mapping(config.mapping)
    inspection = inspect_log(log, chosen, prefer_truth=config.prefer_truth)
    if write_mapping is not None:
        write_mapping_file(inspection, write_mapping)
        _say(f"mapping written to {write_mapping}")
    if as_json:
        _print_json(inspection.to_dict())
    else:
        render_inspection(inspection, _stdout())
    if any(loss.severity == "lost" for loss in inspection.lost):
        raise typer.Exit(EXIT_PARTIAL)


@app.command(
    epilog="""Examples:

  pdhef run drive.mcap -o out

  pdhef run drive.bag -o out --vehicle car.toml --mapping mapping.toml

  pdhef run logs/ -o out --estimators zero,phy-ukf --annotate sidecar

  pdhef run drive.mcap -o out --start +60s --end end-5s --json

Times: seconds from the log's start (12.5, +10s), before its end (end-5s), nanoseconds (an integer of 1e15 or more), or
RFC 3339 (2026-01-31T12:00:00Z)."""
)
def run(
    logs: Annotated[list[str], typer.Argument(help="Logs, folders that hold some, or glob patterns.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for everything that the run writes.")],
    estimators: Annotated[
        str | None, typer.Option("--estimators", "-e", help="Comma-separated names; see pdhef estimators.")
    ] = None,
    vehicle: Annotated[Path | None, typer.Option("--vehicle", "-v", help="vehicle.toml.")] = None,
    mapping: MappingFile = None,
    start: Annotated[str | None, typer.Option("--start", help="Start of the slice (see Times).")] = None,
    end: Annotated[str | None, typer.Option("--end", help="End of the slice (see Times).")] = None,
    annotate: Annotated[
        str | None,
        typer.Option("--annotate", help="full: copy of the log with our topics; sidecar: our topics only; none."),
    ] = None,
    sensors: Annotated[
        str | None, typer.Option("--sensors", help="full, or esp: no wheel speeds in the filters after the start.")
    ] = None,
    prefer_truth: TruthChoice = None,
    config: Annotated[Path | None, typer.Option("--config", help="pdhef.toml; flags win over it.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Run estimators on logs, compare them with truth, and write annotated logs, recordings and metrics."""
    from pdhef_logtool.config import load_config
    from pdhef_logtool.pipeline import run_logs
    from pdhef_logtool.summary import render_run

    settings = load_config(
        config,
        {
            "estimators": None if estimators is None else tuple(n.strip() for n in estimators.split(",") if n.strip()),
            "vehicle": vehicle,
            "mapping": mapping,
            "start": start,
            "end": end,
            "annotate": annotate,
            "sensors": sensors,
            "prefer_truth": prefer_truth,
        },
    )
    with _progress() as progress:
        result = run_logs(logs, output, settings, progress=progress, warn=_warn)
    if as_json:
        _print_json(result.to_dict())
    else:
        render_run(result, _stdout())
    raise typer.Exit(result.exit_code)


@app.command(
    epilog="""Examples:

  pdhef simulate --list

  pdhef simulate dlc --speed 100 --mu 0.85 --seed 1 -o dlc.mcap

  pdhef simulate road --duration 300 --seed 3 -o road.mcap"""
)
def simulate(
    manoeuvre: Annotated[str | None, typer.Argument(help="Name of a manoeuvre; --list shows them.")] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="MCAP file to write.")] = None,
    speed_km_h: Annotated[float | None, typer.Option("--speed", help="km/h; default: the manoeuvre's.")] = None,
    friction: Annotated[float | None, typer.Option("--mu", help="Friction; default: the manoeuvre's.")] = None,
    seed: Annotated[int, typer.Option("--seed", help="Seed of noise and of random profiles.")] = 0,
    duration_s: Annotated[float | None, typer.Option("--duration", help="s; default: the manoeuvre's.")] = None,
    list_all: Annotated[bool, typer.Option("--list", help="List the manoeuvres and their defaults.")] = False,
    as_json: JsonFlag = False,
) -> None:
    """Write a drive of the simulator truthsim as ROS 2 MCAP: noisy sensors, RTK truth and perfect truth."""
    from truthsim.manoeuvres import MANOEUVRES

    if list_all:
        _list_manoeuvres(MANOEUVRES, as_json)
        return
    if manoeuvre is None or output is None:
        raise UsageError(
            expected="a manoeuvre and -o FILE",
            got="no " + ("manoeuvre" if manoeuvre is None else "-o FILE"),
            where="pdhef simulate",
            remedy="pdhef simulate --list shows the manoeuvres",
        )
    from truthsim.drive import simulate_drive, write_drive

    drive = simulate_drive(manoeuvre, speed_km_h=speed_km_h, friction=friction, seed=seed, duration_s=duration_s)
    write_drive(drive, output)
    facts = {"output": str(output), **drive.facts()}
    if as_json:
        _print_json(facts)
    else:
        for key, value in facts.items():
            print(f"{key}: {value:.4g}" if isinstance(value, float) else f"{key}: {value}")  # noqa: T201


def _list_manoeuvres(manoeuvres: Any, as_json: bool) -> None:
    rows = [
        {
            "name": name,
            "description": m.description,
            "speed_km_h": m.speed_km_h,
            "friction": m.friction,
            "duration_s": m.duration_s,
        }
        for name, m in manoeuvres.items()
    ]
    if as_json:
        _print_json({"manoeuvres": rows})
        return
    from rich.table import Table

    table = Table("name", "km/h", "mu", "s", "what it is", box=None, header_style="bold")
    for row in rows:
        table.add_row(
            row["name"], f"{row['speed_km_h']:g}", f"{row['friction']:g}", f"{row['duration_s']:g}", row["description"]
        )
    _stdout().print(table)


@app.command()
def estimators(as_json: JsonFlag = False) -> None:
    """List the estimators that run can use."""
    from pdhef_logtool.estimators.registry import DESCRIPTIONS

    if as_json:
        _print_json({"estimators": [{"name": n, "description": d} for n, d in DESCRIPTIONS.items()]})
        return
    from rich.table import Table

    table = Table("name", "what it is", box=None, header_style="bold")
    for name, description in DESCRIPTIONS.items():
        table.add_row(name, description)
    _stdout().print(table)


@app.command(
    epilog="""Examples:

  pdhef view out

  pdhef view out/logs/drive/recording.rrd"""
)
def view(
    output: Annotated[Path, typer.Argument(help="Output folder of a run, the folder of one log, or a .rrd file.")],
    log: Annotated[str | None, typer.Option("--log", help="Which log of the run; default: the first.")] = None,
) -> None:
    """Open the recording of a run in the Rerun viewer."""
    from pdhef_logtool.viewer import find_recording, open_viewer

    recording = find_recording(output, log)
    _say(f"opening {recording}")
    raise typer.Exit(open_viewer(recording))


# ---- printing ----


def _stdout() -> Console:
    from rich.console import Console

    # A pipe has no width of its own: tables are then as wide as they need to be, unless COLUMNS says otherwise.
    if sys.stdout.isatty() or os.environ.get("COLUMNS"):
        return Console()
    return Console(width=160)


def _say(text: str) -> None:
    print(text, file=sys.stderr)  # noqa: T201


def _warn(text: str) -> None:
    print(f"warning: {text}", file=sys.stderr)  # noqa: T201


def _print_json(document: Any) -> None:
    print(json.dumps(document, indent=2, sort_keys=False, ensure_ascii=False, allow_nan=False))  # noqa: T201


@contextmanager
def _progress() -> Iterator[Callable[[str, float], None]]:
    """Yield ``update(text, share)``: a bar on a terminal's stderr, silence elsewhere."""
    if not sys.stderr.isatty():
        yield lambda _text, _share: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda text, share: bar.update(task, description=text, completed=share)


def main() -> NoReturn:
    """Run the command line; every error that a user can repair is one line on stderr and an exit code."""
    try:
        app(standalone_mode=True)
    except PdhefError as error:
        _say(f"pdhef: {error}")
        sys.exit(error.exit_code)
    except KeyboardInterrupt:
        _say("pdhef: interrupted; nothing half-written was left under its final name")
        sys.exit(130)
    except BrokenPipeError:
        # The reader of our stdout has gone (for example ``| head``): no error of ours.
        sys.stderr.close()
        sys.exit(EXIT_FAILURE)
    except Exception as error:
        if os.environ.get("PDHEF_TRACEBACK"):
            raise
        _say(f"pdhef: internal error, {type(error).__name__}: {error}; PDHEF_TRACEBACK=1 shows where, please report it")
        sys.exit(EXIT_FAILURE)
    sys.exit(0)
