"""``pdhef serve``: the drives of finished runs in a browser of this machine."""

from __future__ import annotations

import socket
from typing import Annotated

import typer
from typer import Argument, Option

from pdhef_logtool.cli import console, options, panels
from pdhef_logtool.records.errors import UsageError
from pdhef_logtool.records.extras import required

commands = typer.Typer()
_LOOPBACK = "127.0.0.1"
_PORT = 8700


@options.command(
    commands,
    "pdhef serve out",
    "pdhef serve before after --open",
    "pdhef serve out --port 0",
    panel=panels.READ,
    notes="The server is reachable from this machine only, and writes nothing. Ctrl-C ends it. It needs: pip install "
    "'pdhef-logtool[serve]'.",
)
def serve(
    outputs: Annotated[list[str], Argument(metavar="OUT", help="Outputs of runs: folders or URLs.")],
    *,
    port: Annotated[int, Option(min=0, max=65535, help="Port on 127.0.0.1; 0 takes a free one.")] = _PORT,
    show: Annotated[bool, Option("--open", help="Open the page in the browser.")] = False,
) -> None:
    """Show the drives of runs in a browser: filter, sort, overlay runs, open a drive, export CSV."""
    required("starlette", "serve", "makes the pages", "pdhef serve")
    uvicorn = required("uvicorn", "serve", "serves the pages", "pdhef serve")
    from pdhef_logtool.reports.server import Library, application
    from pdhef_logtool.results.opened_run import open_run

    library = Library([open_run(output) for output in outputs])
    with _listening(port) as listener:
        address = f"http://{_LOOPBACK}:{listener.getsockname()[1]}/"
        count = library.table.select("run", "drive").n_unique()
        console.say(f"{count} drives of {len(library.runs)} runs at {address} (Ctrl-C ends)")
        if show:
            import webbrowser

            webbrowser.open(address)
        config = uvicorn.Config(application(library), log_level="warning", access_log=False, server_header=False)
        uvicorn.Server(config).run(sockets=[listener])


def _listening(port: int) -> socket.socket:
    """Return a socket on the loopback address; raises UsageError for a port that is in use."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((_LOOPBACK, port))
        listener.listen()  # before the browser opens the page
    except OSError as error:
        listener.close()
        got = f"{port}: {error.strerror or error}"
        raise UsageError(expected="a free port", got=got, where="--port", remedy="--port 0 takes a free one") from error
    return listener
