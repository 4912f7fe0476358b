"""The command line, called in this process."""

import io
import os
import signal
import subprocess
from collections.abc import Callable
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from pdhef_logtool.cli.app import app, main
from pdhef_logtool.cli.printing import print_template


def pdhef(*arguments: object) -> None:
    """Run a command that ends well."""
    assert not app([str(a) for a in arguments], prog_name="pdhef", standalone_mode=False)


def rendered(render: Callable[[Any, Console], None], result: object, width: int = 80) -> str:
    """Return what a command prints of its result."""
    out = io.StringIO()
    render(result, Console(file=out, width=width, highlight=False, markup=False, no_color=True))
    return out.getvalue()


def printed(template: str, result: object, width: int = 80, **fields: object) -> str:
    """Return what a command with a template prints of its result."""
    return rendered(lambda r, console: print_template(template, console, r=r, **fields), result, width)


def called(
    *arguments: object, cwd: Path | None = None, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run a command as its own process would, and return its exit code and streams.

    A process takes two seconds to start. Start one to test signals, the streams themselves or loaded modules.
    """
    words = [str(a) for a in arguments]
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    out, errors = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch, chdir(cwd or Path.cwd()):
        patch.setattr("sys.argv", ["pdhef", *words])
        for name, value in {"COLUMNS": "100", **(env or {})}.items():
            patch.setitem(os.environ, name, value)
        try:
            with redirect_stdout(out), redirect_stderr(errors), pytest.raises(SystemExit) as ended:
                main()
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    return subprocess.CompletedProcess(words, int(ended.value.code or 0), out.getvalue(), errors.getvalue())
