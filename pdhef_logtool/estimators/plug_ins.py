"""Isolation of estimators of other packages: their errors, their output, and their writes to shared data."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from threading import RLock
from traceback import extract_tb
from typing import Any

from pdhef_logtool.records.errors import EstimatorError, PdhefError

_PACKAGE = __name__.partition(".")[0]
#: One plug-in runs at a time: standard output belongs to the whole process.
_ONE_AT_A_TIME = RLock()


def package_of(code: Any) -> str:
    """Return the package that an estimator, a class or a function belongs to; empty for this one."""
    module = getattr(code, "__module__", type(code).__module__)
    package = str(module).partition(".")[0]
    return "" if package == _PACKAGE else package


@contextmanager
def contained(name: str, package: str) -> Iterator[None]:
    """Run the code of ``package`` for the estimator ``name``; code of this package (empty) runs without isolation.

    Output is redirected to stderr.

    Raises
    ------
    EstimatorError
        It raised an exception, or tried to end the process.
    """
    if not package:
        yield
        return
    try:
        with _ONE_AT_A_TIME, redirect_stdout(sys.stderr):
            yield
    except PdhefError:
        raise
    except (Exception, SystemExit) as error:
        frames = extract_tb(error.__traceback__)
        last = next((f for f in reversed(frames) if package in f.filename), frames[-1])
        got = f"{type(error).__name__}: {error} ({Path(last.filename).name}, line {last.lineno})"
        raise EstimatorError(expected="an estimator that runs", got=got, where=f"{name} (plug-in {package})") from error
