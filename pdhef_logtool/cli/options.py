"""Shared options of the commands, and their conversion to the configuration of a run."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from functools import cache, partial, wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
from typer import Argument, Option

from pdhef_logtool.cli.panels import PanelCommand
from pdhef_logtool.records.errors import UsageError

if TYPE_CHECKING:
    from pdhef_logtool.runs.config import RunConfig

#: Panels of the help, in order, after the options without a panel.
INPUT, ESTIMATION, OUTPUT, WORK, SETTINGS = "Input", "Estimation", "Output", "Processes", "Settings"

Log = Annotated[
    str,
    Argument(metavar="LOG", help="Log file (MCAP, rosbag, MDF, CSV, VBO, MAT, ...), rosbag2 folder, or URL of a file."),
]
Logs = Annotated[
    list[str], Argument(metavar="LOG", help="Log files, folders with logs, glob patterns, URLs, or @list.txt.")
]
TruthLogs = Annotated[
    list[str],
    Argument(metavar="LOG", help="Logs with ground truth, folders with logs, glob patterns, URLs, or @list.txt."),
]
#: Options in a panel of the help.
output_option, work_option = partial(Option, rich_help_panel=OUTPUT), partial(Option, rich_help_panel=WORK)
JunitFile = Annotated[Path | None, output_option(help="JUnit XML file for the verdicts of --plan.")]
Jobs = Annotated[int, work_option("--jobs", "-j", help="Number of worker processes. Results do not depend on it.")]


def local_folder(argument: str) -> Path:
    """Return the folder of an argument; raises UsageError for a URL, because the command writes to the folder."""
    from pdhef_logtool.storage.object_store import ObjectFolder, is_url

    if is_url(argument):
        shown = ObjectFolder(argument).shown
        raise UsageError(
            expected="a folder of this machine",
            got=shown,
            where="OUTPUT",
            remedy=f"copy it first: aws s3 cp --recursive {shown} DIR",
        )
    return Path(argument)


def _option(kind: Any, panel: str, text: str | None = None, *names: str, metavar: str | None = None) -> Any:
    """Return the annotation of a shared option of the command line."""
    return Annotated[kind, Option(*names, metavar=metavar, help=text, rich_help_panel=panel)]


_Text, _File, _Many = str | None, Path | None, list[str] | None
#: Shared options by the name of the configuration entry, in the order of the help.
_OPTIONS: dict[str, Any] = {
    "car": _option(_File, INPUT),
    "mapping": _option(
        _File,
        INPUT,
        "mapping.toml, which maps fields to signals, or a folder with one per recorder. Default: recognised "
        "by message type, name and unit.",
        "--mapping",
        "-m",
    ),
    "start": _option(_Text, INPUT, "Start of the time slice: 12.5, +10s, end-5s, ns or RFC 3339."),
    "end": _option(_Text, INPUT, "End of the time slice, same formats as --start."),
    "estimators": _option(
        _Text, ESTIMATION, "Comma-separated names, all or peers. Default: pd-hef, physics, zero.", "--estimators", "-e"
    ),
    "friction": _option(_Text, ESTIMATION, "auto (from the log, else the car, else 1), file, or a number."),
    "network": _option(_File, ESTIMATION, "Network folder, default or none. Default: the car's."),
    "model": _option(
        _File,
        ESTIMATION,
        "auto: fit sensors and car to the log (not causal). off: do not fit the car. FILE: model.toml of a run.",
        metavar="auto|off|FILE",
    ),
    "reference": _option(
        _Text, ESTIMATION, "Sideslip reference without tyre data: auto (without ground truth), on or off."
    ),
    "gnss": _option(_Text, ESTIMATION, "GNSS velocity in filters and reference: auto or off."),
    "no_position": _option(
        bool | None,
        OUTPUT,
        "Keep positions, metadata and file names out of all outputs; copy only topics without a position.",
        "--no-position",
    ),
    "waived": _option(_Many, INPUT, "Ignore the failure of this check. Repeatable.", "--waive", metavar="CHECK"),
    "annotate": _option(_Text, OUTPUT, "full: copy of the log with the estimates; sidecar: estimates only; none."),
    "keep": _option(
        _Text, OUTPUT, "Files per log: metrics, estimates or full. Default: full, for more than 50 logs metrics."
    ),
    "plan": _option(_File, OUTPUT, "Validation plan (pdhef plan init). Exit code 4 if a requirement fails."),
    "config_file": _option(
        _File,
        SETTINGS,
        "Settings file. Default: pdhef.toml in the working directory. Options have priority.",
        "--config",
    ),
    "assignments": _option(
        _Many,
        SETTINGS,
        "A setting of pdhef.toml, listed in docs/settings.md. Repeatable.",
        "--set",
        metavar="KEY=VALUE",
    ),
}


@cache
def _texts() -> dict[str, dict[str, str]]:
    """Return panel, examples and notes of the commands."""
    return tomllib.loads((Path(__file__).parent / "commands.toml").read_text(encoding="utf-8"))


#: All commands, in the order of their registration.
commands = typer.Typer()


def command(
    *, name: str | None = None, shared: str = "", car: str = ""
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a function a command; its parameter ``config`` receives the :class:`RunConfig` from the shared options.

    ``commands.toml`` contains its panel, and the text below its options: command lines, and paragraphs.

    Parameters
    ----------
    name : of the command; None = the name of the function.
    shared : shared options in addition to --config and --set, which every ``config`` has.
    car : help text of --car for the command; empty = no car.
    """
    wanted = {"config_file", "assignments", *shared.split(), *(("car",) if car else ())}
    taken = {key: option for key, option in _OPTIONS.items() if key in wanted}
    if car:
        taken["car"] = _option(_File, INPUT, f"{car}: car folder or vehicle.toml.")

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        given = signature(function).parameters

        @wraps(function)
        def run_command(**values: Any) -> None:
            if isinstance(output := values.get("output"), Path):
                from pdhef_logtool.storage.outputs import local_path

                values["output"] = local_path(output)
            if "config" in given:
                values["config"] = run_config({key: values.pop(key) for key in taken})
            function(**values)

        # Typer reads the options from the signature, in which the shared options replace ``config``.
        hints = get_type_hints(function, localns={"RunConfig": object}, include_extras=True)
        options = [Parameter(key, Parameter.KEYWORD_ONLY, default=None, annotation=o) for key, o in taken.items()]
        parameters: list[Parameter] = []
        for key, parameter in given.items():
            argument = parameter.replace(kind=Parameter.KEYWORD_ONLY, annotation=hints[key])
            parameters += options if key == "config" else [argument]
        run_command.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        run_command.__annotations__ = {p.name: p.annotation for p in parameters}
        texts = _texts()[name or function.__name__]
        # \b keeps the lines of a paragraph as they are.
        epilog = "\n  ".join(("\b\nExamples:", *texts["examples"].splitlines())) + f"\n\n{texts.get('notes', '')}"
        return commands.command(name, epilog=epilog, cls=PanelCommand, rich_help_panel=texts["panel"])(run_command)

    return decorate


def run_config(options: dict[str, Any]) -> RunConfig:
    """Return the configuration from the shared options of a command line (None = not set).

    Raises
    ------
    UsageError
        A value is not allowed, or ``--set`` contains an unknown setting.
    """
    from pdhef_logtool.runs.config import load_config, parse_assignments

    flags = {key: value for key, value in options.items() if value not in (None, [])}
    assigned = parse_assignments(flags.pop("assignments", ()))
    return load_config(flags.pop("config_file", None), assigned | flags)
