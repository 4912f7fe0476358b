"""Commands from functions: ``commands.toml`` describes their parameters; shared options become the configuration."""

import tomllib
from collections.abc import Callable
from functools import cache, wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
from typer import Argument, Option

from pdhef_logtool.cli.panels import PanelCommand
from pdhef_logtool.records.errors import UsageError

if TYPE_CHECKING:
    from pdhef_logtool.runs.config import RunConfig

#: Types of the shared options that become the configuration of a run.
_KINDS = {"text": str | None, "texts": list[str] | None, "file": Path | None, "flag": bool | None}
#: Shared options of every command that has a configuration.
_FILE_AND_SETTINGS = ("config_file", "assignments")


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


@cache
def _texts() -> dict[str, dict[str, Any]]:
    """Return the table of each command, and the shared options."""
    return tomllib.loads((Path(__file__).parent / "commands.toml").read_text(encoding="utf-8"))


#: All commands, in the order of their registration.
commands = typer.Typer()


def command(name: str | None = None) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make a function a command; its parameter ``config`` receives the :class:`RunConfig` from the shared options.

    Positional parameters are arguments, keyword-only ones options. ``commands.toml`` describes them, the command's
    panel, and the text below its options: command lines, and paragraphs. ``name``: None: of the function.
    """

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        called, given = name or function.__name__.rstrip("_"), signature(function).parameters
        shared, texts = _texts()["shared"], _texts()[called]
        wanted = (*texts.get("settings", "").split(), *_FILE_AND_SETTINGS)
        settings = [
            Parameter(key, Parameter.KEYWORD_ONLY, default=None, annotation=_KINDS[option["kind"]])
            for key, option in shared.items()
            if key in wanted
        ]

        @wraps(function)
        def run_command(**values: Any) -> None:
            if isinstance(output := values.get("output"), Path):
                from pdhef_logtool.storage.outputs import local_path

                values["output"] = local_path(output)
            if "config" in given:
                values["config"] = run_config({p.name: values.pop(p.name) for p in settings})
            function(**values)

        # Typer reads the options from the signature, in which the shared options replace ``config``.
        hints = get_type_hints(function, localns={"RunConfig": object}, include_extras=True)
        parameters = [
            _described(p, shared.get(p.name, {}) | texts.get("options", {}).get(p.name, {}))
            for key, parameter in given.items()
            for p in (settings if key == "config" else [parameter.replace(annotation=hints[key])])
        ]
        run_command.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
        run_command.__annotations__ = {p.name: p.annotation for p in parameters}
        # \b keeps the lines of a paragraph as they are.
        epilog = "\n  ".join(("\b\nExamples:", *texts["examples"].splitlines())) + f"\n\n{texts.get('notes', '')}"
        return commands.command(called, epilog=epilog, cls=PanelCommand, rich_help_panel=texts["panel"])(run_command)

    return decorate


def _described(parameter: Parameter, text: dict[str, str]) -> Parameter:
    """Return a parameter of a command with its entry of ``commands.toml``; a type with its own option keeps that."""
    kind, metavar, words = parameter.annotation, text.get("metavar"), text.get("help")
    info: Any = Argument(metavar=metavar, help=words, show_default=False)
    if parameter.kind is Parameter.KEYWORD_ONLY:
        is_flag = kind in (bool, bool | None) and not parameter.default  # without a --no- option
        names = text.get("names", f"--{parameter.name.replace('_', '-')}" if is_flag else "").split()
        info = Option(*names, metavar=metavar, help=words, rich_help_panel=text.get("panel"))
    annotation = Annotated[kind, info] if text else kind
    return parameter.replace(kind=Parameter.KEYWORD_ONLY, annotation=annotation)


def run_config(options: dict[str, Any]) -> "RunConfig":
    """Return the configuration from the shared options of a command line (None = not set).

    Raises
    ------
    UsageError
        A value is not allowed, or ``--set`` contains an unknown setting.
    """
    from pdhef_logtool.runs.config import load_config, parse_assignments

    assigned = parse_assignments(options.pop("assignments", None) or ())
    path = options.pop("config_file", None)
    flags = {k: ",".join(v) if isinstance(v, list) else v for k, v in options.items() if v not in (None, [])}
    return load_config(path, assigned | flags)
