"""The options that commands share, and the one place that turns them into a run's configuration."""

from __future__ import annotations

import functools
from collections.abc import Callable
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
from typer import Argument, Option

from pdhef_logtool.cli.console import say
from pdhef_logtool.records.errors import UsageError

if TYPE_CHECKING:
    from pdhef_logtool.runs.config import RunConfig

Log = Annotated[
    str, Argument(metavar="LOG", help="MCAP file, rosbag1 file, rosbag2 folder, .db3 file, or URL of a file.")
]
Logs = Annotated[
    list[str], Argument(metavar="LOG", help="Logs, folders that hold some, glob patterns, URLs, or @list.txt.")
]
TruthLogs = Annotated[
    list[str], Argument(metavar="LOG", help="Logs with truth, folders that hold some, globs, URLs, or @list.txt.")
]
CarOutput = Annotated[
    Path, Option("--output", "-o", metavar="CAR", help="Car to write: a folder (may be that of --car), or a .toml.")
]
JsonFlag = Annotated[bool, Option("--json", help="One JSON document on stdout instead of tables.")]
JunitFile = Annotated[Path | None, Option(help="Write the verdicts of --thresholds as JUnit XML, for CI.")]
Split = Annotated[str | None, Option(help="Only drives of this split, by the manifest of their set.")]
AnySplit = Annotated[bool, Option("--any-split", help="Take drives of every split, even of those refused otherwise.")]
Jobs = Annotated[int, Option("--jobs", "-j", help="Processes at work; changes no number.")]


def local_folder(argument: str) -> Path:
    """Return the folder that an argument names; raises UsageError for a URL, as the command writes there."""
    from pdhef_logtool.records.object_store import ObjectFolder, is_url

    if is_url(argument):
        shown = ObjectFolder(argument).shown
        raise UsageError(
            expected="a folder of this machine",
            got=shown,
            where="OUTPUT",
            remedy=f"copy it first: aws s3 cp --recursive {shown} DIR",
        )
    return Path(argument)


_Text = str | None
_File = Path | None
#: The shared options by the name of the configuration's entry, in the order of the help.
_OPTIONS: dict[str, Any] = {
    "car": Annotated[_File, Option()],
    "cars": Annotated[_File, Option(help="cars.toml: a car per log, by folder, metadata or name: docs/car.md.")],
    "estimators": Annotated[
        _Text,
        Option(
            "--estimators",
            "-e",
            help="Comma-separated (pdhef estimators), or all. Default: the main one, physics, zero.",
        ),
    ],
    "mapping": Annotated[
        _File, Option("--mapping", "-m", help="mapping.toml: topic.field -> signal; default: by message type.")
    ],
    "start": Annotated[_Text, Option(help="Start of the slice of each log: 12.5, +10s, end-5s, ns, or RFC 3339.")],
    "end": Annotated[_Text, Option(help="End of the slice of each log, as --start.")],
    "annotate": Annotated[_Text, Option(help="full: copy of the log with our topics; sidecar: our topics only; none.")],
    "keep": Annotated[
        _Text, Option(help="Of each drive: metrics, estimates, or full. Default: full, above 50 logs metrics.")
    ],
    "cache": Annotated[
        _Text,
        Option(
            metavar="DIR|URL", help="Keep a slim log of each log there and read that the next time: docs/remote.md."
        ),
    ],
    "cache_max_gb": Annotated[
        float | None,
        Option("--cache-max", metavar="GB", help="What --cache DIR may hold; what was not used for longest goes."),
    ],
    "sensors": Annotated[_Text, Option(help="full, or esp: no wheel speeds in the filters after the start.")],
    "clock": Annotated[
        _Text, Option(help="arrival: samples count when they arrived, as in a car; stamp: by their stamps, not causal.")
    ],
    "friction": Annotated[
        _Text, Option(help="auto (log's, else car's, else estimated), file, estimate, or a number; docs/learn.md")
    ],
    "prefer_truth": Annotated[_Text, Option(help="perfect or rtk: which truth of a simulated log counts.")],
    "msgs": Annotated[_File, Option(metavar="DIR", help="Folder, zip or wheel of .msg files: types a log lacks.")],
    "budget": Annotated[
        float | None, Option(metavar="FACTOR", help="Raise what a log may cost in memory and time: docs/formats.md.")
    ],
    "thresholds": Annotated[_File, Option(help="thresholds.toml: limits on figures; exit code 4 if one is broken.")],
    "config_file": Annotated[_File, Option("--config", help="pdhef.toml; flags win over it.")],
    "network": Annotated[_File, Option(help="Instead of the car's: a folder, default, many-cars, or none.")],
    "intervals": Annotated[_File, Option(help="Instead of the car's: a file of calibrate, unsure (wide), or none.")],
    "calibrate": Annotated[
        _Text, Option(help="A car without evidence, without truth: each log for itself, the pool of all, or off.")
    ],
    "waived": Annotated[
        list[str] | None, Option("--waive", metavar="NAME", help="A failed check that does not count; repeatable.")
    ],
    "allow_private_redirects": Annotated[
        bool | None,
        Option(
            "--allow-private-redirects",
            help="Follow redirects of web servers to other hosts of this machine and its network: docs/remote.md.",
        ),
    ],
    "vehicle": Annotated[_File, Option("--vehicle", "-v", hidden=True)],
    "model": Annotated[_File, Option(hidden=True)],
    "calibration": Annotated[_File, Option(hidden=True)],
    "signal_map": Annotated[_File, Option(hidden=True)],
}
#: Options of old that still work, and what stands for them now.
_ALIASES = {"vehicle": "car", "model": "network", "calibration": "intervals", "signal_map": "mapping"}


