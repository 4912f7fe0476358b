"""Ctrl-C and termination: the first request ends a command in order, the second one at once."""

import signal
import sys
from typing import Any

#: Exit code of a command that a signal ended, minus the number of the signal.
_SIGNAL_BASE = 128
_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


class Stopped(BaseException):
    """Request to end the command, which handlers of errors or of Ctrl-C do not catch."""

    def __init__(self, number: int) -> None:
        self.exit_code = _SIGNAL_BASE + number
        super().__init__(_WORDS[signal.Signals(number)])


#: The last request to end, kept in case that code swallows the exception.
_came: Stopped | None = None


def watch() -> None:
    """Make signals that end a command raise :class:`Stopped`; signals that the caller ignores stay ignored."""
    for number in _WORDS:
        if signal.getsignal(number) not in (signal.SIG_IGN, None):
            signal.signal(number, _stop)


def came() -> Stopped | None:
    """Return the signal that asked this process to end; None before one came."""
    return _came


def check() -> None:
    """Raise :class:`Stopped` again if code such as a callback of the compiler has swallowed it."""
    if _came is not None:
        raise _came


def tell(stop: Stopped, error: BaseException) -> int:
    """Print the request to end with the notes of the propagated ``error``; return the exit code."""
    notes = getattr(error, "__notes__", [])
    text = "; ".join([f"pdhef: {stop}", "no output file was left incomplete", *notes])
    print(text, file=sys.stderr)  # noqa: T201
    return stop.exit_code


def _stop(number: int, _frame: Any) -> None:
    global _came
    for other in _WORDS:
        signal.signal(other, signal.SIG_DFL)
    _came = Stopped(number)
    raise _came
