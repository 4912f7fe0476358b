"""The command line ``pdhef``: each command parses, calls one public function, and prints."""

import contextlib
import importlib
import io
import os
import signal
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from pdhef_logtool.cli import console, options, panels, stopping
from pdhef_logtool.records.errors import EXIT_FAILURE, EXIT_OK, PdhefError, UsageError
from pdhef_logtool.storage.files import OF_WRITING, cannot_write

#: Usage error of click, or of the copy of click in newer versions of typer.
_WrongWord: type[Any] = typer.BadParameter.__bases__[0]
_INTERRUPTED = 130
#: Exit code if the reader of a pipe has closed it.
_NOT_READ = 141
#: Standard input, output and error.
_STREAMS = 3

app = typer.Typer(
    name="pdhef",
    cls=panels.CommandGroup,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
    help="Estimate sideslip on recorded drives (MCAP, rosbag, MDF, VBO, CSV, MAT, ...), score it against ground "
    "truth, and annotate the logs.",
    epilog="Exit codes: 0 ok, 1 failure, 2 usage, 3 finished but some input was lost, a check or some logs failed, "
    "4 a requirement or regression gate failed, 130 interrupted (Ctrl-C), 141 stdout was closed early, 143 terminated.",
)
_MODULES = "inspecting running reporting comparing learning simulating"
for _module in _MODULES.split():
    importlib.import_module(f"{__package__}.{_module}")
app.registered_commands = options.commands.registered_commands


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
    json: Annotated[bool, typer.Option("--json", help="Print one JSON document instead of tables.")] = False,
    quiet: Annotated[
        bool, typer.Option("--quiet", "-q", help="Print errors and results only, no warnings, notes or progress.")
    ] = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Print progress as lines.")] = False,
    no_color: Annotated[
        bool, typer.Option("--no-color", help="Print without colours. NO_COLOR in the environment does the same.")
    ] = False,
) -> None:
    del version
    if quiet and verbose:
        raise UsageError(expected="--quiet or --verbose", got="both", where="pdhef")
    console.set_output(quiet=quiet, verbose=verbose, json=json)
    if no_color:
        os.environ["NO_COLOR"] = "1"


def main() -> NoReturn:
    """Run the command line; each error that a user can repair is one line on stderr and an exit code."""
    open_standard_streams()
    stopping.watch()
    try:
        code = _run()
    except BaseException as error:
        if (stop := stopping.came()) is None:
            raise
        # Any exception: code may have swallowed the request to end, or converted it to another error.
        if isinstance(error, Exception) and os.environ.get("PDHEF_TRACEBACK"):
            raise
        code = stopping.tell(stop, error)
    sys.exit(code)


def _run() -> int:
    try:
        code = app(sys.argv[1:], prog_name="pdhef", standalone_mode=False) or EXIT_OK
        if code == _INTERRUPTED:
            raise KeyboardInterrupt
        sys.stdout.flush()
    except PdhefError as error:
        stopping.check()
        console.error(f"pdhef: {error}")
        return error.exit_code
    except _WrongWord as error:
        if len(sys.argv) == 1:
            error.show()  # pdhef without arguments shows its help
        else:
            command = error.ctx.command_path if error.ctx else "pdhef"
            console.error(f"{command}: {' '.join(error.format_message().split()).rstrip('.')}; see {command} --help")
        return int(error.exit_code)
    except (KeyboardInterrupt, typer.Abort) as error:
        return stopping.tell(stopping.Stopped(signal.SIGINT), error)
    except (BrokenPipeError, SystemExit) as error:
        if isinstance(error, SystemExit) and not isinstance(error.__context__, BrokenPipeError):
            raise
        _drop_stdout()  # within a command, click converts the error to an exit
        return _NOT_READ
    except Exception as error:
        stopping.check()
        if isinstance(error, OSError) and error.errno in OF_WRITING:
            _drop_stdout()
            console.error(f"pdhef: {cannot_write(Path(error.filename or 'standard output'), error)}")
            return EXIT_FAILURE
        if os.environ.get("PDHEF_TRACEBACK"):
            raise
        console.error(
            f"pdhef: internal error, {type(error).__name__}: {error}; please report it with the output of "
            "PDHEF_TRACEBACK=1"
        )
        return EXIT_FAILURE
    return int(code)


def open_standard_streams() -> None:
    """Open the null device for closed standard streams; otherwise, output files would get their descriptors."""
    while (number := os.open(os.devnull, os.O_RDWR)) < _STREAMS:
        os.set_inheritable(number, True)
    os.close(number)
    sys.stdout = sys.stdout or open(1, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    sys.stderr = sys.stderr or open(2, "w", encoding="utf-8", closefd=False)  # noqa: SIM115
    if isinstance(sys.stdout, io.TextIOWrapper) and not sys.stdout.encoding.lower().startswith("utf"):
        sys.stdout.reconfigure(errors="backslashreplace")  # code pages of Windows lack characters such as ≤


def _drop_stdout() -> None:
    """Discard all further output, so that the end of the process does not fail on it again."""
    with contextlib.suppress(OSError, ValueError):
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, sys.stdout.fileno())
        os.close(null)