def command(
    group: typer.Typer, *examples: str, name: str | None = None, notes: str = "", shared: str = "", car: str = ""
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a function a command; what it takes as ``config`` is the :class:`RunConfig` that the shared options make.

    Parameters
    ----------
    group : commands to add it to.
    examples, notes : what stands below the options: lines as they are typed, and paragraphs.
    name : that of the command; None = the function's.
    shared : shared options beside --mapping, --prefer-truth, --msgs, --budget and --allow-private-redirects, which
        every ``config`` takes.
    car : what --car means to the command, which then has --start and --end too; empty = it has no car.
    """
    wanted = f"mapping prefer_truth budget msgs {shared} {'car vehicle start end' if car else ''}".split()
    wanted.append("allow_private_redirects")
    wanted += ["cache_max_gb"] * ("cache" in wanted)
    taken = {key: option for key, option in _OPTIONS.items() if key in wanted}
    if car:
        taken["car"] = Annotated[_File, Option(help=f"{car}: a folder, or a bare vehicle.toml.")]
    # \b keeps the lines of a paragraph as they are.
    epilog = "\n  ".join(("\b\nExamples:", *examples)) + f"\n\n{notes}" if examples else None

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        given = signature(function).parameters

        @functools.wraps(function)
        def run_command(**values: Any) -> None:
            if isinstance(output := values.get("output"), Path):
                from pdhef_logtool.records.outputs import local_path

                values["output"] = local_path(output)
            if "config" in given:
                values["config"] = run_config({key: values.pop(key) for key in taken})
            function(**values)

        # Typer reads a command's options off its signature, where the shared ones stand in the place of ``config``.
        hints = get_type_hints(function, localns={"RunConfig": object}, include_extras=True)
        options = [Parameter(key, Parameter.KEYWORD_ONLY, default=None, annotation=o) for key, o in taken.items()]
        parameters: list[Parameter] = []
        for key, parameter in given.items():
            own = parameter.replace(kind=Parameter.KEYWORD_ONLY, annotation=hints[key])
            parameters += options if key == "config" else [own]
        run_command.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        run_command.__annotations__ = {p.name: p.annotation for p in parameters}
        return group.command(name, epilog=epilog)(run_command)

    return decorate


def run_config(options: dict[str, Any]) -> RunConfig:
    """Return the configuration of the shared options as given on the command line (None = not given).

    Raises
    ------
    UsageError
        A value is none of those allowed, or an option and its alias are both given.
    """
    from pdhef_logtool.runs.config import load_config

    flags = {key: value for key, value in options.items() if value not in (None, [])}
    for alias in [a for a in _ALIASES if a in flags]:
        now = _ALIASES[alias]
        say(f"notice: --{alias.replace('_', '-')} is now --{now}")
        if now in flags:
            raise UsageError(expected=f"--{now} or its alias", got="both", where=f"--{now}")
        flags[now] = flags.pop(alias)
    if "estimators" in flags:
        flags["estimators"] = split_names(flags["estimators"])
    return load_config(flags.pop("config_file", None), flags)


def split_names(text: str) -> tuple[str, ...]:
    """Split a comma-separated list."""
    return tuple(name.strip() for name in text.split(",") if name.strip())
