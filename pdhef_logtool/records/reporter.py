"""Progress, warnings and notes of a running command, each as a line for users."""

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Reporter:
    """Receiver of a command's lines, which ignores them by default.

    Attributes
    ----------
    progress : called with a text and the share that is done, in [0, 1].
    warn : called with a warning. note : called with a line of information.
    """

    progress: Callable[[str, float], None] = lambda *_: None
    warn: Callable[[str], None] = lambda *_: None
    note: Callable[[str], None] = lambda *_: None


#: Ignores all lines.
SILENT = Reporter()
