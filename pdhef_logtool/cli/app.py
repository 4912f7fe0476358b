"""The command line ``pdhef``: each command parses, calls one public function, and prints."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from pdhef_logtool.cli import comparing, compiling, inspecting, learning, reporting, running, simulating, stopping
from pdhef_logtool.cli.console import say
from pdhef_logtool.cli.removed_commands import replacement
from pdhef_logtool.records.errors import EXIT_FAILURE, EXIT_OK, PdhefError
from pdhef_logtool.records.files import OF_WRITING, cannot_write

#: The error of a word that no command takes; it belongs to click, or to the copy of it that newer typers carry.
_WrongWord: type[Any] = typer.BadParameter.__bases__[0]
_INTERRUPTED = 130
#: Whoever read the output has had enough, as of any command in a pipe.
_NOT_READ = 141
#: Standard input, output and error.
_STREAMS = 3

app = typer.Typer(
    name="pdhef",
    cls=simulating.CommandGroup,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
    help="Estimate sideslip on recorded drives (MCAP, rosbag1, rosbag2), score it against truth, annotate the logs.",
    epilog="Exit codes: 0 ok, 1 failure, 2 usage, 3 finished but some input was lost, a check or some logs failed, "
    "4 a threshold or regression gate failed, 130 interrupted (Ctrl-C), 141 nobody read the output to its end, "
    "143 terminated.",
)
for _group in (inspecting, running, reporting, comparing, simulating, learning, compiling):
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
    open_standard_streams()
    stopping.watch()
    try:
        code = _run()
    except BaseException as error:
        if (stop := stopping.came()) is None:
            raise
        # Whatever came up: the request to end may have been swallowed, or have become another error, on its way.
        if isinstance(error, Exception) and os.environ.get("PDHEF_TRACEBACK"):
            raise
        code = stopping.tell(stop, error)
    sys.exit(code)


def _run() -> int:
    try:
        code = app(prog_name="pdhef", standalone_mode=False) or EXIT_OK
        if code == _INTERRUPTED:
            raise KeyboardInterrupt
        sys.stdout.flush()
    except PdhefError as error:
        stopping.check()
        say(f"pdhef: {error}")
        return error.exit_code
    except _WrongWord as error:
        if len(sys.argv) == 1:
            error.show()  # pdhef alone is asked for its help
        elif message := replacement(sys.argv[1:]):
            say(f"pdhef: {message}")
        else:
            command = error.ctx.command_path if error.ctx else "pdhef"
            say(f"{command}: {' '.join(error.format_message().split()).rstrip('.')}; see {command} --help")
        return int(error.exit_code)
    except (KeyboardInterrupt, typer.Abort) as error:
        return stopping.tell(stopping.Stopped(signal.SIGINT), error)
    except (BrokenPipeError, SystemExit) as error:
        if isinstance(error, SystemExit) and not isinstance(error.__context__, BrokenPipeError):
            raise
        _drop_stdout()  # click has made an exit of it where it came up in a command
        return _NOT_READ
    except Exception as error:
        stopping.check()
        if isinstance(error, OSError) and error.errno in OF_WRITING:
            _drop_stdout()
            say(f"pdhef: {cannot_write(Path(error.filename or 'standard output'), error)}")
            return EXIT_FAILURE
        if os.environ.get("PDHEF_TRACEBACK"):
            raise
        say(f"pdhef: internal error, {type(error).__name__}: {error}; PDHEF_TRACEBACK=1 shows where, please report it")
        return EXIT_FAILURE
    return int(code)


def open_standard_streams() -> None:
    """Put the null device in the place of standard streams that are closed: else outputs would get their numbers."""
    while (number := os.open(os.devnull, os.O_RDWR)) < _STREAMS:
        os.set_inheritable(number, True)
    os.close(number)
    sys.stdout = sys.stdout or open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115


def _drop_stdout() -> None:
    """Send what is still to be printed nowhere, so that the end of the process does not fail on it again."""
    with contextlib.suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)
