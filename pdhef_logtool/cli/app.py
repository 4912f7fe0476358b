"""The command line ``pdhef``: each command parses, calls one public function, and prints."""

from __future__ import annotations

import os
import sys
from typing import Annotated, Any, NoReturn

import typer

from pdhef_logtool.cli import inspecting, learning, running, simulating
from pdhef_logtool.cli.console import say
from pdhef_logtool.records.errors import EXIT_FAILURE, EXIT_OK, PdhefError

#: The error of a word that no command takes; it belongs to click, or to the copy of it that newer typers carry.
_WrongWord: type[Any] = typer.BadParameter.__bases__[0]
_INTERRUPTED = 130

app = typer.Typer(
    name="pdhef",
    cls=simulating.CommandGroup,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
    help="Estimate sideslip on recorded drives (MCAP, rosbag1, rosbag2), score it against truth, annotate the logs.",
    epilog="Exit codes: 0 ok, 1 failure, 2 usage, 3 finished but some input was lost or some logs failed, "
    "4 a threshold or regression gate failed.",
)
for _group in (inspecting, running, simulating, learning):
    app.registered_commands += _group.commands.registered_commands


def _version(show: bool) -> None:
    if show:
        from pdhef_logtool.records.version import __version__

        print(f"pdhef {__version__}")  # noqa: T201
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    del version


def main() -> NoReturn:
    """Run the command line; every error that a user can repair is one line on stderr and an exit code."""
    try:
        code = app(prog_name="pdhef", standalone_mode=False) or EXIT_OK
        if code == _INTERRUPTED:
            raise KeyboardInterrupt
    except PdhefError as error:
        say(f"pdhef: {error}")
        code = error.exit_code
    except _WrongWord as error:
        if len(sys.argv) == 1:
            error.show()  # pdhef alone is asked for its help
        else:
            command = error.ctx.command_path if error.ctx else "pdhef"
            say(f"{command}: {' '.join(error.format_message().split()).rstrip('.')}; see {command} --help")
        code = error.exit_code
    except (KeyboardInterrupt, typer.Abort):
        say("pdhef: interrupted; nothing half-written was left under its final name")
        code = _INTERRUPTED
    except Exception as error:
        if os.environ.get("PDHEF_TRACEBACK"):
            raise
        say(f"pdhef: internal error, {type(error).__name__}: {error}; PDHEF_TRACEBACK=1 shows where, please report it")
        code = EXIT_FAILURE
    sys.exit(code)
