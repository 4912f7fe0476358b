"""Ctrl-C and termination: the first one ends a command in order, the second one at once."""

from __future__ import annotations

import signal
import sys
from typing import Any

#: What a shell's exit code is counted from when a signal ended a command.
_SIGNAL_BASE = 128
_WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}


class Stopped(BaseException):
    """The command was asked to end; no handler of errors or of Ctrl-C takes it on its way up."""

    def __init__(self, number: int) -> None:
        self.exit_code = _SIGNAL_BASE + number
        super().__init__(_WORDS[signal.Signals(number)])


#: The request to end that came, if one did: code that swallows exceptions cannot lose it.
_came: Stopped | None = None


def watch() -> None:
    """Make signals that end a command raise :class:`Stopped`; those that the caller ignores stay ignored."""
    for number in _WORDS:
        if signal.getsignal(number) not in (signal.SIG_IGN, None):
            signal.signal(number, _stop)


def came() -> Stopped | None:
    """Return the request to end, None if there was none."""
    return _came


def check() -> None:
    """Raise :class:`Stopped` once more if it came and got lost, as in a callback of the compiler."""
    if _came is not None:
        raise _came


def tell(stop: Stopped, error: BaseException) -> int:
    """State what ended and what ``error``, which came up, has notes of; return the exit code."""
    notes = getattr(error, "__notes__", [])
    text = "; ".join([f"pdhef: {stop}", "nothing half-written was left under its final name", *notes])
    print(text, file=sys.stderr)  # noqa: T201
    return stop.exit_code


def _stop(number: int, _frame: Any) -> None:
    global _came
    for other in _WORDS:
        signal.signal(other, signal.SIG_DFL)
    _came = Stopped(number)
    raise _came
